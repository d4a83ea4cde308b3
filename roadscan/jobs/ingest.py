"""Ingest: raw logs → tables. A log read once is not read again; a damaged record costs itself alone."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.jobs.clock_pairs import log_clock
from roadscan.jobs.fingerprint import grid_digest, key_of
from roadscan.model.crs import Geoid, add_grid_folder
from roadscan.model.errors import FormatError, RoadscanError, RunError
from roadscan.model.survey import ControlConfig, LogConfig, Survey
from roadscan.sensors.base import LogFormat, LogSource, Reject, Rows, format_named, format_of
from roadscan.tables.logs import LogRecord, has_log, read_log_records, retire_log, write_log_record
from roadscan.tables.schema import table_schema
from roadscan.tables.store import Store, file_digest
from roadscan.tables.writer import LogWriter

CONTROL_RUN: Final = "survey"
CONTROL_SENSOR: Final = "control"
DATA_TABLES: Final = ("scans", "returns", "cloud")
"""Tables whose readings become points."""

_SOURCES: Final = "manifest/sources.json"


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


@dataclass(frozen=True)
class IngestResult:
    """What came of one log."""

    record: LogRecord
    fresh: bool
    """False where the store already held it."""


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
    if survey.config.map.grids is not None:
        add_grid_folder(survey.resolve(survey.config.map.grids))
    known = _Sources(store)
    listed: list[tuple[str, LogConfig | ControlConfig]] = [
        (run.id, log) for run in survey.config.runs for log in run.logs
    ]
    listed += [(CONTROL_RUN, control) for control in survey.config.control]
    planned: list[PlannedLog] = []
    unplanned: list[UnplannedLog] = []
    for run, config in listed:
        try:
            planned.append(_plan_log(survey, run, config, known))
        except RoadscanError as error:
            unplanned.append(UnplannedLog(run, str(config.path), error))
    known.save()
    once = {log.key: log for log in reversed(planned)}  # a log listed twice is one log
    ordered = sorted(once.values(), key=lambda p: ("trajectory" not in p.format.yields, p.run, p.sensor, p.key))
    return ordered, unplanned


def ingest(survey: Survey, store: Store, report: Callable[[str], None] = lambda _: None) -> list[IngestResult]:
    """Bring every log of the survey file into the tables.

    Raises
    ------
    RunError
        after all logs were tried, if any could not be read; the others are kept.
    """
    results: list[IngestResult] = []
    planned, unplanned = plan_logs(survey, store)
    failures = [str(u.error) for u in unplanned]
    for failure in failures:
        report(f"failed: {failure}")
    spans: dict[str, tuple[int, int]] = {}
    for log in planned:
        try:
            result = ingest_log(store, log, spans.get(log.run), frozenset(p.key for p in planned))
        except RoadscanError as error:
            failures.append(str(error))
            report(f"failed: {error}")
            continue
        results.append(result)
        span = result.record.span("trajectory")
        if span is not None:
            before = spans.get(log.run, span)
            spans[log.run] = (min(before[0], span[0]), max(before[1], span[1]))
        report(_line(result))
    if failures:
        raise RunError(
            f"{len(failures)} of {len(failures) + len(results)} logs could not be ingested: " + " | ".join(failures),
            change="correct the survey file or the logs; the next run reads only what is missing",
        )
    return results


def ingest_log(
    store: Store,
    log: PlannedLog,
    trajectory_span: tuple[int, int] | None = None,
    listed: frozenset[str] = frozenset(),
) -> IngestResult:
    """Bring one log into the tables, unless it is there already.

    The same bytes read before under other settings are retired, unless the survey file lists them so too (`listed`
    keys: two layers of one file, say).
    """
    if has_log(store, log.key):
        return IngestResult(read_log_records(store, [log.key])[0], fresh=False)
    source = _with_span(log.source, trajectory_span)
    header = log.format.header(source)
    with store.scratch() as folder:
        writer = LogWriter(folder, header.list_size)
        for item in _items(log, source, header):
            _take(writer, item)
        writer.finish()
        for old in read_log_records(store):
            if old.key not in listed and (old.run, old.sensor, old.content) == (log.run, log.sensor, log.content):
                retire_log(store, old)
        tables = writer.publish(store, log.run, log.sensor, log.key)
    record = LogRecord(
        key=log.key,
        run=log.run,
        sensor=log.sensor,
        format=log.format.name,
        path=str(log.config.path),
        content=log.content,
        source_bytes=log.bytes,
        tables=tables,
        attributes=header.attributes,
        rows=sum(n for t, n in writer.rows.items() if t != "rejects"),
        rejected=sum(writer.reject_reasons.values()),
        reject_reasons=dict(writer.reject_reasons),
    )
    write_log_record(store, record)
    return IngestResult(record, fresh=True)


def survey_records(survey: Survey, store: Store) -> list[LogRecord]:
    """Records of the survey file's logs; a log that was never ingested is an error."""
    planned, unplanned = plan_logs(survey, store)
    missing = [str(u.error) for u in unplanned]
    missing += [f"{p.config.path} is not ingested" for p in planned if not has_log(store, p.key)]
    if missing:
        raise RunError(
            f"{len(missing)} logs are not in the store: " + " | ".join(missing),
            change="run `roadscan ingest` (or `roadscan run`) first",
        )
    return read_log_records(store, [p.key for p in planned])


