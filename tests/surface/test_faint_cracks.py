"""Long strips: kernels against loops and drawn strips, cracks that no single cell shows, noise."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.surface.detail_median import REACH, detail_median
from roadscan.surface.faint_cracks import confirmed_strips
from roadscan.surface.kernels.faint_cracks import (
    FIELDS,
    HALF_CUT,
    chain_lines,
    draw_strips,
    fit_strips,
    line_depths,
    mark_peaks,
)
from roadscan.surface.settings import SurfaceConfig, SurfaceSmoothing
from roadscan.surface.smoothing import Smoothing, smooth_surface
from tests.surface.patches import (
    IMPULSES,
    PROFILER_5,
    SICK,
    across,
    cracked,
    depth_bias,
    measured,
    median_9,
    rms_m,
    width_change_cells,
)

WIDTHS = np.array([1.3, 0.5, 2.2])


def strip(shape, row, column, slope, axis, width, *, down):
    """Share of a strip's width in each cell, at 1,000 places across it."""
    rows, columns = np.indices(shape if down else shape[::-1])
    if not down:
        row, column = column, row
    away = column + axis + slope * (rows - row) - columns
    places = (np.arange(1000) + 0.5) / 1000 - 0.5
    share = np.mean(np.abs(away[..., None] + width * places) < 0.5, axis=-1)
    return share if down else share.T


@pytest.mark.parametrize("down", [True, False])
@pytest.mark.parametrize(("slope", "axis", "width"), [(0.35, 0.25, 1.3), (-1.1, -1.5, 0.5), (0.05, 2.0, 2.2)])
def test_fit_finds_a_strip_that_was_drawn(down, slope, axis, width):
    rng = np.random.default_rng(3)
    shape, centre = (60, 70), (29, 33)
    share = strip(shape, *centre, slope, axis, width, down=down)
    depth = 3.0 * max(width, 1.0)
    values = (0.4 - depth * share).astype(np.float32)
    values[rng.random(shape) < 0.1] = np.inf
    found = np.empty((1, FIELDS))
    padded = np.ascontiguousarray(np.pad(values, HALF_CUT, constant_values=np.inf))
    row, column = (np.array([v]) for v in centre)
    begin = np.array([slope + 0.15])
    fit_strips(padded, HALF_CUT, row, column, np.array([down]), begin, WIDTHS, 4.0, 5.0, 1e9, np.inf, found)
    gain, steep, *rest, _ = found[0]
    assert bool(steep) == down
    np.testing.assert_allclose(rest, [slope, axis, width, depth, 0.4], atol=0.02)
    gain_drawn, level, own = (np.zeros(shape, np.float32) for _ in range(3))
    draw_strips(row, column, found, np.array([True]), gain_drawn, level, own)
    drawn = gain_drawn > 0
    assert gain == pytest.approx(gain_drawn.max())
    np.testing.assert_allclose(level[drawn], (0.4 - depth * share)[drawn], atol=0.05)
    rows, columns = np.indices(shape)
    along = np.abs(rows - centre[0] if down else columns - centre[1])
    assert (drawn == (share > 0.01))[(along <= 8) & ((share == 0) | (share > 0.02))].all()
    draw_strips(row, column, found, np.array([False]), cleared := np.zeros(shape, np.float32), level, own)
    assert not cleared.any()


def test_own_share_of_a_strip_is_that_of_the_noise_that_it_keeps():
    rng = np.random.default_rng(4)
    shape = (43, 43)
    share = strip(shape, 21, 21, 0.2, 0.0, 1.3, down=True)
    one, found, pulled = np.array([21]), np.empty((1, FIELDS)), []
    for _ in range(300):
        noise = 0.05 * rng.normal(size=shape)
        values = np.pad((noise - 4.0 * share).astype(np.float32), HALF_CUT, constant_values=np.inf)
        fit_strips(
            values, HALF_CUT, one, one, np.array([True]), np.array([0.2]), WIDTHS[:1], 4.0, 5.0, 1e9, np.inf, found
        )
        gain, level, own = (np.zeros(shape, np.float32) for _ in range(3))
        draw_strips(one, one, found, np.array([True]), gain, level, own)
        pulled.append(((level + 4.0 * share) * noise)[21, 21] / 0.05**2)
    assert np.mean(pulled) == pytest.approx(own[21, 21], abs=4 * np.std(pulled) / np.sqrt(300))
    assert 0.02 < own[21, 21] < 0.1


