"""The vehicle's motion over the road: position and attitude at any time of a pass."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import NS_PER_S, gps_ns_from_utc
from roadscan.simulate.earth import Earth
from roadscan.simulate.motion import MARGIN_S, RUN_UP_S, Motion
from roadscan.simulate.noise import stream
from roadscan.simulate.path import Stand, path_of
from roadscan.simulate.scene import Mount, Scene, Vehicle
from roadscan.simulate.surface import Surface

__all__ = ["RUN_UP_S", "Drive", "Poses", "drives_of"]


_HEAVE_HZ, _ROLL_HZ, _PITCH_HZ, _YAW_HZ = 1.3, 0.9, 1.6, 0.35  # frequencies of the body's motion on its springs
_PITCH_SHARE: Final = 0.7  # amplitude of pitch as a share of that of roll
_YAW_SHARE: Final = 0.3  # amplitude of yaw as a share of that of roll
_CALM_M_PER_S: Final = 1.0
"""Speed (m/s) at which the road moves the springs half as much as at high speed."""


@dataclass(frozen=True)
class Poses:
    """n poses: p_ecef = position + ecef_from_body · p_body (body forward, right, down)."""

    position_ecef_m: Float64
    """(n, 3)"""
    ecef_from_body: Rotation
    """n rotations"""

    def sensor(self, mount: Mount, body_from_axes: Float64) -> tuple[Float64, Float64]:
        """Return the ECEF origin (n, 3) and ecef_from_sensor (n, 3, 3) of a sensor with its true mounting.

        body_from_sensor = R(roll, pitch, heading) · body_from_axes, Z-Y-X.
        """
        angles = [mount.heading_deg, mount.pitch_deg, mount.roll_deg]
        body_from_sensor = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix() @ body_from_axes
        rotation = self.ecef_from_body.as_matrix() @ body_from_sensor
        return self.position_ecef_m + self.ecef_from_body.apply(np.array(mount.lever_arm_body_m)), rotation


class Drive:
    """One pass: path length as a function of time, and the pose there.

    The path follows a lane with the driver's wander, or a route; the body stands on a smooth version of the road (long
    waves, crown and grade) and moves on its springs, which add to roll, pitch and heading of the road under it. Time
    is seconds from the first profile; *driven* is the path's length in the map from there (m).

    Raises
    ------
    ConfigError
        where the path leaves the road, or stops and changes of speed do not fit the pass.
    """

    def __init__(self, scene: Scene, number: int, earth: Earth, ride: Surface) -> None:
        one = scene.passes[number]
        phases = stream(scene.seed, number, "drive").uniform(0, 2 * math.pi, 8)
        path = path_of(scene, number, ride, phases[1:3])
        self.number = number
        self.earth = earth
        self.start_gps_ns = gps_ns_from_utc(scene.start) + round(number * scene.pause_s * NS_PER_S)
        """Epoch of the first profile."""
        self.length_m = path.length_m
        """Path length from the first to the last profile (m)."""
        self._motion = Motion(one, scene.vehicle, number, path.length_m, float(phases[0]))
        self._springs = _Springs(scene.vehicle, phases[3:7])
        self._imu_height_m = scene.vehicle.imu_height_m
        self._sign = -1.0 if one.route is not None and one.route.reverse else 1.0
        first, last = self._motion.recorded_span_s
        self._known_s = first - MARGIN_S, last + MARGIN_S
        begin, end = self._motion.driven_m(np.array(self._known_s))
        self._stand = Stand(path, earth, float(begin), float(end), self._sign)
        self._ecef_from_level = Rotation.from_matrix(self._stand.ecef_from_level)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last profile (s)."""
        return self._motion.duration_s

    @property
    def sign(self) -> float:
        """1 where the body looks along the path, −1 where it drives backwards."""
        return self._sign

    @property
    def recorded_span_gps_ns(self) -> tuple[int, int]:
        """First and last epoch of trajectory, IMU, GNSS and encoder: with run-up, run-out and standstill."""
        first, last = self._motion.recorded_span_s
        return self.start_gps_ns + round(first * NS_PER_S), self.start_gps_ns + round(last * NS_PER_S)

    def epoch_gps_ns(self, driven_m: Float64) -> Int64:
        """Return the epochs (n,) at which path lengths are first reached."""
        return self.start_gps_ns + np.rint(self._motion.time_s(driven_m) * NS_PER_S).astype(np.int64)

    def driven_m(self, epoch_gps_ns: Int64) -> Float64:
        """Return path lengths at epochs (n,): the inverse of :meth:`epoch_gps_ns` where the vehicle moves."""
        return self._motion.driven_m(self._seconds(epoch_gps_ns))

    def station_m(self, epoch_gps_ns: Int64) -> Float64:
        """Return the station of the IMU reference point (n,)."""
        return self._stand.station_m(self.driven_m(epoch_gps_ns))

    def poses(self, epoch_gps_ns: Int64) -> Poses:
        """Return true poses at epochs (n,), up to a quarter of a second outside the recorded span.

        Raises ValueError further outside: what the vehicle does there is not known.
        """
        time_s = self._seconds(epoch_gps_ns)
        if time_s.size and (time_s.min() < self._known_s[0] or time_s.max() > self._known_s[1]):
            raise ValueError(
                f"poses of pass {self.number + 1} are known from {self._known_s[0]:.3f} s to {self._known_s[1]:.3f} s "
                f"after its first profile, not from {time_s.min():.3f} s to {time_s.max():.3f} s"
            )
        driven, speed, acceleration = self._motion.state(time_s)
        north, east, down, heading, pitch, roll, bend = self._stand.at(driven)
        along, aside = self._sign * acceleration, self._sign * speed**2 * bend
        heave, yaw, nod, sway = self._springs.at(time_s, speed, along, aside)
        quaternion, body_down = _attitude(heading + yaw, pitch + nod, roll + sway)
        in_level = np.stack([north, east, down]) - (self._imu_height_m + heave) * body_down
        position = self._stand.origin_ecef_m + in_level.T @ self._stand.ecef_from_level.T
        return Poses(position, Rotation.from_quat((_times(self._ecef_from_level) @ quaternion).T))

    def _seconds(self, epoch_gps_ns: Int64) -> Float64:
        """Return seconds since the first profile (n,)."""
        seconds: Float64 = (epoch_gps_ns - self.start_gps_ns).astype(np.float64) / NS_PER_S
        return seconds


