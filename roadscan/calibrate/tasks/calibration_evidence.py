"""Loads the evidence of a calibration that the survey file names, and provides the searches for ties."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.calibrate.evidence import Evidence, Seen, Traverse
from roadscan.calibrate.reference import ReferenceOptions, register
from roadscan.calibrate.stop_and_go import HeadRun, find_orientation
from roadscan.calibrate.surfaces.heights import HeightTies
from roadscan.calibrate.surfaces.objects import HeadTies, ObjectTies, find_object
from roadscan.calibrate.surfaces.planes import Pieces, PlaneTies, Readings
from roadscan.calibrate.unknowns import Estimate, ObjectPose
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, MapFrame
from roadscan.core.errors import ConfigError, RunError, nearest
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import ScanGeometry
from roadscan.core.settings.calibration import (
    Area,
    CalibrationEvidence,
    CalibrationSettings,
    ObjectEvidence,
    OverlapEvidence,
    ReferenceEvidence,
    StopAndGoEvidence,
)
from roadscan.georeference.place import CloudFrame
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.georeference.sources import ReadingSource, geometry_of, read_rows
from roadscan.ingest.inspect.diagnosis import claimed_format
from roadscan.ingest.inspect.provisional import Stated, open_log
from roadscan.ingest.reading.format import Rows, format_named
from roadscan.navigation.tasks.navigation_logs import imu_readings
from roadscan.navigation.tasks.trajectories import load_trajectory, usual_pose_sigma
from roadscan.poses.trajectory import Trajectory, world_from_ned
from roadscan.store.logs import DataFile
from roadscan.store.readings.row_groups import sensor_xyz_m

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


Find = Callable[[Estimate], Sequence[Evidence]]

_ANY_TIME: Final = Clock(TimeSystem.FREE, offset_s=1e9)
"""Clock that accepts stamps of any system, even zeros: the epochs of a reference scan are not used."""

REFERENCE_READINGS: Final = 400_000
"""Most readings of a sensor that are compared with a reference scan; more are thinned evenly."""
_WIDEST_M2: Final = 700.0  # Largest area over which profilers are compared.
_REFERENCE_MARGIN_M: Final = 5.0  # Readings are loaded up to this far beyond the reference scan.


@dataclass(frozen=True)
class Collected:
    """One source of evidence, loaded."""

    sensors: tuple[str, ...]
    find: Find
    """Finds the observations with the mountings of an estimate."""
    traverses: Mapping[int, Traverse] = field(default_factory=dict)
    locate: Callable[[Estimate], dict[str, ObjectPose]] | None = None
    """Finds the calibration objects that it names with the mountings of an estimate; None where it names none."""


def collect(plan: SurveyPlan, entry: CalibrationEvidence, settings: CalibrationSettings) -> Collected:
    """Load what one entry of the survey file needs.

    Raises
    ------
    RoadscanError
        where it names what the survey does not have, or what it names holds nothing to calibrate from.
    """
    match entry:
        case StopAndGoEvidence():
            return _stop_and_go(plan, entry, settings)
        case ReferenceEvidence():
            return _reference(plan, entry, settings)
        case OverlapEvidence():
            return _overlap(plan, entry, settings)
        case ObjectEvidence():
            return _object(plan, entry, settings)


def traverses_of(
    plan: SurveyPlan, readings: Sequence[Readings], settings: CalibrationSettings
) -> tuple[Pieces, dict[int, Traverse]]:
    """Return pieces of the drives, with the σ of their poses from the run's logs, or from the settings."""
    pieces = Pieces.of_seconds(settings.traverse_piece_s)
    found: dict[int, Traverse] = {}
    for run in dict.fromkeys(one.drive.split(" drive ")[0] for one in readings):
        own = [one for one in readings if one.drive.split(" drive ")[0] == run]
        source = trajectory_source(run, plan.records)
        sigma = usual_pose_sigma(plan.store, plan.records, source, settings)
        axes = world_from_ned(source.world, own[0].position_world_m[:1])[0]
        position, angles = sigma[:3].tolist(), sigma[3:].tolist()
        found |= pieces.traverses(own, axes, tuple(position), tuple(angles), settings.traverse_time_constant_s)
    return pieces, found


def _overlap(plan: SurveyPlan, entry: OverlapEvidence, settings: CalibrationSettings) -> Collected:
    """Return ties between drives over one place: from heights for profilers, from planes for lidars."""
    sensors = tuple(entry.sensors)
    rig = plan.survey.rig.sensors
    if entry.area is None and any(name in rig and rig[name].kind == "profiler" for name in sensors):
        _refuse_wide(plan, entry)
    wanted = Wanted(sensors, tuple(entry.runs), tuple(entry.passes), entry.area, settings.margin_m)
    readings = list(wanted_readings(plan, wanted))
    pieces, traverses = traverses_of(plan, readings, settings)
    kinds = {name: plan.survey.rig.sensors[name].kind for name in sensors}
    profiles = [one for one in readings if kinds[one.sensor] == "profiler"]
    clouds = [one for one in readings if kinds[one.sensor] != "profiler"]
    finders: list[Find] = []
    if profiles:
        finders += [HeightTies(profiles, pieces, traverses), HeadTies(profiles, pieces, traverses)]
    if clouds:
        finders.append(PlaneTies(clouds, pieces, traverses))
    return Collected(sensors, lambda estimate: [t for find in finders for t in find(estimate)], traverses)


