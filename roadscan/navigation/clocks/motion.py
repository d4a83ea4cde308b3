"""Estimates the clock of a sensor from a motion that another sensor with a right clock measured too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.clock_evidence import Drift
from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S
from roadscan.ingest.clock_correction import ClockCorrection, Line, Residuals, robust_line
from roadscan.navigation.clocks.signals import LEAST_SAMPLES, LEAST_WINDOWS, Felt, Lags, Motion, Windows

STEP_S: Final = 0.05
"""Width of the bins of the coarse search."""
_CLEAR: Final = 1.5
"""The best shift is unambiguous if it leaves this many times less than the next, or explains as many times more."""
_LEAST_SHARE: Final = 0.5
"""Shifts with fewer common bins than this share of those of the best shift are not considered."""
_LEAST_BINS: Final = 40  # Least number of common bins of a shift.
_AXES: Final = 3  # Axes of an angular rate, which a rotation maps.
_LOBE: Final = 0.5
"""The main peak extends to where half of the explained variance is left."""


@dataclass(frozen=True)
class Lag:
    """The best shift of a recording, and the best one outside its peak."""

    since_s: float
    """Middle of the recording, since the motion's origin by the sensor's clock."""
    lag_s: float
    """Lag that explains the recording best when it is added to the sensor's epochs."""
    explained: float
    """Share of the variance that the motion explains at this lag, 0–1."""
    next_lag_s: float
    next_explained: float
    """The same for the best shift outside the main peak; 0 where there is none."""
    at_edge: bool
    """True where the best shift is the largest one considered."""

    @property
    def is_clear(self) -> bool:
        """True where no other shift is nearly as good."""
        if self.at_edge or self.explained <= 0.0:
            return False
        left, next_left = 1.0 - self.explained, 1.0 - self.next_explained
        return next_left >= _CLEAR * left or self.explained >= _CLEAR * self.next_explained


