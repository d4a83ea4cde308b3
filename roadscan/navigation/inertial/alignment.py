"""Coarse alignment: finds the initial attitude of the filter, standing, in motion, or both.

Specific forces, turned into the IMU's first axes by the gyroscopes, give a change of velocity for each interval; GNSS
gives the same change, less gravity, in ECEF. The rotation that takes one set of vectors to the other (Wahba's problem,
solved by singular value decomposition) is the first attitude (optimisation-based alignment: Wu and Pan 2013,
"Velocity/position integration formula, part I"). Gravity alone levels; accelerations and turns give the
heading, whichever way the vehicle looks, so that driving backwards is no special case. An IMU whose gyroscopes feel
the Earth's rate standing needs no motion.

The Earth's level axes, normal gravity and rotation (WGS 84).

WGS 84; other datums differ by far less than an accelerometer resolves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.errors import NavigationError
from roadscan.navigation.inertial.kernels.strapdown import (
    EARTH_RATE_RAD_PER_S,
    geodetic_of,
    gravity_at,
    increments,
    turned_frame,
)
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, VehicleSensors
from roadscan.navigation.inertial.timeline import merged

EARTH_RATE_ECEF_RAD_PER_S: Final[Float64] = np.array([0.0, 0.0, EARTH_RATE_RAD_PER_S])  # ECEF axes.


def ecef_from_level(position_ecef_m: Float64) -> Float64:
    """Return rotations (n, 3, 3) from north-east-down to ECEF at positions (n, 3). Groves (2013), eq. 2.150."""
    found = np.empty((len(position_ecef_m), 5))
    geodetic_of(np.ascontiguousarray(position_ecef_m), found)
    sa, ca, so, co, _ = found.T
    rows = [[-sa * co, -so, -ca * co], [-sa * so, co, -ca * so], [ca, np.zeros_like(ca), -sa]]
    axes: Float64 = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return axes


def gravity_ecef(position_ecef_m: Float64) -> Float64:
    """Return normal gravity (3,) at a position (3,), ECEF axes (m/s²)."""
    size, *up = gravity_at(*(float(x) for x in position_ecef_m))
    gravity: Float64 = -size * np.array(up)
    return gravity


_SPACING_NS: Final = 500_000_000
"""Least interval over which changes of velocity are compared."""
_VELOCITY_SIGMA_M_PER_S: Final = 0.1
"""Coarse 1 σ of a change of velocity, from GNSS, lever arm and vibration."""
_ENOUGH_M_PER_S: Final = 8.0
"""Change of horizontal velocity (root of the sum of squares) at which the heading is determined."""
_LITTLE_M_PER_S: Final = 1.5
"""With a smaller change no heading is computed."""
_WINDOW_S: Final = 90.0
"""Motion later than this after the first is not used, since gyroscopes drift."""
_COURSE_M_PER_S: Final = 3.0
"""Least speed at which a course over ground is used as heading."""
_GYROCOMPASS_RAD: Final = np.radians(3.0)  # Largest σ of a heading from standing alone.
_GYROCOMPASS_S: Final = 30.0
"""Least time of standing from which a heading is computed."""
_EARLY_NS: Final = 2_000_000_000  # Latest start of such a standstill, after the first sample.
_HOUR_ANGLE: Final = np.radians(15.041)  # Rotation of the Earth in an hour (rad).


@dataclass(frozen=True)
class Alignment:
    """State of the IMU at its first sample."""

    ecef_from_imu: Float64
    """(3, 3)."""
    velocity_ecef_m_per_s: Float64
    """(3,)."""
    position_ecef_m: Float64
    """(3,)."""
    sigma_level_rad: float
    """1 σ of the two tilts."""
    sigma_heading_rad: float
    sigma_position_m: float
    sigma_velocity_m_per_s: float
    ready_gps_ns: int
    """Epoch up to which readings were used."""


def align(
    imu: ImuReadings, gnss: GnssSolutions, still: Bool, vehicle: VehicleSensors, *, instant: bool, land_vehicle: bool
) -> Alignment:
    """Return attitude, velocity and position at the IMU's first sample.

    Parameters
    ----------
    imu : from the first sample of the trajectory on.
    gnss : usable solutions within its span.
    still : (n,) samples of a standstill.
    instant : samples hold at their epoch, see `SmootherConfig.imu_samples`.
    land_vehicle : the course is a heading where nothing better is at hand.

    Raises
    ------
    NavigationError
        where no motion determines the heading, or there is no GNSS.
    """
    motion = _Motion.of(imu, gnss, still, vehicle, instant=instant)
    if motion.epochs.size < 3:
        raise NavigationError(
            f"{motion.epochs.size} GNSS solutions lie within the IMU's samples",
            expected="at least three, half a second apart",
            change="check the clocks of both logs",
        )
    chosen = _window(motion)
    rotation, heading_sigma = _fitted(motion, chosen)
    if heading_sigma is None:
        compass = _gyrocompass(motion, imu, still, vehicle)
        course = _course(motion, rotation, vehicle) if land_vehicle else None
        found = compass or course
        if found is None:
            raise NavigationError(
                f"the heading cannot be told: velocity changes by {motion.excitation[-1]:.2f} m/s in all",
                expected="driving with changes of speed or turns, or an IMU that feels the Earth's rate standing",
                change="record a start from standstill or a turn; check the clocks of IMU and GNSS",
            )
        rotation, heading_sigma = found
    return _aligned(motion, rotation, heading_sigma, vehicle, int(motion.epochs[chosen]))


@dataclass(frozen=True)
class _Motion:
    """Motion of IMU and GNSS at m epochs half a second or more apart."""

    epochs: Int64
    """(m,)."""
    attitude: Float64
    """(m, 3, 3) first from present IMU axes."""
    felt: Float64
    """(m, 3) velocity from specific forces and the antenna's swing, first IMU axes."""
    velocity: Float64
    """(m, 3) of the antenna, ECEF."""
    gained: Float64
    """(m, 3) the same less gravity and Coriolis: the part caused by specific forces."""
    level: Float64
    """(3, 3) ECEF from north-east-down."""
    position: Float64
    """(m, 3) of the antenna, ECEF."""
    start_gps_ns: int
    bias: Float64
    """(3,) mean rate while standing; zero where the vehicle never stands."""

    @property
    def excitation(self) -> Float64:
        """Root of the sum of squared changes of horizontal velocity up to each epoch (m/s)."""
        change = np.diff(self.velocity, axis=0) @ self.level
        return np.append(0.0, np.sqrt(np.cumsum((change[:, :2] ** 2).sum(axis=1))))

    @classmethod
    def of(
        cls, imu: ImuReadings, gnss: GnssSolutions, still: Bool, vehicle: VehicleSensors, *, instant: bool
    ) -> _Motion:
        from scipy.spatial.transform import Rotation

        epochs, position, velocity = _velocities(gnss)
        inside = (epochs > imu.epochs_gps_ns[0]) & (epochs < imu.epochs_gps_ns[-1])
        epochs, position, velocity = epochs[inside], position[inside], velocity[inside]
        keep = _spaced(epochs)
        epochs, position, velocity = epochs[keep], position[keep], velocity[keep]
        first_still = _first_run(still)
        bias = imu.angular_rate_rad_per_s[first_still].mean(axis=0) if first_still is not None else np.zeros(3)
        bounds = merged(imu.epochs_gps_ns, epochs)
        count = bounds.size - 1
        steps, turn, push = np.empty(count), np.empty((count, 3)), np.empty((count, 3))
        rate, force = imu.angular_rate_rad_per_s - bias, imu.specific_force_m_per_s2
        rate, force = np.ascontiguousarray(rate), np.ascontiguousarray(force)
        increments(imu.epochs_gps_ns, rate, force, instant, bounds, steps, turn, push)
        quaternions, felt = np.empty((count + 1, 4)), np.empty((count + 1, 3))
        turned_frame(turn, push, quaternions, felt)
        at = np.searchsorted(bounds, epochs)
        attitude = Rotation.from_quat(quaternions[at], scalar_first=True).as_matrix().reshape(-1, 3, 3)
        arm = vehicle.body_from_imu.T @ (vehicle.antenna_lever_arm_body_m - vehicle.imu_lever_arm_body_m)
        swing = np.cross(turn[at - 1] / steps[at - 1, None], arm)
        felt = felt[at] + np.einsum("nij,nj->ni", attitude, swing)
        if epochs.size:
            gravity = gravity_ecef(position[0])
            coriolis = 2.0 * np.cross(EARTH_RATE_ECEF_RAD_PER_S, velocity)
            dt = np.append(0.0, np.diff(epochs)) * 1e-9
            pull = np.cumsum((gravity - coriolis) * dt[:, None], axis=0)
            level = ecef_from_level(position[:1])[0]
        else:
            pull, level = np.zeros((0, 3)), np.eye(3)
        start = int(imu.epochs_gps_ns[0])
        return cls(epochs, attitude, felt, velocity, velocity - pull, level, position, start, bias)


