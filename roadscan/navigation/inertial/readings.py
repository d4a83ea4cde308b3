"""Input and output of the smoother: readings, mounting of the sensors, and the solution."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.rig import ImuErrors


@dataclass(frozen=True)
class ImuReadings:
    """Samples of an IMU in its axes, as in the table ``imu``."""

    epochs_gps_ns: Int64
    """(n,) strictly ascending; a sample is the mean over the interval that ends there, or the value at that instant
    (`SmootherConfig.imu_samples`)."""
    angular_rate_rad_per_s: Float64
    """(n, 3) against inertial space, sensor axes."""
    specific_force_m_per_s2: Float64
    """(n, 3) acceleration less gravity, sensor axes; at rest an axis that points up reads +g."""


@dataclass(frozen=True)
class GnssSolutions:
    """Positions and velocities of an antenna, as in the table ``gnss``."""

    world: str
    """Geocentric frame of the positions (as in the log record)."""
    epochs_gps_ns: Int64
    """(m,) strictly ascending."""
    position_world_m: Float64
    """(m, 3); NaN where there is none."""
    covariance_ned_m2: Float64
    """(m, 3, 3) of the positions, local level; NaN where the log states none."""
    quality: npt.NDArray[np.str_]
    """(m,) 'fixed', 'float', 'dgps', 'single' … (``schemas/gnss.toml``)."""
    velocity_ned_m_per_s: Float64
    """(m, 3), local level; NaN where there is none."""
    sigma_velocity_ned_m_per_s: Float64
    """(m, 3); NaN where the log states none."""


@dataclass(frozen=True)
class OdometerReadings:
    """Distance driven, growing forwards, as a wheel's counter states it (nominal metres)."""

    epochs_gps_ns: Int64
    """(k,) strictly ascending."""
    distance_m: Float64
    """(k,) running total; NaN where only the speed is known."""
    speed_m_per_s: Float64
    """(k,) speed, forwards positive; NaN where only the distance is known."""


@dataclass(frozen=True)
class VehicleSensors:
    """Mounting of the sensors on the vehicle, body axes forward, right, down from the IMU reference point (m)."""

    body_from_imu: Float64
    """(3, 3) rotation from the IMU's axes to the body's."""
    imu_lever_arm_body_m: Float64
    """(3,) IMU reference point to the IMU itself (zero where the rig's origin is the IMU)."""
    imu_errors: ImuErrors
    antenna_lever_arm_body_m: Float64
    """(3,)."""
    antenna_sigma_body_m: Float64
    """(3,) 1 σ of it."""
    wheel_lever_arm_body_m: Float64 | None = None
    """(3,) where the odometer's wheel meets the road."""


@dataclass(frozen=True)
class Solution:
    """A smoothed trajectory of the IMU reference point, with the other estimated states."""

    world: str
    epochs_gps_ns: Int64
    """(n,)."""
    position_world_m: Float64
    """(n, 3)."""
    quaternion_world_from_body: Float64
    """(n, 4) scalar first."""
    velocity_ned_m_per_s: Float64
    """(n, 3)."""
    covariance_position_ned_m2: Float64
    """(n, 3, 3)."""
    covariance_attitude_rad2: Float64
    """(n, 3, 3) of a small rotation about north, east, down."""
    covariance_velocity_ned: Float64
    """(n, 3, 3), m²/s²."""
    sigma_rph_rad: Float64
    """(n, 3) 1 σ of roll, pitch, heading."""
    states: dict[str, tuple[Float64, Float64]] = field(default_factory=dict)
    """Other estimated states, by name with frame and unit (``…_imu``: the IMU's axes, ``…_body``: the body's): value
    (j,) or (j, k) and its 1 σ, at `state_epochs_gps_ns`."""
    state_epochs_gps_ns: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))
    innovations: Innovations | None = None
    pieces: tuple[tuple[int, int], ...] = ()
    """First and last epoch (GPS ns) of each unbroken piece; the IMU was silent for too long between them."""
    notes: tuple[str, ...] = ()
    """Notes for the user: where the solution is divided, and which part could not be solved."""


@dataclass(frozen=True)
class Innovations:
    """Every update that the filter was offered: measured less predicted."""

    epochs_gps_ns: Int64
    """(u,)."""
    kind: npt.NDArray[np.str_]
    """(u,) 'gnss position', 'gnss velocity', 'odometer', 'non-holonomic', 'zero velocity', 'zero rotation' …"""
    residual: Float64
    """(u, 3) observed − predicted, in unit and axes of the update; NaN where it has fewer components."""
    normalised: Float64
    """(u,) squared, normalised by the predicted covariance, and divided by the components."""
    weight: Float64
    """(u,) 1 for full weight, below 1 for down-weighted outliers, 0 for rejected ones."""
