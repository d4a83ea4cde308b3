"""Simulated drives as navigation sees them: poses, logs of IMU and encoder with wrong clocks, and the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv as pa_csv
from scipy.spatial.transform import Rotation

from roadscan.core.gpstime import TimeSystem
from roadscan.ingest.clock_correction import ClockCorrection
from roadscan.navigation.inertial.readings import ImuReadings, OdometerReadings
from roadscan.poses.trajectory import Trajectory
from roadscan.simulate import Scene
from roadscan.simulate.drive import Drive, drives_of
from roadscan.simulate.noise import GaussMarkov, stream
from roadscan.simulate.path import Earth
from roadscan.simulate.scene import ClockError
from roadscan.simulate.sensors.clock import SensorClock, write_encoder
from roadscan.simulate.sensors.gnss import head_imus, write_imu
from roadscan.simulate.surface import Surface

WORLD = "EPSG:4978"


def scene_of(length_m: float, seed: int, clock: dict[str, float], grade: str = "tactical", **changes: Any) -> Scene:
    """A straight road, heads with IMUs and an encoder, all on the same wrong clock."""
    values: dict[str, Any] = {
        "length_m": length_m,
        "seed": seed,
        "road": {"alignment": [{"kind": "straight", "length_m": length_m + 100.0}]},
        "profilers": {"head_imus": grade, "clock": clock},
        "encoder": {"on": True, "clock": clock, "side_m": 0.78, "scale_error": 0.006},
    }
    return Scene.parse(values | changes)


@dataclass(frozen=True)
class Driven:
    """The first pass of a scene."""

    scene: Scene
    drive: Drive

    @classmethod
    def of(cls, scene: Scene) -> Driven:
        return cls(scene, drives_of(scene, Earth(scene.map.crs), Surface(scene, ride=True))[0])

    def trajectory(self, rate_hz: int = 200) -> Trajectory:
        """Poses, with the scene's errors of position and attitude."""
        first, last = self.drive.recorded_span_gps_ns
        epochs = np.arange(first, last, 10**9 // rate_hz)
        poses = self.drive.poses(epochs)
        noise = self.scene.noise
        tilt = np.radians(noise.attitude_deg)
        sigma = np.array([noise.position_m] * 3 + [tilt, tilt, 2 * tilt])
        errors = GaussMarkov(stream(self.scene.seed, 0, "poses"), sigma, noise.time_constant_s, 1 / rate_hz)
        wrong = errors.take(epochs.size)
        rotation = poses.ecef_from_body * Rotation.from_rotvec(wrong[:, 3:])
        quaternion = rotation.as_quat()[:, [3, 0, 1, 2]]
        return Trajectory.of(WORLD, epochs, poses.position_ecef_m + wrong[:, :3], quaternion)

    def head(self, file: Path, which: int = 1) -> ImuReadings:
        """Log of a head's IMU."""
        clock = SensorClock.of(self.scene, self.scene.profilers.clock, TimeSystem.GPS)
        list(write_imu(self.scene, self.drive, head_imus(self.scene)[which], clock, file))
        columns = [c.to_numpy() for c in pa_csv.read_csv(file).itercolumns()]
        return ImuReadings(
            columns[0], np.stack(columns[1:4], axis=-1) * 1.0, np.stack(columns[4:], axis=-1) * 1.0
        )  # fmt: skip

    def encoder(self, file: Path) -> OdometerReadings:
        """Log of the encoder, in nominal metres."""
        clock = SensorClock.of(self.scene, self.scene.encoder.clock, TimeSystem.GPS)
        list(write_encoder(self.scene, self.drive, clock, file))
        epochs, ticks = (c.to_numpy() for c in pa_csv.read_csv(file).itercolumns())
        return OdometerReadings(epochs, ticks / self.scene.encoder.ticks_per_m, np.full(ticks.size, np.nan))

    def errors(self, found: ClockCorrection, clock: ClockError) -> tuple[float, float, float]:
        """Error of a correction at its reference (s), its greatest error over its span (s), error of the drift."""
        epochs = np.array([found.reference_gps_ns, found.first_gps_ns, found.last_gps_ns])
        rate = clock.drift_ppm * 1e-6
        shown_s = (epochs - self.drive.start_gps_ns) / 1e9  # = t + offset + rate · t
        true_s = (shown_s - clock.offset_s) / (1.0 + rate) - shown_s
        wrong = (found.applied(epochs) - epochs) / 1e9 - true_s
        return float(wrong[0]), float(np.abs(wrong).max()), found.drift + rate / (1.0 + rate)