def _velocities(gnss: GnssSolutions) -> tuple[Int64, Float64, Float64]:
    """Return epochs, positions and velocities (ECEF) of solutions; velocities from positions where the log has none."""
    position = gnss.position_world_m
    stated = np.isfinite(gnss.velocity_ned_m_per_s).all(axis=1)
    if np.count_nonzero(stated) >= 3:
        turned = np.einsum("nij,nj->ni", ecef_from_level(position[stated]), gnss.velocity_ned_m_per_s[stated])
        return gnss.epochs_gps_ns[stated], position[stated], turned
    if len(position) < 3:
        return gnss.epochs_gps_ns[:0], position[:0], position[:0]
    keep = _spaced(gnss.epochs_gps_ns)
    epochs, position = gnss.epochs_gps_ns[keep], position[keep]
    if epochs.size < 3:
        return epochs[:0], position[:0], position[:0]
    velocity = np.gradient(position, (epochs - epochs[0]) * 1e-9, axis=0)
    return epochs, position, velocity


def _spaced(epochs: Int64) -> Int64:
    """Return indices of epochs at least half a second apart."""
    slots = (epochs - (epochs[0] if epochs.size else 0)) // _SPACING_NS
    return np.flatnonzero(np.diff(slots, prepend=-1) > 0)