def _refuse_wide(plan: SurveyPlan, entry: OverlapEvidence) -> None:
    """Reject whole runs that extend too far, before their readings are loaded."""
    runs = entry.runs or list(dict.fromkeys(s.run for s, _ in plan.sources))
    boxes = []
    for run in runs:
        source = trajectory_source(run, plan.records)
        spans = [s for f in source.files for s in f.group_spans]
        trajectory = load_trajectory(plan.store, source, spans, plan.ground.max_gap_s)
        enh = plan.ground.map.map_from_world(trajectory.world, trajectory.position_world_m[::20])
        boxes.append((enh[:, :2].min(axis=0), enh[:, :2].max(axis=0)))
    extent = np.max([high for _, high in boxes], axis=0) - np.min([low for low, _ in boxes], axis=0)
    if extent[0] * extent[1] > _WIDEST_M2:
        raise ConfigError(
            f"the drives of an overlap without an area extend over {extent[0]:.0f} m × {extent[1]:.0f} m",
            expected=f"at most {_WIDEST_M2:.0f} m² that profilers are compared on",
            change="give its [[calibration]] entry an area: a rectangle of the map about the place, such as 8 m × 8 m",
        )


def _object(plan: SurveyPlan, entry: ObjectEvidence, settings: CalibrationSettings) -> Collected:
    """Return ties of the readings on a calibration object to its known shape."""
    reach = max(max(length, width) for length, width, _ in entry.steps) / 2 + 1.0
    area = Area(
        easting_min_m=entry.easting_m - reach, northing_min_m=entry.northing_m - reach,
        easting_max_m=entry.easting_m + reach, northing_max_m=entry.northing_m + reach,
    )  # fmt: skip
    wanted = Wanted(tuple(entry.sensors), tuple(entry.runs), tuple(entry.passes), area, settings.margin_m)
    readings = list(wanted_readings(plan, wanted))
    pieces, traverses = traverses_of(plan, readings, settings)
    world = trajectory_source(readings[0].drive.split(" drive ")[0], plan.records).world
    frame = plan.ground.map
    height = frame.map_from_world(world, readings[0].position_world_m[:1])[0, 2]
    middle = np.array([[entry.easting_m, entry.northing_m, height]])
    heading = np.radians(entry.heading_deg)
    ahead = np.array([np.sin(heading), np.cos(heading), 0.0])
    axes = np.stack([ahead, np.cross([0.0, 0.0, 1.0], ahead), [0.0, 0.0, 1.0]])
    ways = frame.world_from_map(world, middle + axes) - frame.world_from_map(world, middle - axes)
    u, _, vt = np.linalg.svd(ways.T)  # the nearest rotation, since the map's scale differs from the world's
    about = ObjectPose(frame.world_from_map(world, middle)[0], u @ vt, sigma_m=0.02, sigma_rad=0.02)
    name = f"object at {entry.easting_m:.1f}, {entry.northing_m:.1f}"
    ties = ObjectTies(readings, pieces, traverses, name, entry.steps, entry.sigma_m)

    def locate(estimate: Estimate) -> dict[str, ObjectPose]:
        return {name: find_object(readings, estimate, entry.steps, about)}

    return Collected(tuple(entry.sensors), ties, traverses, locate)


def _stop_and_go(plan: SurveyPlan, entry: StopAndGoEvidence, settings: CalibrationSettings) -> Collected:
    """Return the orientation of a head from the IMU inside it."""
    rig = plan.survey.rig.sensors
    for name in (entry.sensor, entry.imu):
        if name not in rig:
            raise ConfigError(f"calibration names the unknown sensor '{name}'{nearest(name, rig)}")
    errors = rig[entry.imu].imu_errors()
    if errors is None:
        raise ConfigError(
            f"the rig file does not say how good the IMU '{entry.imu}' is",
            change='add imu = "tactical" (or another grade, or a table of its data sheet) to it',
        )
    runs: list[HeadRun] = []
    for run in dict.fromkeys(r.run for r in plan.records):
        logs = [r for r in plan.records if r.run == run and r.sensor == entry.imu and r.tables.get("imu")]
        if not logs or (entry.runs and run not in entry.runs):
            continue
        readings = imu_readings(plan.store, logs)
        source = trajectory_source(run, plan.records)
        span = (int(readings.epochs_gps_ns[0]), int(readings.epochs_gps_ns[-1]))
        trajectory = load_trajectory(plan.store, source, [span], plan.ground.max_gap_s)
        sigma = usual_pose_sigma(plan.store, plan.records, source, settings)[3:].tolist()
        runs.append(HeadRun(readings, trajectory, tuple(sigma), settings.traverse_time_constant_s))
    if not runs:
        raise RunError(f"no run holds samples of the IMU '{entry.imu}'", expected="its log, and a trajectory")
    imu = rig[entry.imu]
    lever = imu.lever_arm_sigma_m or settings.lever_arm_sigma_m
    found = find_orientation(runs, imu.mounting(), lever, errors)
    evidence = [found.evidence(entry.sensor, rig[entry.sensor].mounting(), imu.mounting())]
    return Collected((entry.sensor,), lambda _: evidence)


