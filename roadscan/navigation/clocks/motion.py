"""The clock of a sensor from motion that it shares with one whose clock is right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from roadscan.model.clock_evidence import Drift
from roadscan.model.errors import NavigationError
from roadscan.model.gpstime import NS_PER_S
from roadscan.navigation.clocks.correction import ClockCorrection, Residuals
from roadscan.navigation.clocks.lag import STEP_S, Lag, coarse_lag
from roadscan.navigation.clocks.lines import Line, robust_line
from roadscan.navigation.clocks.signals import Felt, Motion

Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

_CHUNK_S: Final = 300.0
"""The coarse lag is found in pieces of this length: a bad clock drifts away from a lag of the whole."""
_WINDOWS: Final = 30
_WINDOW_OF_RATES_S: Final = (2.0, 10.0)
_WINDOW_OF_TOTALS_S: Final = (6.0, 30.0)
"""Shortest and longest window. Within one a bias of the gyroscopes and the zero of a counter do not change."""
_GAP: Final = 5.0
_APART_S: Final = 2.0
_ANSWER: Final = 0.05
"""A shift changes what is left by at least this share of what the smoothed motion lets expect."""
_LEAST_SAMPLES: Final = 20
_LEAST_WINDOWS: Final = 3
_POOR: Final = 30.0
"""Windows whose σ is so many times that of the better ones say nothing: no motion."""
_SOME: Final = 0.1
"""A shift that explains less of what was felt points nowhere."""
_ROUNDS: Final = 25
_LEARNING: Final = 2
"""Rounds after which the noise is known."""
_SETTLED_S: Final = 1e-7
_SETTLED: Final = 0.02
"""The estimate stands when it moves by less than this, or this share of its σ."""
_GAIN: Final = (0.5, 2.0)
"""Rates that are so many times those of the other sensor are in another unit."""
_OTHER_UNIT: Final = 20.0
"""The same, before noise and offset are known."""


@dataclass(frozen=True)
class MotionFit:
    """A clock that was found from motion."""

    correction: ClockCorrection
    residuals: Residuals
    explained: float
    """Share of the variance of what was felt that the motion explains, 0–1."""
    gain: float
    """What was felt is so many times what it should have been."""
    scale: float
    """Factor that the windows' scatter asked their σ to be multiplied by."""


def clock_from_motion(felt: Felt, motion: Motion, *, search_s: float, drift: Drift, what: str) -> MotionFit:
    """Offset and drift of the clock that stamped `felt`, so that it fits `motion`.

    Coarse lags of pieces first, then maximum likelihood: with F the motion's rates (or totals), continuous in time,

        felt(e) = A · F(e + offset + drift · (e − reference)) + b + noise,

    where the matrix A (orientation, scale, lever arms) and a constant b a window of time are not known. Gauss–Newton
    steps: each window gives the lag that its residuals ask for, with the σ that its noise and motion allow; a robust
    line through the lags corrects offset and drift. At the end the lags scatter about zero, and their scatter is
    held against their σ.

    Parameters
    ----------
    what : the sensor and its run, for messages.

    Raises
    ------
    NavigationError
        where the motion does not tell the lag: too little of it, periodic, or an offset beyond `search_s`.
    """
    _check_units(felt, motion, what)
    start = _start(felt, motion, search_s, drift, what)
    windows = _Windows.of(felt, motion)
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
        if moved < max(_SETTLED_S, _SETTLED * line.sigma_offset_s):
            break
    else:
        raise _too_little(what, f"the estimate does not settle (it still moves by {moved:.2g} s)")
    _check(lags, line, start, what)
    return _fit(felt, motion, lags, line)


def _start(felt: Felt, motion: Motion, search_s: float, drift: Drift, what: str) -> Line:
    """Line through the coarse lags of pieces, or the lag of the whole."""
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
    """The recording in pieces of about five minutes."""
    since = (felt.epochs_gps_ns - felt.epochs_gps_ns[0]).astype(np.float64) / NS_PER_S
    count = max(1, round(since[-1] / _CHUNK_S))
    cuts = np.searchsorted(since, np.linspace(0.0, since[-1], count + 1)[1:-1])
    parts = np.split(np.arange(since.size), cuts)
    return [Felt(felt.epochs_gps_ns[p], felt.values[p], felt.is_total) for p in parts if p.size > _LEAST_SAMPLES]


@dataclass(frozen=True)
class _Lags:
    """What the windows say."""

    middle_s: Float64
    """(w,) since the motion's origin, by the sensor's clock."""
    lag_s: Float64
    """(w,) lag that the window asks for, to be added to the sensor's epochs."""
    sigma_s: Float64
    """(w,)"""
    moving: Bool
    """(w,) False where a window says next to nothing."""
    explained: float
    gain: float
    keep: float
    """Of the filter that made the noise white."""


