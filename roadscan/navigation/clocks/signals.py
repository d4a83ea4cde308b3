"""Motion as signals of time: measured by a sensor, and expected from the poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import scipy

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import NavigationError
from roadscan.core.frames import rotation_from_quaternion
from roadscan.core.gpstime import NS_PER_S
from roadscan.ingest.clock_correction import Line
from roadscan.navigation.inertial.readings import ImuReadings, OdometerReadings
from roadscan.poses.trajectory import Trajectory

EARTH_RATE_RAD_PER_S: Final = 7.292115e-5
"""Angular rate of the Earth (WGS 84)."""
_GAP: Final = 5.0
"""Samples farther apart than this many usual intervals leave a gap."""
_REACH: Final = 4.0
"""Splines are not used within this many widths of the filter from gaps and ends."""
_SMOOTH_KNOTS: Final = 2.0  # Least width (1 σ) of the filter, in intervals of the knots.
_SMOOTH_S: Final = 0.01
"""Width (1 σ) of the filter under which derivatives are computed."""
_FINEST_S: Final = 0.01
"""Least interval of samples and knots; closer ones are averaged or left out, since vehicles do not move faster."""
_MOST_KNOTS: Final = 1_000_000
"""Most knots of a run: three hours at 100 a second; longer runs have coarser knots."""


@dataclass(frozen=True)
class Felt:
    """Measurements of a sensor, by its clock."""

    epochs_gps_ns: Int64
    """(n,) strictly ascending."""
    values: Float64
    """(n, c): angular rates (rad/s), speed (m/s), or distance (m)."""
    is_total: bool
    """True for a running total (distance), False for a rate."""

    @cached_property
    def interval_s(self) -> float:
        """Usual time between samples."""
        return float(np.median(np.diff(self.epochs_gps_ns))) / NS_PER_S

    def averaged(self, interval_s: float) -> Felt:
        """Return means of neighbouring samples, about `interval_s` apart; totals stay unchanged."""
        count = round(interval_s / self.interval_s)
        if self.is_total or count < 2:
            return self
        size = self.epochs_gps_ns.size // count * count
        origin = self.epochs_gps_ns[0]
        since = (self.epochs_gps_ns[:size] - origin).reshape(-1, count)
        whole = since[:, -1] - since[:, 0] < _GAP * count * self.interval_s * NS_PER_S
        values = self.values[:size].reshape(-1, count, self.values.shape[1]).mean(axis=1)
        epochs = origin + np.rint(since.mean(axis=1)).astype(np.int64)
        return Felt(epochs[whole], values[whole], is_total=False)


@dataclass(frozen=True)
class Motion:
    """Expected measurements, continuous in GPS time: totals at knots, with cubic splines between them."""

    epochs_gps_ns: Int64
    """(k,) knots, strictly ascending."""
    totals: Float64
    """(k, p) integrals of the rates: angles (rad) and distance (m)."""
    leads: bool = False
    """True where the first column is what the sensor counts, with the same sign; otherwise its axes are not known."""

    @property
    def origin_gps_ns(self) -> int:
        """Origin of the splines' time."""
        return int(self.epochs_gps_ns[0])

    def since_s(self, epochs_gps_ns: Int64) -> Float64:
        """Return (n,) seconds from the origin to epochs (n,)."""
        since: Float64 = (epochs_gps_ns - self.origin_gps_ns).astype(np.float64) / NS_PER_S
        return since

    @cached_property
    def interval_s(self) -> float:
        """Usual time between knots."""
        return float(np.median(np.diff(self.epochs_gps_ns))) / NS_PER_S

    def at(self, since_s: Float64, *, total: bool) -> tuple[Float64, Float64]:
        """Return rates or totals, and their derivatives by time, (n, p) each.

        Parameters
        ----------
        since_s : (n,) time since `origin_gps_ns` (s).
        """
        order = 0 if total else 1
        return np.asarray(self._spline(since_s, order)), np.asarray(self._spline(since_s, order + 1))

    def smooth(self, since_s: Float64, *, total: bool) -> tuple[Float64, Float64, Float64]:
        """Return the filtered values, and their first and second derivatives by time.

        Errors of the knots are many times larger in what changes, and depend on how far a time lies from a knot.
        """
        order = 0 if total else 1
        first, second, third = (np.asarray(self._smooth(since_s, order + k)) for k in range(3))
        return first, second, third

    def known(self, since_s: Float64) -> Bool:
        """Return (n,) False outside the knots, in gaps, and beside both."""
        interval = np.searchsorted(self._knots_s, since_s, side="right") - 1
        inside = (interval >= 0) & (interval < self._sound.size)
        return inside & self._sound[np.clip(interval, 0, self._sound.size - 1)]

    @cached_property
    def _knots_s(self) -> Float64:
        return self.since_s(self.epochs_gps_ns)

    @cached_property
    def _sound(self) -> Bool:
        """(k − 1,) intervals whose splines are used."""
        sound = np.diff(self._knots_s) <= _GAP * self.interval_s
        beside = math.ceil(_REACH * self._width_knots)
        for at in (-1, *np.flatnonzero(~sound), sound.size):
            sound[max(at - beside, 0) : at + beside + 1] = False
        return sound

    @property
    def _width_knots(self) -> float:
        """Width (1 σ) of the filter, in knots."""
        return max(_SMOOTH_KNOTS, _SMOOTH_S / self.interval_s)

    @cached_property
    def _spline(self) -> scipy.interpolate.CubicSpline:
        return scipy.interpolate.CubicSpline(self._knots_s, self.totals)

    @cached_property
    def _smooth(self) -> scipy.interpolate.CubicSpline:
        # Knots are smoothed with their times, so they need not be even, and steady motion stays unchanged.
        both = np.column_stack([self._knots_s, self.totals])
        smooth = scipy.ndimage.gaussian_filter1d(both, self._width_knots, axis=0, mode="nearest")
        return scipy.interpolate.CubicSpline(smooth[:, 0], smooth[:, 1:])


