"""The vehicle's trajectory: as stated (SBET, with errors) and as it was (Parquet, in the truth)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from roadscan.model.gpstime import NS_PER_S, WEEK_S
from roadscan.simulate.drive import RUN_UP_S, Drive, Poses
from roadscan.simulate.earth import ecef_from_ned
from roadscan.simulate.noise import GaussMarkov, stream
from roadscan.simulate.scene import Scene

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

CHUNK_POSES: Final = 8_192
_DIFFERENCE_NS: Final = 2_000_000
"""Velocities, accelerations and rates are differences over this to both sides."""
_TRUTH_SCHEMA: Final = pa.schema(
    [
        pa.field("epoch_gps_ns", pa.int64()),
        *(pa.field(name, pa.float64()) for name in ("x_world_m", "y_world_m", "z_world_m", "qw", "qx", "qy", "qz")),
    ]
)


def wander_rad(number: int) -> float:
    """Wander angle that a run's platform heading counts from: not zero, and another one for each run."""
    return math.radians((2.75, -1.5, 0.6)[number % 3])


def write_trajectory(scene: Scene, drive: Drive, file: Path, truth_file: Path) -> Iterator[int]:
    """Write the poses of one pass, a chunk a step; yields the poses of each."""
    step = NS_PER_S // scene.trajectory.poses_per_s
    first = (drive.start_gps_ns - round(RUN_UP_S * 1e9)) // step * step
    last = drive.start_gps_ns + round((drive.duration_s + RUN_UP_S) * 1e9)
    errors = _Errors(scene, drive.number)
    with file.open("wb") as log, pq.ParquetWriter(truth_file, _TRUTH_SCHEMA, use_dictionary=False) as truth:
        for begin in range(first, last + step, step * CHUNK_POSES):
            epochs = np.arange(begin, min(begin + step * CHUNK_POSES, last + step), step)
            truth.write_batch(_true_rows(drive, epochs))
            log.write(_sbet(drive, epochs, errors, wander_rad(drive.number)).astype("<f8").tobytes())
            yield epochs.size


class _Errors:
    """Gauss–Markov errors of position (north, east, down) and attitude (roll, pitch, heading)."""

    def __init__(self, scene: Scene, number: int) -> None:
        noise = scene.noise
        tilt = math.radians(noise.attitude_deg)
        self._process = GaussMarkov(
            stream(scene.seed, number, "trajectory"),
            np.array([noise.position_m] * 3 + [tilt, tilt, 2 * tilt]),
            noise.time_constant_s,
            1.0 / scene.trajectory.poses_per_s,
        )

    def take(self, count: int) -> tuple[Float64, Float64]:
        """Position errors (count, 3) in metres and attitude errors (count, 3) in radians, of the next poses."""
        values = self._process.take(count)
        return values[:, :3], values[:, 3:]


def _true_rows(drive: Drive, epochs: Int64) -> pa.RecordBatch:
    poses = drive.poses(epochs)
    quaternion = poses.ecef_from_body.as_quat(canonical=True, scalar_first=True)
    columns = [epochs, *poses.position_ecef_m.T, *quaternion.T]
    return pa.RecordBatch.from_arrays([pa.array(np.ascontiguousarray(c)) for c in columns], schema=_TRUTH_SCHEMA)


def _sbet(drive: Drive, epochs: Int64, errors: _Errors, wander: float) -> Float64:
    """SBET records (n, 17); platform heading = true heading + wander angle.

    Velocities are along the wander frame (x at azimuth −wander, y to its right, z down); accelerations are the
    body's relative to the Earth, without gravity, and rates likewise, in body axes.
    """
    before, here, after = (drive.poses(epochs + shift) for shift in (-_DIFFERENCE_NS, 0, _DIFFERENCE_NS))
    dt = _DIFFERENCE_NS * 1e-9
    lon, lat, _ = drive.earth.geographic_from_ecef(here.position_ecef_m).T
    level = ecef_from_ned(lon, lat)
    position_error, attitude_error = errors.take(epochs.size)
    stated = drive.earth.geographic_from_ecef(here.position_ecef_m + level.apply(position_error))
    heading, pitch, roll = (level.inv() * here.ecef_from_body).as_euler("ZYX").T + attitude_error.T[::-1]
    velocity = level.inv().apply((after.position_ecef_m - before.position_ecef_m) / (2 * dt))
    along_wander = Rotation.from_euler("z", wander).apply(velocity)
    acceleration, rates = _body_motion(before, here, after, dt)
    return np.column_stack(
        [
            epochs % (WEEK_S * NS_PER_S) / NS_PER_S,
            np.radians(stated[:, 1]),
            np.radians(stated[:, 0]),
            stated[:, 2],
            along_wander,
            roll,
            pitch,
            np.mod(heading + wander + math.pi, 2 * math.pi) - math.pi,
            np.full(epochs.size, wander),
            acceleration,
            rates,
        ]
    )


def _body_motion(before: Poses, here: Poses, after: Poses, dt: float) -> tuple[Float64, Float64]:
    """Acceleration (m/s²) and angular rate (rad/s) relative to the Earth, in body axes, (n, 3) each."""
    bend = (after.position_ecef_m - 2 * here.position_ecef_m + before.position_ecef_m) / dt**2
    turn = (before.ecef_from_body.inv() * after.ecef_from_body).as_rotvec() / (2 * dt)
    return here.ecef_from_body.inv().apply(bend), turn
