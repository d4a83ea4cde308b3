"""Repairs damaged tables of ingested rows: their logs are read again; where a log is gone, sound rows are kept.

A log with unchanged bytes gives the same rows, and these give the same files, so that nothing that was made of
them is stale. What is damaged is never deleted: it is kept below ``damaged/``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from roadscan.core.errors import RoadscanError
from roadscan.core.survey import Survey
from roadscan.ingest.ingest import IngestTask, read_log, record_of, with_span
from roadscan.ingest.planned_logs import PlannedLog, plan_logs
from roadscan.ingest.sources import is_unchanged
from roadscan.navigation.tasks.navigate import keep_trajectory, plan_trajectories
from roadscan.store.logs import NAVIGATION, DataFile, LogRecord, read_log_records, table_of, write_log_record
from roadscan.store.salvage import Lost, read_lost, salvaged, write_lost
from roadscan.store.schema import table_schema
from roadscan.store.stamp import stamp_of
from roadscan.store.store import Store
from roadscan.store.verified import note_verified, repair_records
from roadscan.survey.status import find_damage


@dataclass
class Repair:
    """Results of a repair, and remaining faults."""

    lines: list[str] = field(default_factory=list)
    """What was repaired and what is lost, file by file."""
    faults: list[str] = field(default_factory=list)
    """Files that are still damaged."""
    lost: list[Lost] = field(default_factory=list)
    """Rows that the store has lost."""


class _LostLogError(RoadscanError):
    """A log cannot be read again unchanged."""


@dataclass(frozen=True)
class _Broken:
    """A log with damaged files."""

    record: LogRecord
    files: dict[str, DataFile]
    """Files that are damaged, or that lost rows before, by path, as recorded when they were undamaged."""
    damaged: frozenset[str]
    """Those of them that are damaged now."""


def repair_store(survey: Survey, store: Store, report: Callable[[int, int], None] = lambda _a, _b: None) -> Repair:
    """Verify every file of a store against its record, and repair the ingested tables."""
    with store.lock():
        done = Repair()
        repair_records(store, done.lines.append)
        found = find_damage(store, report)
        done.faults += found.faults
        done.lost = read_lost(store)
        records = read_log_records(store, damaged=[])
        broken = _broken(records, found.ingested, done.lost)
        _mend_logs(survey, store, records, [b for b in broken if b.record.sensor != NAVIGATION], done)
        _mend_trajectories(survey, store, [b for b in broken if b.record.sensor == NAVIGATION], done)
        write_lost(store, done.lost)
    return done


def accept_losses(store: Store) -> None:
    """Record that the user continues without the lost rows; they stay listed."""
    with store.lock():
        write_lost(store, [replace(lost, accepted=True) for lost in read_lost(store)])


def _broken(records: Iterable[LogRecord], faults: Mapping[str, str], lost: Sequence[Lost]) -> list[_Broken]:
    found: list[_Broken] = []
    for record in records:
        files = {f.path: f for files_of_table in record.tables.values() for f in files_of_table if f.path in faults}
        files |= {one.file.path: one.file for one in lost if one.log == record.key}
        if files:
            found.append(_Broken(record, files, frozenset(files.keys() & faults.keys())))
    return found


def _mend_logs(
    survey: Survey, store: Store, records: Sequence[LogRecord], broken: Sequence[_Broken], done: Repair
) -> None:
    if not broken:
        return
    planned, unplanned = plan_logs(survey, store)
    spans = _spans(records, planned)
    for one in broken:
        try:
            log = _log_of(one.record, planned, [u.path for u in unplanned])
            _check_whole(survey, store, log)
            task = IngestTask(store, with_span(log, spans.get(log.run)), ())
            done.lines += _read_again(task, one)
            done.lost = [lost for lost in done.lost if lost.log != one.record.key]
        except _LostLogError as error:
            done.lines += _keep_sound(store, one, str(error), done)
        except RoadscanError as error:
            done.faults += [f"{path}: it is damaged; {error}" for path in one.files]


def _spans(records: Iterable[LogRecord], planned: Iterable[PlannedLog]) -> dict[str, tuple[int, int]]:
    """Return the first and last epoch (GPS ns) of each run's trajectory logs."""
    keys = {log.key for log in planned if log.is_trajectory}
    spans: dict[str, tuple[int, int]] = {}
    for record in records:
        span = record.span("trajectory")
        if record.key in keys and span is not None:
            before = spans.get(record.run, span)
            spans[record.run] = (min(before[0], span[0]), max(before[1], span[1]))
    return spans


def _log_of(record: LogRecord, planned: Sequence[PlannedLog], unplanned: Sequence[str]) -> PlannedLog:
    """Return the log of a record as the survey file lists it.

    Raises
    ------
    RoadscanError
        It is to be read in another way now, or not at all.
    _LostLogError
        Its bytes are gone.
    """
    found = next((log for log in planned if log.key == record.key), None)
    if found is not None:
        return found
    listed = [log for log in planned if (str(log.config.path), log.run) == (record.path, record.run)]
    if any(log.content == record.content for log in listed):
        raise RoadscanError("the survey file has its log read in another way now", change="the next run reads it anew")
    if listed:
        raise _LostLogError(f"the raw log {record.path} holds other bytes now")
    if record.path in unplanned:
        raise _LostLogError(f"the raw log {record.path} is gone")
    raise RoadscanError(f"the survey file lists its log {record.path} no more", change="list it again, or leave it")