def _reference(plan: SurveyPlan, entry: ReferenceEvidence, settings: CalibrationSettings) -> Collected:
    """Return ties of a sensor's readings to a georeferenced reference scan."""
    enh = _reference_map(plan, entry)
    low, high = enh[:, :2].min(axis=0) - _REFERENCE_MARGIN_M, enh[:, :2].max(axis=0) + _REFERENCE_MARGIN_M
    area = Area(
        easting_min_m=float(low[0]), northing_min_m=float(low[1]),
        easting_max_m=float(high[0]), northing_max_m=float(high[1]),
    )  # fmt: skip
    wanted = Wanted((entry.sensor,), tuple(entry.runs), (), area, _REFERENCE_MARGIN_M)
    readings = list(wanted_readings(plan, wanted))
    pieces, traverses = traverses_of(plan, readings, settings)
    worlds = {trajectory_source(one.drive.split(" drive ")[0], plan.records).world for one in readings}
    if len(worlds) > 1:
        raise ConfigError(f"runs in different world frames ({', '.join(sorted(worlds))}) see one reference scan")
    reference = plan.ground.map.world_from_map(worlds.pop(), enh)
    sensor = plan.survey.rig.sensors[entry.sensor]
    options = ReferenceOptions(
        start_lever_sigma_m=max(sensor.lever_arm_sigma_m or settings.lever_arm_sigma_m),
        start_boresight_sigma_deg=max(sensor.boresight_sigma_deg or settings.boresight_sigma_deg),
        range_min_m=sensor.range_min_m,
    )
    scan = _thinned(readings, pieces, REFERENCE_READINGS)
    used = {number: traverses[number] for number in np.unique(scan.traverse).tolist()}
    found = register(scan, reference, sensor.mounting(), options)
    return Collected((entry.sensor,), lambda _: [found.ties], used)


def _reference_map(plan: SurveyPlan, entry: ReferenceEvidence) -> Float64:
    """Return the points of a reference scan on the survey's map (n, 3), m.

    Its time does not matter and may be left open; all else has to be stated.
    """
    path = plan.survey.resolve(entry.path)
    log_format = format_named(entry.format) if entry.format else claimed_format(path)
    geoid = plan.survey.geoid(entry.geoid)
    stated = Stated(None, entry.crs, entry.height, geoid, dict(entry.options))
    opened = open_log(log_format, path, stated)
    if opened.needs_key("clock"):
        opened = open_log(log_format, path, replace(stated, clock=_ANY_TIME))
    open_questions = [need.line for need in opened.needs if not need.is_of_time]
    if open_questions:
        raise ConfigError("the reference scan leaves open: " + "; ".join(open_questions), file=path)
    parts = [
        np.stack([item.batch.column(f"{a}_m").to_numpy() for a in "xyz"], axis=-1)
        for item in log_format.read(opened.source, opened.header)
        if isinstance(item, Rows) and item.table == "cloud"
    ]
    if not parts:
        raise ConfigError("the reference scan holds no points", expected="points: LAS, LAZ, PLY or E57", file=path)
    frame = plan.ground.map
    if entry.crs == LOCAL_WORLD and not frame.is_local:
        own = MapFrame(crs=None, local_name=frame.local_name, anchor=frame.anchor)
        world = own.world_from_map(own.anchor.world if own.anchor else LOCAL_WORLD, np.concatenate(parts))
        return frame.map_from_world(own.anchor.world if own.anchor else LOCAL_WORLD, world)
    return CloudFrame(entry.crs, entry.height, geoid).to_map(np.concatenate(parts), frame)


def _thinned(readings: Sequence[Readings], pieces: Pieces, most: int) -> Seen:
    """Return the readings of one sensor as one set, evenly thinned."""
    every = max(1, -(-sum(one.pose.size for one in readings) // most))
    rows = [np.arange(0, one.pose.size, every) for one in readings]
    poses = [one.pose[r] for one, r in zip(readings, rows, strict=True)]
    return Seen(
        readings[0].sensor,
        np.concatenate([one.point_sensor_m[r] for one, r in zip(readings, rows, strict=True)]),
        np.concatenate([one.position_world_m[p] for one, p in zip(readings, poses, strict=True)]),
        np.concatenate([one.world_from_body[p] for one, p in zip(readings, poses, strict=True)]),
        np.concatenate([pieces.numbers(one.epoch_gps_ns)[p] for one, p in zip(readings, poses, strict=True)]),
    )
