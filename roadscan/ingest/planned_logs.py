"""Plans the logs of a survey: finds and fingerprints them, and computes their keys."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.core.strict import Strict
from roadscan.core.survey import ControlConfig, LogConfig, Survey
from roadscan.ingest.clock_pairs import log_clock
from roadscan.ingest.epoch_order import STAMPED
from roadscan.ingest.epoch_order import VERSION as STAMP_CHECKS
from roadscan.ingest.place_checks import PLACED
from roadscan.ingest.place_checks import VERSION as PLACE_CHECKS
from roadscan.ingest.pose_checks import FIXES, POSES
from roadscan.ingest.pose_checks import VERSION as POSE_CHECKS
from roadscan.ingest.reading.format import LogFormat, LogSource, SourceDefaults
from roadscan.ingest.sources import Known, Sources, open_sources
from roadscan.run.keys import grid_key, key_of
from roadscan.run.session import Session, found_once
from roadscan.store.logs import has_log, read_log_records
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

CONTROL_RUN: Final = "survey"
CONTROL_SENSOR: Final = "control"


@dataclass(frozen=True)
class PlannedLog:
    """A log of the survey file with everything that identifies it."""

    run: str
    sensor: str
    config: LogConfig | ControlConfig
    format: LogFormat
    source: LogSource
    key: str
    content: str
    bytes: int
    stamp: str
    """Sizes and times of its files when it was fingerprinted (:func:`roadscan.ingest.sources.stamp_of`)."""

    @property
    def is_trajectory(self) -> bool:
        """True for logs whose span others need."""
        return "trajectory" in self.format.yields


@dataclass(frozen=True)
class UnplannedLog:
    """A log of the survey file that cannot be planned, and why."""

    run: str
    path: str
    error: RoadscanError


Logs: TypeAlias = tuple[list[PlannedLog], list[UnplannedLog]]
"""Logs that can be planned, and those that cannot."""


def plan_logs(survey: Survey, store: Store, *, only_looks: bool = False) -> Logs:
    """All logs of the survey file, trajectories first, with their keys; and those that cannot be planned.

    Bytes are read only to fingerprint them. A log that was ingested and then moved away keeps its fingerprint. Who
    `only_looks` reads none: a log that the store does not know by its size and time counts as not ingested.
    """
    listed: list[tuple[str, LogConfig | ControlConfig]] = [
        (run.id, log) for run in survey.config.runs for log in run.logs
    ]
    listed += [(CONTROL_RUN, control) for control in survey.config.control]
    planned: list[PlannedLog] = []
    unplanned: list[UnplannedLog] = []
    with open_sources(store, survey.folder, only_looks=only_looks) as sources:
        opened = [_open_log(survey, config, sources) for _, config in listed]
        for (run, config), log in zip(listed, opened, strict=True):
            try:
                planned.append(_plan_log(survey, run, config, log, sources, store))
            except RoadscanError as error:
                unplanned.append(UnplannedLog(run, str(config.path), error))
    once = {log.key: log for log in reversed(planned)}  # a log listed twice is one log
    ordered = sorted(once.values(), key=lambda p: (not p.is_trajectory, p.run, p.sensor, p.key))
    return ordered, unplanned


def _check_mounting(format_: LogFormat, name: str, sensor: Sensor, path: Path) -> None:
    """Refuse a lever arm or axes for readings that are already in the vehicle's frame."""
    if not format_.vehicle_axes or sensor.mounts_vehicle_frame:
        return
    applied = Sensor(kind=sensor.kind, axes=format_.vehicle_axes)
    known = applied.model_dump(include={"axes", "lever_arm_body_m"})
    if sensor.mounted_as(known).mounting() != applied.mounting():
        stated = " and ".join(sensor.stated_mounting())
        raise ConfigError(
            f"the rig file states {stated} for the sensor '{name}', and the readings of a log of {format_.name} are in "
            "the vehicle's frame already: the mounting would be applied twice",
            expected="no mounting",
            change=f"take {stated} out of [sensors.{name}]; or, if the trajectory holds another point of the vehicle "
            "than the maker's frame, confirm it with mounts_vehicle_frame = true",
            file=path,
        )


@dataclass(frozen=True)
class _OpenedLog:
    """A log whose fingerprint is being computed."""

    path: Path
    format: LogFormat
    options: Strict
    files: dict[str, Future[Known]]


def _open_log(survey: Survey, config: LogConfig | ControlConfig, sources: Sources) -> _OpenedLog | RoadscanError:
    path = survey.resolve(config.path)
    try:
        format_ = sources.format(path, config.format)
        options = log_options(survey, config, format_, path)
        return _OpenedLog(path, format_, options, sources.begin(path, format_, format_.companions(path, options)))
    except RoadscanError as error:
        return error


def _source_defaults(survey: Survey, config: LogConfig | ControlConfig) -> SourceDefaults:
    """Return the survey file's defaults for what this log does not state."""
    stated = survey.config.defaults
    if stated is None or not isinstance(config, LogConfig):
        return SourceDefaults()
    clock, week = stated.clock, None
    if config.clock is not None:
        clock = None
    elif clock is not None and (clock.week is not None or clock.date is not None):
        week = Clock(TimeSystem.GPS_WEEK, week=clock.week, date=clock.date)
    crs = stated.crs if config.crs is None else None
    height = stated.height if config.height is None else None
    return SourceDefaults(None if clock is None else clock.clock(), week, crs, height)


