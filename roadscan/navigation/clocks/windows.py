"""Divides a recording into windows of time, and estimates the lag of each with its σ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.ingest.clocks.lines import Line
from roadscan.navigation.clocks.signals import Felt, Motion

LEAST_SAMPLES: Final = 20  # Least number of samples of a window.
LEAST_WINDOWS: Final = 3  # Least number of windows.
_WINDOWS: Final = 30  # Approximate number of windows of a recording.
_WINDOW_OF_RATES_S: Final = (2.0, 10.0)  # Shortest and longest window of rates.
_WINDOW_OF_TOTALS_S: Final = (6.0, 30.0)
"""Shortest and longest window of totals; within it, the gyroscopes' bias and a counter's zero are constant."""
_FULL: Final = 0.3
"""A window with a smaller share of the samples of the fullest is left out."""
_GAP: Final = 5.0
"""Samples farther apart than this many usual intervals leave a gap."""
_APART_S: Final = 2.0
"""The random walk of the residuals is estimated over this time."""
_ANSWER: Final = 0.05
"""Least ratio of the actual effect of a shift to the effect expected from the smoothed motion."""
_POOR: Final = 30.0
"""Windows whose σ exceeds that of the better ones this many times have no motion and are left out."""


@dataclass(frozen=True)
class Lags:
    """Lags of the windows."""

    middle_s: Float64
    """(w,) since the motion's origin, by the sensor's clock."""
    lag_s: Float64
    """(w,) lag of the window, to be added to the sensor's epochs."""
    sigma_s: Float64
    """(w,) 1 σ of the lag; infinite where nothing moved."""
    moving: Bool
    """(w,) False where a window has almost no information."""
    explained: float
    """Share of the variance that the motion explains, 0–1."""
    gain: float
    """Ratio of the measured to the expected motion."""
    keep: float
    """Parameter θ of the filter that whitens the noise."""


@dataclass(frozen=True)
class Windows:
    """A recording divided into windows of time."""

    since_s: Float64
    """(n,) since the motion's origin, by the sensor's clock."""
    values: Float64
    """(n, c)"""
    window: Int64
    """(n,) number of the window, ascending."""
    motion: Motion
    is_total: bool
    longest_s: float
    """Longest time over which a bias or a zero is taken as constant."""

    @classmethod
    def of(cls, felt: Felt, motion: Motion) -> Windows:
        """Divide into about thirty windows, long enough to separate bias from motion, with a constant bias in each."""
        since = motion.since_s(felt.epochs_gps_ns)
        shortest, longest = _WINDOW_OF_TOTALS_S if felt.is_total else _WINDOW_OF_RATES_S
        length = float(np.clip((since[-1] - since[0]) / _WINDOWS, shortest, longest))
        window = np.floor((since - since[0]) / length).astype(np.int64)
        return cls(since, felt.values, window, motion, felt.is_total, longest)

    def lags(self, line: Line, keep: float | None) -> Lags | None:
        """Return the lag of each window, linearised about a line; None where fewer than three are left.

        Parameters
        ----------
        keep : θ of the filter that makes the noise white; None: it is found from the residuals.
        """
        samples = self._sampled(line)
        if samples is None:
            return None
        theta = samples.keep(self.longest_s) if keep is None else keep
        return _solved(samples.filtered(theta), line, theta)

    def _sampled(self, line: Line) -> _Samples | None:
        """Return samples with the motion at their epochs, as the line corrects them."""
        shifted = self.since_s + line.at(self.since_s)
        known = self.motion.known(shifted)
        count = np.bincount(self.window, known, minlength=int(self.window[-1]) + 1)
        full = count >= max(LEAST_SAMPLES, _FULL * count.max())
        rows = np.flatnonzero(known & full[self.window])
        _, group = np.unique(self.window[rows], return_inverse=True)
        if rows.size == 0 or group[-1] + 1 < LEAST_WINDOWS:
            return None
        motion = self.motion.at(shifted[rows], total=self.is_total)
        smooth = self.motion.smooth(shifted[rows], total=self.is_total)
        return _Samples(self.since_s[rows], group, self.values[rows], *motion, *smooth)


@dataclass(frozen=True)
class _Samples:
    """Measurements y, with the motion F at the corrected epochs."""

    since_s: Float64
    """(n,)"""
    group: Int64
    """(n,) window, 0 … w − 1."""
    y: Float64
    """(n, c)"""
    f: Float64
    """(n, p) F."""
    df: Float64
    """(n, p) derivative of F by time."""
    z: Float64
    """(n, p) F smoothed."""
    dz: Float64
    ddz: Float64

    def keep(self, memory_s: float) -> float:
        """Return θ of the filter that whitens the residuals, from their differences at once and after two seconds.

        memory_s : longest memory.
        """
        z, f, y = (v - _means(v, self.group)[self.group] for v in (self.z, self.f, self.y))
        left = y - f @ _mixing(z, f, y, np.ones(self.since_s.size))
        step_s = float(np.median(np.diff(self.since_s)))
        longest = float(np.exp(-step_s / memory_s))
        apart = max(2, round(_APART_S / step_s))
        if self.since_s.size <= 2 * apart:
            return longest
        unit = left / np.maximum(np.median(np.abs(left), axis=0), 1e-300)
        near, far = (float(np.median(np.square(unit[m:] - unit[:-m]))) for m in (1, apart))
        walk = max(far - near, 0.0) / (apart - 1)
        ratio = walk / (max(near - walk, 1e-300) / 2)
        return float(np.clip(1.0 + ratio / 2 - np.sqrt(ratio + ratio * ratio / 4), 0.0, longest))

    def filtered(self, keep: float) -> _Samples:
        """Return all signals after the filter that whitens the sum of white noise and a random walk.

        e[k] = θ e[k − 1] + r[k] − r[k − 1], an ARMA(0, 1, 1) process turned round (Box and Jenkins 1976, 4.3.2). Ticks
        of a counter and the noise of gyroscopes are white; errors of positions and biases walk. A constant is taken
        away with it. Nothing is carried over a gap; after one, the level is that of the first samples.
        """
        steps = np.diff(self.since_s)
        parts = np.split(np.arange(self.since_s.size), np.flatnonzero(steps > _GAP * np.median(steps)) + 1)
        level_of = max(1, round(1.0 / (1.0 - keep)))

        def white(values: Float64) -> Float64:
            out = np.empty_like(values)
            for part in parts:
                own = values[part]
                changes = np.diff(own, axis=0, prepend=own[:level_of].mean(axis=0, keepdims=True))
                out[part] = scipy.signal.lfilter([1.0], [1.0, -keep], changes, axis=0)
            return out

        signals = (white(v) for v in (self.y, self.f, self.df, self.z, self.dz, self.ddz))
        return _Samples(self.since_s, self.group, *signals)