def _check_whole(survey: Survey, store: Store, log: PlannedLog) -> None:
    """Raise _LostLogError where the log's bytes are not those that were read before."""
    path, companions = log.source.path, log.format.companions(log.source.path, log.source.options)
    if not path.exists():
        raise _LostLogError(f"the raw log {log.config.path} is gone")
    try:
        whole = is_unchanged(store, survey.folder, path, log.format, companions)
    except OSError as error:
        raise _LostLogError(f"the raw log {log.config.path} cannot be read ({error.strerror or error})") from error
    if not whole:
        raise _LostLogError(f"the raw log {log.config.path} holds other bytes now")


def _read_again(task: IngestTask, broken: _Broken) -> list[str]:
    """Read a log and replace damaged files by its files."""
    store, record = task.store, broken.record
    with store.scratch() as folder:
        writer, header = read_log(task, folder)
        fresh = writer.files(record.run, record.sensor, record.key)
        local = {file.path: path for of_table in fresh.values() for path, file in of_table.items()}
        new = {file.path: file for of_table in fresh.values() for file in of_table.values()}
        kept = {path: _kept_aside(store, path) for path in broken.files}
        before = {f.path for of_table in record.tables.values() for f in of_table} | broken.files.keys()
        if new.keys() == before:
            for path in broken.files:
                store.publish(local[path], path, lasting=True)
            tables = _with_files(record, fresh, {path: new[path] for path in broken.files})
            changed = replace(record, tables=tables, rows=_rows(tables))
        else:
            changed = record_of(task.log, header, writer, writer.publish(store, record.run, record.sensor, record.key))
        if changed != record:
            write_log_record(store, changed)
    note_verified(store, {path: stamp for path in broken.files if (stamp := stamp_of(store, path)) is not None})
    same = {path for path, file in broken.files.items() if path in new and new[path].digest == file.digest}
    return [_mended(path, path in same, kept[path]) for path in sorted(broken.files)]


def _with_files(
    record: LogRecord, tables: Iterable[str], files: Mapping[str, DataFile]
) -> dict[str, tuple[DataFile, ...]]:
    """Return the files of a record by table, with others that replace, or are added to, those that it names."""
    known = {f.path: f for of_table in record.tables.values() for f in of_table} | dict(files)
    of = {path: table_schema(table_of(path)).rows_of for path in known}
    return {t: tuple(known[path] for path in sorted(known) if of[path] == t) for t in sorted({*tables, *record.tables})}


def _rows(tables: Mapping[str, Sequence[DataFile]]) -> int:
    return sum(file.rows for table, of_table in tables.items() if table != "rejects" for file in of_table)


def _mended(path: str, same: bool, aside: str) -> str:
    how = "byte for byte as it was" if same else "with other bytes: the next run makes again what it touches"
    return f"{path}: mended, its log was read again ({how}){_told_aside(aside)}"


def _told_aside(aside: str) -> str:
    return f"; the damaged file is kept ({aside})" if aside else ""


def _kept_aside(store: Store, path: str) -> str:
    return store.set_aside(path, keep=True) if store.exists(path) else ""


def _keep_sound(store: Store, broken: _Broken, why: str, done: Repair) -> list[str]:
    """Keep the sound part of a log's damaged files; the rest is lost, and listed."""
    known = {one.file.path: one for one in done.lost}
    lines: list[str] = []
    files = {f.path: f for of_table in broken.record.tables.values() for f in of_table}
    for path, whole in broken.files.items():
        if path not in broken.damaged:  # reported before, and its log is still gone
            continue
        file, before = files[path], known.get(path)
        table = table_schema(table_of(path)).rows_of
        with store.scratch() as folder:
            kept, rows, spans = salvaged(store, table, file, folder / Path(path).name)
            aside = _kept_aside(store, path)
            if kept is None:
                store.remove(path)
                del files[path]
            else:
                store.publish(folder / Path(path).name, path, lasting=True)
                files[path] = kept
        if rows:
            now = Lost(broken.record.key, table, whole, rows, spans, aside)
            if before is not None:
                done.lost.remove(before)
                now = replace(now, rows=before.rows + rows, spans=(*before.spans, *spans))
            done.lost.append(now)
            lines.append(f"{now}: {why}; the next run makes anew what they touch, without them")
        else:
            lines.append(f"{path}: mended, only what stands beside its rows was damaged{_told_aside(aside)}")
    tables = {
        t: tuple(files[f.path] for f in of_table if f.path in files) for t, of_table in broken.record.tables.items()
    }
    tables = {table: of_table for table, of_table in tables.items() if of_table}
    if tables != broken.record.tables:
        write_lost(store, done.lost)  # first: missing rows are reported
        write_log_record(store, replace(broken.record, tables=tables, rows=_rows(tables)))
    return lines


def _mend_trajectories(survey: Survey, store: Store, broken: Sequence[_Broken], done: Repair) -> None:
    """Compute damaged trajectories again from their logs."""
    if not broken:
        return
    keys = [log.key for log in plan_logs(survey, store)[0]]
    records = [record for record in read_log_records(store, damaged=[]) if record.key in keys]
    planned = {one.key: one for one in plan_trajectories(survey, store, records)}
    for one in broken:
        if one.record.key not in planned:
            done.faults += [f"{path}: it is damaged; the next run computes this trajectory anew" for path in one.files]
            continue
        kept = {path: _kept_aside(store, path) for path in one.files}
        try:
            keep_trajectory(store, planned[one.record.key], done.lines.append)
        except RoadscanError as error:
            done.faults += [f"{path}: it is damaged; {error}" for path in one.files]
            continue
        done.lines += [f"{p}: mended, its trajectory was computed again{_told_aside(kept[p])}" for p in one.files]
