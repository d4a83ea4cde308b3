"""Kernels of assets against NumPy, SciPy, and results known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.stats import binned_statistic_2d

from roadscan.assets.kernels import cubes
from roadscan.assets.kernels.columns import columns, distinct, marked, straight_run, tops
from roadscan.assets.kernels.cubes import features, moments, numbered
from roadscan.assets.kernels.ground import begin, cell_heights, halved, on_ground, planes, relax, scatter
from roadscan.assets.kernels.low_returns import counts, heights_above, lowest_returns

ORIGIN = np.array([2.0, -3.0])
ROWS, COLUMNS, CELL_M = 6, 8, 0.5


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """Points (3, n), some of them outside the raster."""
    rng = np.random.default_rng(5)
    x = ORIGIN[0] + rng.uniform(-0.7, COLUMNS * CELL_M + 0.7, 3000)
    y = ORIGIN[1] + rng.uniform(-0.7, ROWS * CELL_M + 0.7, 3000)
    return np.stack([x, y, rng.normal(10.0, 0.3, 3000)])


def binned(points: np.ndarray, values: np.ndarray, statistic: str) -> np.ndarray:
    edges = [ORIGIN[1] + CELL_M * np.arange(ROWS + 1), ORIGIN[0] + CELL_M * np.arange(COLUMNS + 1)]
    return binned_statistic_2d(points[1], points[0], values, statistic, bins=edges).statistic


def test_lowest_and_number_of_each_cell(points: np.ndarray) -> None:
    low, many = np.full((ROWS, COLUMNS), np.inf, np.float32), np.zeros((ROWS, COLUMNS), np.int32)
    lowest_returns(*points, ORIGIN, 1 / CELL_M, low)
    counts(points[0], points[1], ORIGIN, 1 / CELL_M, many)
    assert np.array_equal(many, binned(points, points[2], "count"))
    np.testing.assert_allclose(low, binned(points, points[2], "min"), rtol=1e-6)


def test_heights_above_a_raster_are_bilinear(points: np.ndarray) -> None:
    ground = np.random.default_rng(1).normal(9.0, 1.0, (ROWS, COLUMNS)).astype(np.float32)
    above = np.empty(points.shape[1], np.float32)
    heights_above(*points, ORIGIN, 1 / CELL_M, ground, above)
    middles = [ORIGIN[1] + CELL_M * (np.arange(ROWS) + 0.5), ORIGIN[0] + CELL_M * (np.arange(COLUMNS) + 0.5)]
    y = np.clip(points[1], middles[0][0], middles[0][-1])
    x = np.clip(points[0], middles[1][0], middles[1][-1])
    expected = points[2] - RegularGridInterpolator(middles, ground.astype(float))(np.stack([y, x], axis=-1))
    np.testing.assert_allclose(above, expected, atol=2e-6)


def test_scatter_of_cells(points: np.ndarray) -> None:
    above, sums = np.empty(points.shape[1], np.float32), np.zeros((ROWS, COLUMNS, 5))
    flat = np.full((2, 2), 10.0, np.float32)
    scatter(*points, ORIGIN, 0.25, flat, 1 / CELL_M, np.array([-0.25, 0.4, 0.2]), above, sums)
    h = points[2] - 10.0
    np.testing.assert_allclose(above, h, atol=1e-6)
    near, close = (h >= -0.25) & (h <= 0.4), np.abs(h) <= 0.2
    for column, (chosen, values) in enumerate([(near, h**0), (near, h), (near, h * h), (close, h**0), (close, h)]):
        expected = binned(points[:, chosen], values[chosen], "sum")
        np.testing.assert_allclose(sums[..., column], expected, atol=1e-9)


def test_heights_of_cells(points: np.ndarray) -> None:
    h = (points[2] - 10.0).astype(np.float32)
    chosen = np.arange(h.size) % 3 > 0
    middle, half = np.full((ROWS, COLUMNS), 0.1, np.float32), np.full((ROWS, COLUMNS), 0.3, np.float32)
    sums = np.zeros((ROWS, COLUMNS, 3))
    cell_heights(*points[:2].copy(), h, chosen, ORIGIN, 1 / CELL_M, middle, half, sums)
    d = h.astype(float) - np.float64(np.float32(0.1))
    used = chosen & (np.abs(d) <= np.float32(0.3))
    for column in range(3):
        np.testing.assert_allclose(sums[..., column], binned(points[:, used], d[used] ** column, "sum"), atol=1e-9)


def test_on_the_ground_are_returns_near_it_or_as_high_as_an_even_cell_beside() -> None:
    rough = np.zeros((1, 3), np.bool_)
    rough[0, 1:] = True
    even = np.full((1, 3), np.nan, np.float32)
    even[0, 0] = 0.10
    tolerance = np.full((1, 3), 0.15, np.float32)
    x = np.array([0.5, 0.5, 1.5, 1.5, 2.5, 3.5])
    above = np.array([0.14, 0.16, 0.12, 0.05, 0.10, 0.0], np.float32)
    found = np.empty(6, np.bool_)
    on_ground(x, np.full(6, 0.5), above, np.zeros(2), 1.0, rough, tolerance, even, 0.03, found)
    assert found.tolist() == [True, False, True, False, False, False]


def test_holes_are_filled_from_the_means_of_two_by_two_and_relax_to_a_harmonic_surface() -> None:
    z = np.array([[1.0, 3.0, 7.0], [9.0, 0.0, 5.0]], np.float32)
    known = np.array([[True, True, True], [False, False, True]])
    coarse, coarse_known = np.empty((1, 2), np.float32), np.empty((1, 2), np.bool_)
    halved(z, known, (0, 0), coarse, coarse_known)
    assert coarse.tolist() == [[2.0, 6.0]] and coarse_known.all()
    begin(coarse, known, (0, 0), z)
    assert z[1].tolist() == [2.0, 3.0, 5.0]  # a quarter of the way to the next middle
    halved(z, known, (0, 1), coarse, coarse_known)
    assert coarse.tolist() == [[1.0, 5.0]]  # the first column is the second of its two by two
    begin(coarse, known, (0, 1), z)
    assert z[1].tolist() == [2.0, 4.0, 5.0]
    column, row = np.meshgrid(np.arange(9.0), np.arange(9.0))
    saddle = (column - 4) * (row - 4)  # the mean of its four neighbours everywhere
    inner = np.ones((9, 9), np.bool_)
    inner[1:-1, 1:-1] = False
    found = np.where(inner, saddle, 0.0).astype(np.float32)
    for _ in range(25):
        relax(found, inner)
    np.testing.assert_allclose(found, saddle, atol=1e-4)


def test_steps_of_time_that_differ_from_the_one_before() -> None:
    epoch = np.array([0, 10, 25, 1000, 1012, 5], np.int64)
    found = np.empty(10, np.int64)
    count = distinct(epoch, np.int64(10), found)
    assert found[:count].tolist() == [0, 1, 2, 100, 101, 0]
    assert distinct(epoch, np.int64(10), found[:2]) == 6


def test_columns_and_their_tops() -> None:
    above = np.array([0.05, 0.3, 0.5, 1.5, 3.0, 0.7], np.float32)
    x = np.array([0.5, 0.5, 0.5, 0.5, 0.5, 9.0])
    ground = np.array([True, False, False, False, False, False])
    levels = np.zeros((1, 1), np.uint32)
    seen = np.zeros((3, 1, 1, 2), np.uint64)
    epoch = np.array([5, 10, 19, 20, 30, 40], np.int64) + 128 * 10 * 7  # two words of slots begin anew each 128
    band = np.array([0.4, 2.5, 4.4])
    columns(x, np.full(6, 0.5), above, ground, epoch, 10, np.zeros(2), 1.0, 0.2, band, levels, seen)
    assert int(levels[0, 0]) == (1 << 1) | (1 << 2) | (1 << 7) | (1 << 15)
    assert seen[:, 0, 0, 0].tolist() == [0b110, 0b1, 0b1000] and not seen[..., 1].any()
    columns(x, np.full(6, 0.5), above, ground, epoch + 640, 10, np.zeros(2), 1.0, 0.2, band, levels, seen)
    assert seen[:, 0, 0, 1].tolist() == [0b110, 0b1, 0b1000]
    top = np.empty((1, 1), np.int32)
    for first, start, gap, expected in [(1, 5, 2, 2), (1, 5, 4, 7), (1, 5, 7, 15), (3, 5, 2, -1), (3, 8, 2, 7)]:
        tops(levels, first, start, gap, top)
        assert top[0, 0] == expected


def test_marked_returns() -> None:
    cells = np.array([[0, 1], [2, 0]], np.int32)
    x, y = np.array([0.5, 1.5, 1.5, 0.5, 5.0]), np.array([0.5, 0.5, 0.5, 1.5, 0.5])
    above = np.array([1.0, 1.0, 3.0, 3.0, 1.0], np.float32)
    out = np.empty(5, np.int32)
    marked(x, y, above, np.zeros(2), 1.0, cells, np.array([0.0, 0.0, 2.0]), np.array([9.0, 2.0, 4.0]), out)
    assert out.tolist() == [0, 1, 0, 2, 0]


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 90.0, 131.3])
def test_the_longest_straight_run_is_the_fence_beside_two_cars(degrees: float) -> None:
    """A fence of 45 cells with a cell missing, and beside it two cars of 22 cells with 4 cells between them."""
    step = np.arange(0.0, 45.0, 0.1)
    fence = np.column_stack([step, np.zeros(step.size)])[(step < 20.0) | (step > 21.0)]
    car = np.array([(a, b) for a in np.arange(0.0, 22.0, 0.4) for b in np.arange(3.0, 11.0, 0.4)])
    turn = np.radians(degrees)
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    cars = np.concatenate([car, car + np.array([26.0, 0.0])])
    cells = [np.unique(np.floor(part @ turned), axis=0) for part in (fence, cars)]
    x, y = np.concatenate(cells).T.copy()
    chosen, many = np.zeros(x.size, np.bool_), len(cells[0])
    assert straight_run(x, y, np.ones(x.size, np.bool_), 72, 1, chosen) == pytest.approx(45, abs=2)
    assert chosen[:many].mean() > 0.9 and not chosen[many:].any()
    assert straight_run(x, y, ~chosen, 72, 1, np.zeros(x.size, np.bool_)) < 30


def test_features_of_cubes_are_those_of_the_covariance_of_27_cubes() -> None:
    rng = np.random.default_rng(3)
    n, edge = 4000, 0.3
    wall = np.stack([rng.uniform(0, 3, n), np.full(n, 1.0), rng.uniform(0, 3, n)])
    line = np.stack([rng.uniform(0, 3, n // 8), np.full(n // 8, 2.5), np.full(n // 8, 2.0)])
    ball = np.stack([rng.uniform(0, 1.5, n), rng.uniform(1.5, 2.1, n), rng.uniform(0, 1.5, n)])
    x, y, z = np.concatenate([wall, line, ball], axis=1) + rng.normal(0, 0.01, (3, 2 * n + n // 8))
    above, origin = np.abs(z).astype(np.float32), np.array([-0.2, -0.1])
    index = np.full((12, 12, 12), -1, np.int32)
    number, place = np.empty(x.size, np.int32), np.empty((x.size, 3), np.int32)
    count = numbered(x, y, above, np.ones(x.size, np.bool_), origin, 1 / edge, index, number, place)
    sums, found = np.zeros((count, cubes.MOMENTS)), np.empty((count, 7), np.float32)
    moments(x, y, above, number, origin, 1 / edge, place[:count], sums)
    features(index, place[:count], sums, found)
    cube = np.floor(np.stack([y - origin[1], x - origin[0], above.astype(float)]) / edge).astype(int)
    assert np.array_equal(place[number].T, cube)
    for k in range(0, count, 7):
        near = (np.abs(cube - place[k][:, None]) <= 1).all(axis=0)
        values, vectors = np.linalg.eigh(np.cov(np.stack([x, y, above])[:, near] / edge, bias=True))
        third, second, first = np.sqrt(np.maximum(values, 0.0))
        assert found[k, cubes.NUMBER] == near.sum()
        expected = [(first - second) / first, (second - third) / first, third / first]
        np.testing.assert_allclose(found[k, 1:4], expected, atol=1e-4)
        assert found[k, cubes.THICKNESS] == pytest.approx(third, abs=1e-4)
        if second - third > 0.05:
            assert found[k, cubes.NORMAL_UP] == pytest.approx(abs(vectors[2, 0]), abs=1e-3)
        if first - second > 0.05:
            assert found[k, cubes.ALONG_UP] == pytest.approx(abs(vectors[2, 2]), abs=1e-3)


def test_repeated_planes_hold_a_road_and_its_bank_and_leave_the_rest_over() -> None:
    rng = np.random.default_rng(9)
    x, y = rng.uniform(0, 10, 900), rng.uniform(0, 10, 900)
    z = np.where(x < 6, 0.02 * x, 0.12 + 0.3 * (x - 6)) + rng.normal(0, 0.01, 900)
    z[::9] += rng.uniform(1.0, 3.0, 100)
    found = np.empty(900, np.bool_)
    begins, key, how = np.array([0, 900]), np.array([77], np.uint64), np.array([6, 60, 500, 40])
    planes(x, y, z, begins, key, 0.05, 0.5, how, found)
    on_planes = np.arange(900) % 9 > 0
    assert found[on_planes].mean() > 0.99
    assert found[~on_planes].mean() < 0.08  # a plane may pass through a few by chance