def _first_run(still: Bool) -> slice | None:
    """Return the first standstill, None where there is none."""
    where = np.flatnonzero(still)
    if where.size == 0:
        return None
    end = np.flatnonzero(~still[where[0] :])
    stop = where[0] + (int(end[0]) if end.size else still.size - int(where[0]))
    return slice(int(where[0]), int(stop)) if stop - where[0] > 10 else None


def _window(motion: _Motion) -> int:
    """Return the epoch up to which motion is used: enough of it, but not too long after the first."""
    excitation = motion.excitation
    enough = int(np.searchsorted(excitation, _ENOUGH_M_PER_S))
    moving = int(np.searchsorted(excitation, 1.0))
    latest = int(np.searchsorted(motion.epochs, motion.epochs[min(moving, motion.epochs.size - 1)] + _WINDOW_S * 1e9))
    return max(2, min(enough, latest, motion.epochs.size - 1))


def _fitted(motion: _Motion, last: int) -> tuple[Float64, float | None]:
    """Return ECEF from first IMU axes, and 1 σ of its heading, None where there was too little motion."""
    felt = np.diff(motion.felt[: last + 1], axis=0)
    gained = np.diff(motion.gained[: last + 1], axis=0)
    u, _, vt = np.linalg.svd(gained.T @ felt)
    rotation = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    excitation = float(motion.excitation[last])
    if excitation < _LITTLE_M_PER_S:
        return rotation, None
    residual = (gained - felt @ rotation.T) @ motion.level
    scatter = float(np.sqrt((residual[:, :2] ** 2).mean()))
    sigma = max(scatter, _VELOCITY_SIGMA_M_PER_S) * np.sqrt(2.0) / excitation
    return rotation, float(np.clip(2.0 * sigma, np.radians(2.0), np.radians(30.0)))