@dataclass(frozen=True)
class _Windows:
    """A recording cut into windows of time."""

    since_s: Float64
    """(n,) since the motion's origin, by the sensor's clock."""
    values: Float64
    """(n, c)"""
    window: Int64
    """(n,) number of the window, growing."""
    motion: Motion
    is_total: bool
    longest_s: float
    """Longest time over which a bias or a zero is taken as constant."""

    @classmethod
    def of(cls, felt: Felt, motion: Motion) -> _Windows:
        since = (felt.epochs_gps_ns - motion.origin_gps_ns).astype(np.float64) / NS_PER_S
        shortest, longest = _WINDOW_OF_TOTALS_S if felt.is_total else _WINDOW_OF_RATES_S
        length = float(np.clip((since[-1] - since[0]) / _WINDOWS, shortest, longest))
        window = np.floor((since - since[0]) / length).astype(np.int64)
        return cls(since, felt.values, window, motion, felt.is_total, longest)

    def lags(self, line: Line, keep: float | None) -> _Lags | None:
        """Lag that each window asks for, linearised about a line; None where fewer than three are left.

        keep : of the filter that makes the noise white; None: it is found from the residuals.
        """
        shifted = self.since_s + line.at(self.since_s)
        rows = self._rows(self.motion.known(shifted))
        if rows.size == 0:
            return None
        _, group = np.unique(self.window[rows], return_inverse=True)
        if group[-1] + 1 < _LEAST_WINDOWS:
            return None
        since, y = self.since_s[rows], self.values[rows]
        f, df = self.motion.at(shifted[rows], total=self.is_total)
        z, dz, ddz = self.motion.smooth(shifted[rows], total=self.is_total)
        if keep is None:
            mixing = _mixing(_centred(z, group), _centred(f, group), _centred(y, group), np.ones(rows.size))
            keep = _keep(since, _centred(y, group) - _centred(f, group) @ mixing, self.longest_s)
        white = _Whitening(keep, _starts(since))
        f, df, z, dz, ddz, y = (white.applied(v) for v in (f, df, z, dz, ddz, y))
        weight = np.ones(group[-1] + 1)
        for _ in range(3):  # windows in which something else was felt do not shape A
            mixing = _mixing(z, f, y, weight[group])
            left = y - f @ mixing
            variance = _variance(left, group)
            usual = np.median(variance, axis=0)
            weight = np.min(usual / np.maximum(variance, usual), axis=1)
        noise = np.maximum(variance, usual) + 1e-300
        shadow = _mixing(f, z, dz @ mixing, weight[group])
        lever, turn = dz @ mixing - z @ shadow, ddz @ mixing - dz @ shadow  # a wrong A does not show in the lever
        precision = (lever**2 / noise[group]).sum(axis=1)
        change = (lever * (df @ mixing) - turn * left) / noise[group]
        own, changes = (np.bincount(group, v).astype(np.float64) for v in (precision, change.sum(axis=1)))
        answer = _answer(own, changes)
        if answer is None:
            return None
        information = own * answer**2
        asked = np.bincount(group, (lever * left / noise[group]).sum(axis=1)) * answer
        middle = np.bincount(group, precision * since) / np.maximum(own, 1e-300)
        middle = np.where(own > 0.0, middle, _means(since[:, None], group)[:, 0])
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = 1.0 / np.sqrt(information)
            lag = line.at(middle) + np.where(information > 0.0, asked / information, 0.0)
        moving = sigma <= _POOR * np.quantile(sigma, 0.1)
        total = float((y**2).sum())
        explained = 1.0 - float((left**2).sum()) / total if total > 0.0 else 0.0
        gain = float(np.sqrt(((f @ mixing) ** 2).sum() / max(float((f**2).sum()), 1e-300)))
        return _Lags(middle, lag, sigma, moving & np.isfinite(sigma), explained, gain, keep)

    def _rows(self, known: Bool) -> Int64:
        """Samples that are known, in windows that hold enough of them."""
        count = np.bincount(self.window, known, minlength=int(self.window[-1]) + 1)
        full = count >= max(_LEAST_SAMPLES, 0.3 * count.max())
        return np.flatnonzero(known & full[self.window])


