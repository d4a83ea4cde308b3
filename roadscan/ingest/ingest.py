"""Ingests raw logs into tables. A log is read once; a damaged record costs only itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from roadscan.core.errors import ChangingLogError, FormatError, FullDiskError, RoadscanError, RunError, StoreError
from roadscan.core.gpstime import TimeSystem
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.ingest.overlap import reject_words
from roadscan.ingest.place_checks import PLACED, place_faults
from roadscan.ingest.planned_logs import Logs, PlannedLog, logs_of, plan_logs
from roadscan.ingest.reading.format import Item, LogHeader, LogSource, Reject
from roadscan.ingest.sources import stamp_of
from roadscan.run.engine.compute import Compute, Done, Inline
from roadscan.run.session import Session, found_once
from roadscan.run.telling import in_this_process
from roadscan.store.logs import (
    DataFile,
    LogRecord,
    has_log,
    read_log_records,
    record_path,
    retire_log,
    write_log_record,
)
from roadscan.store.store import Store
from roadscan.store.writer import LogWriter

if TYPE_CHECKING:
    from roadscan.ingest.log_check import LogCheck

DATA_TABLES: Final = ("scans", "returns", "cloud")
"""Tables whose readings become points."""

_SMALL_BYTES: Final = 64 << 20
"""If all logs together are smaller than this, this process reads them: starting workers takes longer."""


@dataclass(frozen=True)
class IngestResult:
    """The result of ingesting one log."""

    record: LogRecord
    fresh: bool
    """False where the store already has the log."""


@dataclass(frozen=True)
class IngestTask:
    """One log to be read by any worker that can access the log and the store."""

    store: Store
    log: PlannedLog
    replaces: tuple[LogRecord, ...] = ()
    """Earlier records of the same bytes under other settings; no two tasks replace the same one."""

    @property
    def units(self) -> tuple[str]:
        """Name of the log."""
        return (self.log.source.path.name,)


def ingest(
    survey: Survey,
    store: Store,
    report: Callable[[str], None] = lambda _: None,
    compute: Compute | None = None,
    logs: Logs | None = None,
) -> list[IngestResult]:
    """Read every log of the survey file into the tables: one task for each log, trajectories first.

    Parameters
    ----------
    report : receives each log, in the order of :func:`plan_logs` whichever ends first.
    compute : where logs are read; this process by default.
    logs : what :func:`plan_logs` says, where that is known.

    Raises
    ------
    RunError
        after all logs were tried, if any could not be read; the others are kept.
    """
    planned, unplanned = plan_logs(survey, store) if logs is None else logs
    failures = [str(u.error) for u in unplanned]
    for failure in failures:
        report(f"failed: {failure}")
    results: list[IngestResult] = []
    spans: dict[str, tuple[int, int]] = {}
    listed = frozenset(p.key for p in planned)
    held = frozenset(key for key in listed if has_log(store, key))
    for first in (True, False):
        now = [with_span(p, spans.get(p.run)) for p in planned if p.is_trajectory == first]
        tasks = _tasks(store, now, listed, held)
        for done in _ingested(tasks, held, compute or Inline()):
            if done.result is None:
                failures.append(_reason(done))
                report(f"failed: {failures[-1]}")
                continue
            results.append(done.result)
            _widen(spans, done.result.record)
            report(_line(done.result))
    if failures:
        raise RunError(
            f"{len(failures)} of {len(failures) + len(results)} logs could not be ingested: " + " | ".join(failures),
            change="correct the survey file or the logs; the next run reads only what is missing",
        )
    return results


def ingest_log(task: IngestTask) -> IngestResult:
    """Read one log into the tables, unless the store has it already (runs on a worker)."""
    store, log = task.store, task.log
    if has_log(store, log.key):
        return IngestResult(read_log_records(store, [log.key])[0], fresh=False)
    _check_there(task)
    with store.scratch() as folder:
        writer, header = read_log(task, folder)
        for old in task.replaces:
            retire_log(store, old)
        tables = writer.publish(store, log.run, log.sensor, log.key)
    record = record_of(log, header, writer, tables)
    write_log_record(store, record)
    return IngestResult(record, fresh=True)


def record_of(
    log: PlannedLog, header: LogHeader, writer: LogWriter, tables: dict[str, tuple[DataFile, ...]]
) -> LogRecord:
    """Return the record of a log that was read."""
    return LogRecord(
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
        findings=tuple(one if one.subject else replace(one, subject=str(log.config.path)) for one in writer.findings),
    )


def read_log(task: IngestTask, folder: Path) -> tuple[LogWriter, LogHeader]:
    """Read a log's rows into a scratch folder; return their writer and the log's header."""
    header = task.log.format.header(task.log.source)
    writer, checks = LogWriter(folder, header.list_size), _checks(task.log.source, header)
    for item in _items(task.log, header):
        _take(writer, item, checks)
    writer.finish()
    for check in checks:
        check.finish(writer, header)
        writer.finish()
    from roadscan.ingest.resolution import resolution_findings

    writer.findings += resolution_findings(writer, header, task.log.source)
    _check_unchanged(task.log)
    return writer, header


def _check_there(task: IngestTask) -> None:
    """Raise an error where an ingested log was moved away and the store lost its record."""
    if task.log.source.path.exists():
        return
    aside = f"damaged/{record_path(task.log.key)}"
    why = f": its record was damaged ({aside})" if task.store.exists(aside) else ""
    raise FormatError(
        f"the log does not exist, and the store holds it no more{why}",
        change="put the log back for one run",
        file=task.log.source.path,
    )


def _check_unchanged(log: PlannedLog) -> None:
    """Refuse to publish when the file changed after it was fingerprinted."""
    path, options = log.source.path, log.source.options
    try:
        same = stamp_of(path, log.format, log.format.companions(path, options)) == log.stamp
    except OSError:
        same = False
    if not same:
        raise ChangingLogError(
            "the log changed while it was read", change="run again when its upload has ended", file=path
        )


def survey_records(survey: Survey, store: Store, logs: Logs | None = None) -> list[LogRecord]:
    """Return the records of the survey file's logs; a log that was never ingested is an error."""
    planned, unplanned = plan_logs(survey, store) if logs is None else logs
    missing = [str(u.error) for u in unplanned]
    missing += [f"{p.config.path} is not ingested, or has changed since" for p in planned if not has_log(store, p.key)]
    if missing:
        raise RunError(
            f"{len(missing)} logs are not in the store: " + " | ".join(missing),
            change="run `roadscan ingest` (or `roadscan run`) first",
        )
    return read_log_records(store, [p.key for p in planned])


