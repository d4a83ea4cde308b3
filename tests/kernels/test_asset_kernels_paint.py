"""Kernels of paint, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.kernels.paint_levels import FEWEST, paint_levels


def levels(value: np.ndarray, cell: np.ndarray, shape: tuple[int, int], half: int) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(shape[0] * shape[1] + 1))
    level, upper = np.empty(shape), np.empty(shape)
    paint_levels(value[order], first, half, level, upper)
    return level, upper


@pytest.mark.slow
def test_level_of_a_bare_surface_is_its_median_and_the_bound_one_sigma_above() -> None:
    rng = np.random.default_rng(4)
    cell = np.repeat(np.arange(25), 16)
    value = rng.normal(50.0, 4.0, cell.size)
    level, upper = levels(value, cell, (5, 5), 2)
    assert level[2, 2] == np.sort(value)[value.size // 2]
    assert abs(upper[2, 2] - 54.0) < 0.8


def test_paint_over_almost_half_of_the_surface_does_not_lift_its_level() -> None:
    rng = np.random.default_rng(5)
    cell = np.repeat(np.arange(25), 16)
    bare = rng.normal(50.0, 4.0, cell.size)
    value = np.where(rng.random(cell.size) < 0.45, 130.0, bare)
    level, upper = levels(value, cell, (5, 5), 2)
    assert abs(level[2, 2] - 50.0) < 1.5
    assert upper[2, 2] < 60.0


def test_a_cell_without_readings_or_with_too_few_around_has_no_level() -> None:
    cell = np.repeat(np.array([0, 2]), [FEWEST, FEWEST - 1])
    level, _ = levels(np.ones(cell.size), cell, (1, 3), 0)
    np.testing.assert_array_equal(np.isfinite(level), [[True, False, False]])
