"""Motion of a rig by its lidar's way: levelled by gravity, with a σ that grows with the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from roadscan.core.frames import ENU_FROM_NED
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.imu import ImuErrors
from roadscan.core.settings.odometry import OdometryConfig

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

GRAVITY_M_PER_S2: Final = 9.80665
WINDOW_S: Final = 5.0
"""Length of the pieces over which accelerations are averaged and turns compared (s): shorter than a turn of a road."""
_FLOOR_M, _FLOOR_DEG = 0.02, 0.1
"""1 σ of a pose beside its neighbours: centimetres by the noise of ranges and the cubes of the map."""
STANDING_SIGMA_DEG: Final = 2.0
"""1 σ of roll and pitch where no accelerometer says where up is: cross slope and grade of a road, springs."""


@dataclass(frozen=True)
class Way:
    """Poses of the rig's reference point in a local frame."""

    epochs_gps_ns: Int64
    """(n,) ascending."""
    position_m: Float64
    """(n, 3), 0 at the first pose; z is up."""
    world_from_body: Float64
    """(n, 3, 3)."""

    @property
    def seconds(self) -> Float64:
        """Time since the first pose (n,)."""
        return (self.epochs_gps_ns - self.epochs_gps_ns[0]) / NS_PER_S

    @property
    def path_m(self) -> Float64:
        """Way since the first pose (n,)."""
        return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self.position_m, axis=0), axis=1)))

    def turned(self, rotation: Float64) -> Way:
        """Return the way in axes turned by a rotation (3, 3)."""
        return Way(self.epochs_gps_ns, self.position_m @ rotation.T, rotation @ self.world_from_body)


@dataclass(frozen=True)
class Windows:
    """What an IMU measured in pieces of the drive."""

    epochs_gps_ns: Int64
    """(w + 1,) limits of the pieces."""
    up_world: Float64
    """(w, 3) mean specific force less the mean acceleration of the way (m/s²): upwards."""
    turn_rad: Float64
    """(w,) turn about the way's upward axis by the gyroscopes less that of the way."""


def way_of(epochs_gps_ns: Int64, first_from_lidar: Float64, body_from_lidar: Float64, lever_body_m: Float64) -> Way:
    """Return the way of the reference point, level and heading along y at the first pose.

    Parameters
    ----------
    first_from_lidar : (n, 4, 4) poses of the lidar in the axes of the first.
    body_from_lidar, lever_body_m : its mounting, (3, 3) and (3,).
    """
    rotation = body_from_lidar @ first_from_lidar[:, :3, :3] @ body_from_lidar.T
    position = first_from_lidar[:, :3, 3] @ body_from_lidar.T + lever_body_m - rotation @ lever_body_m
    return Way(epochs_gps_ns, position, rotation).turned(ENU_FROM_NED)


def windows_of(
    way: Way, epochs_gps_ns: Int64, force_body_m_per_s2: Float64, rate_body_rad_per_s: Float64
) -> Windows | None:
    """Return what an IMU's samples (m,), (m, 3), (m, 3) say of a way; None where they cover no whole window."""
    own = (epochs_gps_ns >= way.epochs_gps_ns[0]) & (epochs_gps_ns <= way.epochs_gps_ns[-1])
    limits = np.arange(way.epochs_gps_ns[0], way.epochs_gps_ns[-1] + 1, round(WINDOW_S * NS_PER_S))
    if limits.size < 2 or own.sum() < 2:
        return None
    seconds = (epochs_gps_ns[own] - way.epochs_gps_ns[0]) / NS_PER_S
    limits_s = (limits - way.epochs_gps_ns[0]) / NS_PER_S
    turned = Slerp(way.seconds, Rotation.from_matrix(way.world_from_body))
    attitude = turned(seconds)
    force, rate = attitude.apply(force_body_m_per_s2[own]), attitude.apply(rate_body_rad_per_s[own])
    velocity = np.gradient(way.position_m, way.seconds, axis=0)
    at_limits = np.stack([np.interp(limits_s, way.seconds, velocity[:, i]) for i in range(3)], axis=-1)
    piece = np.searchsorted(limits_s, seconds, side="right") - 1
    inside = (piece >= 0) & (piece < limits.size - 1)
    count = np.bincount(piece[inside], minlength=limits.size - 1)
    if not count.all():
        return None
    means = [np.bincount(piece[inside], column[inside], limits.size - 1) / count for column in (*force.T, rate[:, 2])]
    relative = turned(limits_s[1:]) * turned(limits_s[:-1]).inv()
    by_way = relative.as_euler("ZYX")[:, 0]
    by_gyros = means[3] * WINDOW_S
    difference = np.angle(np.exp(1j * (by_gyros - by_way)))
    return Windows(limits, np.stack(means[:3], axis=-1) - np.diff(at_limits, axis=0) / WINDOW_S, difference)


def levelled(way: Way, windows: Windows, errors: ImuErrors) -> tuple[Way, float]:
    """Return the way turned so that the mean of all specific forces points up, and 1 σ (rad) of its tilt."""
    up = windows.up_world.mean(axis=0)
    axis = np.array([up[1], -up[0], 0.0])  # up × z
    angle = np.arctan2(np.hypot(up[0], up[1]), up[2])
    turn = Rotation.from_rotvec(axis / max(float(np.linalg.norm(axis)), 1e-12) * angle).as_matrix()
    scatter = (windows.up_world - up)[:, :2].std(axis=0).max() / GRAVITY_M_PER_S2 / np.sqrt(len(windows.up_world))
    return way.turned(turn), float(np.hypot(1e-3 * errors.accel_bias_mg, scatter))


def sigmas(way: Way, config: OdometryConfig, tilt_rad: float) -> tuple[Float64, Float64]:
    """Return 1 σ of positions (n, 3; north, east, down; m) and of roll, pitch, heading (n, 3; rad)."""
    path, away = way.path_m, np.linalg.norm(way.position_m[:, :2], axis=1)
    level = np.hypot(_FLOOR_M, config.drift_share * path)
    angle = np.radians(np.hypot(_FLOOR_DEG, config.drift_deg_per_100m * path / 100.0))
    tilt = np.hypot(angle, tilt_rad)
    return np.column_stack([level, level, np.hypot(level, tilt_rad * away)]), np.column_stack([tilt, tilt, angle])
