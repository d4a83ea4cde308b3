"""What hides things: voxels of a scene with a wall, a post and a car, and lines of sight through them."""

from __future__ import annotations

import numpy as np
import shapely

from roadscan.assets import classes
from roadscan.assets.kernels.sight import find_hidden
from roadscan.assets.kind import AssetObject
from roadscan.assets.pictures.reader import sight_of
from roadscan.assets.scene import Box, GroundModel, Returns, Scene
from roadscan.assets.visibility import ALWAYS, EDGE_M, screens_of

CORNER = (1000.0, 2000.0)
WALKED = np.array([0.0, 0.0, 0.25])


def scene_of(parts: list[tuple[np.ndarray, int, int]]) -> Scene:
    """A scene on level ground of points (n, 3), each part with a class and an epoch."""
    xyz = np.vstack([p for p, _, _ in parts])
    codes = np.concatenate([np.full(len(p), c, np.uint8) for p, c, _ in parts])
    epoch = np.concatenate([np.full(len(p), t, np.int64) + np.arange(len(p)) for p, _, t in parts])
    n = len(xyz)
    ones = np.ones(n, np.uint8)
    returns = Returns(
        CORNER, xyz[:, 0], xyz[:, 1], xyz[:, 2], np.ones(n, np.float32), epoch, np.ones(n, np.uint16),
        np.zeros(n, np.uint8), np.zeros(n, np.uint16), ones, ones, np.zeros(n), np.zeros(n), np.zeros(n),
    )  # fmt: skip
    flat = GroundModel(0.0, 0.0, 1.0, np.zeros((20, 20), np.float32), np.ones((20, 20), np.bool_))
    tile = Box(0.0, 0.0, 20.0, 20.0)
    return Scene(returns, tile, tile, flat, xyz[:, 2].astype(np.float32), codes, np.zeros((0, 4)))


def patch(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], step: float = 0.1) -> np.ndarray:
    axes = [np.arange(a, b + 1e-9, step) for a, b in (x, y, z)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def hidden(screens, eye: np.ndarray, place: np.ndarray, epoch: np.ndarray) -> np.ndarray:
    voxel = np.column_stack([screens[n].to_numpy() for n in ("column", "row", "level")]).astype(np.int64)
    low = voxel.min(axis=0)
    shape = voxel.max(axis=0) - low + 1
    key = ((voxel[:, 0] - low[0]) * shape[1] + voxel[:, 1] - low[1]) * shape[2] + voxel[:, 2] - low[2]
    order = np.argsort(key, kind="stable")
    spans = np.column_stack([screens["first_epoch_gps_ns"].to_numpy(), screens["last_epoch_gps_ns"].to_numpy()])[order]
    out = np.zeros(len(eye), np.bool_)
    origin = np.array([*CORNER, 0.0]) - low * EDGE_M
    find_hidden(
        eye + origin, place + origin, epoch, key[order], np.ascontiguousarray(spans), shape, EDGE_M, WALKED, out
    )
    return out


def test_walls_hide_posts_and_ground_do_not_and_cars_do_while_they_are_there():
    wall = patch((5.0, 5.0), (2.0, 8.0), (0.5, 3.0))
    post = patch((12.0, 12.1), (4.0, 4.1), (0.0, 3.0))
    car = np.random.default_rng(2).permutation(patch((14.0, 14.0), (2.0, 6.0), (0.4, 1.4)))
    ground = patch((0.0, 19.0), (0.0, 19.0), (0.0, 0.0), 0.5)
    screens = screens_of(
        scene_of(
            [(wall, classes.BUILDING, 10), (post, 1, 10), (car, classes.VEHICLE, 5000), (ground, classes.GROUND, 0)]
        )
    )
    columns = np.unique(screens["column"].to_numpy()) * EDGE_M - CORNER[0]
    assert columns.tolist() == [5.0, 14.0]
    for row in screens.to_pylist():
        is_car = row["column"] * EDGE_M - CORNER[0] == 14.0
        assert ((row["first_epoch_gps_ns"], row["last_epoch_gps_ns"]) == ALWAYS) != is_car
    eye = np.array([[0.5, 4.0, 1.6]] * 3 + [[10.0, 4.0, 1.2]] * 3 + [[0.5, 14.0, 1.6]])
    place = np.array([[9.0, 4.3, 1.6], [9.0, 4.3, 6.0], [4.4, 4.0, 1.0]] + [[18.0, 4.2, 1.0]] * 3 + [[9.0, 14.0, 1.0]])
    epoch = np.array([0, 0, 0, 0, 5200, 99999, 0])
    assert hidden(screens, eye, place, epoch).tolist() == [True, False, False, False, True, False, False]


def test_lines_of_sight_are_hidden_where_they_cross_boxes_of_shapely():
    rng = np.random.default_rng(8)
    wall = patch((6.0, 6.4), (5.0, 9.9), (0.5, 9.9))
    screens = screens_of(scene_of([(wall, classes.BUILDING, 0)]))
    eye = np.column_stack([np.full(400, 1.0), rng.uniform(0, 15, 400), np.full(400, 2.0)])
    place = np.column_stack([np.full(400, 11.0), rng.uniform(0, 15, 400), np.full(400, 2.0)])
    found = hidden(screens, eye, place, np.zeros(400, np.int64))
    lines = shapely.linestrings(np.stack([eye[:, :2], place[:, :2]], axis=1))
    inner, outer = shapely.box(6.0, 5.0, 6.5, 10.0).buffer(-0.13), shapely.box(6.0, 5.0, 6.5, 10.0)
    assert found[shapely.intersects(lines, inner)].all()
    assert not found[~shapely.intersects(lines, outer)].any()
    assert 50 < found.sum() < 350


def test_a_tile_without_returns_hides_nothing():
    assert screens_of(scene_of([(np.zeros((0, 3)), 1, 0)])).num_rows == 0


def test_a_lamp_post_behind_a_parked_car_is_seen_over_it():
    car = patch((7.0, 9.0), (4.0, 6.0), (0.4, 1.5))
    screens = screens_of(scene_of([(car, classes.VEHICLE, 0), (car, classes.VEHICLE, 10**6)]))
    foot, east, north = np.array([10.5, 5.0, 0.0]), *CORNER
    lamp = AssetObject(
        shapely.Point(east + 10.5, north + 5.0, 0.0), 0.01, 0.01, 0.9, 9, 1, 0, 1, {"asset_height_m": 6.0}
    )
    place = sight_of("lighting", lamp).places_m[0] - [east, north, 0.0]
    eyes, epochs = np.tile([3.0, 5.0, 2.4], (2, 1)), np.full(2, 500_000, np.int64)
    assert hidden(screens, eyes, np.stack([foot, place]), epochs).tolist() == [True, False]
    assert place.tolist() == [10.5, 5.0, 2.0]
