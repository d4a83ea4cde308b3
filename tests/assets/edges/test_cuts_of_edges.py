"""Kerbs, sidewalks and road edges of a drawn road are the same however squares are cut: within 1 mm."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
import shapely
from scipy.spatial import cKDTree

from roadscan.assets.edges.line_pieces import cut_at, joined_lines, node_names, pieces_table, ribbon
from roadscan.assets.edges.steps import raster_of
from roadscan.assets.edges.tracks import tracks_of
from roadscan.assets.kind import AssetObject
from roadscan.assets.kinds.kerb import Kerb, KerbOptions
from roadscan.assets.kinds.road_edge import RoadEdge, RoadEdgeOptions
from roadscan.assets.kinds.sidewalk import Sidewalk, SidewalkOptions
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from tests.assets.edges.streets import returns_of

Float64 = npt.NDArray[np.float64]

KINDS = ((Kerb(), KerbOptions()), (Sidewalk(), SidewalkOptions()), (RoadEdge(), RoadEdgeOptions()))
LENGTH_M = 90.0
STRAIGHT_M = 30.0
"""Straight part before the curve (m)."""
HALO_M, DRIVE_M = max(kind.reach_m for kind, _ in KINDS), 8.0
"""Scenes reach so far beyond their squares, and their drives so much farther, as a run with all kinds has them."""
SAME_M = 1e-3


def middle_at(station: Float64, radius_m: float) -> tuple[Float64, Float64, Float64]:
    """Place and heading of the middle of a road that turns left by 90°; an infinite radius: of a straight one."""
    turned = np.clip((station - STRAIGHT_M) / radius_m, 0.0, math.pi / 2.0)
    before, begin = np.minimum(station, STRAIGHT_M), math.radians(8.0 if math.isfinite(radius_m) else 17.0)
    if not math.isfinite(radius_m):
        return station * math.cos(begin), station * math.sin(begin), np.full_like(station, begin)
    after = np.maximum(station - STRAIGHT_M - radius_m * math.pi / 2.0, 0.0)
    heading = begin + turned
    x = before * math.cos(begin) + radius_m * (np.sin(heading) - math.sin(begin)) - after * math.sin(begin)
    y = before * math.sin(begin) - radius_m * (np.cos(heading) - math.cos(begin)) + after * math.cos(begin)
    return x, y, heading


def drawn_road(radius_m: float, seed: int = 5) -> Scene:
    """A road that falls to both sides, seen unevenly with 8 mm of noise.

    On the left a kerb of 12 cm, lowered to 3 cm between 50 and 55 m and hidden by a car at 22 m, a sidewalk of 2 m and
    a wall; a fence at the kerb's foot from 65 m on; on the right a verge that falls by 20 % from 4.5 m on.
    """
    draw = np.random.default_rng(seed)
    s, o = (v.ravel() for v in np.meshgrid(np.arange(0.0, LENGTH_M, 0.07), np.arange(-8.0, 5.6, 0.07)))
    s, o = s + draw.uniform(-0.03, 0.03, s.size), o + draw.uniform(-0.03, 0.03, o.size)
    kerb = np.where((s > 50.0) & (s < 55.0), 0.03, 0.12) + 0.02 * (o - 3.5)
    z = 100.0 + 0.01 * s - 0.02 * np.abs(np.clip(o, -4.5, 3.5)) + np.where(o > 3.5, kerb, 0.0)
    z += np.where(o < -4.5, 0.2 * (o + 4.5), 0.0) + draw.normal(0.0, 0.008, s.size)
    share = draw.uniform(0.1, 1.2, (40, 8))[(s / 2.5).astype(int), ((o + 8.5) / 2.5).astype(int)]
    seen = (draw.random(s.size) < share) & ~((s > 20.0) & (s < 24.0) & (o > 2.0) & (o < 4.2))
    wall_s, wall_z = (v.ravel() for v in np.meshgrid(np.arange(0.0, LENGTH_M, 0.07), np.arange(0.0, 2.5, 0.07)))
    fence_s, fence_z = draw.uniform(65.0, LENGTH_M, 6000), draw.uniform(0.0, 1.1, 6000)
    s = np.concatenate([s[seen], wall_s, fence_s])
    o = np.concatenate([o[seen], np.full(wall_s.size, 5.62), draw.normal(3.5, 0.02, fence_s.size)])
    z = np.concatenate([z[seen], 100.1 + 0.01 * wall_s + wall_z, 100.0 + 0.01 * fence_s + fence_z])
    x, y, heading = middle_at(s, radius_m)
    places = np.column_stack([x - o * np.sin(heading), y + o * np.cos(heading), z])
    sensor = np.column_stack([x, y, np.full(s.size, 102.0)])
    returns = returns_of(places, np.full(s.size, 1000.0), np.arange(s.size), sensor)
    x, y, _ = middle_at(np.arange(0.0, LENGTH_M, 0.35), radius_m)
    drive = np.column_stack([x, y, np.full(x.size, 102.0), np.ones(x.size)])
    box = around(Box(*places[:, :2].min(axis=0), *places[:, :2].max(axis=0)), 2.0)
    return make_scene(returns, box, box, drive)


def around(box: Box, reach_m: float) -> Box:
    """A box that ends at multiples of 3 m, as those of scenes do."""
    least = (3.0 * math.floor((side - reach_m) / 3.0) for side in box[:2])
    return Box(*least, *(3.0 * math.ceil((side + reach_m) / 3.0) for side in box[2:]))


def parts_of(scene: Scene, edge_m: float, corner_m: Sequence[float]) -> Iterator[Scene]:
    """Scenes of squares through a corner, with what a search of one square alone sees."""
    first = [math.floor((side - at) / edge_m) for side, at in zip(scene.window[:2], corner_m, strict=True)]
    last = [math.floor((side - at) / edge_m) for side, at in zip(scene.window[2:], corner_m, strict=True)]
    for row in range(first[1], last[1] + 1):
        for column in range(first[0], last[0] + 1):
            x, y = corner_m[0] + column * edge_m, corner_m[1] + row * edge_m
            tile = Box(x, y, x + edge_m, y + edge_m)
            window = around(tile, HALO_M)
            rows = window.holds(scene.returns.x_m, scene.returns.y_m)
            driven = around(window, DRIVE_M).holds(*scene.drive_xyh_m[:, :2].T)
            yield Scene(
                scene.returns.at(rows), tile, window, scene.ground, scene.above_ground_m[rows], scene.classes[rows],
                scene.drive_xyh_m[driven], scene.statistics,
            )  # fmt: skip


def objects_in(scenes: list[Scene]) -> list[list[AssetObject]]:
    """Objects by kind, joined from the pieces of all scenes."""
    return [
        list(
            kind.objects(
                kind.joined(pa.concat_tables([kind.evidence(scene, options).pieces for scene in scenes])), options, {}
            )
        )
        for kind, options in KINDS
    ]


def apart_m(some: list[AssetObject], others: list[AssetObject]) -> float:
    """Greatest distance of a place of the lines and outlines of some objects from those of others (m)."""
    lines = shapely.union_all([one.geometry if one.geometry.geom_type == "LineString" else one.geometry.boundary
                               for one in others])  # fmt: skip
    places = np.concatenate([shapely.get_coordinates(shapely.segmentize(one.geometry, 0.1)) for one in some])
    return float(shapely.distance(shapely.points(places), lines).max())


@pytest.mark.parametrize("radius_m", [math.inf, 20.0])
def test_any_cut_gives_the_same_edges(radius_m: float) -> None:
    scene, draw = drawn_road(radius_m), np.random.default_rng(11)
    whole = objects_in([scene])
    assert [len(found) >= 1 for found in whole] == [True, True, True]
    for edge_m in (30.0, 40.0, 55.0):
        cut = objects_in(list(parts_of(scene, edge_m, draw.uniform(0.0, edge_m, 2))))
        for ours, other in zip(whole, cut, strict=True):
            assert max(apart_m(ours, other), apart_m(other, ours)) <= SAME_M, edge_m
            assert sorted(str(one.attributes.get("type")) for one in ours) == sorted(
                str(one.attributes.get("type")) for one in other
            )
            lengths = [sorted(one.attributes["length_m"] for one in some) for some in (ours, other)]
            np.testing.assert_allclose(*lengths, atol=0.01)


@pytest.mark.parametrize("radius_m", [math.inf, 20.0])
def test_stations_of_a_drive_are_the_same_wherever_it_enters(radius_m: float) -> None:
    """Places and headings from 8.5 m behind the entry on: the next crossing of the lattice, and a heading's reach."""
    x, y, _ = middle_at(np.arange(0.0, LENGTH_M, 0.35), radius_m)
    drive = np.column_stack([x, y, np.full(x.size, 102.0), np.ones(x.size)])
    (whole,) = tracks_of(drive)
    for first, last in ((17, 211), (40, 160), (93, x.size)):
        (part,) = tracks_of(drive[first:last])
        inner = shapely.LineString(drive[first + 25 : last - 25, :2]).buffer(0.01, cap_style="flat")
        inside = shapely.contains_xy(inner, part.places)
        away, at = cKDTree(whole.places).query(part.places[inside])
        assert inside.sum() > 40 and away.max() < 1e-9
        assert np.abs(part.heading[inside] - whole.heading[at]).max() < 1e-9


