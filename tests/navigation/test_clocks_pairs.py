"""Clocks from pairs of stamps and from arrivals: against known lines, SciPy's linear programming and hull."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from roadscan.ingest.clock_correction import ClockCorrection, Residuals, robust_line
from roadscan.ingest.clock_pairs import PairFit, Pairs, clock_from_arrivals, clock_from_pairs, lower_hull

S = 10**9
T0 = 1_400_000_000 * S


def pairs_of(stamp_s: np.ndarray, apart_s: np.ndarray, sigma_s: float = 0.01) -> Pairs:
    stamp = np.rint(stamp_s * S).astype(np.int64)
    nominal = stamp + T0
    return Pairs(stamp, nominal, nominal + np.rint(apart_s * S).astype(np.int64), np.full(stamp.size, sigma_s))


# --- pairs --------------------------------------------------------------------------------------------


def test_one_pair_gives_the_offset_and_its_stated_sigma() -> None:
    fit = clock_from_pairs(pairs_of(np.array([1234.5]), np.array([-18.25]), 0.05), "auto")
    assert (fit.offset_s, fit.drift) == (-18.25, 0.0)
    assert fit.correction.sigma_offset_s == pytest.approx(0.05)
    assert fit.correction.sigma_drift == pytest.approx(1e-4)  # nothing is known of it but that it is a clock
    assert fit.residuals.residual_s.tolist() == [0.0]
    hour = np.array([fit.correction.reference_gps_ns + 3600 * S])
    assert fit.correction.sigma_s(hour)[0] == pytest.approx(np.hypot(0.05, 0.36))


def test_a_line_through_several_names_the_outlier() -> None:
    draw = np.random.default_rng(7)
    stamp = np.sort(draw.uniform(0, 7200, 12))
    noise = draw.normal(0, 0.01, 12)
    noise[5] += 1.0  # misread by a second
    fit = clock_from_pairs(pairs_of(stamp, 3.5 + 25e-6 * stamp + noise), "estimate")
    assert np.flatnonzero(~fit.residuals.used).tolist() == [5]
    good = np.delete(np.arange(12), 5)
    slope, level = np.polyfit(stamp[good], 3.5 + 25e-6 * stamp[good] + noise[good], 1)
    assert fit.drift == pytest.approx(slope, abs=1e-9)
    assert fit.offset_s + fit.drift * (0.0 - fit.reference_s) == pytest.approx(level, abs=1e-6)
    epochs = np.rint(stamp * S).astype(np.int64) + T0
    expected = epochs + np.rint((level + slope * stamp) * S).astype(np.int64)
    assert np.abs(fit.correction.applied(epochs) - expected).max() < 2_000


def test_two_close_pairs_do_not_make_a_wild_drift() -> None:
    """0.1 s over 10 s would be 10,000 ppm: no clock does that, so it is the reading of the screen."""
    pairs = pairs_of(np.array([0.0, 10.0]), np.array([2.0, 2.1]), 0.1)
    fit = clock_from_pairs(pairs, "auto")
    assert abs(fit.drift) < 1e-4
    assert fit.offset_s == pytest.approx(2.05, abs=1e-3)
    assert clock_from_pairs(pairs, "estimate").drift == pytest.approx(0.01)


@given(
    offset_ns=st.integers(-(10**17), 10**17),
    ppm=st.floats(-80, 80),
    seed=st.integers(0, 1000),
    count=st.integers(3, 40),
)
@settings(max_examples=60, deadline=None)
def test_an_exact_line_is_found(offset_ns: int, ppm: float, seed: int, count: int) -> None:
    stamp = np.unique(np.random.default_rng(seed).integers(0, 36_000, count))
    apart_ns = offset_ns + np.rint(ppm * 1e-6 * stamp * S).astype(np.int64)
    pairs = Pairs(stamp * S, stamp * S + T0, stamp * S + T0 + apart_ns, np.full(stamp.size, 1e-3))
    found = clock_from_pairs(pairs, "estimate").correction
    wrong = found.applied(pairs.nominal_gps_ns) - pairs.time_gps_ns
    assert np.abs(wrong).max() <= 40 + abs(offset_ns) * 2**-50


def test_sigma_of_a_line_is_that_of_its_errors() -> None:
    draw = np.random.default_rng(3)
    squares = []
    for _ in range(300):
        x = np.sort(draw.uniform(0, 3600, 9))
        sigma = np.full(9, 0.02)
        line = robust_line(x, 1.0 + 30e-6 * x + draw.normal(0, 0.02, 9), sigma, "estimate")
        squares.append(
            [
                ((line.at(np.array([line.reference_s]))[0] - 1.0 - 30e-6 * line.reference_s) / line.sigma_offset_s)
                ** 2,
                ((line.drift - 30e-6) / line.sigma_drift) ** 2,
            ]
        )
    assert (np.abs(np.mean(squares, axis=0) - 0.95) < 0.3).all()  # σ never shrinks below the stated, so below 1


# --- arrivals -----------------------------------------------------------------------------------------


def arrivals(seed: int, count: int = 4000, span_s: float = 1800.0, mean_s: float = 4e-3) -> tuple[Pairs, float, float]:
    """Counter stamps, and arrivals that are late by exponential delays and by bursts."""
    draw = np.random.default_rng(seed)
    stamp = np.sort(draw.uniform(0, span_s, count))
    offset, drift = draw.uniform(-50, 50), draw.uniform(-60e-6, 60e-6)
    late = draw.exponential(mean_s, count) + np.where(draw.random(count) < 0.05, draw.uniform(0, 0.2, count), 0.0)
    return pairs_of(stamp, offset + drift * stamp + late, 1e-6), offset, drift


def errors(fit: PairFit, pairs: Pairs, offset: float, drift: float) -> np.ndarray:
    """Error (2,) at both ends of the log (s)."""
    ends = pairs.stamp_ns[[0, -1]]
    true = ends + T0 + np.rint((offset + drift * ends / S) * S).astype(np.int64)
    return (fit.correction.applied(ends + T0) - true) / S


def test_the_lower_envelope_finds_what_a_mean_does_not() -> None:
    """Mean delay 9 ms with bursts; the least delays tell offset and drift to microseconds."""
    worst, normalised = [], []
    for seed in range(20):
        pairs, offset, drift = arrivals(seed)
        fit = clock_from_arrivals(pairs, "estimate")
        worst.append(np.abs(errors(fit, pairs, offset, drift)).max())
        middle = float(fit.reference_s)
        normalised.append(
            [
                (fit.offset_s - offset - drift * middle) / fit.correction.sigma_offset_s,
                (fit.drift - drift) / fit.correction.sigma_drift,
            ]
        )
        assert (fit.residuals.residual_s >= 0).all()
    assert max(worst) < 0.05e-3
    assert (np.sqrt(np.mean(np.square(normalised), axis=0)) > 0.4).all()
    assert (np.sqrt(np.mean(np.square(normalised), axis=0)) < 1.8).all()
    plain = robust_line(
        pairs.stamp_ns / S, (pairs.time_gps_ns - pairs.nominal_gps_ns) / S, np.full(4000, 4e-3), "estimate"
    )
    assert abs(plain.at(np.array([0.0]))[0] - offset) > 2e-3  # what least squares would have said


def test_the_envelope_is_the_linear_programme_of_moon() -> None:
    """min Σ (y − a − b x) subject to a + b x ≤ y."""
    pairs, _, _ = arrivals(3, 400)
    fit = clock_from_arrivals(pairs, "estimate")
    x = (pairs.stamp_ns - pairs.stamp_ns[0]) / S
    y = (pairs.time_gps_ns - pairs.nominal_gps_ns - (pairs.time_gps_ns - pairs.nominal_gps_ns)[0]) / S
    centred = (x - x.mean()) / x.std()
    solved = linprog(
        [-x.size, -centred.sum()],
        A_ub=np.column_stack([np.ones(x.size), centred]),
        b_ub=y,
        bounds=[(None, None), (None, None)],
        method="highs",
    )
    assert fit.drift == pytest.approx(solved.x[1] / x.std(), abs=1e-9)


@given(seed=st.integers(0, 10_000), count=st.integers(3, 300), shape=st.sampled_from(["noise", "convex", "concave"]))
@settings(max_examples=80, deadline=None)
def test_the_lower_hull_is_scipys(seed: int, count: int, shape: str) -> None:
    draw = np.random.default_rng(seed)
    x = np.unique(draw.uniform(0, 1, count))
    bend = {"noise": 0.0, "convex": 1.0, "concave": -1.0}[shape]
    y = bend * (x - 0.5) ** 2 + draw.uniform(0, 0.3, x.size)
    ours = lower_hull(x, y)
    theirs = ConvexHull(np.column_stack([x, y])).vertices
    lower = [i for i in theirs if _is_below(x, y, i)]
    assert ours.tolist() == sorted(lower, key=lambda i: x[i])


def _is_below(x: np.ndarray, y: np.ndarray, i: int) -> bool:
    """On the lower side: no point lies below the chord between the ends and it."""
    first, last = int(np.argmin(x)), int(np.argmax(x))
    return i in (first, last) or y[i] < y[first] + (y[last] - y[first]) * (x[i] - x[first]) / (x[last] - x[first])


def test_arrivals_without_drift_and_of_a_short_log() -> None:
    pairs, offset, _ = arrivals(1, 200, span_s=0.5)
    fit = clock_from_arrivals(pairs, "auto")  # half a second says nothing of 100 ppm
    assert (fit.drift, fit.correction.sigma_drift) == (0.0, 1e-4)
    assert fit.offset_s == pytest.approx(offset, abs=0.5e-3)
    assert clock_from_arrivals(pairs, "none").correction.sigma_drift == 0.0
    alone = clock_from_arrivals(pairs_of(np.array([5.0]), np.array([2.0])), "auto")
    assert alone.offset_s == pytest.approx(2.0)


# --- corrections --------------------------------------------------------------------------------------


def test_a_correction_is_applied_about_its_reference() -> None:
    found = ClockCorrection(0.25, 2e-6, T0, sigma_offset_s=1e-3, sigma_drift=1e-6, correlation=-0.5)
    epochs = T0 + np.array([0, 1000, -1000]) * S
    assert (found.applied(epochs) - epochs).tolist() == [250_000_000, 252_000_000, 248_000_000]
    assert found.sigma_s(epochs) == pytest.approx([1e-3, 1e-3, np.sqrt(3) * 1e-3])  # 1 + 1 ∓ 1


def test_weights_are_shares_of_what_is_used() -> None:
    left = Residuals(np.arange(3), np.array([1.0, -1.0, 9.0]), np.array([1.0, 2.0, 1.0]), np.array([True, True, False]))
    assert left.weights.tolist() == [0.8, 0.2, 0.0]
    assert left.rms_s == pytest.approx(1.0)
