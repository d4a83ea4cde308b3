"""Calibration: a million ties, and how honest σ are over many seeds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.csv as pa_csv
from scipy.spatial.transform import Rotation

from benchmarks.timing import Figure, best_seconds
from roadscan.calibrate.estimator import Calibration, Prior, calibrate
from roadscan.calibrate.evidence import Seen, Ties, Traverse
from roadscan.calibrate.stop_and_go import HeadRun, find_orientation
from roadscan.core.crs import world_from_geodetic
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned, quaternion_from_rotation, rotation_from_rph
from roadscan.core.gpstime import NS_PER_S, WEEK_S
from roadscan.core.rig import IMU_GRADES, Mounting, Rig
from roadscan.navigation.inertial.readings import ImuReadings
from roadscan.poses.trajectory import Trajectory
from roadscan.simulate import Scene, simulate

HEADINGS_DEG = (0.0, 90.0, 180.0, 270.0)
LEVER_ARM_M = np.array([-1.7, 0.1, -1.4])
SIGMA_M, LEVER_SIGMA_M, BORESIGHT_SIGMA_RAD = 0.002, 0.03, np.radians(1.0)
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.006, np.radians(0.004)
TILT_RAD = np.radians(0.004)
SEEDS = 50
YARDS = 20


def figures(folder: Path) -> Iterator[Figure]:
    """Speed of the adjustment, honesty of its σ, stop and go."""
    many = Drives(np.random.default_rng(0), 100_000)
    yield Figure("calibration, 1,000,000 ties (bar: a few)", best_seconds(many.calibrate, runs=1), "s")
    squares = [Drives(np.random.default_rng(seed), 40).normalised_square() for seed in range(1, SEEDS + 1)]
    yield Figure(f"calibration, normalised error² / 6, {SEEDS} seeds", float(np.mean(squares)) / 6, "", 1.0, "expected")
    errors, squares = zip(*(found for seed in range(YARDS) for found in head_errors(folder, seed)), strict=True)
    rms = np.degrees(np.sqrt(np.mean(np.square(errors), axis=0)))
    yield Figure(f"stop and go, roll, RMS of {YARDS} yards", float(rms[0]), "°")
    yield Figure(f"stop and go, pitch, RMS of {YARDS} yards", float(rms[1]), "°")
    yield Figure(f"stop and go, heading, RMS of {YARDS} yards", float(rms[2]), "°")
    yield Figure("stop and go, normalised error² / 3", float(np.mean(squares)) / 3, "", 1.0, "expected")


class Drives:
    """A sensor with a wrong mounting over a place with relief, from four sides, with poses that are off."""

    def __init__(self, rng: np.random.Generator, ties_each: int) -> None:
        self.rotation = Rotation.from_rotvec(BORESIGHT_SIGMA_RAD * rng.standard_normal(3))
        self.lever_arm_m = LEVER_ARM_M + LEVER_SIGMA_M * rng.standard_normal(3)
        self.shift = POSE_SIGMA_M * rng.standard_normal((4, 3))
        self.turn = Rotation.from_rotvec(POSE_SIGMA_RAD * rng.standard_normal((4, 3)))
        sigma = (POSE_SIGMA_M,) * 3, (POSE_SIGMA_RAD,) * 3
        self.traverses = {k: Traverse(f"run-{k}", 0, *sigma, ENU_FROM_NED) for k in range(4)}
        self.ties = [self._ties(rng, a, b, ties_each) for a in range(4) for b in range(a, 4)]

    def _ties(self, rng: np.random.Generator, first: int, second: int, count: int) -> Ties:
        place = rng.uniform([-3, -3, 0], [3, 3, 1], (count, 3))
        normal = rng.standard_normal((count, 3)) * [0.5, 0.5, 1.0]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        noisy = place + rng.normal(0, SIGMA_M, (count, 1)) * normal
        return Ties(
            "loops", self._seen(rng, noisy, first), self._seen(rng, place, second), (normal / SIGMA_M)[:, None, :]
        )

    def _seen(self, rng: np.random.Generator, place: np.ndarray, key: int) -> Seen:
        angles = rng.normal([HEADINGS_DEG[key], 0, 0], 1.0, (len(place), 3))
        world_from_body = ENU_FROM_NED @ Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        position = place + 2 * world_from_body[:, :, 0] + rng.normal([0, 0, 1.5], 0.3, (len(place), 3))
        in_body = np.einsum("nji,nj->ni", world_from_body, place - position)
        point = self.rotation.inv().apply(in_body - self.lever_arm_m)
        stated = world_from_body @ self.turn[key].inv().as_matrix()
        return Seen("lidar", point, position - ENU_FROM_NED @ self.shift[key], stated, np.full(len(place), key))

    def calibrate(self) -> Calibration:
        nominal = Mounting(tuple(LEVER_ARM_M.tolist()), tuple(map(tuple, np.eye(3).tolist())))
        prior = Prior(nominal, (LEVER_SIGMA_M,) * 3, (BORESIGHT_SIGMA_RAD,) * 3)
        return calibrate({"lidar": prior}, self.ties, self.traverses)

    def normalised_square(self) -> float:
        found = self.calibrate()
        rotation, lever_arm = found.mountings["lidar"].arrays()
        turn = (self.rotation * Rotation.from_matrix(rotation).inv()).as_rotvec()
        error = np.concatenate([self.lever_arm_m - lever_arm, turn])
        return float(error @ np.linalg.solve(found.covariance, error))


def head_errors(folder: Path, seed: int) -> Iterator[tuple[np.ndarray, float]]:
    """Error (rad, body axes) and normalised square of the left head's orientation in one simulated yard."""
    yard, off = Scene.load("calibration_yard"), {"on": False}
    scene = yard.changed(
        seed=seed, profilers={"spacing_m": 2.0, "readings": 2}, lidar=off, sick=off, camera=off, imu=off, gnss=off,
        encoder=off, road={"texture": None},
    )  # fmt: skip
    made = simulate(scene, folder / f"yard-{seed}").folder
    name = "profiler_left_imu"
    nominal, true = (Rig.load(made / rig).sensors[name].mounting() for rig in ("RIG.toml", "truth/RIG.toml"))
    runs = head_runs(made, name, len(scene.passes), TILT_RAD)
    found = find_orientation(runs, nominal, (0.03, 0.03, 0.03), IMU_GRADES["tactical"])
    error = Rotation.from_matrix(true.arrays()[0] @ found.body_from_imu.T).as_rotvec()
    yield error, float(error @ np.linalg.solve(found.covariance_rad2, error))