@found_once
def ingested_of(session: Session) -> list[LogRecord]:
    """Records of the survey file's logs (:func:`survey_records`)."""
    return survey_records(session.survey, session.store, logs_of(session))


def _tasks(store: Store, logs: Sequence[PlannedLog], listed: frozenset[str], held: frozenset[str]) -> list[IngestTask]:
    """Return one task for each log. Logs that are still listed (`listed` keys) are not replaced."""
    missing = [log for log in logs if log.key not in held]
    older: dict[tuple[str, str, str], list[LogRecord]] = {}
    for old in read_log_records(store) if missing else ():
        if old.key not in listed:
            older.setdefault((old.run, old.sensor, old.content), []).append(old)
    replaced = {log.key: tuple(older.pop((log.run, log.sensor, log.content), ())) for log in missing}
    return [IngestTask(store, log, replaced.get(log.key, ())) for log in logs]


def _ingested(
    tasks: Sequence[IngestTask], held: frozenset[str], compute: Compute
) -> Iterator[Done[IngestTask, IngestResult]]:
    """Yield the result of each task, in their order; logs in the store (`held` keys) are not sent to workers."""
    missing = [t for t in tasks if t.log.key not in held]
    if len(missing) < 2 or sum(t.log.bytes for t in missing) < _SMALL_BYTES:
        here = in_this_process(compute)
        for task in tasks:
            yield from (Inline() if task.log.key in held else here).map(ingest_log, [task])
        return
    arriving = compute.map(ingest_log, sorted(missing, key=lambda t: -t.log.bytes))
    arrived: dict[str, Done[IngestTask, IngestResult]] = {}
    for task in tasks:
        if task.log.key in held:
            yield from Inline().map(ingest_log, [task])
            continue
        while task.log.key not in arrived:
            done = next(arriving)
            arrived[done.task.log.key] = done
        yield arrived.pop(task.log.key)