@dataclass(frozen=True)
class _Whitening:
    """Filter that makes noise white which is the sum of white noise and a random walk: an ARMA(0, 1, 1) process.

    e[k] = θ e[k − 1] + r[k] − r[k − 1] (Box and Jenkins 1976, 4.3.2). Ticks of a counter and gyroscopes' noise are
    white; errors of positions and biases walk. A constant is taken away with it.
    """

    keep: float
    """θ: near 1 where next to nothing walks, 0 where all does."""
    starts: Int64
    """Samples before which there is a gap, and the first one."""

    def applied(self, values: Float64) -> Float64:
        """Filtered columns (n, c). Nothing is carried over a gap; after one, the level is that of the first samples."""
        level_of = max(1, round(1.0 / (1.0 - self.keep)))
        out = np.empty_like(values)
        for part in np.split(np.arange(values.shape[0]), self.starts[1:]):
            own = values[part]
            steps = np.diff(own, axis=0, prepend=own[:level_of].mean(axis=0, keepdims=True))
            out[part] = lfilter([1.0], [1.0, -self.keep], steps, axis=0)
        return out


def _starts(since_s: Float64) -> Int64:
    """The first sample, and those after a gap."""
    steps = np.diff(since_s)
    return np.concatenate([[0], np.flatnonzero(steps > _GAP * np.median(steps)) + 1])


def _keep(since_s: Float64, left: Float64, memory_s: float) -> float:
    """Of the filter that makes residuals (n, c) white: from how much they differ at once and after two seconds.

    memory_s : longest memory.
    """
    step_s = float(np.median(np.diff(since_s)))
    longest = float(np.exp(-step_s / memory_s))
    apart = max(2, round(_APART_S / step_s))
    if since_s.size <= 2 * apart:
        return longest
    unit = left / np.maximum(np.median(np.abs(left), axis=0), 1e-300)
    near, far = (float(np.median(np.square(unit[m:] - unit[:-m]))) for m in (1, apart))
    walk = max(far - near, 0.0) / (apart - 1)
    ratio = walk / (max(near - walk, 1e-300) / 2)
    return float(np.clip(1.0 + ratio / 2 - np.sqrt(ratio + ratio * ratio / 4), 0.0, longest))


def _means(values: Float64, group: Int64) -> Float64:
    count = np.maximum(np.bincount(group), 1)
    return np.stack([np.bincount(group, column) / count for column in values.T], axis=-1)


def _centred(values: Float64, group: Int64) -> Float64:
    return values - _means(values, group)[group]


def _answer(precision: Float64, change: Float64) -> Float64 | None:
    """How far what is left really changes with a shift, by what the smoothed motion lets expect, a window (w,).

    Windows that say little take over what all say. None where all is noise.
    """
    mean = float(precision.mean())
    usual = float(change.mean()) / max(mean, 1e-300)
    if not usual > _ANSWER:
        return None
    own = (change + mean * usual) / (precision + mean)
    return np.asarray(np.maximum(own, 0.3 * usual))


def _mixing(instrument: Float64, f: Float64, y: Float64, weight: Float64) -> Float64:
    """A (p, c) with which f @ A explains y: instrumental variables, so that noise in f does not make A too small.

    instrument : (n, p) like f, without its noise.
    """
    weighted = instrument * weight[:, None]
    size = np.sqrt((f**2).mean(axis=0))  # distances and angles are of different size
    size = np.where(size > 0.0, size, 1.0)
    normal = (weighted.T @ f) / np.outer(size, size)
    right = (weighted.T @ y) / size[:, None]
    mixing: Float64 = np.linalg.pinv(normal, rcond=1e-6) @ right / size[:, None]
    return mixing


def _variance(left: Float64, group: Int64) -> Float64:
    """(w, c) variance of residuals about zero a window."""
    count = np.maximum(np.bincount(group) - 1, 1)
    return np.stack([np.bincount(group, column**2) / count for column in left.T], axis=-1)


def _check(lags: _Lags, line: Line, start: Line, what: str) -> None:
    """Refuse an estimate that left the coarse lag's peak, or that is in another unit."""
    away = np.abs(line.at(lags.middle_s) - start.at(lags.middle_s)).max()
    if line.sigma_offset_s > STEP_S or np.count_nonzero(line.used) < _LEAST_WINDOWS:
        raise _too_little(what, f"the offset is known to {line.sigma_offset_s:.2g} s only")
    if away > 10 * STEP_S:
        raise _too_little(what, f"the fine estimate lies {away:.2g} s from the coarse one")
    if not _GAIN[0] <= lags.gain <= _GAIN[1]:
        raise _wrong_unit(what, lags.gain)


def _check_units(felt: Felt, motion: Motion, what: str) -> None:
    """Refuse what cannot be the same motion in the same unit."""
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


def _fit(felt: Felt, motion: Motion, lags: _Lags, line: Line) -> MotionFit:
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
