"""Which logs a survey has: found, fingerprinted, and keyed by everything that shapes their rows."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from roadscan.jobs.clock_pairs import log_clock
from roadscan.jobs.fingerprint import grid_digest, key_of
from roadscan.jobs.sources import Known, Sources, open_sources
from roadscan.model.crs import Geoid, add_grid_folder
from roadscan.model.errors import RoadscanError
from roadscan.model.strict import Strict
from roadscan.model.survey import ControlConfig, LogConfig, Survey
from roadscan.sensors.base import LogFormat, LogSource
from roadscan.tables.schema import table_schema
from roadscan.tables.store import Store

CONTROL_RUN: Final = "survey"
CONTROL_SENSOR: Final = "control"


@dataclass(frozen=True)
class PlannedLog:
    """A log of the survey file with all that identifies it."""

    run: str
    sensor: str
    config: LogConfig | ControlConfig
    format: LogFormat
    source: LogSource
    key: str
    content: str
    bytes: int
    stamp: str
    """Sizes and times of its files when it was fingerprinted (:func:`roadscan.jobs.sources.stamp_of`)."""

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


def plan_logs(survey: Survey, store: Store) -> tuple[list[PlannedLog], list[UnplannedLog]]:
    """All logs of the survey file, trajectories first, with their keys; and those that cannot be planned.

    Bytes are read only to fingerprint them. A log that was ingested and then moved away keeps its fingerprint.
    """
    grids = grid_folder(survey)
    if grids is not None:
        add_grid_folder(grids)
    listed: list[tuple[str, LogConfig | ControlConfig]] = [
        (run.id, log) for run in survey.config.runs for log in run.logs
    ]
    listed += [(CONTROL_RUN, control) for control in survey.config.control]
    planned: list[PlannedLog] = []
    unplanned: list[UnplannedLog] = []
    with open_sources(store) as sources:
        opened = [_open_log(survey, config, sources) for _, config in listed]
        for (run, config), log in zip(listed, opened, strict=True):
            try:
                planned.append(_plan_log(survey, run, config, log, sources))
            except RoadscanError as error:
                unplanned.append(UnplannedLog(run, str(config.path), error))
    once = {log.key: log for log in reversed(planned)}  # a log listed twice is one log
    ordered = sorted(once.values(), key=lambda p: (not p.is_trajectory, p.run, p.sensor, p.key))
    return ordered, unplanned


def grid_folder(survey: Survey) -> Path | None:
    """Folder of the survey's geoid grids, where it has one of its own."""
    grids = survey.config.map.grids
    return None if grids is None else survey.resolve(grids)


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
        options = format_.options.parse(config.options, file=path)
        return _OpenedLog(path, format_, options, sources.begin(path, format_, format_.companions(path, options)))
    except RoadscanError as error:
        return error


def _plan_log(
    survey: Survey, run: str, config: LogConfig | ControlConfig, opened: _OpenedLog | RoadscanError, sources: Sources
) -> PlannedLog:
    if isinstance(opened, RoadscanError):
        raise opened
    path, format_, options = opened.path, opened.format, opened.options
    is_log = isinstance(config, LogConfig)
    in_map = format_.needs_map or not is_log
    sensor = config.sensor if isinstance(config, LogConfig) else None
    clock = log_clock(survey, config) if isinstance(config, LogConfig) else None
    needs_sensor = bool({"scans", "returns"} & set(format_.yields))
    if is_log and sensor is None and needs_sensor:
        raise RoadscanError(
            "the log names no sensor", expected=f"sensor = one of {', '.join(survey.rig.sensors)}", file=path
        )
    content, size, stamp = sources.end(path, format_, opened.files)
    source = LogSource(
        path=path,
        options=options,
        clock=clock,
        sensor=survey.sensor(sensor) if sensor else None,
        crs=config.crs,
        height=config.height,
        geoid=Geoid(config.geoid) if config.geoid else None,
        map=survey.config.map.frame() if in_map else None,
    )
    schemas = [
        [(c.name, c.type) for c in table_schema(t).columns] + [table_schema(t).partition_s] for t in format_.yields
    ]
    shaping = [
        format_.name, format_.version, content, options.model_dump(mode="json"), clock,
        config.crs, config.height, grid_digest(config.geoid), run, sensor, schemas,
        [survey.config.map.model_dump(mode="json"), grid_digest(survey.config.map.geoid)] if in_map else None,
    ]  # fmt: skip
    name = sensor or (format_.yields[0] if is_log else CONTROL_SENSOR)
    return PlannedLog(run, name, config, format_, source, key_of(*shaping), content, size, stamp)
