"""The kernels that look for mirror images, against NumPy, and against sight lines that are followed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.kernels.mirror_images import count_stopped, follow_lines, lowest_rows, rows_up_to

ORIGIN, PER_M, SHAPE = np.array([-3.0, 5.0]), 2.0, (8, 12)
LEVEL_M, LEVELS = 0.25, 6


@pytest.fixture(scope="module")
def drawn() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns x, y and height of returns (m) in and around the grid."""
    draw = np.random.default_rng(37)
    return draw.uniform(-4.0, 4.0, 4000), draw.uniform(4.0, 10.0, 4000), draw.normal(0.0, 1.0, 4000)


def cells(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns row and column of places, and which of them the grid holds."""
    i, j = (np.floor((a - b) * PER_M).astype(int) for a, b in ((y, ORIGIN[1]), (x, ORIGIN[0])))
    return i, j, (i >= 0) & (i < SHAPE[0]) & (j >= 0) & (j < SHAPE[1])


def expected_lowest(x: np.ndarray, y: np.ndarray, z: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    i, j, inside = cells(x, y)
    chosen = inside & ~left_out
    lowest = np.full(SHAPE, np.inf, np.float32)
    np.minimum.at(lowest, (i[chosen], j[chosen]), z[chosen].astype(np.float32))
    return lowest


def test_the_lowest_return_of_each_cell(drawn: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    x, y, z = drawn
    left_out = z < -1.0
    lowest, row = np.full(SHAPE, np.inf, np.float32), np.full(SHAPE, -1)
    lowest_rows(x, y, z, left_out, ORIGIN, PER_M, lowest, row)
    np.testing.assert_array_equal(lowest, expected_lowest(x, y, z, left_out))
    i, j, _ = cells(x[row], y[row])
    np.testing.assert_array_equal((i, j), np.indices(SHAPE))
    np.testing.assert_array_equal(z[row].astype(np.float32), lowest)
    assert not left_out[row].any()


def test_returns_are_counted_by_their_height_above_the_lowest(drawn: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    x, y, z = drawn
    lowest = expected_lowest(x, y, z, np.zeros(z.size, np.bool_))
    stopped = np.zeros((*SHAPE, LEVELS), np.int32)
    count_stopped(x, y, z, ORIGIN, PER_M, lowest, LEVEL_M, stopped)
    i, j, inside = cells(x, y)
    i, j = i[inside], j[inside]
    level = np.floor((z[inside] - lowest[i, j].astype(float)) / LEVEL_M).astype(int)
    kept = (level >= 0) & (level < LEVELS)
    expected = np.zeros_like(stopped)
    np.add.at(expected, (i[kept], j[kept], level[kept]), 1)
    np.testing.assert_array_equal(stopped, expected)


def test_returns_up_to_a_limit(drawn: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    x, y, z = drawn
    limit = np.random.default_rng(38).normal(-0.5, 1.0, SHAPE).astype(np.float32)
    limit[2] = -np.inf
    rows = np.empty(z.size, np.int64)
    found = rows[: rows_up_to(x, y, z, ORIGIN, PER_M, limit, rows)]
    i, j, inside = cells(x, y)
    expected = inside & (z <= limit[i.clip(0, SHAPE[0] - 1), j.clip(0, SHAPE[1] - 1)])
    np.testing.assert_array_equal(found, np.flatnonzero(expected))


@pytest.mark.parametrize(("end_m", "stopped_by_wall", "passed_wall", "found"), [
    (-0.8, 40, 0, True),
    (-0.8, 40, 3, False),  # more than a twentieth of the lines passed: a fence before a slope
    (-0.8, 15, 0, False),  # too few ended there to call it solid
    (-0.2, 40, 0, False),  # not 0.3 m below the ground
])  # fmt: skip
def test_a_low_return_behind_a_solid_wall_tells_the_ground_before_it(
    end_m: float, stopped_by_wall: int, passed_wall: int, found: bool
) -> None:
    """A sensor 2.1 m up looks 5.5 m along x; a wall stands on level ground in the seventh cell, nothing behind it."""
    lowest = np.full(SHAPE, np.inf, np.float32)
    lowest[4, :7], lowest[4, 11] = 0.0, end_m
    stopped, passed = np.zeros((2, *SHAPE, 12), np.int32)
    stopped[4, 6], passed[4, 6] = stopped_by_wall, passed_wall
    end, start = ([np.array([one]) for one in place] for place in ((2.75, 7.25, end_m), (-2.75, 7.25, 2.1)))
    limits = np.array([LEVEL_M, 0.0, 0.3, 0.1, 20.0, 0.5, 20.0, 19.0])
    foot = np.full(1, -np.inf)
    line = np.zeros(1, np.int64), tuple(end), tuple(start), ORIGIN, PER_M, lowest, lowest, limits, stopped
    follow_lines(*line, passed, False, foot)
    assert foot[0] == (0.0 if found else -np.inf)
    before = passed.copy()
    follow_lines(*line, passed, True, foot)
    places = np.argwhere(passed - before)[:, :2]
    assert ([4, 6] in places.tolist()) == (end_m < -0.3)
