"""Remembers which files of SQL were verified against their records, and repairs damaged records.

DuckDB does not verify checksums. A file whose size and time are as they were when its digest was found right was not
written since, and checking them takes microseconds. What changed since, or was never verified, is read once.

The note is no record: where it is lost or damaged, files are read once more.

Repairs damaged records of the store: they are set aside, never deleted, and what they described is made again.

A log's record has a copy, which takes its place; without one the log is read again. Of a damaged part of the manifest
the sound rows stay. What else it said is not known: it may have replaced or forgotten records of parts before it. So
the files of those are verified against their digests, and what differs counts as stale.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from roadscan.core.errors import AnswerError, DamagedError, StoreError
from roadscan.store.digest import digest_holds
from roadscan.store.history import history_faults
from roadscan.store.logs import LogRecord, copy_path, log_keys, parse_log_record, record_path
from roadscan.store.manifest import Manifest, ReadPart, begin_changes, part_path, read_parts
from roadscan.store.records import OutputRecord, Packed, latest, rows_of, table_of
from roadscan.store.small_tables import REPAIR_HINT, digests_fault, read_small, small_path, small_records
from roadscan.store.stamp import Stamp, stamp_of
from roadscan.store.store import MADE_AGAIN, Store

_FILE: Final = "manifest/verified.parquet"
_STAMPS: Final = pa.schema([("path", pa.string()), ("bytes", pa.int64()), ("changed", pa.string())])
_RECORDED: Final = pa.schema([("path", pa.string()), ("bytes", pa.int64()), ("digest", pa.string())])
_SUFFIX: Final = ".parquet"


class Recorded(NamedTuple):
    """Recorded properties of a file."""

    bytes: int
    digest: str


def recorded_files(store: Store, logs: Iterable[LogRecord], manifest: Manifest) -> pa.Table:
    """Return every recorded Parquet file (columns path, bytes, digest): ingested, made or estimated."""
    data = [(f.path, f.bytes, f.digest) for log in logs for own in log.tables.values() for f in own]
    data += [(path, *one) for path, one in small_records(store).items()]
    ingested = _table(data, _RECORDED)
    made = manifest.table().select(_RECORDED.names)
    return pa.concat_tables([ingested, made.filter(pc.ends_with(made.column("path"), _SUFFIX))])


def faults_of_opened(store: Store, opened: Mapping[str, Stamp], recorded: pa.Table) -> list[AnswerError]:
    """Return the faults of files that a query opened (paths and stamps); verified ones are not read again.

    A file of an object store is verified by its size alone, unless its time or tag has changed since then: the
    object store checks what it keeps, and to read all of it would cost more than the query.
    """
    paths = sorted(opened)
    records, notes = _looked_up(paths, recorded), _looked_up(paths, _read(store))
    faults = {p: _fault_of_held(store, p) for p in _held_of(paths) if p not in records}
    faults.update(history_faults(store, paths))
    due: list[str] = []
    for path in paths:
        record, stamp = records.get(path), opened[path]
        if record is None:
            continue
        if stamp.bytes != record[0]:
            faults[path] = f"{path}: {stamp.bytes} bytes, expected {record[0]}"
        elif tuple(stamp) != notes.get(path) and (store.is_folder or path in notes):
            due.append(path)
    found = _held_against(store, {path: Recorded(*records[path]) for path in due})
    note_verified(store, {path: opened[path] for path in due if found[path] is None})
    return [_in_answer(path, fault) for path, fault in sorted({**faults, **found}.items()) if fault is not None]


def note_verified(store: Store, stamps: Mapping[str, Stamp], *, anew: bool = False) -> None:
    """Store the stamps of verified files, in addition to known ones, or in their place if `anew`.

    Who may only read the store asks it all the same, and holds such files each time.
    """
    if not stamps and not anew:
        return
    table = _table([(path, *stamps[path]) for path in sorted(stamps)], _STAMPS)
    before = _read(store)
    if not anew:
        kept = before.filter(pc.invert(pc.is_in(before.column("path"), table.column("path"))))
        table = pa.concat_tables([kept, table])
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True)
    with contextlib.suppress(StoreError):
        store.write_bytes(_FILE, sink.getvalue().to_pybytes(), lasting=False)


def note_written(store: Store, since_ns: int, recorded: pa.Table) -> None:
    """Note the recorded files written after a time (ns): their digests were taken when they were published."""
    if not store.is_folder:
        return
    paths = recorded.column("path").to_pylist()
    notes = _looked_up(paths, _read(store))
    sizes = dict(zip(paths, recorded.column("bytes").to_pylist(), strict=True))
    stamps = {path: stamp for path in paths if (stamp := stamp_of(store, path)) is not None}
    note_verified(
        store,
        {
            path: stamp
            for path, stamp in stamps.items()
            if stamp.bytes == sizes[path] and int(stamp.changed) >= since_ns and tuple(stamp) != notes.get(path)
        },
    )


def held_faults(store: Store) -> list[str]:
    """Return the faults of the small tables, and of the list of their digests."""
    records, found = small_records(store), [digests_fault(store)]
    for path in map(small_path, REPAIR_HINT):
        fault = None
        if path in records and store.exists(path):
            fault = _held_against(store, {path: Recorded(*records[path])})[path]
        found.append(fault or _fault_of_held(store, path) or "")
    return [fault for fault in found if fault]


def _held_of(paths: Iterable[str]) -> list[str]:
    return [path for path in paths if path in map(small_path, REPAIR_HINT)]


def _fault_of_held(store: Store, path: str) -> str | None:
    """Return the fault of a small table without a record, by the checksums of its pages."""
    try:
        read_small(store, path.split("/")[1])
    except StoreError as error:
        return str(error)
    return None


def _held_against(store: Store, files: Mapping[str, Recorded]) -> dict[str, str | None]:
    """Return the faults of some files, read completely on all cores; None for each that is as recorded."""
    with tempfile.TemporaryDirectory(prefix="roadscan-") as folder, ThreadPoolExecutor(os.cpu_count()) as threads:
        place = Path(folder)
        faults = threads.map(lambda path: fault_of(store, place, path, *files[path]), files)
        return {path: _with_way_out(path, fault) for path, fault in zip(files, faults, strict=True)}


def _with_way_out(path: str, fault: str | None) -> str | None:
    return f"{fault}; {REPAIR_HINT[path.split('/')[1]]}" if fault and _held_of([path]) else fault


def _in_answer(path: str, fault: str) -> AnswerError:
    if path.startswith("manifest/history/"):
        return AnswerError(f"the answer is made of a damaged file: {fault}")
    ingested = "/log=" in path and not path.startswith("tables/footprints/")
    change = "" if _held_of([path]) else "`roadscan verify --repair` reads its log again" if ingested else MADE_AGAIN
    return AnswerError(f"the answer is made of a damaged file: {fault}", change=change)


def _table(rows: Sequence[tuple[str, int, str]], schema: pa.Schema) -> pa.Table:
    columns = list(zip(*rows, strict=True)) or [()] * len(schema)
    return pa.Table.from_arrays([pa.array(c, f.type) for c, f in zip(columns, schema, strict=True)], schema=schema)


def _looked_up(paths: Sequence[str], table: pa.Table) -> dict[str, tuple[int, str]]:
    """Return the other two columns of the rows that name a path; the last row of several."""
    known = table.filter(pc.is_in(table.column("path"), pa.array(paths, pa.string())))
    columns = [known.column(name).to_pylist() for name in known.column_names]
    return {path: (size, text) for path, size, text in zip(*columns, strict=True)}


def _read(store: Store) -> pa.Table:
    with contextlib.suppress(StoreError, pa.ArrowException, OSError, ValueError):
        if store.exists(_FILE):
            return store.read_table(_FILE).select(_STAMPS.names).cast(_STAMPS)
    return _STAMPS.empty_table()


Report = Callable[[str], None]


def repair_records(store: Store, report: Report = lambda _: None) -> None:
    """Set damaged records aside (requires the store's lock); `report` receives each, with its consequences."""
    _mend_logs(store, report)
    _mend_manifest(store, report)


def fault_of(
    store: Store,
    folder: Path,
    path: str,
    size: int,
    digest: str,
    also: Callable[[Path], str | None] = lambda _: None,
) -> str | None:
    """Return what is wrong with a recorded file, None for nothing.

    Parameters
    ----------
    folder : for copies of remote files.
    also : says what else is wrong with a file whose bytes are as recorded, from a local copy of it.
    """
    found = store.size(path)
    if found is None:
        return f"{path}: missing"
    if found != size:
        return f"{path}: {found} bytes, expected {size}"
    try:
        with store.copied(path, folder) as local:
            return also(local) if digest_holds(local, digest) else f"{path}: the content has changed (digest differs)"
    except OSError as error:
        return f"{path}: it cannot be read: {error.strerror or error}"


def _mend_logs(store: Store, report: Report) -> None:
    for key in log_keys(store):
        path, copy = record_path(key), copy_path(key)
        content = store.read_bytes(path)
        try:
            parse_log_record(content, key, store.path(path))
        except DamagedError as error:
            whole = _whole_copy(store, key)
            aside = store.set_aside(path)
            told = f"{error.file}: {error.arrived}; it was set aside ({aside})"
            if whole is None:
                report(f"{told}, and the log is read again")
            else:
                store.write_bytes(path, whole)
                report(f"{told}, and its copy put in its place")
            continue
        if store.size(copy) != len(content):
            store.write_bytes(copy, content)


def _whole_copy(store: Store, key: str) -> bytes | None:
    """Return the copy of a log's record, None where it is missing or damaged too."""
    path = copy_path(key)
    if not store.exists(path):
        return None
    content = store.read_bytes(path)
    try:
        parse_log_record(content, key, store.path(path))
    except DamagedError:
        return None
    return content


def _mend_manifest(store: Store, report: Report) -> None:
    parts = read_parts(store)
    damaged = [number for number, part in enumerate(parts) if part.fault is not None]
    if not damaged:
        return
    for one in damaged:
        fault = parts[one].fault
        if fault is not None and not isinstance(fault, DamagedError):
            raise fault  # may be readable tomorrow
    begin_changes(store, older=True)  # files that only it named have no record now
    rows, _ = latest(pa.concat_tables([part.table for part in parts]), forgotten=True)
    doubtful = _doubtful(rows, parts[damaged[-1] + 1 :])
    with store.scratch() as folder:
        gone = [r for r in doubtful if fault_of(store, folder, r.path, r.bytes, r.digest) is not None]
    forgotten = table_of([(r.product, r.unit, "", "", 0, "", "") for r in gone])
    rows, _ = latest(pa.concat_tables([rows, forgotten]), forgotten=True)
    store.write_bytes(part_path(parts[-1].number + 1), Packed.of(rows, "lz4").content)
    for one in damaged:  # last: until then the next run repeats all of this
        fault = parts[one].fault
        aside = store.set_aside(parts[one].path)
        report(
            f"{store.path(parts[one].path)}: {'' if fault is None else fault.arrived}; it was set aside ({aside}), and "
            f"what it alone told of is made again. Of {len(doubtful):,} older files {len(gone):,} are not as recorded"
        )


def _doubtful(rows: pa.Table, later: Sequence[ReadPart]) -> list[OutputRecord]:
    """Return the records of files that parts after the last damaged one do not mention."""
    known = {tuple(row) for part in later for row in zip(*_names(part.table), strict=True)}
    product, unit = _names(rows)
    open_ = np.array([pair not in known for pair in zip(product, unit, strict=True)], dtype=bool)
    files = pc.not_equal(rows.column("path"), "").to_numpy(zero_copy_only=False)
    return list(map(OutputRecord._make, rows_of(rows.filter(pa.array(open_ & files)))))


def _names(rows: pa.Table) -> tuple[list[str], list[str]]:
    return rows.column("product").to_pylist(), rows.column("unit").to_pylist()
