"""Noise of readings. GNSS: as the log states it, or by quality where it states none.

A position's error has a part that is independent between epochs and a part that changes slowly. If the slow part were
taken as independent too, a standing receiver's σ would fall to a millimetre after a minute. It is a state of the filter
instead: a Gauss–Markov process of the stated σ (Bar-Shalom, Li and Kirubarajan 2001, section 8.2, "coloured measurement
noise"). It restarts when the quality of the solution changes.

IMU: the noise of its data sheet, and a share of what it trembles at the upper end of its band. Vibration of engine and
road lies largely above half the rate of the samples and folds back into what is integrated; where samples are polled
their ages differ, which does the same. It depends on axis and time (standing, driving, surface), so it is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2
from roadscan.core.settings.navigation import SmootherConfig
from roadscan.navigation.inertial.kernels.kalman_states import Fixes
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, VehicleSensors


@dataclass(frozen=True)
class _Quality:
    horizontal_m: float
    vertical_m: float
    velocity_m_per_s: float


QUALITIES: Final[dict[str, _Quality]] = {
    "fixed": _Quality(0.015, 0.025, 0.05),
    "float": _Quality(0.4, 0.6, 0.08),
    "ppp": _Quality(0.1, 0.2, 0.08),
    "sbas": _Quality(1.0, 1.5, 0.15),
    "dgps": _Quality(0.8, 1.5, 0.15),
    "pps": _Quality(1.5, 3.0, 0.2),
    "single": _Quality(2.0, 4.0, 0.2),
    "simulated": _Quality(2.0, 4.0, 0.2),
}
"""1 σ by quality where the log states none. Solutions of other qualities are not measured, and not used."""
_SLOW_SHARE: Final = 0.9
"""Share of the variance that changes slowly, for all solutions that are not fixed."""


def usable(gnss: GnssSolutions) -> npt.NDArray[np.bool_]:
    """Return True (m,) for measured solutions with a position."""
    measured = np.isin(gnss.quality, list(QUALITIES))
    return np.asarray(measured & np.isfinite(gnss.position_world_m).all(axis=1))


def fixes_of(gnss: GnssSolutions, config: SmootherConfig) -> Fixes:
    """Return solutions with their noise in the filter's form; all of them :func:`usable`."""
    covariance = _covariance(gnss, config) * config.gnss_position_factor**2
    slow = np.where(gnss.quality == "fixed", config.gnss_correlated_share, _SLOW_SHARE)
    default = np.array([QUALITIES[str(q)].velocity_m_per_s for q in gnss.quality])
    sigma = gnss.sigma_velocity_ned_m_per_s * config.gnss_sigma_factor
    sigma = np.maximum(np.where(np.isfinite(sigma), sigma, default[:, None]), config.gnss_floor_velocity_m_per_s)
    sigma *= config.gnss_velocity_factor
    return Fixes(
        position=np.ascontiguousarray(gnss.position_world_m),
        white=covariance * (1.0 - slow)[:, None, None],
        coloured=np.sqrt(np.einsum("nii->ni", covariance) * slow[:, None]),
        velocity=np.ascontiguousarray(gnss.velocity_ned_m_per_s),
        velocity_variance=sigma**2,
    )


def _covariance(gnss: GnssSolutions, config: SmootherConfig) -> Float64:
    """Return covariances (m, 3, 3), north-east-down, of the positions: stated or by quality, not below the floor."""
    found = np.array(gnss.covariance_ned_m2, dtype=np.float64) * config.gnss_sigma_factor**2
    diagonal = np.einsum("nii->ni", found)
    unknown = ~(np.isfinite(found).all(axis=(1, 2)) & (diagonal > 0.0).all(axis=1))
    kinds = [QUALITIES[str(q)] for q in gnss.quality[unknown]]
    default = np.array([(k.horizontal_m, k.horizontal_m, k.vertical_m) for k in kinds]).reshape(-1, 3)
    found[unknown] = default[:, :, None] ** 2 * np.eye(3)
    floor = np.array([config.gnss_floor_horizontal_m] * 2 + [config.gnss_floor_vertical_m])
    raised = np.maximum(floor**2 - np.einsum("nii->ni", found), 0.0)
    found += raised[:, :, None] * np.eye(3)
    # Rounded covariances may have a correlation of one: the least eigenvalue is kept above zero.
    kept: Float64 = found + 0.01 * np.einsum("nii->ni", found)[:, :, None] * np.eye(3)
    return kept


def colour_restarts(gnss: GnssSolutions) -> npt.NDArray[np.bool_]:
    """Return True (m,) where a solution has another quality than the one before it."""
    return np.append(False, gnss.quality[1:] != gnss.quality[:-1])


_LEAST_DENSITY: Final = 1e-8
"""Noise of a perfect IMU, rad/√s and m/s/√s, from rounding."""
_TREMBLING_S: Final = 1.0  # Time over which vibration is measured.


def imu_noise(
    imu: ImuReadings, vehicle: VehicleSensors, config: SmootherConfig, epochs: npt.NDArray[np.int64]
) -> tuple[Float64, Float64]:
    """Return noise of gyroscopes (rad²/s) and accelerometers (m²/s³), (k, 3) in the IMU's axes, around epochs (k,)."""
    errors = vehicle.imu_errors
    gyro = max(float(np.radians(errors.gyro_noise_deg_per_sqrt_h)) / 60.0, _LEAST_DENSITY)
    accel = max(errors.accel_noise_ug_per_sqrt_hz * 1e-6 * STANDARD_GRAVITY_M_PER_S2, _LEAST_DENSITY)
    at = np.clip(np.searchsorted(imu.epochs_gps_ns, epochs), 0, imu.epochs_gps_ns.size - 1)
    step = float(np.median(np.diff(imu.epochs_gps_ns))) * 1e-9
    share = config.vibration_share**2 * step
    size = round(_TREMBLING_S / step)
    level, down = config.imu_factor_horizontal**2, config.imu_factor_vertical**2
    along_down = vehicle.body_from_imu[2] ** 2
    factor = level * (1.0 - along_down) + down * along_down
    # Vibration may fold back less than assumed; a data sheet is no upper limit.
    return (
        gyro**2 * max(level, 1.0) + share * _trembling(imu.angular_rate_rad_per_s, size)[at] * level,
        accel**2 * np.maximum(factor, 1.0) + share * _trembling(imu.specific_force_m_per_s2, size)[at] * factor,
    )


def _trembling(vectors: Float64, size: int) -> Float64:
    """Variance (n, 3) of white noise with these second differences, which pass the upper half of the band."""
    from scipy.ndimage import uniform_filter1d

    bend = np.zeros_like(vectors)
    bend[1:-1] = vectors[1:-1] - 0.5 * (vectors[:-2] + vectors[2:])
    return np.asarray(uniform_filter1d(bend**2, max(size, 1), axis=0) / 1.5)
