"""Kernels of judges, breaks of terrain and shafts against NumPy, SciPy and results by hand."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import binary_propagation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from roadscan.assets import classes
from roadscan.assets.bins import cells_of, in_bins
from roadscan.assets.kernels.boosted_trees import tree_sums
from roadscan.assets.kernels.buckets import sort_groups
from roadscan.assets.kernels.ground import drops_on_both_sides, grow, relax
from roadscan.assets.kernels.shafts import Part, about_shaft, longest_run, near_axis, returns_about, widths_of_levels
from roadscan.assets.kernels.spots import grow_spot
from roadscan.compute.kernel_options import read_only


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


@pytest.mark.slow
def test_groups_are_sorted_each_by_itself() -> None:
    key = np.random.default_rng(1).permutation(200).astype(np.int64)
    begins, order = np.array([0, 50, 50, 130, 200], np.int64), np.empty(200, np.int64)
    sort_groups(key, begins, order)
    for first, end in pairwise(begins.tolist()):
        assert (order[first:end] == first + np.argsort(key[first:end])).all()


@pytest.mark.slow
def test_components_near_a_leaning_axis_are_kept_and_one_beside_it_is_not() -> None:
    level = np.arange(12, dtype=np.int64)
    x, y = 5.0 + 0.01 * level, 2.0 - 0.005 * level
    x[6] += 0.4
    kept = np.empty(12, np.bool_)
    near_axis(x, y, level, np.array([5.0, 2.0]), 0.04, kept)
    assert np.flatnonzero(~kept).tolist() == [6]


@pytest.mark.slow
def test_the_longest_run_of_levels_is_kept() -> None:
    level = np.array([0, 1, 2, 9, 10, 11, 12, 20], np.int64)
    kept = np.ones(8, np.bool_)
    longest_run(level, 4, 3, kept)
    assert level[kept].tolist() == [9, 10, 11, 12]
    kept[:] = True
    longest_run(level, 4, 5, kept)
    assert not kept.any()


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_spot_grows_over_what_hangs_together_with_its_square() -> None:
    """A bright disc, a bright place apart from it, and noise: as SciPy's trees and graphs tell them."""
    draw = np.random.default_rng(5)
    xy, place, half = draw.uniform(0.0, 3.0, (4000, 2)), np.array([1.5, 1.4]), 0.25
    bright = (np.hypot(*(xy - [1.55, 1.45]).T) < 0.32) | (np.hypot(*(xy - [1.95, 1.87]).T) < 0.13)
    value = bright + draw.normal(0.0, 0.4, len(xy))
    x, y = xy.T.copy()
    buckets, grid = in_bins(cells_of(x, y, (0.0, 0.0, 0.5), (6, 6)), 36), (0.0, 0.0, 0.5, 6, 6)
    limits, square = (1.0, 0.12, 0.1, 0.25, 4), (1.5, 1.4, half)
    near, inside = grow_spot(x, y, value, buckets, grid, square, limits, (0.9, 0.75))
    assert near.tolist() == sorted(cKDTree(xy).query_ball_point(place, 1.0))
    own, v = xy[near], value[near]
    first, second = cKDTree(own).query_pairs(0.12, output_type="ndarray").T
    mean, number = v.copy(), np.ones(v.size)
    for a, b in ((first, second), (second, first)):
        np.add.at(mean, a, v[b])
        np.add.at(number, a, 1.0)
    mean /= number
    away = np.abs(own - place).max(axis=1)
    limit = (np.quantile(mean[away <= half], 0.9) + np.quantile(mean[away >= half + 0.1], 0.75)) / 2
    belongs = (mean >= limit) & (away <= half + 0.25)
    held = belongs[first] & belongs[second]
    links = coo_array((np.ones(held.sum()), (first[held], second[held])), (v.size, v.size))
    label = connected_components(links, directed=False)[1]
    expected = belongs & np.isin(label, label[belongs & (away <= half)])
    assert (inside == expected).all() and 50 < inside.sum() < belongs.sum()
    few = (*limits[:4], 10_000)
    assert not grow_spot(x, y, value, buckets, grid, square, few, (0.9, 0.75))[1].any()