def _plan_log(
    survey: Survey,
    run: str,
    config: LogConfig | ControlConfig,
    opened: _OpenedLog | RoadscanError,
    sources: Sources,
    store: Store,
) -> PlannedLog:
    if isinstance(opened, RoadscanError):
        raise opened
    path, format_, options = opened.path, opened.format, opened.options
    is_log = isinstance(config, LogConfig)
    source = log_source(survey, config, path, format_, options)
    content, size, stamp = sources.end(path, format_, opened.files)
    sensor = config.sensor if isinstance(config, LogConfig) else None
    map_grid = grid_key(survey.geoid(survey.config.map.geoid)) if source.map else None
    schemas = [
        [(c.name, c.type) for c in table_schema(t).columns] + [table_schema(t).partition_s] for t in format_.yields
    ]
    shaping = [
        format_.name, format_.version, content, options.shaping(), source.clock,
        config.crs, config.height or "ellipsoidal", grid_key(source.geoid), run, sensor, schemas,
        [survey.config.map.model_dump(mode="json"), map_grid] if source.map else None,
        *([source.defaults] if source.defaults != SourceDefaults() else []),
    ]  # fmt: skip
    name = sensor or (format_.yields[0] if is_log else CONTROL_SENSOR)
    key = key_of(*shaping, *_checks_of(format_))
    if not path.exists() and not has_log(store, key):
        # It was archived after an earlier version of reader or checks had read it: its rows stay.
        earlier = (
            key_of(format_.name, before, *shaping[2:], *checks)
            for before in range(format_.version, 0, -1)
            for checks in (_checks_of(format_), *_earlier_checks(format_))
        )
        key = next((one for one in earlier if has_log(store, one)), key)
    if not has_log(store, key) and format_.lacks() is not None:
        for programs in _programs_of(store, (run, name, content)):
            computed = [{**one, "programs": programs} if one == options.shaping() else one for one in shaping]
            kept = key_of(*computed, *_checks_of(format_))
            key = kept if has_log(store, kept) else key
    return PlannedLog(run, name, config, format_, source, key, content, size, stamp)


def _programs_of(store: Store, log: tuple[str, str, str]) -> list[str]:
    """Return hashes of the programs that computed the stored rows of a log, by its run, sensor and content."""
    own = (r for r in read_log_records(store, damaged=[]) if (r.run, r.sensor, r.content) == log)
    return [str(r.attributes["programs"]) for r in own if "programs" in r.attributes]


def _checks_of(format_: LogFormat) -> list[list[object]]:
    """Return the versions of the checks that leave out rows of a format, as part of the key of its logs."""
    found: list[list[object]] = []
    if {POSES, FIXES} & set(format_.yields):
        found.append(["poses", POSE_CHECKS])
    if set(PLACED) & set(format_.yields):
        found.append(["places", PLACE_CHECKS])
    if set(STAMPED) & set(format_.yields):
        found.append(["stamps", STAMP_CHECKS])
    return found


def _earlier_checks(format_: LogFormat) -> list[list[list[object]]]:
    """Return what :func:`_checks_of` returned in earlier versions, the latest first."""
    places: list[list[object]] = [["places", 1]] if set(PLACED) & set(format_.yields) else []
    first: list[list[object]] = [["poses", 1]] if POSES in format_.yields else []
    second: list[list[object]] = [["poses", 2]] if {POSES, FIXES} & set(format_.yields) else []
    before_stamps = [one for one in _checks_of(format_) if one[0] != "stamps"]
    return [before_stamps, second + places, first + places, []]


def log_options(survey: Survey, config: LogConfig | ControlConfig, format_: LogFormat, path: Path) -> Strict:
    """Return the settings of a log's format: its own before those that the survey file states for all."""
    return format_.options.parse({**format_.shared_options(survey), **config.options}, file=path)


def log_source(
    survey: Survey, config: LogConfig | ControlConfig, path: Path, format_: LogFormat, options: Strict
) -> LogSource:
    """Return the description of a log for its reader; nothing of the log is read.

    Raises
    ------
    RoadscanError
        where a log of readings names no sensor, pairs of stamps cannot be read, or the map is none.
    """
    is_log = isinstance(config, LogConfig)
    sensor = config.sensor if isinstance(config, LogConfig) else None
    if is_log and sensor is None and {"scans", "returns"} & set(format_.yields):
        raise RoadscanError(
            "the log names no sensor", expected=f"sensor = one of {', '.join(survey.rig.sensors)}", file=path
        )
    if sensor is not None:
        _check_mounting(format_, sensor, survey.sensor(sensor), path)
    return LogSource(
        path=path,
        options=options,
        clock=log_clock(survey, config) if isinstance(config, LogConfig) else None,
        sensor=survey.sensor(sensor) if sensor else None,
        crs=config.crs,
        height=config.height,
        geoid=survey.geoid(config.geoid),
        map=survey.frame() if format_.needs_map or not is_log else None,
        defaults=_source_defaults(survey, config),
    )


@found_once
def logs_of(session: Session) -> Logs:
    """Logs of the survey file with their keys, trajectories first; and those that cannot be planned."""
    return plan_logs(session.survey, session.store, only_looks=session.only_looks)
