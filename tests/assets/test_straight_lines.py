"""Straight lines that touch parked cars: which cells they have, and whether they are flanks of a row of cars."""

from __future__ import annotations

import numpy as np

from roadscan.assets.ground.surface import Grid
from roadscan.assets.moving import CELL_M, Columns
from roadscan.assets.straight_lines import Lines, are_no_flanks, lines_of


def lines_in(inside: np.ndarray, top: int | np.ndarray = 6) -> Lines:
    """The lines of a group of cells (rows, columns) that are seen up to a level, or to one of each cell."""
    seen = np.zeros((3, *inside.shape, 4), np.uint64)
    levels = np.where(inside, np.uint32(2) ** np.uint32(top + 1) - np.uint32(2), np.uint32(0))
    raster = Columns(Grid(0.0, 0.0, CELL_M, *inside.shape), levels, np.where(inside, top, -1).astype(np.int32), *seen)
    return lines_of([(inside, 0, 0)], raster)


def mask(lines: Lines, inside: np.ndarray) -> np.ndarray:
    return lines.mask(np.ones(len(lines.row), np.bool_), inside.shape)


def test_a_fence_that_touches_a_car_is_a_line_and_no_side_of_a_car_is() -> None:
    """Cells of 0.2 m: a fence of 9 m, which the mirror of a car touches, of which three sides are seen; a van of 4.4 m
    by 2 m touches the car. Cars whose bodies are seen all over touch each other.
    """
    fence, vehicles = np.zeros((40, 80), np.bool_), np.zeros((40, 80), np.bool_)
    fence[14, 5:50] = True
    vehicles[4:13, 10], vehicles[4:13, 31], vehicles[4, 10:32], vehicles[25:35, 32:54] = True, True, True, True
    vehicles[13, 10] = vehicles[12:25, 31] = True
    lines = mask(lines_in(fence | vehicles), fence)
    assert lines[fence].all() and np.count_nonzero(lines & vehicles & ~fence) <= 3  # what touches it
    touching = np.zeros((40, 80), np.bool_)
    for k in range(4):  # cars of 3.2 m by 1.8 m side by side, each 1.2 m farther ahead; holes in their roofs
        touching[2 + 9 * k : 11 + 9 * k, 20 + 6 * k : 36 + 6 * k] = True
        touching[4 + 9 * k : 9 + 9 * k : 2, 24 + 6 * k : 32 + 6 * k : 3] = False
    assert not lines_in(touching).row
    vehicles[14, 31] = False
    assert not lines_in(vehicles).row


def test_flanks_of_a_row_of_cars_are_no_line_and_a_wall_of_any_height_is() -> None:
    """Cells of 0.2 m: flanks of 22 cells, 5 apart; bonnets lie 0.6 m below cabins, and cars stand bumper to bumper."""
    along = np.arange(76)
    inside, bonnet = np.zeros((40, 80), np.bool_), (along % 27 < 6) | (along % 27 >= 18)
    inside[20, 2:78] = True
    for level in range(3, 8):
        assert are_no_flanks(lines_in(inside, level)).all()
    top = np.full((40, 80), 7)
    top[20, 2:78][bonnet] = 4
    cars = lines_in(inside, top)
    assert len(cars.row) == 1
    assert not are_no_flanks(cars).any()
