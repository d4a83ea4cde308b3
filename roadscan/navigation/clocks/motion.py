"""Estimates the clock of a sensor from a motion that another sensor with a right clock measured too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.clock_evidence import Drift
from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S
from roadscan.ingest.clocks.correction import ClockCorrection, Residuals
from roadscan.ingest.clocks.lines import Line, robust_line
from roadscan.navigation.clocks.lag import STEP_S, Lag, coarse_lag
from roadscan.navigation.clocks.signals import Felt, Motion
from roadscan.navigation.clocks.windows import LEAST_SAMPLES, LEAST_WINDOWS, Lags, Windows

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