def _reason(done: Done[IngestTask, IngestResult]) -> str:
    """Return why a log failed; raise errors that are no fault of the log or its worker."""
    error = done.error or StoreError("no result", file=done.task.log.source.path)
    if isinstance(error, FullDiskError):
        return f"{done.task.log.source.path}: its rows cannot be kept: {error}"
    if isinstance(error, RoadscanError):
        return str(error)
    if isinstance(error, OSError):  # of reading, a format has reported
        return f"{done.task.log.source.path}: its rows cannot be kept: {error}; see to the store's disk"
    if type(error).__name__ == "KilledWorker":
        return f"{done.task.log.source.path}: the worker process died twice while it read this log"
    raise error


def _widen(spans: dict[str, tuple[int, int]], record: LogRecord) -> None:
    """Extend the span of the record's run by its trajectory."""
    span = record.span("trajectory")
    if span is not None:
        before = spans.get(record.run, span)
        spans[record.run] = (min(before[0], span[0]), max(before[1], span[1]))


def _items(log: PlannedLog, header: LogHeader) -> Iterator[Item]:
    try:
        yield from log.format.read(log.source, header)
    except RoadscanError as error:
        if error.file is None:
            error.file = str(log.source.path)
        raise
    except OSError as error:
        raise FormatError(f"the log cannot be read: {error.strerror or error}", file=log.source.path) from error


def _checks(source: LogSource, header: LogHeader) -> list[LogCheck]:
    """Return the checks that follow the rows of a log, in the order in which they run."""
    # Here, since `status` and `sql` import this module for its plan alone.
    from roadscan.ingest.epoch_order import EpochOrder, StandingClock
    from roadscan.ingest.log_check import Refuses
    from roadscan.ingest.motion_checks import MotionCheck, RepeatedProfiles
    from roadscan.ingest.pose_checks import PoseRecords
    from roadscan.ingest.reading.stamps import FutureTimes
    from roadscan.ingest.return_checks import CloudPoints, FarReturns, LaserRanges

    free = source.clock is not None and source.clock.system is TimeSystem.FREE
    poses = PoseRecords()
    return [
        Refuses(lambda rows: place_faults(rows.table, rows.batch, header) if rows.table in PLACED else ()),
        Refuses(FutureTimes.of(source, header).refused),
        StandingClock(),
        EpochOrder(free=free),
        RepeatedProfiles(),
        FarReturns(),
        poses,
        CloudPoints(),
        LaserRanges(in_sensor_frame=header.attributes.get("frame") == "sensor"),
        MotionCheck(poses),
    ]


def _take(writer: LogWriter, item: Item, checks: Sequence[LogCheck]) -> None:
    if isinstance(item, Finding):
        writer.findings.append(item)
        return
    if isinstance(item, Reject):
        writer.reject(item.file, item.record, item.offset, item.records, item.reason)
        return
    refused = writer.add(*item.stored, [one for check in checks for one in check.refused(item)])
    for check in checks:
        check.take(item, [rows for rows, _ in refused])
    for rows, reason in refused:
        for record, offset, count in item.places(rows):
            writer.reject(item.file, record, offset, count, reason)


def with_span(log: PlannedLog, span: tuple[int, int] | None) -> PlannedLog:
    """Return the log with the span of its run's trajectory (GPS ns), which readers of short stamps need."""
    return replace(log, source=replace(log.source, trajectory_span_gps_ns=span))


def _line(result: IngestResult) -> str:
    r = result.record
    state = "read" if result.fresh else "known"
    rejected = f", {r.rejected:,} rejected: {reject_words(r)}" if r.rejected else ""
    return f"{state}: {r.run}/{r.sensor} {r.path} ({r.format}) {r.rows:,} rows{rejected}"
