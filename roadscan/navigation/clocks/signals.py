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