def _gyrocompass(
    motion: _Motion, imu: ImuReadings, still: Bool, vehicle: VehicleSensors
) -> tuple[Float64, float] | None:
    """Return the attitude from gravity and the Earth's rate, where the gyroscopes are good enough for it."""
    run = _first_run(still)
    if run is None or imu.epochs_gps_ns[run.start] - imu.epochs_gps_ns[0] > _EARLY_NS:
        return None
    seconds = float(imu.epochs_gps_ns[run.stop - 1] - imu.epochs_gps_ns[run.start]) * 1e-9
    errors = vehicle.imu_errors
    drift = errors.gyro_bias_deg_per_h + errors.gyro_noise_deg_per_sqrt_h / np.sqrt(max(seconds, 1.0) / 3600.0)
    horizontal = _HOUR_ANGLE * abs(float(motion.level[2, 0]))
    sigma = float(np.radians(drift) / max(horizontal, 1e-9))
    if seconds < _GYROCOMPASS_S or sigma > _GYROCOMPASS_RAD:
        return None
    up = imu.specific_force_m_per_s2[run].mean(axis=0)
    east = np.cross(imu.angular_rate_rad_per_s[run].mean(axis=0), up)
    down, east = -up / np.linalg.norm(up), east / np.linalg.norm(east)
    imu_from_level = np.stack([np.cross(east, down), east, down], axis=-1)
    return motion.level @ imu_from_level.T, max(2.0 * sigma, float(np.radians(0.1)))


def _course(motion: _Motion, rotation: Float64, vehicle: VehicleSensors) -> tuple[Float64, float] | None:
    """Return `rotation` turned about the vertical so that the body's forward axis points along the course."""
    from scipy.spatial.transform import Rotation

    speed = np.linalg.norm(motion.velocity @ motion.level[:, :2], axis=1)
    fast = np.flatnonzero(speed > _COURSE_M_PER_S)
    if fast.size == 0:
        return None
    at = fast[0]
    course = motion.velocity[at] @ motion.level
    forward = motion.level.T @ rotation @ motion.attitude[at] @ vehicle.body_from_imu.T[:, 0]
    turn = np.arctan2(course[1], course[0]) - np.arctan2(forward[1], forward[0])
    about_down = Rotation.from_euler("z", turn).as_matrix()
    return motion.level @ about_down @ motion.level.T @ rotation, float(np.radians(8.0))


def _aligned(
    motion: _Motion, rotation: Float64, heading_sigma: float, vehicle: VehicleSensors, ready: int
) -> Alignment:
    """Return the state at the first sample, by carrying the first velocity and position of GNSS back."""
    early = (int(motion.epochs[0]) - motion.start_gps_ns) * 1e-9
    arm = rotation @ motion.attitude[0] @ vehicle.body_from_imu.T
    arm = arm @ (vehicle.antenna_lever_arm_body_m - vehicle.imu_lever_arm_body_m)
    velocity = motion.velocity[0]
    if np.linalg.norm(motion.velocity[0]) < 0.3:
        velocity = np.zeros(3)
    speed = float(np.linalg.norm(velocity))
    return Alignment(
        ecef_from_imu=rotation,
        velocity_ecef_m_per_s=velocity,
        position_ecef_m=motion.position[0] - arm - velocity * early,
        sigma_level_rad=float(np.radians(2.0)),
        sigma_heading_rad=heading_sigma,
        sigma_position_m=1.0 + 2.0 * early + 0.2 * speed,
        sigma_velocity_m_per_s=1.0 + 2.0 * early,
        ready_gps_ns=ready,
    )
