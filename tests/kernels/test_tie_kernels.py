"""Kernels of places, patches and shifts on tiny arrays, against NumPy and sums by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from roadscan.adjust.kernels.places import (
    Bins,
    Cells,
    Frame,
    Laid,
    Limits,
    Meetings,
    Samples,
    Splat,
    Spread,
    Visits,
    add_moments,
    cell_numbers,
    correlate,
    feet,
    fill_cells,
    lay_upon,
    leave_out_far,
    local_axes,
    meetings,
    splat,
    visits,
)


def two_tracks() -> Samples:
    """Eleven samples to the north at easting 0 and at easting 3, 2 m apart; the second an hour later."""
    n = 11
    north = np.tile(2.0 * np.arange(n), 2)
    east = np.repeat([0.0, 3.0], n)
    since = np.tile(0.1 * np.arange(n), 2) + np.repeat([0.0, 3600.0], n)
    joined = np.tile(np.arange(n) < n - 1, 2)
    return Samples(east, north, np.zeros(2 * n), np.zeros(2 * n), since, np.full(2 * n, 2.0), np.full(2 * n, 2.0),
                   np.repeat(np.array([0, 1], np.int32), n), joined)  # fmt: skip


def test_visits_meetings_and_feet() -> None:
    samples = two_tracks()
    bins = Bins(np.arange(22), np.zeros(22, np.int64), 1000.0, 1, 0.0, 0.0)
    lead = np.array([0, 5], np.int64)
    out = Visits(*(np.zeros(4, np.int64) for _ in range(3)), np.zeros(4), np.zeros(4))
    count = visits(samples, bins, lead, Limits(30.0, 2.0), out)
    assert count == 2
    assert out.lead[:2].tolist() == [0, 1]
    # The other track sees from 2 m left of its own line: offsets 1 to 3 of the lead, which sees up to 2.
    assert out.low_m[:2] == pytest.approx(1.0)
    assert out.high_m[:2] == pytest.approx(2.0)
    assert (out.first[1], out.last[1]) == (15, 16)
    # Too short an output still says how much is needed.
    assert visits(samples, bins, lead, Limits(30.0, 2.0), Visits(*(a[:1] for a in out))) == 2
    found = Visits(*(a[:2] for a in out))
    met = Meetings(np.zeros(4, np.int64), np.zeros(4), np.zeros(8, np.int64), np.zeros(8, np.int64))
    alone, aside = np.zeros(2, np.bool_), np.zeros(2)
    assert meetings(samples, found, lead, Spread(0.2, 0.5), aside, alone, met) == (2, 2)
    assert met.offset_m[:2] == pytest.approx(1.5)
    foot = np.zeros(1)
    feet(samples, np.array([1.5]), np.array([10.5]), np.array([14]), np.array([17]), foot)
    assert foot[0] == pytest.approx(11 + 10.5 / 2.0)


def test_local_axes_and_cell_numbers() -> None:
    heading = 0.3
    along, across = np.array([0.2, -0.4]), np.array([0.1, 0.3])
    e = along * math.sin(heading) + across * math.cos(heading) + 500.0
    n = along * math.cos(heading) - across * math.sin(heading) + 900.0
    a, c = np.zeros(2), np.zeros(2)
    local_axes(e, n, Frame(500.0, 900.0, math.sin(heading), math.cos(heading)), a, c)
    assert a == pytest.approx(along)
    assert c == pytest.approx(across)
    number, count = np.zeros(3, np.int32), np.zeros(16, np.int64)
    cell_numbers(np.array([-0.99, 0.1, 1.2]), np.array([0.6, -0.6, 0.0]), 1.0, 0.5, 4, number, count)
    assert number.tolist() == [3, 8, -1]
    assert count.sum() == 2


def test_cells_hold_the_mean_of_the_middle_half() -> None:
    height = np.array([3.0, 1.0, 100.0, 2.0, 4.0, -50.0, 5.0, 6.0, 9.0])
    number = np.array([0, 0, 0, 0, 0, 0, 0, 0, 1], np.int32)
    count = np.array([8, 1, 0], np.int64)
    cells = Cells(np.zeros(3), np.zeros(3), np.zeros(3, np.int32), np.zeros(3))
    fill_cells(number, height, np.arange(9, dtype=np.uint16), count, 2, cells)
    assert cells.height_m[0] == pytest.approx(np.mean([2.0, 3.0, 4.0, 5.0]))
    assert cells.spread_m[0] == pytest.approx((5.0 - 2.0) / 1.349)
    assert np.isnan(cells.height_m[1:]).all()
    assert cells.used.tolist() == [8, 1, 0]
    assert cells.intensity[0] == pytest.approx(3.5)
    # Of many readings an even choice: none of a cell's first or last are left out as a block.
    many = np.arange(320, dtype=np.float64)
    one = Cells(np.zeros(1), np.zeros(1), np.zeros(1, np.int32), np.zeros(1))
    fill_cells(np.zeros(320, np.int32), many, np.zeros(320, np.uint16), np.array([320], np.int64), 2, one)
    assert one.used[0] == 32
    assert one.height_m[0] == pytest.approx(159.5, abs=6.0)


def test_splat_keeps_sums_and_centres() -> None:
    sums = Splat(*(np.zeros((4, 4)) for _ in range(3)))
    road = np.array([10.0])
    along, across = np.array([1.3, 2.0, 1.0]), np.array([1.9, 2.2, 1.0])
    height = np.array([10.01, 9.98, 11.0])
    grey = np.array([100, 300, 9000], np.uint16)
    splat(along, across, height, grey, np.zeros(3, np.int32), road, 0.05, 10.0, 1.0, sums)
    assert sums.mass.sum() == pytest.approx(2.0)  # the third lies a metre above the road
    assert sums.height.sum() == pytest.approx(0.01 - 0.02)
    assert sums.intensity.sum() == pytest.approx(400.0)
    middle = np.arange(4) + 0.5
    assert (sums.mass.sum(axis=1) @ middle) == pytest.approx(along[:2].sum())
    assert (sums.mass.sum(axis=0) @ middle) == pytest.approx(across[:2].sum())


def test_correlate_against_numpy() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=(2, 12, 12))
    second[3:6, 3:6] = np.nan
    shifts, out = np.array([-2, 0, 3]), np.zeros((3, 3))
    correlate(first, second, 1, shifts, shifts, 20, out)
    for i, a in enumerate(shifts):
        for j, b in enumerate(shifts):
            r, c = np.meshgrid(np.arange(12), np.arange(12), indexing="ij")
            inside = (r + a >= 0) & (r + a < 12) & (c + b >= 0) & (c + b < 12)
            x, y = first[r[inside], c[inside]], second[r[inside] + a, c[inside] + b]
            seen = np.isfinite(y)
            assert out[i, j] == pytest.approx(np.corrcoef(x[seen], y[seen])[0, 1])
    correlate(first, second, 1, np.array([11]), np.array([11]), 20, out)
    assert np.isnan(out[0, 0])


def test_lay_upon_a_shifted_picture() -> None:
    rng = np.random.default_rng(2)
    wave = gaussian_filter(rng.normal(size=(64, 64)), 4.0, mode="wrap")
    phase = np.exp(-2j * np.pi * (np.fft.fftfreq(64)[:, None] * 1.3 + np.fft.fftfreq(64)[None] * -0.6))
    moved = np.fft.ifft2(np.fft.fft2(wave) * phase).real
    laid = Laid(np.zeros((64, 64)), np.zeros((64, 64, 2)), np.zeros((64, 64, 2)))
    lay_upon(wave, moved, 1.3, -0.6, laid)
    inside = np.s_[8:-8, 8:-8]
    assert np.abs(laid.left[inside]).max() < 0.02 * wave.std()
    assert np.isnan(laid.left[0]).all()
    slope = laid.first_slope[inside]
    assert np.abs(slope - laid.second_slope[inside]).max() < 0.1 * np.abs(slope).max()
    assert slope[..., 1] == pytest.approx(np.gradient(wave, axis=0)[inside])


def test_moments_of_groups_are_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    point, group, kept = rng.normal(size=(40, 3)), rng.integers(0, 3, 40), rng.random(40) < 0.8
    count, total, squares = np.zeros(4, np.int64), np.zeros((4, 3)), np.zeros((4, 6))
    add_moments(point, group, kept, count, total, squares)
    for g in range(4):
        own = point[kept & (group == g)]
        assert count[g] == len(own)
        assert total[g] == pytest.approx(own.sum(axis=0))
        assert squares[g] == pytest.approx((own.T @ own)[np.triu_indices(3)])


def test_points_far_from_the_plane_of_their_group_are_left_out() -> None:
    point = np.array([[0.0, 0.0, 0.1], [5.0, 0.0, 0.3], [0.0, 0.0, 0.1], [0.0, 0.0, 0.0]])
    kept = np.array([True, True, True, False])
    normal = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    leave_out_far(point, np.array([0, 0, 1, 0]), np.zeros((2, 3)), normal, np.array([0.2, -1.0]), kept)
    assert kept.tolist() == [True, False, False, False]
