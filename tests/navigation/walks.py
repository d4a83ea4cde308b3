"""Walks with known truth for the smoother: a rig that a person carries, low-cost IMU and RTK.

The gait follows published figures of level walking: two steps a second, a vertical path of ± 2 to 4 cm at step rate,
a sideways one of ± 2 cm at half of it (Inman, Ralston and Todd 1981, "Human walking"), heel strikes of some g that
ring at tens of hertz. The errors of the IMU go beyond what :class:`~roadscan.core.rig.ImuErrors` describes: its bias
wanders within a minute, vibration shifts it, and gyroscopes feel accelerations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from roadscan.core.rig import IMU_GRADES
from roadscan.core.settings.navigation import SmootherConfig
from roadscan.navigation.inertial.alignment import ecef_from_level
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, Solution, VehicleSensors
from roadscan.simulate.drive import Poses
from roadscan.simulate.noise import GaussMarkov
from roadscan.simulate.path import Earth
from roadscan.simulate.sensors.gnss import AT_BODY, felt
from tests.navigation.inertial_drives import rows

START_GPS_NS = 1_400_000_000 * 10**9
IMU_HZ, GNSS_HZ = 100, 5
OUTAGES = ((60.0, 10.0), (95.0, 10.0), (130.0, 10.0), (165.0, 10.0))
"""Start and length (s) of the four masked spans."""
ANTENNA_BODY_M = np.array([0.05, 0.0, -0.8])
GNSS_SIGMA_M = np.array([0.01, 0.01, 0.018])
VELOCITY_SIGMA_M_PER_S = 0.03
WALKER = SmootherConfig(imu_samples="instant", poses_per_s=20.0)
"""Nothing says that it is no vehicle."""


@dataclass(frozen=True)
class Walk:
    """Motion of a carried rig; the part of a :class:`~roadscan.simulate.drive.Drive` that sensors ask for."""

    seed: int
    length_s: float = 210.0

    @property
    def earth(self) -> Earth:
        return Earth("EPSG:25832")

    @cached_property
    def _plan(self) -> tuple[CubicSpline, CubicSpline, CubicSpline, CubicSpline]:
        """By seconds: way (m; north, east), heading (rad), gait (0 standing, 1 walking), slow sway (8 columns)."""
        rng = np.random.default_rng(self.seed)
        t = np.arange(-20.0, self.length_s + 5.0, 0.01)
        speed, turn = np.zeros(t.size), np.zeros(t.size)
        at = 8.0  # stands for eight seconds
        while at < self.length_s - 6.0:
            walk = rng.uniform(12.0, 25.0)
            inside = (t >= at) & (t < at + walk)
            speed[inside] = rng.uniform(1.0, 1.8)
            for bend in np.arange(at + 3.0, at + walk - 3.0, rng.uniform(4.0, 7.0)):
                turn[(t >= bend) & (t < bend + 2.0)] = np.radians(rng.uniform(-45.0, 45.0))
            at += walk
            pause = rng.uniform(3.0, 6.0)
            turn[(t >= at + 0.8) & (t < at + 2.4)] = np.radians(rng.choice([-1.0, 1.0]) * rng.uniform(30.0, 90.0))
            at += pause
        ease = np.hanning(101) / np.hanning(101).sum()
        speed, turn = (np.convolve(v, ease, "same") for v in (speed, turn))
        heading = rng.uniform(0.0, 2 * np.pi) + np.cumsum(turn) * 0.01
        way = np.cumsum(speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0) * 0.01
        drift = GaussMarkov(rng, np.ones(8), 2.0, 0.01).take(t.size)
        kernel = np.hanning(121) / np.hanning(121).sum()
        drift = np.stack([np.convolve(c, kernel, "same") for c in drift.T], axis=-1)
        return CubicSpline(t, way), CubicSpline(t, heading), CubicSpline(t, speed / 1.4), CubicSpline(t, drift)

    @cached_property
    def _gait(self) -> np.ndarray:
        """Steps a second (1), heave (m), side sway (m), surge (m), pitch, roll, yaw (rad) of this person."""
        rng = np.random.default_rng(self.seed + 1000)
        middle = np.array([2.0, 0.03, 0.02, 0.015, np.radians(3.0), np.radians(4.0), np.radians(5.0)])
        return middle * rng.uniform(0.7, 1.3, 7)

    def seconds(self, epochs: np.ndarray) -> np.ndarray:
        return np.asarray((epochs - START_GPS_NS) * 1e-9)

    def phase(self, t: np.ndarray) -> np.ndarray:
        """Phase of the steps (rad)."""
        return np.asarray(2 * np.pi * self._gait[0] * t + 0.5 * np.sin(0.7 * t))

    def gait(self, t: np.ndarray) -> np.ndarray:
        return np.asarray(self._plan[2](t))

    def poses(self, epochs: np.ndarray) -> Poses:
        """True poses at epochs (n,)."""
        t = self.seconds(epochs)
        way, course, gait, drift = (spline(t) for spline in self._plan)
        _, heave, sway, surge, nod, lean, swing = self._gait
        phase = self.phase(t)
        aside = gait * sway * np.sin(phase / 2) + 0.01 * drift[:, 0]
        ahead = gait * surge * np.sin(phase + 1.0) + 0.01 * drift[:, 1]
        down = gait * heave * np.cos(phase) + 0.005 * drift[:, 2] + _ground_m(way)
        roll = gait * lean * np.sin(phase / 2 + 0.4) + np.radians(1.5) * drift[:, 3]
        pitch = gait * nod * np.sin(phase + 0.7) + np.radians(2.0) * drift[:, 4] - np.radians(8.0)
        heading = course + gait * swing * np.sin(phase / 2 + 1.1) + np.radians(6.0) * drift[:, 5]
        north = way[:, 0] + ahead * np.cos(course) - aside * np.sin(course)
        east = way[:, 1] + ahead * np.sin(course) + aside * np.cos(course)
        origin = self.earth.ecef_from_map(np.array([[566_000.0, 5_933_000.0, 50.0]]))
        level = self.earth.ecef_from_level(origin)[0]
        body = Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], axis=-1))
        return Poses(origin + level.apply(np.stack([north, east, down], axis=-1)), level * body)


@dataclass(frozen=True)
class Walked:
    """Readings of one walk, and its truth."""

    walk: Walk
    imu: ImuReadings
    gnss: GnssSolutions
    """All solutions."""
    vehicle: VehicleSensors

    @property
    def outage(self) -> np.ndarray:
        """(m,) True for solutions within a masked span."""
        t = self.walk.seconds(self.gnss.epochs_gps_ns)
        return np.any([(t >= a) & (t < a + length) for a, length in OUTAGES], axis=0)

    @property
    def masked(self) -> GnssSolutions:
        """Solutions outside the outages."""
        return rows(self.gnss, ~self.outage)

    def ratios(self, solution: Solution) -> tuple[float, float, float, float]:
        """RMS of the antenna's true error in the outages, horizontal and down (m), and each over the σ stated."""
        t = self.walk.seconds(solution.epochs_gps_ns)
        inside = np.any([(t >= a) & (t < a + length) for a, length in OUTAGES], axis=0)
        truth = self.walk.poses(solution.epochs_gps_ns[inside])
        error = solution.position_world_m[inside] - truth.position_ecef_m
        ned = error @ ecef_from_level(truth.position_ecef_m[:1])[0]
        variance = np.einsum("nii->ni", solution.covariance_position_ned_m2[inside])
        rms, sigma = np.sqrt((ned**2).mean(axis=0)), np.sqrt(variance.mean(axis=0))
        both = np.hypot(*rms[:2]), np.hypot(*sigma[:2])
        return float(both[0]), float(rms[2]), float(both[0] / both[1]), float(rms[2] / sigma[2])