def head_runs(made: Path, name: str, count: int, tilt_rad: float) -> list[HeadRun]:
    """Runs of a simulated survey with the samples of one head's IMU; σ of roll and pitch, heading twice that."""
    sigma = (tilt_rad, tilt_rad, 2 * tilt_rad)
    return [HeadRun(*_logs(made / "raw" / f"run-{k + 1}", name), sigma) for k in range(count)]


def _logs(folder: Path, name: str) -> tuple[ImuReadings, Trajectory]:
    table = pa_csv.read_csv(folder / f"{name}.csv")
    rate, force = (
        np.column_stack([table[column.format(axis)].to_numpy() for axis in "xyz"])
        for column in ("angular_rate_{}_rad_per_s", "specific_force_{}_m_per_s2")
    )
    epochs = table["time_ns"].to_numpy().astype(np.int64)
    time_s, latitude, longitude, height, *_, roll, pitch, platform, wander = np.fromfile(
        folder / "trajectory.sbet"
    ).reshape(-1, 17)[:, :11].T  # fmt: skip
    at = epochs[0] // (WEEK_S * NS_PER_S) * WEEK_S * NS_PER_S + np.rint(time_s * NS_PER_S).astype(np.int64)
    position = world_from_geodetic("EPSG:4978", np.column_stack([*np.degrees([longitude, latitude]), height]))
    attitude = ecef_from_ned(latitude, longitude) @ rotation_from_rph(roll, pitch, platform - wander)
    return ImuReadings(epochs, rate, force), Trajectory.of(
        "EPSG:4978", at, position, quaternion_from_rotation(attitude)
    )