def drives_of(scene: Scene, earth: Earth, ride: Surface) -> list[Drive]:
    """Return all passes of a scene.

    Raises
    ------
    ConfigError
        where a path leaves the road, stops do not fit, or a pass starts before the one before it has ended.
    """
    drives = [Drive(scene, number, earth, ride) for number in range(len(scene.passes))]
    longest = 0.0
    for one, following in itertools.pairwise(drives):
        overlap_s = (one.recorded_span_gps_ns[1] - following.recorded_span_gps_ns[0]) / NS_PER_S + 2 * MARGIN_S
        longest = max(longest, overlap_s)
    if longest > 0.0:
        raise ConfigError(
            f"passes overlap in time: with run-up, run-out, stops and standstill one takes {longest:.1f} s longer "
            f"than pause_s leaves ({scene.pause_s:g} s from start to start)",
            change=f"give pause_s {math.ceil(scene.pause_s + longest)} or more",
        )
    return drives


class _Springs:
    """The body on its suspension: waves that fade at low speed, and lean."""

    def __init__(self, vehicle: Vehicle, phases: Float64) -> None:
        self._waves = list(zip((_HEAVE_HZ, _ROLL_HZ, _PITCH_HZ, _YAW_HZ), phases, strict=True))
        self._heave_m = vehicle.heave_m
        self._sway_rad = math.radians(vehicle.sway_deg)
        self._lean = math.radians(vehicle.lean_deg_per_m_per_s2)

    def at(
        self, time_s: Float64, speed: Float64, along: Float64, aside: Float64
    ) -> tuple[Float64, Float64, Float64, Float64]:
        """Return heave (m, upwards), yaw, pitch and roll (rad), (n,) each.

        speed : (m/s); along, aside : acceleration of the body forward and to its right (m/s²).
        """
        shaken = speed**2 / (speed**2 + _CALM_M_PER_S**2)
        waves = (np.sin(2 * math.pi * hertz * time_s + phase) for hertz, phase in self._waves)
        heave, roll, pitch, yaw = (shaken * wave for wave in waves)
        sway = self._sway_rad
        return (
            self._heave_m * heave,
            _YAW_SHARE * sway * yaw,
            _PITCH_SHARE * sway * pitch + self._lean * along,
            sway * roll - self._lean * aside,
        )


def _attitude(heading: Float64, pitch: Float64, roll: Float64) -> tuple[Float64, Float64]:
    """Return quaternions (4, n: x, y, z, w) of Z-Y-X angles, and the body's down axis (3, n)."""
    sh, ch, sp, cp, sr, cr = (f(a / 2) for a in (heading, pitch, roll) for f in (np.sin, np.cos))
    x, y = sr * cp * ch - cr * sp * sh, cr * sp * ch + sr * cp * sh
    z, w = cr * cp * sh - sr * sp * ch, cr * cp * ch + sr * sp * sh
    return np.stack([x, y, z, w]), np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def _times(rotation: Rotation) -> Float64:
    """Return the matrix (4, 4) that multiplies quaternions (x, y, z, w) by a rotation from the left."""
    x, y, z, w = rotation.as_quat()
    return np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
