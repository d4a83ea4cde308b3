"""Motion of a rig by its lidar's way: levelled by gravity, with a σ that grows with the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.frames import ENU_FROM_NED
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.imu import STANDARD_GRAVITY_M_PER_S2, ImuErrors
from roadscan.core.settings.odometry import OdometryConfig

WINDOW_S: Final = 5.0
"""Length of the pieces over which accelerations are averaged and turns compared (s): shorter than a turn of a road."""
_FLOOR_M, _FLOOR_DEG = 0.02, 0.1
"""1 σ of a pose beside its neighbours: centimetres by the noise of ranges and the cubes of the map."""
_AROUND_S: Final = 0.25  # time before and after an end of a window over which its speed is taken (s)
_SPEED_SIGMA_M_PER_S: Final = 0.1  # of the way at the ends of a window: centimetres in half a second, and its change
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
        seconds: Float64 = (self.epochs_gps_ns - self.epochs_gps_ns[0]) / NS_PER_S
        return seconds

    @property
    def path_m(self) -> Float64:
        """Way since the first pose (n,)."""
        steps = np.linalg.norm(np.diff(self.position_m, axis=0), axis=1)
        path: Float64 = np.append(0.0, np.cumsum(steps))
        return path

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
    from scipy.spatial.transform import Rotation, Slerp

    own = (epochs_gps_ns >= way.epochs_gps_ns[0]) & (epochs_gps_ns <= way.epochs_gps_ns[-1])
    limits = np.arange(way.epochs_gps_ns[0], way.epochs_gps_ns[-1] + 1, round(WINDOW_S * NS_PER_S))
    if limits.size < 2 or own.sum() < 2:
        return None
    seconds = (epochs_gps_ns[own] - way.epochs_gps_ns[0]) / NS_PER_S
    limits_s = (limits - way.epochs_gps_ns[0]) / NS_PER_S
    turned = Slerp(way.seconds, Rotation.from_matrix(way.world_from_body))
    attitude = turned(seconds)
    force, rate = attitude.apply(force_body_m_per_s2[own]), attitude.apply(rate_body_rad_per_s[own])
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
    return Windows(
        limits, np.stack(means[:3], axis=-1) - np.diff(_velocity(way, limits_s), axis=0) / WINDOW_S, difference
    )


def _velocity(way: Way, seconds: Float64) -> Float64:
    """Return velocities (n, 3) at times (n,) since the first pose, means over half a second around them."""
    from_s, to_s = np.maximum(seconds - _AROUND_S, 0.0), np.minimum(seconds + _AROUND_S, way.seconds[-1])
    before, after = (
        np.stack([np.interp(at, way.seconds, way.position_m[:, i]) for i in range(3)], axis=-1) for at in (from_s, to_s)
    )
    velocity: Float64 = (after - before) / (to_s - from_s)[:, None]
    return velocity


def levelled(way: Way, windows: Windows) -> Way:
    """Return the way turned so that the mean of all specific forces points up."""
    from scipy.spatial.transform import Rotation

    (turn,) = _to_up(windows.up_world.mean(axis=0, keepdims=True))
    return way.turned(Rotation.from_rotvec(turn).as_matrix())


def unbent(way: Way, windows: Windows, is_held: npt.NDArray[np.bool_]) -> Way:
    """Return the way turned so that specific forces point up all along it: its roll and pitch drift no more.

    Each step between two poses is turned like the poses; what the lidar measured of it stays as it is. Pieces in which
    surfaces do not hold a pose (n,) do not count: the speed is guessed there, and with it what is left of the forces.
    """
    from scipy.spatial.transform import Rotation

    guessed = np.searchsorted(windows.epochs_gps_ns, way.epochs_gps_ns[~is_held], side="right") - 1
    counts = ~np.isin(np.arange(len(windows.up_world)), guessed)
    if not counts.any():
        return way
    middles = ((windows.epochs_gps_ns[1:] + windows.epochs_gps_ns[:-1]) / 2 - way.epochs_gps_ns[0])[counts]
    turns = _to_up(windows.up_world[counts])
    turn = np.stack([np.interp(way.seconds, middles / NS_PER_S, turns[:, i]) for i in range(3)], axis=-1)
    steps = Rotation.from_rotvec((turn[1:] + turn[:-1]) / 2).apply(np.diff(way.position_m, axis=0))
    position = np.concatenate([way.position_m[:1], way.position_m[0] + np.cumsum(steps, axis=0)])
    return Way(way.epochs_gps_ns, position, Rotation.from_rotvec(turn).as_matrix() @ way.world_from_body)


def _to_up(up: Float64) -> Float64:
    """Return rotation vectors (n, 3) that turn directions (n, 3) to z."""
    axis = np.column_stack([up[:, 1], -up[:, 0], np.zeros(len(up))])  # up × z
    level = np.linalg.norm(axis, axis=1)
    turn: Float64 = axis * (np.arctan2(level, up[:, 2]) / np.maximum(level, 1e-12))[:, None]
    return turn


def tilt_sigma_rad(errors: ImuErrors) -> float:
    """Return 1 σ of roll and pitch of a way that was unbent."""
    return float(
        np.hypot(1e-3 * errors.accel_bias_mg, np.sqrt(2) * _SPEED_SIGMA_M_PER_S / WINDOW_S / STANDARD_GRAVITY_M_PER_S2)
    )


def sigmas(
    way: Way, is_held: npt.NDArray[np.bool_], config: OdometryConfig, tilt_rad: float, *, is_unbent: bool
) -> tuple[Float64, Float64]:
    """Return 1 σ of positions (n, 3; north, east, down; m) and of roll, pitch, heading (n, 3; rad).

    Where the surfaces around do not hold a pose (n,), matching pulls it back by any part of the way: there σ grows by
    the greatest speed that the rig had elsewhere.
    """
    path, away = way.path_m, np.linalg.norm(way.position_m[:, :2], axis=1)
    step_s = np.diff(way.seconds)
    fastest = np.max(np.diff(path) / step_s, where=is_held[1:], initial=0.0)
    guessed = np.append(0.0, np.cumsum(np.where(is_held[1:], 0.0, fastest * step_s)))
    level = np.hypot(np.hypot(_FLOOR_M, config.drift_share * path), guessed)
    angle = np.radians(np.hypot(_FLOOR_DEG, config.drift_deg_per_100m * path / 100.0))
    tilt = np.hypot(np.radians(_FLOOR_DEG) if is_unbent else angle, tilt_rad) + np.zeros_like(angle)
    return np.column_stack([level, level, np.hypot(level, tilt_rad * away)]), np.column_stack([tilt, tilt, angle])