def felt_by_imu(imu: ImuReadings, finest_s: float) -> Felt:
    """Return angular rates of an IMU, averaged where samples are closer than `finest_s`."""
    felt = _felt(imu.epochs_gps_ns, imu.angular_rate_rad_per_s, is_total=False)
    return felt.averaged(max(finest_s, _FINEST_S))


def felt_by_encoder(odometer: OdometerReadings) -> Felt:
    """Return the distance that an encoder counts; its speed where the log states no distance."""
    if np.isfinite(odometer.distance_m).sum() >= 2:
        return _felt(odometer.epochs_gps_ns, odometer.distance_m[:, None], is_total=True)
    return _felt(odometer.epochs_gps_ns, odometer.speed_m_per_s[:, None], is_total=False)


def turning(trajectory: Trajectory) -> Motion:
    """Return angles about body forward, right, down relative to inertial space, from a trajectory's attitudes.

    The Earth's turn is added where the world turns with it.
    """
    increments = _turns(trajectory)
    if trajectory.world != LOCAL_WORLD:
        interval_s = np.diff(trajectory.epochs_gps_ns) / NS_PER_S
        pole_body = rotation_from_quaternion(trajectory.quaternion_world_from_body)[:-1, 2]
        increments = increments + EARTH_RATE_RAD_PER_S * interval_s[:, None] * pole_body
    return _motion(trajectory.epochs_gps_ns, increments)


def turning_of_imu(imu: ImuReadings) -> Motion:
    """Return angles about the axes of an IMU whose stamps are right."""
    felt = _felt(imu.epochs_gps_ns, imu.angular_rate_rad_per_s, is_total=False)
    interval_s = np.diff(felt.epochs_gps_ns)[:, None] / NS_PER_S
    return _motion(felt.epochs_gps_ns, 0.5 * (felt.values[1:] + felt.values[:-1]) * interval_s)


