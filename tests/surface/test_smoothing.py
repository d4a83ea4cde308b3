"""Smoothing: the paper's energy from its printed filters as sparse matrices, and patches with known cracks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import eigsh, spsolve

from roadscan.core.errors import RoadscanError
from roadscan.surface.detail_median import REACH, detail_median, detail_pairs, lines_onward
from roadscan.surface.kernels.line_medians import (
    CrackCells,
    Shapes,
    heights_by_support,
    judge_lines,
    least_risk,
    line_means,
    line_medians,
    mirrored_line_medians,
)
from roadscan.surface.settings import SurfaceSmoothing
from roadscan.surface.smoothing import FILTER_BOUND, Smoothing, halo_cells, smooth_surface, steps
from tests.surface.patches import (
    PROFILER_1,
    PROFILER_5,
    SICK,
    cracked,
    depth_bias,
    median_9,
    rms_m,
    width_change_cells,
)

CONFIG = SurfaceSmoothing()
CROSS = [[0, 0, -1, 0, 0], [0, 0, -1, 0, 0], [0, -1, 6, -1, 0], [0, 0, -1, 0, 0], [0, 0, -1, 0, 0]]
SLANT = [[-1, 0, 0, 0, 0], [0, -1, -1, 0, 0], [0, -1, 8, -1, 0], [0, 0, -1, -1, 0], [0, 0, 0, 0, -1]]
AROUND = [[-1, -1, -1, -1, -1], [-1, -1, -2, -1, -1], [-1, -2, 28, -2, -1], [-1, -1, -2, -1, -1], [-1, -1, -1, -1, -1]]
PRINTED = [  # eq. 12
    np.array(CROSS) / 12, np.array(CROSS).T / 12, np.array(SLANT) / 16, np.array(SLANT)[:, ::-1] / 16,
    np.array(AROUND) / 56,
]  # fmt: skip


def bumpy(shape, seed=1):
    """Noise, an edge, a crack along a slant, outliers, holes; at a height of 560 m."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(shape)
    height = 560.0 + rng.normal(0.0, 0.0005, shape) + 0.0001 * x + 0.006 * (y > 0.8 * shape[0])
    height[np.abs(x - 0.3 * y - 8) < 1.5] -= 0.012
    height[rng.random(shape) < 0.02] += 0.02
    height[rng.random(shape) < 0.08] = np.nan
    height[5:9, shape[1] // 2 : shape[1] // 2 + 6] = np.nan
    return height


def filter_matrix(chosen, measured):
    """S: a row a cell, the printed filter there, its differences to cells without a height left out."""
    rows, columns = chosen.shape
    found = []
    for i, j in np.argwhere((chosen > 0) & measured):
        for (a, b), weight in np.ndenumerate(PRINTED[chosen[i, j] - 1]):
            y, x = i + a - 2, j + b - 2
            if weight < 0 and 0 <= y < rows and 0 <= x < columns and measured[y, x]:
                at = i * columns + j
                found += [(weight, at, y * columns + x), (-weight, at, at)]
    values, row, column = np.array(found).T
    return sparse.coo_array((values, (row.astype(int), column.astype(int))), shape=(chosen.size,) * 2).tocsr()


class Energy:
    """E(F) of eq. 10 with the medians and filters that were chosen, as matrices."""

    def __init__(self, of):
        self.measured = ~np.isnan(of.height_m)
        self.filters = filter_matrix(of.chosen, self.measured)
        self.weight = of.weight.ravel()
        self.p, self.m = np.nan_to_num(of.height_m - 560).ravel(), np.nan_to_num(of.median_m - 560).ravel()
        self.c, self.k = of.config.curvature_weight, of.config.median_weight
        data = sparse.diags_array(self.weight + self.k * self.measured.ravel() + ~self.measured.ravel())
        self.hessian = (data + self.c * (self.filters.T @ self.filters)).tocsc()
        self.aim = self.weight * self.p + self.k * self.m

    def __call__(self, height_m):
        f = np.nan_to_num(height_m - 560).ravel()
        rough = self.filters @ f
        return (self.weight * (f - self.p) ** 2).sum() + self.c * rough @ rough + self.k * ((f - self.m) ** 2).sum()

    def explicit(self, beta, count):
        """Eq. 11 as printed, with CᵢᵀIᵢCᵢ for its gradient."""
        f = beta * self.aim
        for _ in range(count):
            f = f + beta * (self.aim - self.hessian @ f) * self.measured.ravel()
        return f


@pytest.fixture(scope="module")
def small():
    return Smoothing.of(bumpy((26, 31)), CONFIG)


def test_norms_that_the_step_rests_on():
    responses = []
    for printed in PRINTED:
        padded = np.zeros((256, 256))
        padded[:5, :5] = printed
        responses.append(np.abs(np.fft.fft2(padded)) ** 2)
    assert sum(responses).max() == pytest.approx(2.4476, abs=1e-4)  # all five at every cell
    assert 1 + 30 + 50 * sum(responses).max() > 2 * 30  # so the paper's β = 1/λ_M is unstable there
    assert 1 + 30 + 50 * responses[4].max() < 2 * 30  # and stable where C5 acts alone
    largest = np.max(np.abs(PRINTED), axis=0)
    assert largest.sum() == pytest.approx(FILTER_BOUND)
    rng = np.random.default_rng(0)
    chosen, measured = rng.integers(0, 6, (20, 20)), rng.random((20, 20)) < 0.9
    found = filter_matrix(chosen, measured)
    assert eigsh(found.T @ found, k=1)[0][0] <= FILTER_BOUND


def test_finds_the_minimum_that_a_direct_solver_finds(small):
    assert set(np.unique(small.chosen)) >= {0, 1, 2, 3, 4, 5}
    energy = Energy(small)
    exact = spsolve(energy.hessian, energy.aim).reshape(small.height_m.shape)
    start = small.median_m + next(small.corrections(0))
    found = small.minimum()
    inside = energy.measured
    left, begun = (np.linalg.norm((f - 560 - exact)[inside]) for f in (found, start))
    assert left <= CONFIG.tolerance * begun
    precise = Smoothing.of(small.height_m, CONFIG.model_copy(update={"tolerance": 1e-9})).minimum()
    assert np.abs(precise - 560 - exact)[inside].max() < 2e-9


def test_energy_falls_at_every_step(small):
    energy = Energy(small)
    trace = [energy(small.median_m + c) for c in small.corrections(steps(CONFIG))]
    assert len(trace) == steps(CONFIG) + 1 == 15
    assert (np.diff(trace) < 0).all()


def test_agrees_with_the_explicit_iteration_where_that_converges(small):
    rng = np.random.default_rng(2)
    level = Smoothing.of(560 + rng.normal(0.0, 0.0004, (20, 20)), CONFIG.model_copy(update={"tolerance": 1e-8}))
    assert (level.chosen == 5).all()
    explicit = Energy(level).explicit(1 / 30, 300)
    assert np.abs(explicit.reshape(20, 20) + 560 - level.minimum()).max() < 2e-9
    everywhere = Energy(small)
    matrices = [filter_matrix(np.full((26, 31), k), everywhere.measured) for k in range(1, 6)]
    everywhere.hessian = sparse.diags_array(everywhere.weight + 30) + 50 * sum(m.T @ m for m in matrices)
    assert np.abs(everywhere.explicit(1 / 30, 60)).max() > 1e3  # metres: all five at once burst


def test_same_bits_in_any_window():
    quick = CONFIG.model_copy(update={"tolerance": 0.1})
    halo = halo_cells(quick)
    height = bumpy((2 * halo + 20, 2 * halo + 31), seed=4)
    whole = smooth_surface(height, quick)
    for top, left in ((0, 0), (6, 9), (17, 28)):
        core = (slice(halo + top, halo + top + 3), slice(halo + left, halo + left + 3))
        window = (slice(top, 2 * halo + top + 3), slice(left, 2 * halo + left + 3))
        np.testing.assert_array_equal(
            smooth_surface(height[window], quick)[halo : halo + 3, halo : halo + 3], whole[core]
        )


def test_median_has_the_same_bits_in_any_window():
    height = bumpy((300, 330), seed=7)
    whole = detail_median(height, CONFIG)
    for top, left in ((0, 0), (40, 61), (83, 90), (111, 144), (150, 170)):
        window = (slice(top, top + 150), slice(left, left + 160))
        part = detail_median(height[window], CONFIG)
        inner = (slice(REACH, -REACH),) * 2
        np.testing.assert_array_equal(part.height_m[inner], whole.height_m[window][inner])


def test_holes_stay_and_nothing_crosses_them():
    height = bumpy((40, 60))
    height[:, 25 : 25 + 10] = np.nan
    found = smooth_surface(height, CONFIG)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(height))
    other = height.copy()
    other[:, 35:] = 3.0
    np.testing.assert_array_equal(smooth_surface(other, CONFIG)[:, :25], found[:, :25])
    assert np.isnan(smooth_surface(np.full((3, 4), np.nan), CONFIG)).all()
    lonely = np.full((9, 9), np.nan)
    lonely[4, 4] = 560.1
    assert smooth_surface(lonely, CONFIG)[4, 4] == 560.1