def test_eight_sweeps_of_relaxation_are_those_of_gauss_and_seidel_one_by_one() -> None:
    draw = np.random.default_rng(6)
    for shape in ((40, 7), (3, 9), (1, 5), (18, 1)):
        z, known = draw.normal(size=shape).astype(np.float32), draw.random(shape) < 0.2
        found = z.copy()
        relax(found, known)
        for _ in range(8):
            for i, j in np.argwhere(~known).tolist():
                south, north = z[max(i - 1, 0), j], z[min(i + 1, shape[0] - 1), j]
                west, east = z[i, max(j - 1, 0)], z[i, min(j + 1, shape[1] - 1)]
                z[i, j] = np.float32(0.25) * (south + north + west + east)
        assert (found == z).all()


def test_what_is_about_a_shaft_is_counted_as_numpy_does() -> None:
    draw = np.random.default_rng(7)
    n, slot = 3000, 100
    x, y, height = draw.normal(5.0, 0.5, n), draw.normal(2.0, 0.5, n), draw.uniform(9.8, 16.0, n)
    x[:400], y[:400] = draw.normal(5.0, 0.05, 400), draw.normal(2.0, 0.05, 400)
    kind = draw.choice(np.array([classes.HIGH_VEGETATION, classes.BUILDING, classes.UNCLASSIFIED], np.uint8), n)
    epoch, near = draw.integers(0, 4000, n), np.sort(draw.permutation(n)[:2500])
    number, sectors = np.zeros(len(Part), np.int64), np.zeros(8, np.int64)
    on_it, slots = np.empty((near.size, 3)), np.zeros(2, np.int64)
    axis, heights, edges = (5.0, 2.0, 11.0, 0.02, -0.01, 0.06), (10.0, 0.4, 4.0), (0.1, 0.35, 0.6, 1.2)
    returns = (x, y, height, kind, read_only(epoch))
    about_shaft(returns, near, axis, heights, edges, slot, number, sectors, on_it, slots)
    h, above, kind, time = height[near], height[near] - 10.0, kind[near], epoch[near] // slot
    right, ahead = x[near] - 5.0 - 0.02 * (h - 11.0), y[near] - 2.0 + 0.01 * (h - 11.0)
    away = np.hypot(right, ahead) - 0.06
    beside, higher, close = (above >= 0.4) & (above <= 4.0), above > 4.0, away <= 0.6
    own, upper = beside & (away <= 0.1), above >= 2.2
    leaf, built = kind == classes.HIGH_VEGETATION, kind == classes.BUILDING
    expected = {
        Part.ON_IT: own, Part.BESIDE: beside, Part.RING_1: beside & (away > 0.1) & (away <= 0.35),
        Part.RING_2: beside & (away > 0.35) & close, Part.RING_3: beside & ~close & (away <= 1.2),
        Part.ON_LOWER: own & ~upper, Part.NEAR_LOWER: beside & close & ~upper, Part.ON_UPPER: own & upper,
        Part.NEAR_UPPER: beside & close & upper, Part.BELOW: (above > 0.1) & (above < 0.4) & close,
        Part.OVER: higher & close, Part.GOES_ON: higher & (away <= 0.1) & (above < 5.0),
        Part.LEAVES: beside & leaf, Part.OWN_LEAVES: own & leaf,
        Part.BUILDING: beside & built, Part.OWN_BUILDING: own & built,
    }  # fmt: skip
    assert set(expected) == set(Part) and all(some.any() for some in expected.values())
    assert [int(number[part]) for part in Part] == [int(expected[part].sum()) for part in Part]
    np.testing.assert_allclose(on_it[: own.sum()], np.column_stack([right, ahead, above])[own], atol=1e-12)
    sector = np.floor(np.arctan2(ahead, right) / (np.pi / 4)).astype(np.int64)[beside & ~own] % 8
    assert sectors.tolist() == np.bincount(sector, minlength=8).tolist()
    seen = np.unique(time[own])
    assert slots.tolist() == [seen.size, np.setdiff1d(time[higher | (beside & ~own)], seen).size]


def test_returns_about_a_place_in_each_of_some_slices_once() -> None:
    counts = np.random.default_rng(8).integers(0, 9, (60, 14, 14)).astype(np.uint16)[:, :13, :13]  # as cut from more
    dy, dx = np.mgrid[-6:7, -6:7] * 0.1
    inside = np.hypot(dx, dy) <= 0.45
    assert returns_about(counts, np.array([3, 59, 3, 4]), 0.1, 0.45) == int(counts[[3, 4, 59]][:, inside].sum())