@pytest.mark.parametrize(("repeated", "expected"), [(1, 1.0), (2, 2.0), (3, 3.0)])
def test_a_strip_counts_less_in_noise_that_neighbours_share(repeated, expected):
    """Rows that come twice or three times: the mean of a line has two or three times the variance."""
    rng = np.random.default_rng(6)
    share = strip((43, 43), 21, 21, 0.0, 0.0, 1.3, down=True)
    one, down, level = np.array([21]), np.array([True]), np.array([0.0])
    plain, lessened, variances = np.empty((1, FIELDS)), np.empty((1, FIELDS)), []
    for _ in range(150):
        noise = np.repeat(rng.normal(size=(43, 43)), repeated, axis=0)[:43]
        values = np.pad((noise - 4.0 * share).astype(np.float32), HALF_CUT, constant_values=np.inf)
        fit_strips(values, HALF_CUT, one, one, down, level, WIDTHS, 4.0, 5.0, 1e9, np.inf, plain)
        fit_strips(values, HALF_CUT, one, one, down, level, WIDTHS, 4.0, 5.0, 0.01, np.inf, lessened)
        np.testing.assert_array_equal(plain[0, 1:], lessened[0, 1:])
        variances.append(0.01 * (plain[0, 0] / lessened[0, 0]) ** 2)
    assert np.mean(variances) == pytest.approx(expected, rel=0.12)


def test_a_strip_does_not_depend_on_the_peaks_before_it():
    values = np.pad(noise((90, 90), 8) - 560.0, HALF_CUT, constant_values=np.inf)
    values = np.where(np.isnan(values), np.inf, values / 0.006).astype(np.float32)
    rng = np.random.default_rng(9)
    row, column = rng.integers(0, 90, (2, 400))
    steep, slope = rng.random(400) < 0.5, rng.uniform(-1.0, 1.0, 400)
    found, turned = np.empty((400, FIELDS)), np.empty((400, FIELDS))
    rest = (WIDTHS, 0.0, 0.0, 0.01, np.inf)
    fit_strips(values, HALF_CUT, row, column, steep, slope, *rest, found)
    back = [np.ascontiguousarray(field[::-1]) for field in (row, column, steep, slope)]
    fit_strips(values, HALF_CUT, *back, *rest, turned)
    assert (found[:, 0] > 0).all()
    np.testing.assert_array_equal(turned[::-1], found)


def test_chains_and_peaks_like_loops():
    rng = np.random.default_rng(0)
    ground, median = rng.normal(size=(2, 12, 15))
    count = rng.integers(0, 8, (12, 15)).astype(float)
    ground[2, 3] = np.inf
    depth = np.zeros((28, 31), np.float32)
    line_depths(ground, median, count, 3, 2.0, np.inf, 8, depth)
    inner = np.where((count >= 3) & np.isfinite(ground), 2.0 * (ground - median), 0.0)
    np.testing.assert_allclose(depth[8:-8, 8:-8], inner, rtol=1e-6)
    assert depth[:8].any() == depth[:, -8:].any() == False  # noqa: E712
    best, direction = np.full((12, 15), 1.5, np.float32), np.zeros((12, 15), np.uint8)
    chain_lines(depth, 8, 7, -3, 0, 1, np.uint8(5), best, direction)
    for i, j in np.ndindex(12, 15):
        ends = [max(depth[i + 8 + s * 7, j + 8 - s * 3 + k] for k in (-1, 0, 1)) for s in (-1, 1)]
        total = depth[i + 8, j + 8] + sum(ends)
        assert best[i, j] == pytest.approx(max(total, 1.5), abs=1e-5)
        assert direction[i, j] == (5 if total > 1.5 + 1e-6 else 0)
    contrast = np.zeros((12, 15), np.float32)
    contrast[9, 11] = 11.0
    best[4, 4] = best[4, 5] = 50.0
    best[8, 10] = 60.0
    row, column = (a.ravel() for a in np.indices(best.shape))
    peak = np.zeros(row.size, np.bool_)
    mark_peaks(row, column, np.pad(best, 3), np.pad(contrast, 3), np.float32(10.0), peak)
    peak = peak.reshape(best.shape)
    assert peak[4, 4]
    assert not peak[4, 5] and not peak[8, 10]
    for i, j in np.argwhere(peak):
        assert best[i, j] == best[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3].max()
        assert max(abs(i - 9), abs(j - 11)) > 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("way", "sensor", "crack"),
    [
        ("along", SICK, (0.02, 0.03)),
        ("along", SICK, (0.02, 0.02)),
        ("along", SICK, (0.01, 0.03)),
        ("across", SICK, (0.02, 0.03)),
        ("along", PROFILER_5, (0.003, 0.005)),
    ],
)
def test_cracks_that_single_cells_hardly_show(way, sensor, crack):
    """9 × 9 medians lose nine tenths of each; the bar is 10 % of the depth."""
    patch = cracked(sensor, 150, (crack,)) if way == "along" else across(sensor, 150, *crack)
    config, biases = SurfaceSmoothing(sigma_m=sensor.sigma_m), []
    for seed in (3, 4, 5):
        seen = measured(sensor, patch.truth_m, patch.crack_m, seed)
        found, median = smooth_surface(seen.measured_m, config), median_9(seen.measured_m)
        biases.append(depth_bias(seen, found))
        assert rms_m(seen, found) < rms_m(seen, median) / 1.5
        assert abs(width_change_cells(seen, found)) < 2
        assert depth_bias(seen, median) < -0.85
    assert abs(np.mean(biases)) < 0.1


