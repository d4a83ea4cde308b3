"""Writes the vehicle's trajectory: as stated (SBET and SMRMSG, with errors) and as it was (Parquet, in the truth).

A rig in a local frame has no latitude: there the stated trajectory is a table of poses, too.
"""

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

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.gpstime import NS_PER_S, WEEK_S
from roadscan.simulate.drive import Drive, Poses
from roadscan.simulate.noise import GaussMarkov, stream
from roadscan.simulate.scene import Scene
from roadscan.simulate.scene.rig import Outage

CHUNK_POSES: Final = 8_192  # poses of a chunk
_DIFFERENCE_NS: Final = 2_000_000
"""Step on each side (ns) of the differences for velocities, accelerations and rates."""
_LEAST_SIGMA_M: Final = 0.001  # no post-processor states less
_LEAST_SIGMA_DEG: Final = 0.0005
"""Least stated σ of an angle (degrees): no post-processor states less."""
_TRUTH_SCHEMA: Final = pa.schema(
    [
        pa.field("epoch_gps_ns", pa.int64()),
        *(pa.field(name, pa.float64()) for name in ("x_world_m", "y_world_m", "z_world_m", "qw", "qx", "qy", "qz")),
    ]
)
_LOCAL_SCHEMA: Final = pa.schema(
    [
        pa.field("timestamp_ns", pa.int64()),
        *(pa.field(name, pa.float64()) for name in ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")),
    ]
)


def file_name(drive: Drive) -> str:
    """Return the file name of the stated trajectory's log."""
    return "trajectory.parquet" if drive.earth.is_local else "trajectory.sbet"


def wander_rad(number: int) -> float:
    """Return the wander angle of a run's platform heading: not zero, and different for each run."""
    return math.radians((2.75, -1.5, 0.6)[number % 3])


def first_gps_ns(scene: Scene, drive: Drive) -> int:
    """Return the epoch of the first pose."""
    step = NS_PER_S // scene.trajectory.poses_per_s
    return drive.recorded_span_gps_ns[0] // step * step


def write_trajectory(scene: Scene, drive: Drive, file: Path, truth_file: Path) -> Iterator[int]:
    """Write the poses of one pass, one chunk per step; yields the poses of each."""
    step = NS_PER_S // scene.trajectory.poses_per_s
    first, last = first_gps_ns(scene, drive), drive.recorded_span_gps_ns[1]
    errors = PoseErrors(scene, drive.number)
    with pq.ParquetWriter(truth_file, _TRUTH_SCHEMA, use_dictionary=False) as truth, _Log(drive, file) as log:
        for begin in range(first, last + step, step * CHUNK_POSES):
            epochs = np.arange(begin, min(begin + step * CHUNK_POSES, last + step), step)
            truth.write_batch(_true_rows(drive, epochs))
            log.write(epochs, errors)
            yield epochs.size


def write_accuracy(scene: Scene, drive: Drive, file: Path) -> Iterator[int]:
    """Write the companion SMRMSG of a pass, a record a second; yields their count.

    Records of 10 doubles: time, position σ (m), velocity σ (m/s), roll, pitch, heading σ (arc minutes).
    """
    first, last = drive.recorded_span_gps_ns
    epochs = np.arange(first // NS_PER_S * NS_PER_S, last + NS_PER_S, NS_PER_S)
    sigma = np.array(scene.noise.pose_sigma())
    position = np.maximum(sigma[:3], _LEAST_SIGMA_M)
    velocity = position * np.sqrt(2.0 * (1.0 - np.exp(-1.0 / np.array(scene.noise.pose_time_constants_s()[:3]))))
    tilt = max(float(sigma[3]), _LEAST_SIGMA_DEG) * 60.0
    heading = max(float(sigma[5]), 2.0 * _LEAST_SIGMA_DEG) * 60.0
    rows = np.empty((epochs.size, 10))
    rows[:, 0] = epochs % (WEEK_S * NS_PER_S) / NS_PER_S
    rows[:, 1:] = [*position, *velocity, tilt, tilt, heading]
    for one in outages_of(scene, drive.number):
        grown = fading(one, (epochs - drive.start_gps_ns).astype(np.float64) * 1e-9)[:, None]
        rows[:, 1:4] = np.hypot(rows[:, 1:4], one.position_m * grown)
        rows[:, 7:10] = np.hypot(rows[:, 7:10], 60.0 * one.attitude_deg * grown)
    file.write_bytes(rows.astype("<f8").tobytes())
    yield epochs.size


def outages_of(scene: Scene, number: int) -> list[Outage]:
    """Return the outages of a pass, counted from 0."""
    return [one for one in scene.noise.outages if not one.passes or number + 1 in one.passes]


def fading(outage: Outage, time_s: Float64) -> Float64:
    """Return σ (n,) at times since the first profile, as a share of that in an outage's middle; 0 outside."""
    share = np.clip((time_s - outage.start_s) / outage.duration_s, 0.0, 1.0)
    return np.asarray(4.0 * share * (1.0 - share))


class PoseErrors:
    """Gauss–Markov errors of position (north, east, down; with steps) and of attitude (roll, pitch, heading)."""

    def __init__(self, scene: Scene, number: int) -> None:
        sigma = np.array(scene.noise.pose_sigma())
        sigma[3:] = np.radians(sigma[3:])
        self._process = GaussMarkov(
            stream(scene.seed, number, "trajectory"),
            sigma,
            np.array(scene.noise.pose_time_constants_s()),
            1.0 / scene.trajectory.poses_per_s,
        )
        noise, rng = scene.noise, stream(scene.seed, number, "steps")
        self._level_m = noise.pass_step_m * rng.standard_normal(3)
        self._step_m, self._rng = noise.step_m, rng
        self._share = noise.steps_per_minute / 60.0 / scene.trajectory.poses_per_s
        waves = stream(scene.seed, number, "outages")
        self._drifts = [(one, waves.standard_normal((2, 6))) for one in outages_of(scene, number)]

    def of(self, drive: Drive, epochs: Int64) -> tuple[Float64, Float64]:
        """Return errors as :meth:`take` does, of the next poses, whose epochs are (n,), with those of outages."""
        position, attitude = self.take(epochs.size)
        time_s = (epochs - drive.start_gps_ns).astype(np.float64) * 1e-9
        for one, waves in self._drifts:
            turn = math.pi * (time_s - one.start_s) / one.duration_s
            wave = np.cos(turn)[:, None] * waves[0] + np.sin(turn)[:, None] * waves[1]
            wave *= fading(one, time_s)[:, None]
            position = position + one.position_m * wave[:, :3]
            attitude = attitude + math.radians(one.attitude_deg) * wave[:, 3:]
        return position, attitude

    def take(self, count: int) -> tuple[Float64, Float64]:
        """Return position errors (count, 3) in metres and attitude errors (count, 3) in radians of the next poses."""
        values = self._process.take(count)
        position = values[:, :3] + self._level_m
        if self._step_m > 0.0 and self._share > 0.0:
            steps = self._step_m * self._rng.standard_normal((count, 3))
            steps = np.cumsum(np.where(self._rng.random((count, 1)) < self._share, steps, 0.0), axis=0)
            position = position + steps
            self._level_m = self._level_m + steps[-1]
        return position, values[:, 3:]


class _Log:
    """The stated trajectory's log, an SBET or (in a local frame) a table of poses."""

    def __init__(self, drive: Drive, file: Path) -> None:
        self._drive = drive
        local = drive.earth.is_local
        self._table = pq.ParquetWriter(file, _LOCAL_SCHEMA, use_dictionary=False) if local else None
        self._stream = None if local else file.open("wb")

    def __enter__(self) -> _Log:
        return self

    def __exit__(self, *_: object) -> None:
        for one in (self._table, self._stream):
            if one is not None:
                one.close()

    def write(self, epochs: Int64, errors: PoseErrors) -> None:
        """Append poses, with the next errors."""
        if self._table is not None:
            self._table.write_batch(_local_rows(self._drive, epochs, errors))
        if self._stream is not None:
            rows = _sbet(self._drive, epochs, errors, wander_rad(self._drive.number))
            self._stream.write(rows.astype("<f8").tobytes())


def _true_rows(drive: Drive, epochs: Int64) -> pa.RecordBatch:
    poses = drive.poses(epochs)
    quaternion = poses.ecef_from_body.as_quat(canonical=True, scalar_first=True)
    return _batch([epochs, *poses.position_ecef_m.T, *quaternion.T], _TRUTH_SCHEMA)


def _local_rows(drive: Drive, epochs: Int64, errors: PoseErrors) -> pa.RecordBatch:
    """Return stated poses in the local frame, axes forward, right, down."""
    here = drive.poses(epochs)
    position, attitude = stated_poses(drive, here, *errors.of(drive, epochs))
    quaternion = attitude.as_quat(canonical=True, scalar_first=True)
    return _batch([epochs, *quaternion.T, *position.T], _LOCAL_SCHEMA)


def _batch(columns: list[npt.NDArray[np.generic]], schema: pa.Schema) -> pa.RecordBatch:
    return pa.RecordBatch.from_arrays([pa.array(np.ascontiguousarray(c)) for c in columns], schema=schema)


def stated_poses(
    drive: Drive, here: Poses, position_error_m: Float64, attitude_error_rad: Float64
) -> tuple[Float64, Rotation]:
    """Return ECEF positions (n, 3) and attitudes of poses with errors (n, 3) each.

    Errors are those of north, east and down, and of roll, pitch and heading.
    """
    level = drive.earth.ecef_from_level(here.position_ecef_m)
    angles = (level.inv() * here.ecef_from_body).as_euler("ZYX") + attitude_error_rad[:, ::-1]
    return here.position_ecef_m + level.apply(position_error_m), level * Rotation.from_euler("ZYX", angles)


def _sbet(drive: Drive, epochs: Int64, errors: PoseErrors, wander: float) -> Float64:
    """Return SBET records (n, 17); platform heading = true heading + wander angle.

    Velocities are along the wander frame (x at azimuth −wander, y to its left, z up); accelerations are the
    body's relative to the Earth, without gravity, and rates likewise, in body axes.
    """
    before, here, after = (drive.poses(epochs + shift) for shift in (-_DIFFERENCE_NS, 0, _DIFFERENCE_NS))
    dt = _DIFFERENCE_NS * 1e-9
    level = drive.earth.ecef_from_level(here.position_ecef_m)
    position, attitude = stated_poses(drive, here, *errors.of(drive, epochs))
    stated = drive.earth.geographic_from_ecef(position)
    heading, pitch, roll = (level.inv() * attitude).as_euler("ZYX").T
    velocity = level.inv().apply((after.position_ecef_m - before.position_ecef_m) / (2 * dt))
    along_wander = Rotation.from_euler("z", wander).apply(velocity) * [1.0, -1.0, -1.0]
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
    """Return acceleration (m/s²) and angular rate (rad/s) relative to the Earth, in body axes, (n, 3) each."""
    bend = (after.position_ecef_m - 2 * here.position_ecef_m + before.position_ecef_m) / dt**2
    turn = (before.ecef_from_body.inv() * after.ecef_from_body).as_rotvec() / (2 * dt)
    return here.ecef_from_body.inv().apply(bend), turn