def _items(log: PlannedLog, source: LogSource, header: Any) -> Iterator[Rows | Reject]:
    try:
        yield from log.format.read(source, header)
    except RoadscanError as error:
        if error.file is None:
            error.file = str(source.path)
        raise


def _take(writer: LogWriter, item: Rows | Reject) -> None:
    if isinstance(item, Reject):
        writer.reject(item.file, item.record, item.offset, item.records, item.reason)
        return
    for rows, reason in writer.add(item.table, item.batch):
        for first, count in _consecutive(rows):
            offset = -1 if item.first_offset < 0 or not item.record_bytes else (
                item.first_offset + first * item.record_bytes
            )  # fmt: skip
            writer.reject(item.file, item.first_record + first, offset, count, reason)


def _consecutive(rows: npt.NDArray[np.int64]) -> list[tuple[int, int]]:
    """Runs of consecutive row numbers as (first, count)."""
    breaks = np.flatnonzero(np.diff(rows) != 1) + 1
    return [(int(part[0]), int(part.size)) for part in np.split(rows, breaks)]


def _plan_log(survey: Survey, run: str, config: LogConfig | ControlConfig, known: _Sources) -> PlannedLog:
    path = survey.resolve(config.path)
    format_ = known.format(path, config.format)
    is_log = isinstance(config, LogConfig)
    in_map = format_.needs_map or not is_log
    sensor = config.sensor if isinstance(config, LogConfig) else None
    clock = log_clock(survey, config) if isinstance(config, LogConfig) else None
    needs_sensor = bool({"scans", "returns"} & set(format_.yields))
    if is_log and sensor is None and needs_sensor:
        raise RoadscanError(
            "the log names no sensor", expected=f"sensor = one of {', '.join(survey.rig.sensors)}", file=path
        )
    options = format_.options.parse(config.options, file=path)
    content, size = known.digest(path, format_, format_.companions(path, options))
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
    return PlannedLog(run, name, config, format_, source, key_of(*shaping), content, size)


def _with_span(source: LogSource, span: tuple[int, int] | None) -> LogSource:
    return LogSource(**{**source.__dict__, "trajectory_span_gps_ns": span})


def _line(result: IngestResult) -> str:
    r = result.record
    state = "read" if result.fresh else "known"
    rejected = f", {r.rejected:,} rejected" if r.rejected else ""
    return f"{state}: {r.run}/{r.sensor} {r.path} ({r.format}) {r.rows:,} rows{rejected}"


class _Sources:
    """Fingerprints of raw logs; a file of unchanged size and time is not read again, a log moved away is remembered."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._before: dict[str, Any] = json.loads(store.read_bytes(_SOURCES)) if store.exists(_SOURCES) else {}
        self._now: dict[str, Any] = {}

    def format(self, path: Path, stated: str | None) -> LogFormat:
        """Format of a log: as stated, as remembered, or found from its bytes."""
        if stated is None and not path.exists() and str(path) in self._before:
            stated = str(self._before[str(path)]["format"])
        return format_named(stated) if stated else format_of(path)

    def digest(self, path: Path, format_: LogFormat, companions: list[Path]) -> tuple[str, int]:
        """Fingerprint over names and contents of a log's files and companions, and their bytes in all."""
        before = self._before.get(str(path), {"files": {}})["files"]
        if path.exists():
            named = {_name(file, path): file for file in format_.files(path)}
            named |= {f"beside:{file.name}": file for file in companions if file not in named.values()}
            missing = next((file for file in named.values() if not file.exists()), None)
            if missing is not None:
                raise FormatError("a file that the log's options name does not exist", file=missing)
            files = {name: _fingerprint(file, before.get(name)) for name, file in named.items()}
        elif before:
            files = before
        else:
            raise FormatError("the log does not exist", change="check its path in the survey file", file=path)
        self._now[str(path)] = {"format": format_.name, "files": files}
        combined = hashlib.blake2b(digest_size=16)
        for name, (_, _, digest) in files.items():
            combined.update(f"{name}\0{digest}\n".encode())
        return combined.hexdigest(), sum(size for size, _, _ in files.values())

    def save(self) -> None:
        """Keep what was learnt; logs that are no longer listed stay known."""
        if {**self._before, **self._now} != self._before:
            self._store.write_bytes(_SOURCES, json.dumps({**self._before, **self._now}).encode())


def _name(file: Path, log: Path) -> str:
    return file.relative_to(log).as_posix() if file != log and log in file.parents else ""


def _fingerprint(file: Path, known: list[Any] | None) -> list[Any]:
    stat = file.stat()
    if known is not None and known[:2] == [stat.st_size, stat.st_mtime_ns]:
        return known
    return [stat.st_size, stat.st_mtime_ns, file_digest(file)]