def coarse_lag(felt: Felt, motion: Motion, search_s: float, about_s: float = 0.0) -> Lag | None:
    """Return the shift within `about_s` ± `search_s` that explains a recording best; None where too little is known.

    The sensor's orientation need not be known: for each shift the share of variance that the motion explains in the
    axes that suit it best, by Fourier transforms over the bins that both have (masked correlation, Padfield, IEEE
    Trans. Image Process. 2012, 21).
    """
    since = motion.since_s(felt.epochs_gps_ns)
    reach = round(search_s / STEP_S)
    shift = round(about_s / STEP_S)
    first = int(np.floor(since[0] / STEP_S))
    last = int(np.floor(since[-1] / STEP_S)) + 1
    values, has_values = _binned(felt, since, np.arange(first, last + 1))
    edges = np.arange(first + shift - reach, last + shift + reach + 1)
    rates, has_rates = _rates(motion, edges.astype(np.float64) * STEP_S)
    explained = _explained(values, has_values, rates, has_rates, 2 * reach + 1, same_sign=motion.leads)
    if not np.isfinite(explained).any():
        return None
    lags = np.arange(shift - reach, shift + reach + 1).astype(np.float64) * STEP_S
    return _best(lags, explained, float(since[since.size // 2]))


def _best(lags: Float64, explained: Float64, middle_s: float) -> Lag:
    filled = np.where(np.isfinite(explained), explained, 0.0)
    best = int(np.argmax(filled))
    left, right = _lobe(filled, best)
    outside = filled.copy()
    outside[left : right + 1] = 0.0
    second = int(np.argmax(outside))
    at_edge = best in (0, lags.size - 1)
    fine = 0.0
    if not at_edge:
        before, here, after = filled[best - 1 : best + 2]
        bend = before - 2 * here + after
        fine = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return Lag(
        middle_s, float(lags[best]) + fine * STEP_S, float(filled[best]), float(lags[second]), float(outside[second]),
        at_edge,
    )  # fmt: skip


def _lobe(explained: Float64, best: int) -> tuple[int, int]:
    """Return first and last shift of the main peak: down to half of it, and on to the next minimum."""
    edges = []
    for step in (-1, 1):
        at = best
        while 0 <= at + step < explained.size and explained[at + step] > _LOBE * explained[best]:
            at += step
        while 0 <= at + step < explained.size and explained[at + step] < explained[at]:
            at += step
        edges.append(at)
    return edges[0], edges[1]


def _binned(felt: Felt, since_s: Float64, edges: Int64) -> tuple[Float64, Bool]:
    """Return mean rates (b, c) in the bins between `edges` (b + 1,), and which bins have samples around them (b,)."""
    if felt.is_total:
        totals = felt.values
    else:
        steps = 0.5 * (felt.values[1:] + felt.values[:-1]) * np.diff(since_s)[:, None]
        totals = np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])
    at = edges * STEP_S
    columns = [np.interp(at, since_s, totals[:, c]) for c in range(totals.shape[1])]
    interval = np.clip(np.searchsorted(since_s, at, side="right") - 1, 0, since_s.size - 2)
    near = np.diff(since_s)[interval] <= max(5.0 * felt.interval_s, STEP_S)
    known = near & (at >= since_s[0]) & (at <= since_s[-1])
    return np.diff(np.stack(columns, axis=-1), axis=0) / STEP_S, known[1:] & known[:-1]


def _rates(motion: Motion, edges_s: Float64) -> tuple[Float64, Bool]:
    known = motion.known(edges_s)
    totals = np.where(known[:, None], motion.at(edges_s, total=True)[0], 0.0)
    totals = totals[:, :1] if motion.leads else totals
    return np.diff(totals, axis=0) / STEP_S, known[1:] & known[:-1]


def _explained(
    values: Float64, has_values: Bool, rates: Float64, has_rates: Bool, shifts: int, *, same_sign: bool
) -> Float64:
    """Explained share of variance (shifts,), for values that begin 0, 1 … bins after the rates; NaN: unknown.

    same_sign : values are the rates themselves; otherwise they are the rates in other axes, or a mixture.
    """
    fft = scipy.fft
    size = fft.next_fast_len(rates.shape[0] + values.shape[0])

    def together(a: Float64, b: Float64) -> Float64:
        """Return Σ a[k] · b[k + shift] for each shift."""
        product: Float64 = fft.irfft(np.conj(fft.rfft(a, size)) * fft.rfft(b, size), size)[:shifts]
        return product

    of_y, of_x = has_values.astype(np.float64), has_rates.astype(np.float64)
    y = (values - values[has_values].mean(axis=0) if has_values.any() else values) * of_y[:, None]
    x = (rates - rates[has_rates].mean(axis=0) if has_rates.any() else rates) * of_x[:, None]
    channels, regressors = range(y.shape[1]), range(x.shape[1])
    count = np.rint(together(of_y, of_x))
    enough = count >= max(_LEAST_BINS, _LEAST_SHARE * count.max())
    n = np.maximum(count, 1.0)
    mean_x = [together(of_y, x[:, i]) / n for i in regressors]
    mean_y = [together(y[:, c], of_x) / n for c in channels]
    xx = np.empty((shifts, x.shape[1], x.shape[1]))
    for i in regressors:
        for j in regressors:
            xx[:, i, j] = together(of_y, x[:, i] * x[:, j]) / n - mean_x[i] * mean_x[j]
    xy = np.empty((shifts, x.shape[1], y.shape[1]))
    for i in regressors:
        for c in channels:
            xy[:, i, c] = together(y[:, c], x[:, i]) / n - mean_x[i] * mean_y[c]
    yy = sum((together(np.square(y[:, c]), of_x) / n - np.square(mean_y[c]) for c in channels), np.zeros(shifts))
    known = enough & (yy > 0.0)
    explained = _by_rotation(xx, xy) if same_sign or x.shape[1] == y.shape[1] == _AXES else _by_mixing(xx, xy)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip(explained / yy, 0.0, 1.0)
    return np.where(known, share, np.nan)


def _by_rotation(xx: Float64, xy: Float64) -> Float64:
    """Return the variance (s,) of y that x explains after the best rotation: Wahba's problem (Markley 1988).

    xx, xy : (s, k, k) covariances, k = 3, or 1 where y is x.
    """
    if xy.shape[1] == 1:
        best = xy[:, 0, 0]
    else:
        left, size, right = np.linalg.svd(xy)
        best = size[:, 0] + size[:, 1] + size[:, 2] * np.sign(np.linalg.det(left) * np.linalg.det(right))
    explained: Float64 = 2.0 * best - np.einsum("sii->s", xx)
    return explained


def _by_mixing(xx: Float64, xy: Float64) -> Float64:
    """Variance (s,) of y (s, p, c) that a linear combination of x explains, by a regression for each shift."""
    trace = np.maximum(np.einsum("sii->s", xx), 1e-300)
    held = xx + (1e-9 * trace)[:, None, None] * np.eye(xx.shape[1])
    explained: Float64 = np.einsum("sic,sic->s", xy, np.linalg.solve(held, xy))
    return explained


_CHUNK_S: Final = 300.0
"""The coarse lag is found in pieces of this length, since a drifting clock has no single lag."""
_SOME: Final = 0.1
"""A shift that explains a smaller share of the variance is not used."""
_ROUNDS: Final = 25  # Most rounds of the adjustment.
_LEARNING: Final = 2
"""Number of rounds in which the noise is estimated; then it is kept."""
_SETTLED_S: Final = 1e-7  # The estimate is final when it moves by less than this …
_SETTLED: Final = 0.02
"""… or by less than this share of its σ."""
_LONG: Final = 12  # After this many rounds a wider limit applies:
_SWAYING: Final = 0.25
"""An estimate that still changes by this share of its σ is final, too: windows at the edge of being outliers
come and go."""
_GAIN: Final = (0.5, 2.0)
"""Rates outside this range of ratios to those of the other sensor are in another unit."""
_OTHER_UNIT: Final = 20.0
"""The same limit before noise and offset are known."""


@dataclass(frozen=True)
class MotionFit:
    """A clock that was estimated from motion."""

    correction: ClockCorrection
    residuals: Residuals
    explained: float
    """Share of the variance that the motion explains, 0–1."""
    gain: float
    """Ratio of the measured to the expected motion."""
    scale: float
    """Factor on the σ of the windows, from their scatter."""


def clock_from_motion(felt: Felt, motion: Motion, *, search_s: float, drift: Drift, what: str) -> MotionFit:
    """Return offset and drift of the clock that stamped `felt`, so that it fits `motion`.

    Coarse lags of pieces first, then maximum likelihood: with F the motion's rates (or totals), continuous in time,

        felt(e) = A · F(e + offset + drift · (e − reference)) + b + noise,

    where the matrix A (orientation, scale, lever arms) and a constant b a window of time are not known. Gauss–Newton
    steps: each window gives a lag from its residuals, with a σ from its noise and motion; a robust
    line through the lags corrects offset and drift. At the end the lags scatter about zero, and their scatter is
    compared with their σ.

    Parameters
    ----------
    what : the sensor and its run, for messages.

    Raises
    ------
    NavigationError
        where the motion does not determine the lag: too little of it, periodic, or an offset beyond `search_s`.
    """
    _check_units(felt, motion, what)
    start = _start(felt, motion, search_s, drift, what)
    windows = Windows.of(felt, motion)
    line, keep = start, None
    for round_ in range(_ROUNDS):
        lags = windows.lags(line, keep)
        if lags is None:
            raise _too_little(what, "too few samples lie within the other sensor's recording, or it is all noise")
        keep = lags.keep if round_ >= _LEARNING else None
        asked = robust_line(lags.middle_s[lags.moving], lags.lag_s[lags.moving], lags.sigma_s[lags.moving], drift)
        ends = lags.middle_s[[0, -1]]
        moved = float(np.abs(asked.at(ends) - line.at(ends)).max())
        line = asked
        enough = _SETTLED if round_ < _LONG else _SWAYING
        if moved < max(_SETTLED_S, enough * line.sigma_offset_s):
            break
    else:
        raise _too_little(what, f"the estimate does not settle (it still moves by {moved:.2g} s)")
    _check(lags, line, start, what)
    return _fit(felt, motion, lags, line)


def _start(felt: Felt, motion: Motion, search_s: float, drift: Drift, what: str) -> Line:
    """Return the line through the coarse lags of pieces, or the lag of the whole."""
    pieces = _pieces(felt)
    found = [lag for piece in pieces if (lag := coarse_lag(piece, motion, search_s)) is not None]
    clear = [lag for lag in found if lag.is_clear]
    if not clear:
        whole = coarse_lag(felt, motion, search_s)
        if whole is None or not whole.is_clear:
            raise _unclear(what, search_s, whole)
        clear = [whole]
    lags = np.array([lag.lag_s for lag in clear])
    middles = np.array([lag.since_s for lag in clear])
    return robust_line(middles, lags, np.full(lags.size, STEP_S / 2), "none" if drift == "none" else "auto")


def _pieces(felt: Felt) -> list[Felt]:
    """Return the recording in pieces of about five minutes."""
    since = (felt.epochs_gps_ns - felt.epochs_gps_ns[0]).astype(np.float64) / NS_PER_S
    count = max(1, round(since[-1] / _CHUNK_S))
    cuts = np.searchsorted(since, np.linspace(0.0, since[-1], count + 1)[1:-1])
    parts = np.split(np.arange(since.size), cuts)
    return [Felt(felt.epochs_gps_ns[p], felt.values[p], felt.is_total) for p in parts if p.size > LEAST_SAMPLES]


def _check(lags: Lags, line: Line, start: Line, what: str) -> None:
    """Reject an estimate that left the coarse lag's peak, or that is in another unit."""
    away = np.abs(line.at(lags.middle_s) - start.at(lags.middle_s)).max()
    if line.sigma_offset_s > STEP_S or np.count_nonzero(line.used) < LEAST_WINDOWS:
        raise _too_little(what, f"the offset would be known to {line.sigma_offset_s:.2g} s only")
    if away > 10 * STEP_S:
        raise _too_little(what, f"the fine estimate lies {away:.2g} s from the coarse one")
    if not _GAIN[0] <= lags.gain <= _GAIN[1]:
        raise _wrong_unit(what, lags.gain)


def _check_units(felt: Felt, motion: Motion, what: str) -> None:
    """Reject a motion that cannot be the same in the same unit."""
    steps, knots = (np.diff(e) / NS_PER_S for e in (felt.epochs_gps_ns, motion.epochs_gps_ns))
    rates = np.diff(felt.values, axis=0) / steps[:, None] if felt.is_total else felt.values
    moves = np.diff(motion.totals[:, :1] if motion.leads else motion.totals, axis=0) / knots[:, None]
    felt_size, true_size = (np.sqrt((np.var(v, axis=0)).sum()) for v in (rates, moves))
    if felt_size > _OTHER_UNIT * true_size > 0.0 or true_size > _OTHER_UNIT * felt_size:
        raise _wrong_unit(what, float(felt_size / true_size))


def _wrong_unit(what: str, gain: float) -> NavigationError:
    return NavigationError(
        f"{what} felt {gain:.3g} times the motion of the other sensor",
        expected="about the same",
        change="check the unit of its log (degrees for radians: 57.3; ticks: metres_per_tick in the rig file)",
    )


def _fit(felt: Felt, motion: Motion, lags: Lags, line: Line) -> MotionFit:
    origin = motion.origin_gps_ns

    def epochs(since_s: Float64) -> Int64:
        return origin + np.rint(since_s * NS_PER_S).astype(np.int64)

    used = lags.moving.copy()
    used[lags.moving] = line.used
    kept = np.isfinite(lags.sigma_s)
    correction = ClockCorrection(
        offset_s=line.offset_s,
        drift=line.drift,
        reference_gps_ns=int(epochs(np.array([line.reference_s]))[0]),
        sigma_offset_s=line.sigma_offset_s,
        sigma_drift=line.sigma_drift,
        correlation=0.0,
        first_gps_ns=int(felt.epochs_gps_ns[0]),
        last_gps_ns=int(felt.epochs_gps_ns[-1]),
    )
    residuals = Residuals(
        epochs(lags.middle_s[kept]),
        (lags.lag_s - line.at(lags.middle_s))[kept],
        lags.sigma_s[kept],
        used[kept],
    )
    return MotionFit(correction, residuals, lags.explained, lags.gain, line.scale)


def _unclear(what: str, search_s: float, lag: Lag | None) -> NavigationError:
    if lag is None:
        return _too_little(what, f"no shift within ±{search_s:g} s brings enough of both recordings together")
    if lag.at_edge and lag.explained > _SOME:
        return NavigationError(
            f"{what}: the best offset is the largest looked for ({lag.lag_s:+.2f} s)",
            expected=f"an offset within ±{search_s:g} s",
            change="raise search_s, or state what is known of the offset in the log's clock",
        )
    return _too_little(
        what,
        f"an offset of {lag.lag_s:+.2f} s explains {lag.explained:.0%} of what was felt, and one of "
        f"{lag.next_lag_s:+.2f} s explains {lag.next_explained:.0%}",
    )


def _too_little(what: str, why: str) -> NavigationError:
    return NavigationError(
        f"{what}: the motion does not tell the clock's offset: {why}",
        expected="a drive with turns, stops or an uneven road, recorded by both sensors at the same time",
        change="lower search_s to what is known of the offset, record a livelier drive, or give pairs of stamps",
    )