def driving(trajectory: Trajectory, *, backwards_counts_down: bool) -> Motion:
    """Return distance forward, and angles about right and down, which change the distance of a wheel off the origin.

    A wheel at l (body) drives forward at v + ω_right · l_down − ω_down · l_right.

    Parameters
    ----------
    backwards_counts_down : the counter falls when the vehicle reverses; otherwise it grows both ways.
    """
    forward = rotation_from_quaternion(trajectory.quaternion_world_from_body)[:, :, 0]
    steps = np.diff(trajectory.position_world_m, axis=0)
    distance = np.einsum("ni,ni->n", steps, 0.5 * (forward[1:] + forward[:-1]))
    increments = np.column_stack([distance, _turns(trajectory)[:, 1:]])
    if not backwards_counts_down:
        increments = increments * np.where(distance < 0.0, -1.0, 1.0)[:, None]
    return _motion(trajectory.epochs_gps_ns, increments, leads=True)


def _felt(epochs: Int64, values: Float64, *, is_total: bool) -> Felt:
    order = np.argsort(epochs, kind="stable")
    order = order[np.isfinite(values[order]).all(axis=1)]
    fresh = np.concatenate([[True], np.diff(epochs[order]) > 0]) if order.size else np.zeros(0, dtype=bool)
    kept = order[fresh]
    if kept.size < 2:
        raise NavigationError("the log holds fewer than two samples", expected="a recording of motion")
    return Felt(epochs[kept], values[kept], is_total)


def _motion(epochs: Int64, increments: Float64, *, leads: bool = False) -> Motion:
    """Return totals of increments (k − 1, p), thinned to the necessary number of knots."""
    totals = np.concatenate([np.zeros((1, increments.shape[1])), np.cumsum(increments, axis=0)])
    span_s = float(epochs[-1] - epochs[0]) / NS_PER_S
    finest_s = max(_FINEST_S, span_s / _MOST_KNOTS)
    every = max(1, round(finest_s / (float(np.median(np.diff(epochs))) / NS_PER_S)))
    return Motion(epochs[::every], totals[::every], leads)


def _turns(trajectory: Trajectory) -> Float64:
    """Return (k − 1, 3) rotation vectors from knot to knot, body axes."""
    if trajectory.epochs_gps_ns.size < 2:
        raise NavigationError("the trajectory holds fewer than two poses", expected="poses of the whole run")
    before, after = trajectory.quaternion_world_from_body[:-1], trajectory.quaternion_world_from_body[1:]
    w1, x1, y1, z1 = before.T
    w2, x2, y2, z2 = after.T
    real = w1 * w2 + x1 * x2 + y1 * y2 + z1 * z2
    imaginary = np.stack(
        [
            w1 * x2 - x1 * w2 - y1 * z2 + z1 * y2,
            w1 * y2 + x1 * z2 - y1 * w2 - z1 * x2,
            w1 * z2 - x1 * y2 + y1 * x2 - z1 * w2,
        ],
        axis=-1,
    )
    imaginary = imaginary * np.where(real < 0.0, -1.0, 1.0)[:, None]
    sine = np.linalg.norm(imaginary, axis=1)
    half = np.arctan2(sine, np.abs(real))
    factor = np.where(sine > 1e-12, 2.0 * half / np.maximum(sine, 1e-300), 2.0)
    turns: Float64 = imaginary * factor[:, None]
    return turns


LEAST_SAMPLES: Final = 20  # Least number of samples of a window.
LEAST_WINDOWS: Final = 3  # Least number of windows.
_WINDOWS: Final = 30  # Approximate number of windows of a recording.
_WINDOW_OF_RATES_S: Final = (2.0, 10.0)  # Shortest and longest window of rates.
_WINDOW_OF_TOTALS_S: Final = (6.0, 30.0)
"""Shortest and longest window of totals; within it, the gyroscopes' bias and a counter's zero are constant."""
_FULL: Final = 0.3
"""A window with a smaller share of the samples of the fullest is left out."""
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
