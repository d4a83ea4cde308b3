"""Holes of a grid: NumPy's interpolation as judge, and the same bits in every window."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.surface.reconstruction import RIM, Holes, cells_across


def fill_holes(values: np.ndarray, known: np.ndarray, most: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Values with holes filled, and which cells were."""
    holes = Holes.of(known, most)
    return holes.fill(values), holes.filled()


def test_a_hole_in_a_row_is_filled_as_numpy_interpolates() -> None:
    values = np.full((1, 30), np.nan)
    values[0, :10], values[0, 14:20] = 2.0, 3.0
    found, filled = fill_holes(values, ~np.isnan(values), (0, 4))
    assert np.flatnonzero(filled).tolist() == [10, 11, 12, 13]
    np.testing.assert_allclose(found[0, 10:14], np.interp(range(10, 14), [9, 14], [2.0, 3.0]))
    assert np.isnan(found[0, 20:]).all()  # nothing goes beyond the border
    assert not fill_holes(values, ~np.isnan(values), (0, 3))[1].any()


def test_rims_are_means_of_three_and_the_shorter_way_counts() -> None:
    values = np.zeros((9, 12))
    values[4, 2:5] = [3.0, 6.0, 9.0]
    values[3:6, 5:9] = np.nan
    found, filled = fill_holes(values, ~np.isnan(values), (4, 4))
    assert filled.sum() == 12
    np.testing.assert_array_equal(found[3:6, 5:9], 0.0)  # three cells down are shorter than four across
    across = fill_holes(values, ~np.isnan(values), (0, 4))[0]
    np.testing.assert_allclose(across[4, 5:9], 6.0 * np.array([4, 3, 2, 1]) / 5)
    square = values.copy()
    square[3:6, 8] = 0.0
    both = fill_holes(square, ~np.isnan(square), (4, 4))[0]
    np.testing.assert_allclose(both[4, 5:8], 3.0 * np.array([3, 2, 1]) / 4)


@pytest.mark.parametrize("most", [(3, 5), (6, 2)])
def test_every_window_has_the_same_bits(most: tuple[int, int]) -> None:
    draw = np.random.default_rng(5)
    values = draw.normal(size=(70, 90))
    values[draw.random(values.shape) < 0.6] = np.nan
    whole, filled = fill_holes(values, ~np.isnan(values), most)
    assert filled.any() and np.isnan(whole).any()
    np.testing.assert_array_equal(whole[~np.isnan(values)], values[~np.isnan(values)])
    edge = max(most) + RIM
    part = values[11:60, 20:77]
    again, there = fill_holes(part, ~np.isnan(part), most)
    inner = (slice(edge, -edge),) * 2
    assert again[inner].tobytes() == whole[11:60, 20:77][inner].tobytes()
    assert np.array_equal(there[inner], filled[11:60, 20:77][inner])


def test_cells_in_the_widest_hole() -> None:
    assert [cells_across(*one) for one in ((0.1, 0.005), (0.1, 0.03), (0.0, 0.005))] == [20, 3, 0]
