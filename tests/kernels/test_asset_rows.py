"""Kernels of judges, breaks of terrain and shafts against NumPy, SciPy and results by hand."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import binary_propagation

from roadscan.assets.ground.kernels.breaks import drops_on_both_sides, grow
from roadscan.assets.judgement.kernels.boosted_trees import tree_sums
from roadscan.assets.kernels.buckets import sort_groups
from roadscan.assets.upright.kernels.shafts import longest_run, near_axis, widths_of_levels


def test_each_row_gets_the_leaves_that_it_reaches() -> None:
    """Two trees: one asks for x ≤ 1 and then for y ≤ 0, the other is a single leaf."""
    starts = np.array([0, 5], np.int32)
    feature = np.array([0, -1, 1, -1, -1, -1], np.int32)
    left, right = np.array([1, -1, 3, -1, -1, -1], np.int32), np.array([2, -1, 4, -1, -1, -1], np.int32)
    threshold, value = np.array([1.0, 0, 0, 0, 0, 0]), np.array([0, 10.0, 0, 20.0, 40.0, 0.5])
    missing = np.array([False, False, True, False, False, False])
    rows = np.array([[1.0, 9.0], [1.1, 0.0], [2.0, 0.1], [np.nan, 1.0], [2.0, np.nan]])
    out = np.empty(5)
    tree_sums(rows, starts, feature, threshold, left, right, missing, value, out)
    assert out.tolist() == [10.5, 20.5, 40.5, 40.5, 20.5]


def test_a_wall_drops_on_both_sides_and_a_terrace_on_one() -> None:
    z = np.zeros((20, 30), np.float32)
    z[:, 10:12] = 3.0
    z[:, 20:] = 2.0
    out = np.empty_like(z)
    drops_on_both_sides(z, np.array([[0.0, 1.0], [1.0, 0.0]]), 4, 0.0, out)
    assert (out[:, 10:12] == 3.0).all()
    assert (out[:, 20:] <= 0.0).all() and (out[:, :9] <= 0.0).all()
    drops_on_both_sides(z, np.array([[0.0, 1.0]]), 4, 0.5, out)
    np.testing.assert_allclose(out[:, 10], 2.0)  # the farther side is two cells away, at half a metre each


def test_ground_grows_as_a_binary_propagation() -> None:
    draw = np.random.default_rng(3)
    shape = (15, 18)
    z = draw.integers(0, 3, shape).astype(np.float64)
    may, seed = draw.random(shape) < 0.8, np.zeros(shape, np.bool_)
    seed[7, 7] = True
    numbers = np.pad(np.arange(z.size).reshape(shape), 1, mode="edge")
    near = np.stack([numbers[1:-1, :-2], numbers[1:-1, 2:], numbers[:-2, 1:-1], numbers[2:, 1:-1]], -1).reshape(-1, 4)
    found = seed.ravel().copy()
    grow(z.ravel(), near, may.ravel(), 10.0, 1, found)
    assert (found.reshape(shape) == binary_propagation(seed, mask=may | seed)).all()
    strict = seed.ravel().copy()
    grow(z.ravel(), near, may.ravel(), 0.5, 1, strict)
    level = binary_propagation(seed, mask=(may | seed) & (z == z[7, 7]))
    assert strict.sum() == level.sum() and (strict.reshape(shape) == level).all()


def test_groups_are_sorted_each_by_itself() -> None:
    key = np.random.default_rng(1).permutation(200).astype(np.int64)
    begins, order = np.array([0, 50, 50, 130, 200], np.int64), np.empty(200, np.int64)
    sort_groups(key, begins, order)
    for first, end in pairwise(begins.tolist()):
        assert (order[first:end] == first + np.argsort(key[first:end])).all()


def test_components_near_a_leaning_axis_are_kept_and_one_beside_it_is_not() -> None:
    level = np.arange(12, dtype=np.int64)
    x, y = 5.0 + 0.01 * level, 2.0 - 0.005 * level
    x[6] += 0.4
    kept = np.empty(12, np.bool_)
    near_axis(x, y, level, np.array([5.0, 2.0]), 0.04, kept)
    assert np.flatnonzero(~kept).tolist() == [6]


def test_the_longest_run_of_levels_is_kept() -> None:
    level = np.array([0, 1, 2, 9, 10, 11, 12, 20], np.int64)
    kept = np.ones(8, np.bool_)
    longest_run(level, 4, 3, kept)
    assert level[kept].tolist() == [9, 10, 11, 12]
    kept[:] = True
    longest_run(level, 4, 5, kept)
    assert not kept.any()


def test_widths_of_levels_are_those_of_quantiles() -> None:
    draw = np.random.default_rng(2)
    xyh, level = draw.normal(size=(300, 3)), draw.integers(0, 5, 300)
    level[:2], level[level == 4] = 4, 3
    level[:2] = 4
    widths = np.full(5, -1.0)
    widths_of_levels(xyh, level, 3, np.array([0.1, 0.9]), widths)
    for k in range(4):
        box = np.ptp(np.quantile(xyh[level == k, :2], [0.1, 0.9], axis=0), axis=0)
        np.testing.assert_allclose(widths[k], np.hypot(*box))
    assert widths[4] == -1.0
