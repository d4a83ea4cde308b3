"""The vehicle's motion over the road: position and attitude at any instant of a pass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from roadscan.model.gpstime import gps_ns_from_utc
from roadscan.simulate.earth import Earth
from roadscan.simulate.kernels.road import NODE_STEP_M
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import Mount, Scene
from roadscan.simulate.surface import Surface

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

RUN_UP_S = 0.6
"""Driven before the first and after the last profile (s); the trajectory covers it."""
_SPEED_WAVE_M = 120.0
_WANDER_WAVES_M = (83.0, 31.0)
_AXLE_M = 0.5
"""Half the distance between the points of contact that tilt the body (m)."""
_HEAVE_HZ, _ROLL_HZ, _PITCH_HZ, _YAW_HZ = 1.3, 0.9, 1.6, 0.35
_YAW_SHARE = 0.3


@dataclass(frozen=True)
class Poses:
    """n poses: p_ecef = position + ecef_from_body · p_body (body forward, right, down)."""

    position_ecef_m: Float64
    """(n, 3)"""
    ecef_from_body: Rotation
    """n rotations"""

    def sensor(self, mount: Mount, body_from_axes: Float64) -> tuple[Float64, Float64]:
        """ECEF origin (n, 3) and ecef_from_sensor (n, 3, 3) of a sensor.

        body_from_sensor = R(roll, pitch, heading) · body_from_axes, Z-Y-X.
        """
        boresight = Rotation.from_euler("ZYX", [mount.heading_deg, mount.pitch_deg, mount.roll_deg], degrees=True)
        rotation = (self.ecef_from_body * boresight).as_matrix() @ body_from_axes
        return self.position_ecef_m + self.ecef_from_body.apply(np.array(mount.lever_arm_body_m)), rotation


class Drive:
    """One pass: path length driven as a function of time, and the pose there.

    The mean path follows a lane with the driver's wander; the body stands on a smooth version of the road (long
    waves, crown and grade) and moves on its springs. Time is seconds from the first profile; *driven* is the path's
    length in the map from there (m).
    """

    def __init__(self, scene: Scene, number: int, earth: Earth, ride: Surface) -> None:
        one = scene.passes[number]
        self.number = number
        self.earth = earth
        self.start_gps_ns = gps_ns_from_utc(scene.start) + round(number * scene.pause_s * 1e9)
        """Epoch of the first profile."""
        self._vehicle = scene.vehicle
        self._ride = ride
        self._sign = 1.0 if one.direction == "forward" else -1.0
        self._lane_m = scene.road.lane_offset_m(one.lane)
        self._phases = stream(scene.seed, number, "drive").uniform(0, 2 * math.pi, 8)
        self._station, self.length_m = self._path(scene)
        self.duration_s = float(self._time_s(np.array(self.length_m)))
        """From the first to the last profile (s)."""

    def epoch_gps_ns(self, driven_m: Float64) -> Int64:
        """Epochs at which a path length was driven (n,)."""
        return self.start_gps_ns + np.rint(self._time_s(driven_m) * 1e9).astype(np.int64)

    def driven_m(self, epoch_gps_ns: Int64) -> Float64:
        """Path length driven at epochs (n,): the inverse of :meth:`epoch_gps_ns`, by Newton's method."""
        time_s = self._seconds(epoch_gps_ns)
        driven = time_s * self._vehicle.speed_m_per_s
        for _ in range(5):
            driven = driven - (self._time_s(driven) - time_s) / self._slowness(driven)
        return driven

    def station_m(self, epoch_gps_ns: Int64) -> Float64:
        """Station of the IMU reference point (n,)."""
        found: Float64 = self._station(self.driven_m(epoch_gps_ns))
        return found

    def poses(self, epoch_gps_ns: Int64) -> Poses:
        """True poses at epochs (n,)."""
        time_s = self._seconds(epoch_gps_ns)
        station = self.station_m(epoch_gps_ns)
        contact, ahead, aside = (self._contact(station, *shift) for shift in ((0, 0), (_AXLE_M, 0), (0, _AXLE_M)))
        behind, other = (self._contact(station, *shift) for shift in ((-_AXLE_M, 0), (0, -_AXLE_M)))
        forward = _unit(ahead - behind) * self._sign
        down = _unit(np.cross(forward, (aside - other) * self._sign))
        road = np.stack([forward, np.cross(down, forward), down], axis=-1)
        heave, sway = self._springs(time_s)
        ecef_from_body = Rotation.from_matrix(road) * sway
        height = self._vehicle.imu_height_m + heave
        return Poses(contact - height[:, None] * ecef_from_body.apply([0.0, 0.0, 1.0]), ecef_from_body)

    def _seconds(self, epoch_gps_ns: Int64) -> Float64:
        """Seconds since the first profile (n,)."""
        seconds: Float64 = (epoch_gps_ns - self.start_gps_ns).astype(np.float64) * 1e-9
        return seconds

    def _time_s(self, driven_m: Float64) -> Float64:
        k = 2 * math.pi / _SPEED_WAVE_M
        bow = self._vehicle.speed_variation * (np.sin(k * driven_m + self._phases[0]) - math.sin(self._phases[0])) / k
        out: Float64 = (driven_m + bow) / self._vehicle.speed_m_per_s
        return out

    def _slowness(self, driven_m: Float64) -> Float64:
        k = 2 * math.pi / _SPEED_WAVE_M
        bow = self._vehicle.speed_variation * np.cos(k * driven_m + self._phases[0])
        out: Float64 = (1.0 + bow) / self._vehicle.speed_m_per_s
        return out

    def _offset_m(self, station_m: Float64) -> Float64:
        """Offset of the path: the lane's middle and the driver's wander."""
        long, short = (
            np.sin(2 * math.pi * station_m / wave + phase)
            for wave, phase in zip(_WANDER_WAVES_M, self._phases[1:3], strict=True)
        )
        offset: Float64 = self._lane_m + self._vehicle.wander_m * (0.8 * long + 0.2 * short)
        return offset

    def _path(self, scene: Scene) -> tuple[CubicSpline, float]:
        """Station as a function of the path length driven, and the length of the whole pass."""
        first = float(self._ride.arrays.nodes[0, 12])
        station = first + NODE_STEP_M / 2 * np.arange(2 * (self._ride.arrays.nodes.shape[0] - 1) + 1)
        fine = first + NODE_STEP_M / 8 * np.arange(4 * (station.size - 1) + 1, dtype=np.float64)
        e, n, _ = self._ride.place(fine, self._offset_m(fine))
        # Chords of 62 mm are shorter than their arcs by 0.02 µm at a radius of 30 m.
        lengths = np.append(0.0, np.cumsum(np.hypot(np.diff(e), np.diff(n))))[::4]
        ends = np.interp([0.0, scene.length_m], station, lengths)
        driven = lengths - ends[0] if self._sign > 0 else (ends[1] - lengths)[::-1]
        path = CubicSpline(driven, station if self._sign > 0 else station[::-1])
        return path, float(ends[1] - ends[0])

    def _contact(self, station_m: Float64, ahead_m: float, right_m: float) -> Float64:
        """ECEF points (n, 3) of the smooth road at the path, shifted along and across it."""
        station = station_m + ahead_m
        offset = self._offset_m(station) + right_m
        return self.earth.ecef_from_map(self._ride.points_at(station, offset))

    def _springs(self, time_s: Float64) -> tuple[Float64, Rotation]:
        """Heave (n,) upwards in metres and the body's turn on its springs."""
        heave, roll, pitch, yaw = (
            np.sin(2 * math.pi * hertz * time_s + phase)
            for hertz, phase in zip((_HEAVE_HZ, _ROLL_HZ, _PITCH_HZ, _YAW_HZ), self._phases[3:7], strict=True)
        )
        sway = self._vehicle.sway_deg
        turns = np.stack([_YAW_SHARE * sway * yaw, 0.7 * sway * pitch, sway * roll], axis=-1)
        return self._vehicle.heave_m * heave, Rotation.from_euler("ZYX", turns, degrees=True)


def _unit(vectors: Float64) -> Float64:
    out: Float64 = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return out