def _ground_m(way: np.ndarray) -> np.ndarray:
    """How far down the ground lies (n,): slopes of up to 8 %, that the rig does not lean with."""
    north, east = way.T
    return np.asarray(0.4 * np.sin(2 * np.pi * north / 50.0) + 0.25 * np.sin(2 * np.pi * east / 40.0))


def walked(seed: int, *, sigma_factor: float = 1.0, arm_error_m: float = 0.03) -> Walked:
    """A walk with the noise of a seed.

    Parameters
    ----------
    sigma_factor : true σ of GNSS over what the receiver states.
    arm_error_m : size of the error of the stated lever arm of the antenna.
    """
    walk, rng = Walk(seed), np.random.default_rng(seed + 2000)
    away = rng.standard_normal(3)
    arm = ANTENNA_BODY_M + arm_error_m * away / np.linalg.norm(away)
    vehicle = VehicleSensors(np.eye(3), np.zeros(3), IMU_GRADES["mems"], arm, np.full(3, 0.03))
    return Walked(walk, _imu(walk, rng), _gnss(walk, rng, sigma_factor), vehicle)


def _imu(walk: Walk, rng: np.random.Generator) -> ImuReadings:
    step = 10**9 // IMU_HZ
    epochs = START_GPS_NS + np.arange(0, round(walk.length_s * IMU_HZ)) * step
    rate, force = felt(walk, AT_BODY, epochs, step, 1)  # type: ignore[arg-type]
    strike = _heel_strikes(walk, epochs, step)
    count, h = epochs.size, 1.0 / IMU_HZ
    errors = IMU_GRADES["mems"]
    g = 9.80665
    shake = strike**2
    kernel = np.ones(IMU_HZ // 2) / (IMU_HZ // 2)
    shaken = np.stack([np.convolve(c, kernel, "same") for c in shake.T], axis=-1) / g**2
    wander = GaussMarkov(rng, np.repeat([np.radians(60.0) / 3600.0, 2.0e-3 * g], 3), 40.0, h).take(count)
    steady = rng.standard_normal(6) * np.repeat([np.radians(100.0) / 3600.0, 10e-3 * g], 3)
    density = np.repeat(
        [np.radians(errors.gyro_noise_deg_per_sqrt_h) / 60.0, errors.accel_noise_ug_per_sqrt_hz * 1e-6 * g], 3
    )
    noise = rng.standard_normal((count, 6)) * density / np.sqrt(h)
    scale = 1.0 + rng.standard_normal(6) * 6e-3
    rectified = shaken * rng.normal(0.0, 10e-3 * g, 3)
    felt_force = force + strike + rectified
    g_sensitive = (felt_force / g) @ (rng.standard_normal((3, 3)) * np.radians(0.1))
    stated = np.concatenate([rate + g_sensitive, felt_force], axis=1) * scale + wander + steady + noise
    jitter = np.rint(rng.uniform(-1e6, 1e6, count)).astype(np.int64)
    return ImuReadings(epochs + jitter, stated[:, :3], stated[:, 3:])


def _heel_strikes(walk: Walk, epochs: np.ndarray, step: int) -> np.ndarray:
    """Ringing of the rig after each step (n, 3), m/s², mean over each sample; it leaves no velocity behind."""

    def velocity(at: np.ndarray) -> np.ndarray:
        t = walk.seconds(at)
        since = np.mod(walk.phase(t), 2 * np.pi) / (2 * np.pi * walk._gait[0])
        ring = np.exp(-since / 0.05) * np.sin(2 * np.pi * 27.0 * since)
        return np.asarray(walk.gait(t)[:, None] * np.array([0.024, 0.012, 0.048]) * ring[:, None])

    return (velocity(epochs + step // 2) - velocity(epochs - step // 2)) / (step * 1e-9)


def _gnss(walk: Walk, rng: np.random.Generator, sigma_factor: float) -> GnssSolutions:
    step = 10**9 // GNSS_HZ
    epochs = START_GPS_NS + step + np.arange(0, round((walk.length_s - 1.0) * GNSS_HZ)) * step
    count, half = epochs.size, 5_000_000

    def antenna(at: np.ndarray) -> np.ndarray:
        poses = walk.poses(at)
        return np.asarray(poses.position_ecef_m + poses.ecef_from_body.apply(ANTENNA_BODY_M))

    here = antenna(epochs)
    level = ecef_from_level(here[:1])[0]
    velocity = (antenna(epochs + half) - antenna(epochs - half)) / (2e-9 * half) @ level
    slow = GaussMarkov(rng, GNSS_SIGMA_M * np.sqrt(0.5), 20.0, 1.0 / GNSS_HZ).take(count)
    error = slow + GNSS_SIGMA_M * np.sqrt(0.5) * rng.standard_normal((count, 3))
    return GnssSolutions(
        "EPSG:4978",
        epochs,
        here + sigma_factor * error @ level.T,
        np.tile(np.diag(GNSS_SIGMA_M**2), (count, 1, 1)),
        np.full(count, "fixed"),
        velocity + VELOCITY_SIGMA_M_PER_S * rng.standard_normal((count, 3)),
        np.full((count, 3), VELOCITY_SIGMA_M_PER_S),
    )
