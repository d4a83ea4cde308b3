"""Drives with known truth for the smoother: simulated ones in memory, and the recorded one."""

from __future__ import annotations

import datetime as dt
import functools
import gzip
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from roadscan.core.frames import rotation_from_quaternion
from roadscan.core.rig import IMU_GRADES, ImuErrors, ImuGrade
from roadscan.core.settings.navigation import SmootherConfig
from roadscan.navigation.inertial.alignment import ecef_from_level
from roadscan.navigation.inertial.readings import (
    GnssSolutions,
    ImuReadings,
    OdometerReadings,
    Solution,
    VehicleSensors,
)
from roadscan.simulate import Scene
from roadscan.simulate.drive import Drive, Poses, drives_of
from roadscan.simulate.noise import stream
from roadscan.simulate.path import Earth
from roadscan.simulate.sensors import gnss as simulated_gnss
from roadscan.simulate.sensors import gnss as simulated_imu
from roadscan.simulate.sensors.clock import WheelEncoder
from roadscan.simulate.surface import Surface

Gaps = tuple[tuple[float, float], ...]
NO_GAPS: Gaps = ()
THREE_GAPS: Gaps = ((60.0, 10.0), (110.0, 30.0), (180.0, 60.0))
"""Start and length (s)."""
ANTENNA_SIGMA_M = 0.005


def urban(grade: ImuGrade = "tactical", gaps: Gaps = THREE_GAPS, **changes: Any) -> Scene:
    """5½ minutes through a town: standstill at both ends, three stops, changes of speed, curves to both sides."""
    straight = [{"kind": "straight", "length_m": length} for length in (120.0, 90.0)]
    curves = [
        {"kind": "arc", "length_m": 150.0, "radius_m": 90.0},
        {"kind": "arc", "length_m": 260.0, "radius_m": -120.0},
    ]
    spiral = {"kind": "spiral", "length_m": 40.0}
    scene = Scene().changed(
        length_m=3200.0,
        map={
            "crs": "EPSG:25832",
            "easting_m": 566000.0,
            "northing_m": 5933000.0,
            "height_m": 48.5,
            "azimuth_deg": 35.0,
        },
        road={
            "alignment": [straight[0], spiral, curves[0], spiral, straight[1], spiral, curves[1], spiral],
            "lead_m": 90.0,
            "grade": 0.01,
        },
        passes=[
            {
                "lane": 2,
                "stops": [
                    {"at_m": at, "duration_s": time} for at, time in ((350.0, 8.0), (1500.0, 6.0), (2500.0, 10.0))
                ],
                "speeds": [
                    {"at_m": at, "speed_m_per_s": v} for at, v in ((700.0, 9.0), (1200.0, 16.0), (2000.0, 11.0))
                ],
            }
        ],
        vehicle={"standstill_s": 20.0, "lean_deg_per_m_per_s2": 0.3},
        imu={"on": True, "grade": grade, "rate_hz": 100.0},
        encoder={"on": True, "scale_error": 0.006},
        gnss={"on": True, "gaps": [{"start_s": start, "duration_s": length} for start, length in gaps]},
    )
    return scene.changed(**changes) if changes else scene