def test_no_strips_where_cells_share_their_noise():
    """A SICK's crack of 20 × 20 mm: seen in cells, and left as before in cells that are interpolated."""
    patch = cracked(SICK, 160, ((0.02, 0.02),))
    off = {}
    for method in ("cells", "points"):
        settings = SurfaceConfig(method=method, sigma_m=SICK.sigma_m).smoothing_settings()
        assert settings is not None
        off[method] = depth_bias(patch, smooth_surface(patch.measured_m, settings))
    assert off["cells"] > -0.1 and off["points"] < -0.2


def test_no_filter_flattens_a_strip():
    patch = cracked(SICK, 150, ((0.02, 0.02),))
    config = SurfaceSmoothing(sigma_m=SICK.sigma_m)
    drawn = detail_median(patch.measured_m, config).drawn
    assert drawn.mean() > 0.01
    of = Smoothing.of(patch.measured_m, config)
    assert not of.chosen[drawn].any() and not of.own[drawn].any() and not of.residual_m[drawn].any()
    assert of.chosen[~drawn].any()


def noise(shape, seed):
    """σ 6 mm, wrong and lost readings."""
    rng = np.random.default_rng(seed)
    height = 560.0 + rng.normal(0.0, 0.006, shape)
    wrong = rng.random(shape) < IMPULSES
    size = rng.uniform(0.1, 1.0, shape) * rng.choice([-1.0, 1.0], shape) * SICK.impulse_m
    height += np.where(wrong, size, 0.0)
    height[rng.random(shape) < 0.05] = np.nan
    return height


def test_no_strip_in_noise():
    assert not detail_median(noise((700, 700), 21), SurfaceSmoothing(sigma_m=0.006)).drawn.any()


def test_strips_have_the_same_bits_in_any_window():
    config = SurfaceSmoothing(sigma_m=0.006)
    height = noise((420, 450), 5)
    y, x = np.indices(height.shape)
    for k in range(6):
        height[np.abs(x - 0.3 * y - 80 * k) < 1.1] -= 0.010
        height[np.abs(y + 0.6 * x - 110 * k) < 1.1] -= 0.010
    whole = detail_median(height, config)
    assert whole.drawn.mean() > 0.02
    for top, left in ((0, 0), (71, 93), (150, 100), (198, 220)):
        window = (slice(top, top + 220), slice(left, left + 230))
        part = detail_median(height[window], config)
        inner = (slice(REACH, -REACH),) * 2
        np.testing.assert_array_equal(part.height_m[inner], whole.height_m[window][inner])
        np.testing.assert_array_equal(part.drawn[inner], whole.drawn[window][inner])


def test_strips_confirm_one_another():
    def strip_of(gain, slope, axis, steep=1.0):
        return [gain, steep, slope, axis, 1.3, 3.0, 0.0, 10.0]

    row, column = np.array([40, 54, 40, 54, 40, 10, 90]), np.array([10, 17, 40, 52, 80, 60, 60])
    strips = np.array(
        [
            strip_of(5.2, 0.5, 0.25), strip_of(5.1, 0.5, 0.5),  # 14 rows on, 7 columns aside
            strip_of(5.2, 0.5, 0.25), strip_of(5.1, 0.5, 0.5),  # five columns off
            strip_of(5.9, 0.0, 0.0), strip_of(6.0, 0.0, 0.0),  # alone
            strip_of(4.9, 0.0, 0.0),
        ]
    )  # fmt: skip
    found = confirmed_strips(row, column, strips, (100, 100))
    assert found.tolist() == [True, True, False, False, False, True, False]
    flat = strips.copy()
    flat[:, 1] = 0.0
    assert confirmed_strips(column, row, flat, (100, 100)).tolist() == found.tolist()
    strips[1, 0] = 4.9  # too little to confirm another
    assert not confirmed_strips(row, column, strips, (100, 100))[0]