def test_a_line_with_a_node_on_a_border_is_one_line() -> None:
    """Squares end at x = 10 and x = 20, where nodes lie, and at y = 0.75, between nodes."""
    scene = drawn_road(math.inf)
    at = np.arange(0.0, 30.5, 0.5)
    nodes = np.zeros((at.size, len(Kerb.piece_schema.names) - 6))
    nodes[:, 0], nodes[:, 1], nodes[:, 2] = at, 0.05 * at, np.sin(at)
    tables = []
    for x in (0.0, 10.0, 20.0, 30.0):
        for low, high in ((-5.0, 0.76), (0.76, 5.0)):
            parts = cut_at(nodes, Box(x, low, x + 10.0, high))
            tables.append(pieces_table(parts, scene, raster_of(scene), Kerb.piece_schema))
    (line,) = joined_lines(pa.concat_tables(tables))
    np.testing.assert_array_equal(line.nodes, nodes)


def test_a_kerb_that_is_cut_at_its_corner_is_one() -> None:
    """Pieces of 5 m that meet at a right angle on the border of two squares."""
    schema, along = Kerb.piece_schema, np.arange(0.0, 5.1, 0.5)
    rows = []
    for x, y, cut in ((along, 0.0 * along, (False, True)), (5.0 + 0.0 * along, along, (True, False))):
        nodes = {name: np.zeros(along.size) for name in node_names(schema)} | {"easting_m": x, "northing_m": y}
        rows.append(nodes | {"returns": 9, "passes": [1], "first_epoch_gps_ns": 1, "last_epoch_gps_ns": 2,
                             "cut_first": cut[0], "cut_last": cut[1]})  # fmt: skip
    (line,) = joined_lines(pa.Table.from_pylist(rows, schema=schema))
    assert np.ptp(line.nodes[:, 0]) == np.ptp(line.nodes[:, 1]) == 5.0


