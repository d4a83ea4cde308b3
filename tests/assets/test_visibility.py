"""Which places a pass has in sight, on a plane with a wall whose shadow is known by geometry."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest

from roadscan.assets.scene import Box, GroundModel, Returns, Scene
from roadscan.assets.visibility import CELL_M, PASSES, in_sight, passes_in_sight

CORNER = (691_000.0, 5_334_000.0)
SENSOR_M = 2.0
WALL_X_M, WALL_TOP_M, WALL_Y_M = 12.0, 2.4, (8.0, 12.0)
"""A wall along y; the sensor drives along x = 6."""


def seen(pass_id: int, wall: bool) -> dict[str, npt.NDArray[np.float64]]:
    """Returns of a lidar that drives along a plane, with or without the wall beside it."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 0.5)), np.radians(np.arange(-20.0, 8.0, 0.5)))
    way = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1)
    way = way.reshape(-1, 3)
    parts = []
    for y in np.arange(0.0, 20.0, 1.0):
        with np.errstate(divide="ignore", invalid="ignore"):
            length = np.where(way[:, 2] < 0, SENSOR_M / -way[:, 2], np.inf)
            to_wall = (WALL_X_M - 6.0) / way[:, 0]
            at = y + to_wall * way[:, 1], SENSOR_M + to_wall * way[:, 2]
            hits = (to_wall > 0) & (at[0] > WALL_Y_M[0]) & (at[0] < WALL_Y_M[1]) & (at[1] < WALL_TOP_M)
        if wall:
            length = np.where(hits & (to_wall < length), to_wall, length)
        start = np.array([6.0, y, SENSOR_M])
        held = length < 60.0
        place = start + length[held, None] * way[held]
        parts.append(np.column_stack([place, np.broadcast_to(start, place.shape), np.full(len(place), pass_id)]))
    found = np.concatenate(parts)
    inside = (found[:, :2] > -8.0).all(axis=1) & (found[:, :2] < 28.0).all(axis=1)
    return found[inside]


def scene(*passes: npt.NDArray[np.float64], sensors_known: bool = True) -> Scene:
    x, y, z, sx, sy, sz, number = np.concatenate(passes).T
    if not sensors_known:
        sx = np.full_like(sx, np.nan)
    n = x.size
    returns = Returns(
        CORNER, x, y, z + 100.0, np.zeros(n, np.float32), np.arange(n), number.astype(np.uint16),
        np.zeros(n, np.uint8), np.zeros(n, np.uint16), np.ones(n, np.uint8), np.ones(n, np.uint8), sx, sy, sz + 100.0,
    )  # fmt: skip
    ground = GroundModel(-8.0, -8.0, 0.5, np.full((72, 72), 100.0, np.float32), np.ones((72, 72), bool))
    window, drive = Box(-8.0, -8.0, 28.0, 28.0), np.zeros((0, 4))
    return Scene(returns, Box(0, 0, 20, 20), window, ground, np.float32(z), np.zeros(n, np.uint8), drive)


def at(cells: pa.Table, x: float, y: float) -> list[int]:
    """Passes of the bands of the cell at a place; zeros where it has none."""
    held = {(c, r): n for n, (c, r) in enumerate(zip(*(cells[k].to_pylist() for k in ("column", "row")), strict=True))}
    key = int((CORNER[0] + x) // CELL_M), int((CORNER[1] + y) // CELL_M)
    return [cells[name][held[key]].as_py() if key in held else 0 for name in PASSES]


@pytest.fixture(scope="module")
def cells() -> pa.Table:
    """Seen twice, once past the wall."""
    return passes_in_sight(scene(seen(1, wall=True), seen(2, wall=False)))


def test_a_place_behind_a_wall_is_in_sight_of_the_pass_that_had_no_wall_before_it(cells: pa.Table) -> None:
    for x, y in ((9.0, 10.0), (3.0, 4.0), (12.9, 3.0), (14.0, 17.5)):
        assert at(cells, x, y)[:2] == [2, 2], (x, y)
    for x, y in ((13.5, 10.0), (14.0, 9.5), (13.2, 11.0)):
        assert at(cells, x, y)[:3] == [1, 1, 1], (x, y)


def test_above_the_wall_the_air_is_in_sight_where_nothing_stood_before_it(cells: pa.Table) -> None:
    assert at(cells, 9.0, 10.0)[3:] == [2, 2]  # towards the sky nothing comes back
    assert at(cells, 13.5, 10.0)[3:] == [1, 1]  # what lies above a place that is not in sight is not known


def test_where_sensors_stood_must_be_known(cells: pa.Table) -> None:
    assert passes_in_sight(scene(seen(1, wall=False), sensors_known=False)).num_rows == 0
    assert cells.num_rows > 1000
    assert set(cells["ground_height_m"].to_pylist()) == {100.0}


def test_cells_belong_to_the_tile_that_holds_their_middle(cells: pa.Table) -> None:
    for name, corner in (("column", CORNER[0]), ("row", CORNER[1])):
        middle = (np.array(cells[name]) + 0.5) * CELL_M - corner
        assert middle.min() >= 0.0 and middle.max() < 20.0


def test_a_pass_counts_by_its_rays() -> None:
    """Bands of five cells: rays that reached them, and rays that were stopped before."""
    cells = {
        (200, 60, 5, 0, 0): ((0, 90, 5, 0, 0), (1, 0, 0, 0, 0)),  # the second band is hidden, and with it the sky
        (200, 100, 5, 0, 0): ((0, 90, 140, 0, 0), (1, 1, 1, 1, 1)),  # less than half of 1.5 x 190 is stopped
        (201, 100, 5, 0, 0): ((0, 90, 150, 0, 0), (1, 1, 0, 0, 0)),
        (30, 80, 0, 0, 0): ((0, 0, 0, 0, 0), (0, 1, 1, 1, 1)),
        (49, 49, 49, 49, 49): ((0, 0, 0, 0, 0), (0, 0, 0, 0, 0)),
    }
    passed = np.array([list(cells)], float)
    hidden = np.array([[stopped for stopped, _ in cells.values()]], float)
    assert in_sight(passed, hidden)[0].astype(int).tolist() == [list(seen) for _, seen in cells.values()]
