"""Repairs damaged records of the store: they are set aside, never deleted, and what they described is made again.

A log's record has a copy, which takes its place; without one the log is read again. Of a damaged part of the manifest
the sound rows stay. What else it said is not known: it may have replaced or forgotten records of parts before it. So
the files of those are verified against their digests, and what differs counts as stale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.core.errors import DamagedError
from roadscan.store.digest import digest_holds
from roadscan.store.logs import copy_path, log_keys, parse_log_record, record_path
from roadscan.store.manifest import ReadPart, begin_changes, part_path, read_parts
from roadscan.store.records import OutputRecord, Packed, latest, rows_of, table_of
from roadscan.store.store import Store

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
