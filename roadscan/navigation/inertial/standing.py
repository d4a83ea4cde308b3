"""Detects standstill from the odometer and from the vibration of the IMU."""

from __future__ import annotations

from typing import Final

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, OdometerReadings, VehicleSensors

WINDOW_S: Final = 1.0
"""Length of the window over which vibration is measured."""
_STILL_M_PER_S: Final = 0.15
"""GNSS speed below which a vehicle may stand."""
_MOVING_M_PER_S: Final = 0.5  # GNSS speed above which a vehicle moves.
_STILL_M: Final = 0.02
"""Distance that an odometer may count in a window while standing (play, rounding)."""
_LEARNING_S: Final = 4.0
"""Least standing time, by GNSS, from which the vibration of a standing vehicle is estimated."""


def standing(imu: ImuReadings, gnss: GnssSolutions, odometer: OdometerReadings | None, vehicle: VehicleSensors) -> Bool:
    """Return True (n,) at samples of an IMU within a standstill.

    How much a standing vehicle trembles, engine on, is learnt from the times when GNSS or odometer say that it stands;
    a sample stands when rate and force tremble no more than there, and nothing says that it moves. Where nothing ever
    stands, the noise of the data sheet is the measure.
    """
    from scipy.ndimage import minimum_filter1d

    seconds = (imu.epochs_gps_ns - imu.epochs_gps_ns[0]) * 1e-9
    if seconds.size < 10:
        return np.zeros(seconds.size, bool)
    step = float(np.median(np.diff(seconds)))
    size = max(5, round(WINDOW_S / step))
    rate = _trembling(imu.angular_rate_rad_per_s, size)
    force = _trembling(imu.specific_force_m_per_s2, size)
    speed = _speed(imu.epochs_gps_ns, gnss)
    stands, moves = speed < _STILL_M_PER_S, speed > _MOVING_M_PER_S
    if odometer is not None:
        counted = _counted(imu.epochs_gps_ns, odometer)
        stands = np.where(np.isfinite(counted), counted < _STILL_M, stands)
        moves = np.where(np.isfinite(counted), counted >= _STILL_M, moves)
    whole = minimum_filter1d(stands.astype(np.uint8), 2 * size) > 0
    errors = vehicle.imu_errors
    density = (
        np.radians(errors.gyro_noise_deg_per_sqrt_h) / 60.0,
        errors.accel_noise_ug_per_sqrt_hz * 9.80665e-6,
    )
    found = ~moves
    for trembles, noise in zip((rate, force), density, strict=True):
        found &= trembles <= _limit(trembles, whole, moves, noise**2 / step * 3.0, step)
    # Only samples that stand for a whole window, and away from its ends.
    return np.asarray(minimum_filter1d(found.astype(np.uint8), size) > 0)


def _limit(trembles: Float64, stands: Bool, moves: Bool, noise: float, step_s: float) -> float:
    """Return the largest variance of a standing window."""
    if np.count_nonzero(stands) * step_s < _LEARNING_S:
        return 4.0 * noise
    limit = 3.0 * float(np.quantile(trembles[stands], 0.9))
    if np.any(moves):
        limit = min(limit, max(float(np.quantile(trembles[moves], 0.02)), float(np.quantile(trembles[stands], 0.5))))
    return max(limit, 2.0 * noise)


def _trembling(vectors: Float64, size: int) -> Float64:
    """Return the variance (n,) within windows of `size`, summed over axes."""
    from scipy.ndimage import uniform_filter1d

    centred = vectors - vectors.mean(axis=0)
    mean = uniform_filter1d(centred, size, axis=0)
    square = uniform_filter1d(centred**2, size, axis=0)
    return np.asarray(np.maximum(square - mean**2, 0.0).sum(axis=1))


def _speed(epochs: Int64, gnss: GnssSolutions) -> Float64:
    """Return GNSS speed (m/s) at epochs, NaN where no solution with a velocity is within a second."""
    known = np.isfinite(gnss.velocity_ned_m_per_s).all(axis=1)
    at = gnss.epochs_gps_ns[known]
    if at.size < 2:
        return np.full(epochs.size, np.nan)
    speed = np.linalg.norm(gnss.velocity_ned_m_per_s[known], axis=1)
    nearest = np.clip(np.searchsorted(at, epochs), 1, at.size - 1)
    gap = np.minimum(np.abs(epochs - at[nearest - 1]), np.abs(epochs - at[nearest]))
    value = np.interp((epochs - at[0]).astype(np.float64), (at - at[0]).astype(np.float64), speed)
    return np.where(gap < 1_000_000_000, value, np.nan)


def _counted(epochs: Int64, odometer: OdometerReadings) -> Float64:
    """Return the distance (m) that the odometer counted within half a window on both sides, NaN where it has none."""
    from scipy.ndimage import maximum_filter1d

    at, distance = odometer_distance(odometer)
    if at.size < 2:
        return np.full(epochs.size, np.nan)
    half = round(WINDOW_S / 2 * 1e9)
    since, values = (at - at[0]).astype(np.float64), (epochs - at[0]).astype(np.float64)
    inside = (epochs >= at[0]) & (epochs <= at[-1])
    before, after = np.interp(values - half, since, distance), np.interp(values + half, since, distance)
    longest = maximum_filter1d(np.append(np.diff(since), 0.0), 3)
    nearest = np.clip(np.searchsorted(at, epochs) - 1, 0, at.size - 1)
    return np.where(inside & (longest[nearest] < 1e9), np.abs(after - before), np.nan)


def odometer_distance(odometer: OdometerReadings) -> tuple[Int64, Float64]:
    """Epochs (k,) and distance (k,) of an odometer that states a distance or a speed, without damaged records."""
    if np.isfinite(odometer.distance_m).any():
        sound = np.isfinite(odometer.distance_m)
        return odometer.epochs_gps_ns[sound], odometer.distance_m[sound]
    sound = np.isfinite(odometer.speed_m_per_s)
    at, speed = odometer.epochs_gps_ns[sound], odometer.speed_m_per_s[sound]
    steps = 0.5 * (speed[1:] + speed[:-1]) * np.diff(at) * 1e-9
    return at, np.append(0.0, np.cumsum(steps))[: at.size]
