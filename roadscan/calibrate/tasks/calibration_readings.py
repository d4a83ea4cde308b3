"""Loads readings in sensor axes, with their poses, for a calibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.calibrate.surfaces.readings import Readings
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError, RunError, nearest
from roadscan.core.scan_geometry import ScanGeometry
from roadscan.core.settings.calibration import Area
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import ReadingSource, geometry_of, read_rows
from roadscan.navigation.tasks.trajectories import load_trajectory
from roadscan.poses.trajectory import Trajectory
from roadscan.store.logs import DataFile
from roadscan.store.readings.returns import sensor_xyz_m

Span = tuple[int, int]

MOST_READINGS: Final = 4_000_000
"""Most readings of one sensor in one drive; more are thinned evenly."""
_APART_NS: Final = 3_000_000_000
"""If the vehicle leaves an area for longer than this, its return counts as another drive."""
_STEP_M: Final = 10.0  # Step of the numerical derivative of the map.


@dataclass(frozen=True)
class Wanted:
    """Which readings a calibration requests."""

    sensors: tuple[str, ...]
    runs: tuple[str, ...] = ()
    """All where empty."""
    passes: tuple[int, ...] = ()
    """Passes, in place of whole runs."""
    area: Area | None = None
    """Only readings within it, as the survey's mountings place them; each time the vehicle comes by is a drive."""
    margin_m: float = 0.0
    """Readings so far outside the area are taken too: the mountings are not yet known (m)."""


def wanted_readings(plan: SurveyPlan, wanted: Wanted) -> Iterator[Readings]:
    """Load readings with poses of all sensors, one set for each sensor and drive.

    Raises
    ------
    ConfigError
        where a sensor or run is not of the survey.
    RunError
        where a sensor has no reading there.
    """
    _check(plan, wanted)
    for sensor in wanted.sensors:
        found = 0
        for run in dict.fromkeys(s.run for s, _ in plan.sources):
            if wanted.runs and run not in wanted.runs:
                continue
            own = [(s, f) for s, files in plan.sources if (s.run, s.sensor) == (run, sensor) for f in files]
            if own:
                for readings in _of_run(plan, wanted, own):
                    found += readings.pose.size
                    yield readings
        if not found:
            raise RunError(
                f"sensor '{sensor}' has no readings with poses in the runs and the area of the calibration",
                expected="at least one drive over the place",
            )


def _check(plan: SurveyPlan, wanted: Wanted) -> None:
    sensors = sorted({s.sensor for s, _ in plan.sources if s.table in ("scans", "returns")})
    for sensor in wanted.sensors:
        if sensor not in sensors:
            raise ConfigError(
                f"calibration names the sensor '{sensor}', which has no profiles and no returns"
                f"{nearest(sensor, sensors)}",
                expected=f"one of: {', '.join(sensors)}",
            )
    runs = sorted({s.run for s, _ in plan.sources})
    for run in wanted.runs:
        if run not in runs:
            raise ConfigError(f"calibration names the run '{run}'{nearest(run, runs)}", expected=", ".join(runs))


def _of_run(plan: SurveyPlan, wanted: Wanted, own: Sequence[tuple[ReadingSource, DataFile]]) -> Iterator[Readings]:
    source = own[0][0]
    if source.trajectory is None:
        return
    whole = (min(f.span[0] for _, f in own if f.span), max(f.span[1] for _, f in own if f.span))
    trajectory = load_trajectory(plan.store, source.trajectory, source.spans([whole]), plan.ground.max_gap_s)
    if trajectory.epochs_gps_ns.size < 2:
        return
    near = None if wanted.area is None else _Near.of(plan, wanted.area, trajectory, source.range_max_m)
    for number, span in enumerate(_drives(plan, wanted, source, trajectory, near), 1):
        parts = list(_parts(plan, own, span, trajectory, near, wanted.margin_m))
        if parts:
            yield _joined(parts, source.sensor, f"{source.run} drive {number}")