def drawn_roundabout(radius_m: float, seed: int) -> Scene:
    """An island with a kerb of 12 cm, a carriageway of 8 m that falls inward, and a kerb of 11 cm around it.

    Seen unevenly with 8 mm of noise by a drive that goes round once and a third.
    """
    draw, outer_m = np.random.default_rng(seed), radius_m + 8.0
    side = np.arange(-outer_m - 2.0, outer_m + 2.0, 0.07)
    x, y = (v.ravel() + draw.uniform(-0.03, 0.03, v.size) for v in np.meshgrid(side, side))
    away = np.hypot(x, y)
    z = 100.0 + 0.02 * np.clip(away, radius_m, outer_m) + np.where(away < radius_m, 0.12, 0.0)
    z += np.where(away > outer_m, 0.11, 0.0) + draw.normal(0.0, 0.008, x.size)
    share = draw.uniform(0.2, 1.2, (40, 40))[((x - side[0]) / 2.5).astype(int), ((y - side[0]) / 2.5).astype(int)]
    places = np.column_stack([x, y, z])[draw.random(x.size) < share] + [3.3, -2.1, 0.0]
    turn = np.arange(0.0, 8.4, 0.3 / (radius_m + 4.0))
    drive = np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn, 0.0 * turn]) * (radius_m + 4.0)
    drive += [3.3, -2.1, 102.0, 1.0]
    sensor = np.tile([3.3, -2.1, 102.0], (len(places), 1))
    returns = returns_of(places, np.full(len(places), 1000.0), np.arange(len(places)), sensor)
    box = around(Box(*places[:, :2].min(axis=0), *places[:, :2].max(axis=0)), 2.0)
    return make_scene(returns, box, box, drive)


@pytest.mark.parametrize("radius_m", [2.0, 6.0])
def test_lines_around_a_roundabout_are_closed_and_begin_at_their_westernmost_node(radius_m: float) -> None:
    scene, draw = drawn_roundabout(radius_m, 4), np.random.default_rng(12)
    whole = objects_in([scene])
    for edge_m in (16.0, 90.0):
        cut = objects_in(list(parts_of(scene, edge_m, draw.uniform(0.0, edge_m, 2))))
        for k in (0, 2):
            both = (sorted(some[k], key=lambda one: one.geometry.length) for some in (whole, cut))
            for ours, other in zip(*both, strict=True):
                nodes, others = (shapely.get_coordinates(one.geometry) for one in (ours, other))
                assert ours.geometry.is_closed and other.geometry.is_closed
                assert nodes[0, 0] == nodes[:, 0].min()
                np.testing.assert_allclose(nodes, others, atol=SAME_M)
            assert len(whole[k]) == len(cut[k]) == 2
        assert max(apart_m(whole[1], cut[1]), apart_m(cut[1], whole[1])) <= 0.02  # outlines are simplified by 20 mm


def test_a_strip_around_a_roundabout_leaves_its_inside_free() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 81)
    inner, outer = (np.column_stack([r * np.cos(turn), r * np.sin(turn), 0.0 * turn]) for r in (8.0, 10.0))
    around = ribbon(inner, outer)
    assert around is not None
    assert around.area == pytest.approx(np.pi * (10.0**2 - 8.0**2), rel=0.02)
    assert around.has_z
