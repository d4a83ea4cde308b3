"""Squares, clusters of them, the order of returns, and where sensors stood and assets lie."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roadscan.assets.kind import asset_kinds
from roadscan.assets.make_scene import CLASSES_REACH_M
from roadscan.assets.settings import AssetsConfig, GroundSettings
from roadscan.assets.tasks.load_returns import _Columns, in_order
from roadscan.assets.tasks.objects import clustered
from roadscan.assets.tasks.plan import halos_of
from roadscan.assets.tasks.tables import along_roads
from roadscan.assets.tiling import AssetGrid, Halos
from roadscan.condition.road_line import Lane, RoadLine, Roads
from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.rig import Mounting, Mountings
from roadscan.georeference.sensor_places import sensor_places
from roadscan.poses.trajectory import Trajectory


def grid_of(per_edge: int) -> AssetGrid:
    return AssetGrid(TileGrid(10.0, 0.1), per_edge, Halos(14.0, 22.0, 68.0))


def test_squares_are_whole_tiles_and_look_as_far_as_their_halos() -> None:
    grid = grid_of(4)
    assert grid.of_tile(TileId(-1, 7)) == TileId(-1, 1)
    assert grid.own_box(TileId(1, 0)) == (40.0, 0.0, 80.0, 40.0)
    assert grid.scene_box(TileId(1, 0)) == (24.0, -15.0, 96.0, 54.0)
    assert grid.classes_box(TileId(1, 0)) == (18.0, -24.0, 102.0, 63.0)
    assert grid.ground_box(TileId(1, 0)) == (-48.0, -72.0, 168.0, 120.0)
    under = grid.tiles_under(TileId(1, 0))
    assert (under[0], under[-1]) == (TileId(-5, -8), TileId(16, 11))


def test_a_place_has_the_same_coordinates_in_squares_of_any_edge() -> None:
    tile = TileId(23, -150)
    origins = {grid.origin_m(grid.of_tile(tile)) for grid in map(grid_of, (4, 6, 8, 12))}
    assert origins == {(0.0, -1920.0)}
    for grid in map(grid_of, (4, 6, 8, 12)):
        assert grid.own_box(grid.of_tile(tile)).holds(235.0, 1920.0 - 1495.0)


def test_halos_follow_from_what_reads_them() -> None:
    halos = halos_of(AssetsConfig())
    kinds = asset_kinds().values()
    assert halos.scene_m == max(kind.reach_m for kind in kinds) >= 14.0
    assert halos.classes_m == halos.scene_m + CLASSES_REACH_M
    assert halos.ground_m >= halos.classes_m + 2.0 * GroundSettings().largest_object_m
    wider = AssetsConfig.parse({"ground": {"largest_object_m": 30.0}})
    assert halos_of(wider).ground_m == halos.ground_m + 24.0
    with pytest.raises(ConfigError, match="remove this line"):
        AssetsConfig.parse({"halo_m": 8.0})


def test_squares_that_touch_are_one_cluster() -> None:
    squares = [TileId(c, r) for c, r in ((5, 0), (0, 0), (1, 1), (2, 1), (2, 3), (5, 1))]
    expected = [((0, 0), (1, 1), (2, 1)), ((5, 0), (5, 1)), ((2, 3),)]
    for order in (squares, squares[::-1]):
        assert [tuple(map(tuple, c)) for c in clustered(dict.fromkeys(order))] == expected


def columns(seed: int, count: int = 400) -> _Columns:
    """Returns in random order, many of them with equal epochs and lasers."""
    random = np.random.default_rng(seed)
    few = [random.integers(0, n, count) for n in (3, 40, 4)]
    place = [random.integers(0, 10**6, count).astype(np.int32) for _ in range(3)]
    ones = np.ones(count, np.uint8)
    intensity = random.integers(0, 9, count).astype(np.uint16)
    return _Columns(
        few[0].astype(np.uint16), few[1] + 10**18, few[2].astype(np.uint16), *place, intensity, intensity, ones, ones
    )  # fmt: skip


def test_the_order_of_returns_does_not_depend_on_how_they_came() -> None:
    came = columns(7)
    ordered = in_order(came)
    other = in_order(came.at(np.random.default_rng(1).permutation(came.x.size)))
    for one, two in zip(ordered, other, strict=True):
        np.testing.assert_array_equal(one, two)
    by_hand = sorted(zip(came.source, came.epoch_gps_ns, came.laser, came.x, strict=True))
    assert list(zip(ordered.source, ordered.epoch_gps_ns, ordered.laser, ordered.x, strict=True)) == by_hand


def test_a_sensor_stood_where_its_poses_say() -> None:
    """A vehicle on a circle of 30 m at 12 m/s in a local frame, the sensor 2 m before and 1.5 m above its origin."""
    epoch = 10**18 + np.arange(0, 8 * 10**9, 10**7)
    angle = 12.0 / 30.0 * (epoch - epoch[0]) / 1e9
    place = np.column_stack([30 * np.sin(angle), 30 * np.cos(angle), np.full(angle.size, 100.0)])
    heading = np.pi / 2 + angle  # clockwise from north
    axes = np.stack([np.sin(heading), np.cos(heading), 0 * heading, np.cos(heading), -np.sin(heading), 0 * heading,
                     0 * heading, 0 * heading, -1 + 0 * heading], -1).reshape(-1, 3, 3).transpose(0, 2, 1)  # fmt: skip
    turned = Rotation.from_matrix(axes).as_quat(scalar_first=True)
    trajectory = Trajectory.of("local", epoch, place, turned)
    mountings = Mountings.one(Mounting((2.0, 0.0, -1.5), ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))))
    frame = MapFrame(None)
    at = epoch[0] + np.random.default_rng(3).integers(-(10**9), 9 * 10**9, 5000)
    found = sensor_places(trajectory, frame, mountings, at)
    inside = (at >= epoch[0]) & (at <= epoch[-1])
    assert np.isnan(found[~inside]).all()
    way = 12.0 / 30.0 * (at - epoch[0]) / 1e9
    true = np.column_stack([
        30 * np.sin(way) + 2 * np.sin(np.pi / 2 + way), 30 * np.cos(way) + 2 * np.cos(np.pi / 2 + way),
        np.full(way.size, 101.5),
    ])  # fmt: skip
    assert np.abs(found - true)[inside].max() < 1e-3
    alone = np.concatenate([sensor_places(trajectory, frame, mountings, at[k : k + 1]) for k in range(40)])
    np.testing.assert_array_equal(alone, found[:40])


def test_assets_lie_along_the_nearest_road() -> None:
    straight = RoadLine("a", np.column_stack([np.arange(101.0), np.zeros(101)]), first_m=200)
    across = RoadLine("b", np.column_stack([np.full(101, 130.0), np.arange(101.0)]))
    lanes = (Lane("a", "1", -1, 200, np.full(101, -1.75), 3.5, "default", (1,)),
             Lane("a", "north", 1, 200, np.full(101, 1.75), 3.5, "default", (2,)))  # fmt: skip
    places = np.array([[30.0, -2.0], [30.25, 2.5], [60.0, 12.0], [125.0, 40.0], [105.0, 0.0], [40.0, 60.0]])
    found = along_roads(places, Roads({"b": across, "a": straight}, lanes))
    assert found.road == ["a", "a", "a", "b", None, None]
    assert found.station_m[:4] == pytest.approx([230.0, 230.25, 260.0, 40.0], abs=1e-6)
    assert found.offset_m[:4] == pytest.approx([2.0, -2.5, -12.0, -5.0], abs=1e-6)
    assert found.lane == [2, 1, None, None, None, None]
    assert np.isnan(found.station_m[4:]).all()
    assert along_roads(places, Roads({}, ())).road == [None] * 6