@dataclass(frozen=True)
class _Near:
    """An area of the map in the world frame: the map is linearised about the area's middle."""

    area: Area
    origin_world_m: Float64
    origin_map_m: Float64
    map_from_world: Float64
    """(2, 3) derivative of easting and northing (m/m)."""
    reach_m: float

    @classmethod
    def of(cls, plan: SurveyPlan, area: Area, trajectory: Trajectory, range_max_m: float) -> _Near:
        frame, world = plan.ground.map, trajectory.world
        middle = trajectory.position_world_m[trajectory.epochs_gps_ns.size // 2]
        height = frame.map_from_world(world, middle[None])[0, 2]
        centre = [(area.easting_min_m + area.easting_max_m) / 2, (area.northing_min_m + area.northing_max_m) / 2]
        origin = frame.world_from_map(world, np.array([[*centre, height]]))[0]
        steps = np.vstack([np.zeros((1, 3)), np.eye(3) * _STEP_M, -np.eye(3) * _STEP_M])
        value = frame.map_from_world(world, origin + steps)
        slope = (value[1:4, :2] - value[4:7, :2]).T / (2 * _STEP_M)
        return cls(area, origin, value[0, :2], slope, min(range_max_m, 100.0))

    def holds(self, points_world_m: Float64, margin_m: float) -> npt.NDArray[np.bool_]:
        """Return whether points (n, 3) lie in the area, or no farther than a margin from it."""
        away = self.origin_map_m + (points_world_m - self.origin_world_m) @ self.map_from_world.T
        a = self.area
        inside: npt.NDArray[np.bool_] = (
            (away[:, 0] >= a.easting_min_m - margin_m)
            & (away[:, 0] <= a.easting_max_m + margin_m)
            & (away[:, 1] >= a.northing_min_m - margin_m)
            & (away[:, 1] <= a.northing_max_m + margin_m)
        )
        return inside


def _drives(
    plan: SurveyPlan, wanted: Wanted, source: ReadingSource, trajectory: Trajectory, near: _Near | None
) -> list[Span]:
    """Return spans of time (GPS ns) in which the vehicle is near enough, one for each drive."""
    spans: list[Span] = [trajectory.span_gps_ns]
    if wanted.passes:
        passes = [p for p in plan.passes if p.pass_id in wanted.passes and p.run == source.run]
        spans = [(p.start_gps_ns, p.end_gps_ns - 1) for p in passes]
    if near is None:
        return spans
    epochs = trajectory.epochs_gps_ns
    close = np.flatnonzero(near.holds(trajectory.position_world_m, near.reach_m))
    if close.size == 0:
        return []
    breaks = np.flatnonzero(np.diff(epochs[close]) > _APART_NS)
    starts, ends = epochs[close][np.append(0, breaks + 1)], epochs[close][np.append(breaks, close.size - 1)]
    pieces = [(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]
    return [(max(a, c), min(b, d)) for a, b in pieces for c, d in spans if max(a, c) < min(b, d)]


def _parts(
    plan: SurveyPlan,
    own: Sequence[tuple[ReadingSource, DataFile]],
    span: Span,
    trajectory: Trajectory,
    near: _Near | None,
    margin_m: float,
) -> Iterator[tuple[Float64, npt.NDArray[np.int64], Int64, Float64, Float64]]:
    """Yield points, row of pose, epochs, positions, rotations for each row group."""
    groups = [
        (source, file, group)
        for source, file in own
        for group, (a, b) in enumerate(source.spans(file.group_spans))
        if a <= span[1] and b >= span[0]
    ]
    expected = sum(f.group_rows[g] * (geometry.readings if (geometry := geometry_of(s)) else 1) for s, f, g in groups)
    every = max(1, -(-expected // MOST_READINGS)) if near is None else 1
    for source, file, group in groups:
        rows = read_rows(plan.store, source, file.path, [group]).combine_chunks()
        for batch in rows.to_batches():
            points, pose, epochs = _sensor_points(batch, geometry_of(source), source, span, every)
            poses = trajectory.poses(epochs)
            sound = poses.found[pose]
            if near is not None and points.size:
                rotation, lever = source.mountings.mountings[0].arrays()
                body = points @ rotation.T + lever
                world = poses.position_world_m[pose] + np.einsum("nij,nj->ni", poses.world_from_body[pose], body)
                sound &= near.holds(np.nan_to_num(world), margin_m)
            if sound.any():
                yield points[sound], pose[sound], epochs, poses.position_world_m, poses.world_from_body


def _sensor_points(
    batch: pa.RecordBatch, geometry: ScanGeometry | None, source: ReadingSource, span: Span, every: int
) -> tuple[Float64, npt.NDArray[np.int64], Int64]:
    """Points (n, 3) of a batch in the sensor's frame, row (n,) of each one's pose, and the poses' epochs (p,)."""
    limits = (source.range_min_m, source.range_max_m)
    if geometry is None:
        epochs = batch.column("pose_epoch_gps_ns").to_numpy()
        xyz = np.stack(sensor_xyz_m(batch), axis=-1)
        distance = np.linalg.norm(xyz, axis=1)
        kept = (epochs >= span[0]) & (epochs <= span[1]) & (distance >= limits[0]) & (distance <= limits[1])
        kept[np.arange(kept.size) % every > 0] = False
        unique, pose = np.unique(epochs[kept], return_inverse=True)
        return xyz[kept], pose.astype(np.int64), unique
    epochs = batch.column("epoch_gps_ns").to_numpy()
    raw = batch.column("range").flatten().to_numpy().reshape(batch.num_rows, geometry.readings)
    distance = geometry.range_offset_m + geometry.range_step_m * raw
    kept = (raw > 0) & (distance >= limits[0]) & (distance <= limits[1])
    kept &= ((epochs >= span[0]) & (epochs <= span[1]))[:, None]
    kept.ravel()[np.arange(kept.size) % every > 0] = False
    origins, directions = geometry.rays()
    row, reading = np.nonzero(kept)
    points = origins[reading] + distance[row, reading, None] * directions[reading]
    if not geometry.reading_period_ns:
        return points, row.astype(np.int64), epochs
    each = geometry.reading_epochs(epochs[row], reading)
    return points, np.arange(row.size, dtype=np.int64), each


def _joined(
    parts: Sequence[tuple[Float64, npt.NDArray[np.int64], Int64, Float64, Float64]], sensor: str, drive: str
) -> Readings:
    """Return readings of one drive, with the poses that they use, in order of time."""
    points, poses, epochs, positions, rotations = [], [], [], [], []
    first = 0
    for own_points, pose, own_epochs, position, rotation in parts:
        used, renumbered = np.unique(pose, return_inverse=True)
        points.append(own_points)
        poses.append(renumbered + first)
        epochs.append(own_epochs[used])
        positions.append(position[used])
        rotations.append(rotation[used])
        first += used.size
    epoch = np.concatenate(epochs)
    order = np.argsort(epoch, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(order.size)
    return Readings(
        sensor=sensor,
        drive=drive,
        point_sensor_m=np.concatenate(points),
        pose=place[np.concatenate(poses)].astype(np.int32),
        epoch_gps_ns=epoch[order],
        position_world_m=np.concatenate(positions)[order],
        world_from_body=np.concatenate(rotations)[order],
    )