def test_a_plane_stays_a_plane_up_to_its_border():
    y, x = np.indices((80, 80))
    plane = 560 + 0.0002 * x - 0.0001 * y
    assert np.abs(smooth_surface(plane, CONFIG) - plane).max() < 0.0006  # medians at the border are one-sided
    assert np.abs(smooth_surface(plane, CONFIG) - plane)[30:-30, 30:-30].max() < 1e-9


def scattered(shape, share, seed=0):
    """Normal values, some missing."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=shape)
    values[rng.random(shape) < share] = np.inf
    return values


BENT = np.array([(-3, -2), (-2, -1), (-1, -1), (0, 0), (1, 1), (2, 1), (3, 2)])


def test_lines_like_numpy():
    values = scattered((14, 17), 0.3)
    median, count, mean, own = *(np.empty((8, 11)) for _ in range(3)), np.empty((8, 11), np.float32)
    line_medians(values, 3, BENT, np.inf, median, count, own)
    line_means(values, 3, BENT, np.inf, mean)
    for i, j in np.ndindex(8, 11):
        line = values[i + 3 + BENT[:, 0], j + 3 + BENT[:, 1]]
        there = line[np.isfinite(line)]
        assert count[i, j] == there.size
        assert median[i, j] == (np.median(there) if there.size else np.inf)
        paired = line[np.isfinite(line) & np.isfinite(line[::-1])]
        assert mean[i, j] == (pytest.approx(paired.mean()) if np.isfinite(line[3]) else np.inf)


def test_share_of_a_cell_in_its_median_is_the_derivative():
    values = scattered((14, 17), 0.3)
    median, moved, count = (np.empty((8, 11)) for _ in range(3))
    own, other = np.empty((8, 11), np.float32), np.empty((8, 11), np.float32)
    line_medians(values, 3, BENT, np.inf, median, count, own)
    for i, j in np.ndindex(8, 11):
        if np.isfinite(values[i + 3, j + 3]):
            shifted = values.copy()
            shifted[i + 3, j + 3] += 1e-6
            line_medians(shifted, 3, BENT, np.inf, moved, count, other)
            assert own[i, j] == pytest.approx((moved - median)[i, j] / 1e-6, abs=1e-3)
    assert set(np.unique(own)) >= {0.0, 0.5, 1.0}


def test_risk_of_a_line_like_numpy():
    heights = scattered((8, 11), 0.3)
    ground, median, count, own = scattered((4, 8, 11), 0.0, seed=2)
    own, contrast = own.astype(np.float32), np.full((8, 11), 0.5, np.float32)
    count, risk = 4.0 + np.abs(count).round(), np.empty((8, 11), np.float32)
    judge_lines(heights, ground, median, count, own, 5, 0.4, 3.0, np.inf, contrast, risk)
    there = np.isfinite(heights)
    misfit = np.minimum(np.abs(heights - median) / 0.4, 3.0)
    np.testing.assert_allclose(risk, np.where(there, misfit**2 + 2.0 * own, 0.0), rtol=1e-5)
    away = np.where(there & (count >= 5), np.abs(median - ground) * np.sqrt(count), 0.0)
    np.testing.assert_allclose(contrast, np.maximum(away, 0.5), rtol=1e-6)


def test_medians_at_a_border_do_not_lean():
    y, x = np.indices((30, 40))
    slope = np.pad(1.0 * x - 0.5 * y, 3, constant_values=np.inf)
    line = np.stack([np.zeros(7, np.int64), np.arange(-3, 4)], axis=-1)
    median, plain, count, own = *(np.empty((30, 40)) for _ in range(3)), np.empty((30, 40), np.float32)
    mirrored_line_medians(slope, 3, line, slope[3:-3, 3:-3], np.inf, median)
    line_medians(slope, 3, line, np.inf, plain, count, own)
    assert np.abs(plain - slope[3:-3, 3:-3]).max() == 1.5
    lean = np.abs(median - slope[3:-3, 3:-3])
    assert lean.max() == 0.5  # where one cell alone is missing
    assert lean[:, [0, 1, -2, -1]].max() == 0.0
    one = scattered((7, 7), 0.0)
    one[3, [1]] = np.inf  # a single dropout is not mirrored
    mirrored_line_medians(one, 3, line, np.full((1, 1), -9.0), np.inf, median[:1, :1])
    assert median[0, 0] == np.median(one[3][np.isfinite(one[3])])


def test_a_slope_has_no_detail_up_to_its_border():
    rng = np.random.default_rng(3)
    y, x = np.indices((160, 160))
    slope = 560.0 + 0.025 * 0.005 * x + 0.01 * 0.005 * y + rng.normal(0.0, 0.0005, x.shape)
    assert detail_median(slope, CONFIG).detail.mean() < 0.01


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_heights_by_support_like_least_squares(share):
    values = scattered((19, 23), share)
    values[9, 9:14] = np.arange(5) * 0.1
    row, column = np.full(5, 3), np.arange(3, 8)
    pairs, onward = detail_pairs(), lines_onward()
    off, own = np.empty((5, 6), np.float32), np.empty((5, 6), np.float32)
    middle, direction = np.linspace(-1, 1, 5), np.arange(5, dtype=np.uint8)
    cells = CrackCells(row, column, middle, np.full(5, 0.5, np.float32), direction)
    heights_by_support(values, 6, cells, 0.25, Shapes(onward, pairs), np.inf, off, own)
    for t in range(5):
        i, j = row[t] + 6, column[t] + 6

        def both(cells, i=i, j=j):
            """Heights of the cells whose mirror image is measured as well, and where they are."""
            found = [(c, values[i + c[0], j + c[1]]) for c in [*cells, *(-cells)]]
            whole = [(c, z) for c, z in found if np.isfinite(z) and np.isfinite(values[i - c[0], j - c[1]])]
            return np.array([c for c, _ in whole]).reshape(-1, 2), np.array([z for _, z in whole])

        assert (off[t, 0], own[t, 0]) == (0.0, 0.75)
        for k, n in ((1, 1), (2, 6)):
            _, z = both(onward[t, :n])
            if z.size >= n:
                assert off[t, k] + middle[t] == pytest.approx((z.sum() + values[i, j]) / (z.size + 1), abs=1e-6)
                assert own[t, k] == pytest.approx(1 / (z.size + 1) + (0.25 if z.size else 0.0))
        for k, n in ((3, 24), (4, 40)):
            cells, z = both(pairs[:n])
            cells, z = np.vstack([cells, [(0, 0)]]), np.append(z, values[i, j])
            design = [np.ones(z.size), (cells**2).sum(axis=1)]
            if share == 0.0:  # nothing changes with all the terms of a paraboloid
                design += [cells[:, 0], cells[:, 1], cells[:, 0] * cells[:, 1], cells[:, 0] ** 2]
            solved = np.linalg.pinv(np.stack(design, axis=-1).astype(float))[0]
            assert off[t, k] + middle[t] == pytest.approx(solved @ z, abs=1e-6)
            assert own[t, k] == pytest.approx(solved[-1], abs=1e-6)


def test_support_of_least_risk():
    rng = np.random.default_rng(5)
    row, column = (a.ravel() for a in np.indices((9, 12)))
    number = np.pad(np.arange(108, dtype=np.int32).reshape(9, 12), 3, constant_values=-1)
    off = rng.normal(0.0, 0.3, (108, 6)).astype(np.float32)
    own = rng.uniform(0.0, 0.5, (108, 6)).astype(np.float32)
    height = rng.normal(size=108)
    height[::17] += 30.0
    cost = np.minimum(np.abs(height[:, None] - off) / 0.7, 4.0) ** 2 + 2.0 * own
    expected = np.empty(108)
    for t in range(108):
        near = (np.abs(row - row[t]) <= 3) & (np.abs(column - column[t]) <= 3)
        expected[t] = off[t, np.argmin(cost[near].sum(axis=0))]
    chosen = np.empty(108, np.float32)
    least_risk(row, column, number, height, off, own, 0.7, 4.0, chosen)
    np.testing.assert_array_equal(chosen, expected.astype(np.float32))


def test_says_what_a_grid_is():
    with pytest.raises(RoadscanError, match="1 of them infinite; expected a grid"):
        smooth_surface([[1.0, np.inf]])


@pytest.mark.parametrize(
    ("sensor", "classes", "bias"),
    [
        (PROFILER_5, ((0.006, 0.01), (0.02, 0.03)), 0.1),
        (PROFILER_1, ((0.003, 0.005), (0.006, 0.01), (0.01, 0.02)), 0.1),
        (PROFILER_1, ((0.02, 0.005),), 0.03),  # wide and flat: the 9 × 9 median is right within 0.05
        (SICK, ((0.02, 0.03),), 0.15),  # two cells wide, three σ deep; the raw cells are off by 0.06 as well
    ],
    ids=lambda v: getattr(v, "name", ""),
)
def test_cracks_stay_and_noise_goes(sensor, classes, bias):
    patch = cracked(sensor, 90, classes)
    found = smooth_surface(patch.measured_m, SurfaceSmoothing(sigma_m=sensor.sigma_m))
    median = median_9(patch.measured_m)
    assert rms_m(patch, found) < rms_m(patch, patch.measured_m) / 3
    assert rms_m(patch, found) < rms_m(patch, median) / 1.5
    assert abs(depth_bias(patch, found)) < bias < abs(depth_bias(patch, median))
    if len(classes) == 1:
        assert abs(width_change_cells(patch, found)) < 2