@dataclass(frozen=True)
class Simulated:
    """One drive with its noise, and the truth at the IMU's epochs."""

    imu: ImuReadings
    gnss: GnssSolutions
    odometer: OdometerReadings
    vehicle: VehicleSensors
    truth: Poses
    velocity_ecef_m_per_s: np.ndarray
    drive: Drive

    def errors(self, solution: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Truth less solution: position (m), velocity (m/s), attitude (rad) in north-east-down, (n, 3) each."""
        at = np.searchsorted(self.imu.epochs_gps_ns, solution.epochs_gps_ns)
        level = ecef_from_level(solution.position_world_m)
        position = self.truth.position_ecef_m[at] - solution.position_world_m
        turn = (
            self.truth.ecef_from_body[at]
            * Rotation.from_quat(solution.quaternion_world_from_body, scalar_first=True).inv()
        )
        velocity = np.einsum("nji,nj->ni", level, self.velocity_ecef_m_per_s[at])
        return (
            np.einsum("nji,nj->ni", level, position),
            velocity - solution.velocity_ned_m_per_s,
            np.einsum("nji,nj->ni", level, turn.as_rotvec()),
        )

    def normalised(self, solution: Solution) -> np.ndarray:
        """(3, n) squared errors of position, velocity, attitude over their covariance: 3 on average."""
        covariances = (
            solution.covariance_position_ned_m2,
            solution.covariance_velocity_ned,
            solution.covariance_attitude_rad2,
        )
        pairs = zip(self.errors(solution), covariances, strict=True)
        return np.stack([np.einsum("ni,ni->n", e, np.linalg.solve(c, e[..., None])[..., 0]) for e, c in pairs])

    def seconds(self, solution: Solution) -> np.ndarray:
        """Seconds since the first profile (n,), that gaps count from."""
        return np.asarray((solution.epochs_gps_ns - self.drive.start_gps_ns) * 1e-9)

    @property
    def seconds_of_imu(self) -> np.ndarray:
        """Seconds since the first profile of the IMU's samples."""
        return np.asarray((self.imu.epochs_gps_ns - self.drive.start_gps_ns) * 1e-9)

    def worst_m(self, solution: Solution, start_s: float, length_s: float) -> float:
        """Greatest horizontal error in a gap."""
        s = self.seconds(solution)
        error = np.hypot(*self.errors(solution)[0][(s >= start_s) & (s < start_s + length_s), :2].T)
        return float(error.max())


@functools.lru_cache(maxsize=4)
def _felt(scene_json: str, number: int) -> tuple[Any, ...]:
    scene = Scene.model_validate_json(scene_json)
    drive = drives_of(scene, Earth(scene.map.crs), Surface(scene, ride=True))[number]
    imu = simulated_imu.imu_of(scene)
    first = simulated_imu.first_gps_ns(drive, imu)
    last = drive.recorded_span_gps_ns[1] - 2 * imu.stride * imu.step_ns
    epochs = np.arange(first, last + 1, imu.step_ns)
    rate, force = simulated_imu.felt(drive, simulated_imu.AT_BODY, epochs, imu.step_ns, imu.stride)
    truth = drive.poses(epochs)
    half = imu.step_ns // 2
    moved = drive.poses(epochs + half).position_ecef_m - drive.poses(epochs - half).position_ecef_m
    return drive, imu, epochs, rate, force, truth, moved / (2 * half * 1e-9)


def simulated(scene: Scene, seed: int = 1, *, noisy: bool = True) -> Simulated:
    """A drive of a scene with the noise of a seed; the same motion for all seeds."""
    drive, imu, epochs, rate, force, truth, velocity = _felt(scene.model_dump_json(), 0)
    if noisy:
        streams = stream(seed, 0, "imu"), stream(seed, 0, "imu bias")
        rate, force = simulated_imu._SensorErrors(imu, *streams).applied(rate, force)
    found = simulated_gnss.solve(scene.changed(seed=seed), drive)
    lon, lat, height = found.geographic.T
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    count = found.epoch_gps_ns.size
    gnss = GnssSolutions(
        "EPSG:4978",
        found.epoch_gps_ns,
        np.stack(to_ecef.transform(lon, lat, height), axis=-1),
        found.sigma_ned_m[:, :, None] ** 2 * np.eye(3),
        np.where(found.quality == simulated_gnss.FIXED, "fixed", "float"),
        found.velocity_ned_m_per_s,
        np.full((count, 3), simulated_gnss._VELOCITY_SIGMA_M_PER_S),
    )
    ticks_at = np.arange(drive.recorded_span_gps_ns[0], drive.recorded_span_gps_ns[1], 20_000_000)
    ticks = WheelEncoder(scene, drive).ticks(ticks_at)
    odometer = OdometerReadings(ticks_at, ticks / scene.encoder.ticks_per_m, np.full(ticks_at.size, np.nan))
    arm = np.array(scene.gnss.lever_arm_body_m) + np.random.default_rng(seed).normal(0.0, ANTENNA_SIGMA_M, 3)
    vehicle = VehicleSensors(
        np.eye(3), np.zeros(3), imu.errors, arm, np.full(3, ANTENNA_SIGMA_M),
        np.array([0.0, 0.0, scene.vehicle.imu_height_m]),
    )  # fmt: skip
    return Simulated(ImuReadings(epochs, rate, force), gnss, odometer, vehicle, truth, velocity, drive)


INSTANT = SmootherConfig(imu_samples="instant")
"""The simulator's samples hold at their stamps."""


@dataclass(frozen=True)
class Recorded:
    """The recorded drive: see ``README.md`` beside the recordings."""

    imu: ImuReadings
    gnss: GnssSolutions
    vehicle: VehicleSensors
    outage: np.ndarray
    """(m,) number of the outage that a solution falls into, −1 outside."""

    @property
    def masked(self) -> GnssSolutions:
        """Solutions outside the outages."""
        return rows(self.gnss, self.outage < 0)

    def errors(self, solution: Solution, arm_body_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Antenna by the solution less GNSS (k, 3), σ of the solution (k, 3), north-east-down, and outage (k,)."""
        start = solution.epochs_gps_ns[0]
        known, asked = (solution.epochs_gps_ns - start) * 1e-9, (self.gnss.epochs_gps_ns - start) * 1e-9
        inside = (asked >= 0) & (asked <= known[-1])
        antenna = solution.position_world_m + rotation_from_quaternion(solution.quaternion_world_from_body) @ arm_body_m
        origin = antenna[0]
        predicted = CubicSpline(known, antenna - origin)(asked[inside])
        error = (predicted - (self.gnss.position_world_m[inside] - origin)) @ ecef_from_level(origin[None])[0]
        nearest = np.clip(np.searchsorted(known, asked[inside]), 0, known.size - 1)
        sigma = np.sqrt(np.einsum("nii->ni", solution.covariance_position_ned_m2[nearest]))
        return error, sigma, self.outage[inside]


def rows(gnss: GnssSolutions, keep: np.ndarray | slice) -> GnssSolutions:
    """Some of the solutions."""
    return replace(gnss, **{k: v[keep] for k, v in vars(gnss).items() if k != "world"})


DRIVE_CONFIG = SmootherConfig(
    imu_clock_sigma_s=0.1,
    imu_clock_wander_ms_per_sqrt_s=1.0,
    gnss_velocity_lag_s=0.125,
)
"""The IMU's stamps were put on GPS time by one straight line; velocities are means over the quarter of a second before
(their sums fit the positions' differences best 0.125 s later, which the log itself shows)."""

DRIVE_ERRORS = ImuErrors(
    gyro_noise_deg_per_sqrt_h=0.0038 * 60.0,
    gyro_bias_deg_per_h=1800.0,
    gyro_scale_ppm=3000.0,
    accel_noise_ug_per_sqrt_hz=70.0,
    accel_bias_mg=30.0,
    accel_scale_ppm=3000.0,
    bias_time_constant_s=1e6,
)
"""Noise as stated; biases of a consumer-grade IMU that are unknown at the start (0.5 °/s, 30 mg) and wander slowly."""


def recorded(folder: Path) -> Recorded:
    """The drive of the recordings, with 15 s of GNSS masked every 45 s from 40 s on (11 outages)."""
    with gzip.open(folder / "drive" / "imu.csv.gz", "rt") as file:
        table = np.genfromtxt(file, delimiter=",", skip_header=1)
    late_s = -0.125
    epochs = np.rint((table[:, 0] - 315_964_800 + late_s) * 1e4).astype(np.int64) * 100_000
    imu = ImuReadings(epochs, np.radians(table[:, 4:7]), table[:, 1:4] * 9.80665)
    with gzip.open(folder / "drive" / "gnss_rtk.pos.gz", "rt") as file:
        lines = [line.split() for line in file if not line.startswith("%")]
    columns = np.array([[float(v) for v in line[2:]] for line in lines])
    gnss = _rtklib([f"{line[0]} {line[1]}" for line in lines], columns)
    # Roll, pitch and yaw lead from the body's axes to the IMU's: standing level, z down then reads −g.
    imu_from_body = Rotation.from_euler("ZYX", [185.35, -6.79, 180.0], degrees=True).as_matrix()
    vehicle = VehicleSensors(
        imu_from_body.T, np.array([0.0, 0.0, -0.65]), DRIVE_ERRORS, np.array([0.0, -0.05, -0.65]), np.full(3, 0.01)
    )
    since = (gnss.epochs_gps_ns - gnss.epochs_gps_ns[0]) * 1e-9 - 40.0
    outage = np.where((since >= 0) & (since % 45.0 < 15.0), since // 45.0, -1).astype(int)
    return Recorded(imu, gnss, vehicle, np.where(outage < 11, outage, -1))


def _rtklib(stamps: Sequence[str], columns: np.ndarray) -> GnssSolutions:
    epoch = dt.datetime(1980, 1, 6)
    seconds = [(dt.datetime.strptime(s, "%Y/%m/%d %H:%M:%S.%f") - epoch).total_seconds() for s in stamps]
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    names = np.array(["none", "fixed", "float", "sbas", "dgps", "single", "ppp"])
    return GnssSolutions(
        "EPSG:4978",
        np.rint(np.array(seconds) * 1e3).astype(np.int64) * 1_000_000,
        np.stack(to_ecef.transform(columns[:, 1], columns[:, 0], columns[:, 2]), axis=-1),
        columns[:, 5:8][:, :, None] ** 2 * np.eye(3),
        names[columns[:, 3].astype(int)],
        columns[:, 13:16] * [1.0, 1.0, -1.0],
        columns[:, 16:19],
    )


def highway(folder: Path) -> tuple[ImuReadings, GnssSolutions, OdometerReadings, VehicleSensors]:
    """A minute of motorway with wheel speeds; the poses are given as positions, σ 0.1 m and 0.15 m.

    How the IMU is mounted is not stated. Its data tell: x follows the change of speed (correlation 0.90), y the
    acceleration to the right in curves (0.76), and z reads −9.66 m/s²: forward, right, down. The motion is too calm for
    more; the angles between its axes and the direction of travel are left to the smoother.
    """

    def load(name: str) -> np.ndarray:
        return np.asarray(np.load(folder / "odometer" / f"{name}.npy"))

    times, weeks = load("global_pose_frame_times"), load("global_pose_frame_gps_times")
    offset = float(np.median(weeks[:, 0] * 604_800 + weeks[:, 1] - times))
    positions, count = load("global_pose_frame_positions"), times.size
    nothing = np.full((count, 3), np.nan)
    covariance = np.tile(np.diag([0.1, 0.1, 0.15]) ** 2, (count, 1, 1))

    def epochs(boot_s: np.ndarray) -> np.ndarray:
        return np.rint((boot_s + offset) * 1e6).astype(np.int64) * 1000

    gnss = GnssSolutions("EPSG:4978", epochs(times), positions, covariance, np.full(count, "ppp"), nothing, nothing)
    imu = ImuReadings(epochs(load("IMU_gyro_t")), load("IMU_gyro_value"), load("IMU_accelerometer_value"))
    wheels, at = load("CAN_wheel_speed_value").mean(axis=1), epochs(load("CAN_wheel_speed_t"))
    odometer = OdometerReadings(at, np.full(at.size, np.nan), wheels)
    vehicle = VehicleSensors(np.eye(3), np.zeros(3), IMU_GRADES["mems"], np.zeros(3), np.full(3, 0.3))
    return imu, gnss, odometer, vehicle
