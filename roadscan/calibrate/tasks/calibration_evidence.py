"""Loads the evidence of a calibration that the survey file names, and provides the searches for ties."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from roadscan.calibrate.evidence import Evidence, Seen, Traverse
from roadscan.calibrate.reference import ReferenceOptions, register
from roadscan.calibrate.stop_and_go import HeadRun, find_orientation
from roadscan.calibrate.surfaces.heads import HeadTies
from roadscan.calibrate.surfaces.heights import HeightTies
from roadscan.calibrate.surfaces.objects import ObjectTies, find_object
from roadscan.calibrate.surfaces.planes import PlaneTies
from roadscan.calibrate.surfaces.readings import Pieces, Readings
from roadscan.calibrate.tasks.calibration_readings import Wanted, wanted_readings
from roadscan.calibrate.unknowns import Estimate, ObjectPose
from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, MapFrame
from roadscan.core.errors import ConfigError, RunError, nearest
from roadscan.core.gpstime import Clock, TimeSystem
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
from roadscan.ingest.inspect.diagnosis import claimed_format
from roadscan.ingest.inspect.provisional import Stated, open_log
from roadscan.ingest.reading.format import Rows, format_named
from roadscan.navigation.tasks.navigation_logs import imu_readings
from roadscan.navigation.tasks.pose_sigma import usual_pose_sigma
from roadscan.navigation.tasks.trajectories import load_trajectory
from roadscan.poses.trajectory import world_from_ned

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