def _solved(s: _Samples, line: Line, keep: float) -> Lags | None:
    """Return the lag of each window from white samples.

    The lever is the effect of a shift on the smoothed motion, less what a wrong A would change as well: noise of F is
    in the residuals, but not in the lever, so it neither biases the lag nor lowers its σ.
    """
    mixing, left, noise, weight = _explained(s)
    shadow = _mixing(s.f, s.z, s.dz @ mixing, weight)
    lever, turn = s.dz @ mixing - s.z @ shadow, s.ddz @ mixing - s.dz @ shadow
    expected = _sums(lever**2 / noise, s.group)
    answer = _answer(expected, _sums((lever * (s.df @ mixing) - turn * left) / noise, s.group))
    if answer is None:
        return None
    # A window in which nothing moves has an infinite σ, and the middle of its samples.
    moves = expected > 0.0
    middle = _means(s.since_s[:, None], s.group)[:, 0]
    middle[moves] = (_sums(lever**2 / noise * s.since_s[:, None], s.group)[moves]) / expected[moves]
    sigma, beside = np.full(middle.size, np.inf), np.zeros(middle.size)
    sigma[moves] = 1.0 / (answer * np.sqrt(expected))[moves]
    beside[moves] = (_sums(lever * left / noise, s.group) / (answer * np.maximum(expected, 1e-300)))[moves]
    moving = np.isfinite(sigma) & (sigma <= _POOR * np.quantile(sigma, 0.1))
    explained = 1.0 - float((left**2).sum()) / max(float((s.y**2).sum()), 1e-300)
    gain = float(np.sqrt(((s.f @ mixing) ** 2).sum() / max(float((s.f**2).sum()), 1e-300)))
    return Lags(middle, line.at(middle) + beside, sigma, moving, explained, gain, keep)


def _explained(s: _Samples) -> tuple[Float64, Float64, Float64, Float64]:
    """Return A (p, c), residuals (n, c), their variance by window (n, c), and the weight of the window (n,).

    Windows in which something else was felt as well do not shape A.
    """
    weight = np.ones(int(s.group[-1]) + 1)
    for _ in range(3):
        mixing = _mixing(s.z, s.f, s.y, weight[s.group])
        left = s.y - s.f @ mixing
        variance = _means(left**2, s.group)
        usual = np.median(variance, axis=0)
        weight = np.min((usual + 1e-300) / (np.maximum(variance, usual) + 1e-300), axis=1)
    return mixing, left, (np.maximum(variance, usual) + 1e-300)[s.group], weight[s.group]


def _answer(expected: Float64, change: Float64) -> Float64 | None:
    """Return the ratio (w,) of the residuals' change with a shift to that expected from the smoothed motion.

    Windows that say little take over what all say. None where all is noise.
    """
    mean = float(expected.mean())
    usual = float(change.mean()) / max(mean, 1e-300)
    if not usual > _ANSWER:
        return None
    own = (change + mean * usual) / (expected + mean)
    return np.asarray(np.maximum(own, _FULL * usual))


def _mixing(instrument: Float64, f: Float64, y: Float64, weight: Float64) -> Float64:
    """Return A (p, c) with which f @ A explains y, by instrumental variables, so noise in f does not make A too small.

    instrument : (n, p) like f, without its noise.
    """
    weighted = instrument * weight[:, None]
    size = np.sqrt((f**2).mean(axis=0))  # distances and angles differ in size
    size = np.where(size > 0.0, size, 1.0)
    normal = (weighted.T @ f) / np.outer(size, size)
    right = (weighted.T @ y) / size[:, None]
    mixing: Float64 = np.linalg.pinv(normal, rcond=1e-6) @ right / size[:, None]
    return mixing


def _means(values: Float64, group: Int64) -> Float64:
    """Return (w, c) mean of columns (n, c) for each window."""
    count = np.maximum(np.bincount(group), 1)
    return np.stack([np.bincount(group, column) / count for column in values.T], axis=-1)


def _sums(values: Float64, group: Int64) -> Float64:
    """Return (w,) sum over all columns (n, c) for each window."""
    return np.asarray(np.bincount(group, values.sum(axis=1)), dtype=np.float64)
