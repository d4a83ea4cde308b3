"""Log records: which raw logs the store has, and where their rows are."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast
from weakref import WeakValueDictionary

from roadscan.core.errors import DamagedError, StoreError
from roadscan.core.witness import Finding
from roadscan.store.codecs.group_spans import GroupRows, GroupSpans
from roadscan.store.digest import bytes_digest, checked_json, parse_checked
from roadscan.store.store import Store

_FOLDER: Final = "manifest/logs"
_COPIES: Final = "manifest/log_copies"

NAVIGATION: Final = "navigation"
"""Sensor in the records of computed trajectories."""

_HELD: Final[WeakValueDictionary[tuple[str, str], LogRecord]] = WeakValueDictionary()
"""Records that somebody holds, by file and digest of its content: a run and `status` ask for them again and again."""


@dataclass(frozen=True)
class DataFile:
    """One Parquet file of ingested rows."""

    path: str
    """Relative to the survey's root."""
    rows: int
    bytes: int
    digest: str
    """BLAKE3-128 of its bytes with the prefix ``blake3:``; without a prefix, BLAKE2b-128 (older versions)."""
    group_rows: Sequence[int]
    """Rows of each row group, stored as :class:`GroupRows`."""
    group_spans: Sequence[tuple[int, int]]
    """First and last epoch (GPS ns) of each row group (:class:`GroupSpans`); empty for tables without epochs."""

    def __post_init__(self) -> None:
        for name, kind in (("group_rows", GroupRows), ("group_spans", GroupSpans)):
            if not isinstance(given := getattr(self, name), kind):
                object.__setattr__(self, name, kind(given))

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last epoch (GPS ns)."""
        return cast("GroupSpans", self.group_spans).span

    def as_json(self) -> dict[str, Any]:
        """Return its entry in a record: equal rows of neighbouring groups as [groups, rows], spans as a text."""
        rows, spans = cast("GroupRows", self.group_rows), cast("GroupSpans", self.group_spans)
        packed = {"group_rows": list(map(list, rows.runs)), "group_spans": spans.text()}
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)} | packed


@dataclass(frozen=True)
class LogRecord:
    """Record of one ingested log; written last, so a log is in the store completely or not at all."""

    key: str
    """Fingerprint of the log's bytes and of everything that affected its rows."""
    run: str
    sensor: str
    """Sensor of the rig; 'trajectory' or 'control' for logs without one."""
    format: str
    path: str
    """Path in the survey file."""
    content: str
    """Fingerprint of only the log's bytes."""
    source_bytes: int
    tables: dict[str, tuple[DataFile, ...]]
    attributes: dict[str, Any]
    rows: int
    rejected: int
    """Records listed in the table ``rejects``."""
    reject_reasons: dict[str, int]
    findings: tuple[Finding, ...] = ()
    """Findings of its reader and of the checks of its rows."""

    def span(self, table: str) -> tuple[int, int] | None:
        """Return the first and last epoch (GPS ns) of the log's rows in a table."""
        spans = [f.span for f in self.tables.get(table, ()) if f.span is not None]
        return (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else None

    def folder(self, table: str) -> str:
        """Return the folder of the log's rows in a table, relative to the survey's root."""
        files = self.tables.get(table, ())
        return log_folder(table_of(files[0].path) if files else table, self.run, self.sensor, self.key)


def log_folder(table: str, run: str, sensor: str, key: str) -> str:
    """Return the folder of one log's rows in a table."""
    return f"tables/{table}/run={run}/sensor={sensor}/log={key}"


def table_of(path: str) -> str:
    """Return the table whose form the rows of a log's file have."""
    return path.split("/")[1]


def log_of(path: str) -> str:
    """Return the key of the log whose rows are in a file below its folder."""
    return path.partition("/log=")[2].partition("/")[0]


def record_path(key: str) -> str:
    """Return the file of a log's record, relative to the survey's root."""
    return f"{_FOLDER}/{key}.json"


def copy_path(key: str) -> str:
    """Return the file of a record's copy: raw logs may be archived, and nothing else explains their rows."""
    return f"{_COPIES}/{key}.json"


def write_log_record(store: Store, record: LogRecord) -> None:
    """Make a log part of the store."""
    values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    tables = {name: [one.as_json() for one in files] for name, files in record.tables.items()}
    findings = [dataclasses.asdict(one) for one in record.findings]
    content = checked_json(values | {"tables": tables, "findings": findings})
    store.write_bytes(copy_path(record.key), content, lasting=False)
    store.write_bytes(record_path(record.key), content)


def read_log_records(
    store: Store, keys: Iterable[str] | None = None, damaged: list[StoreError] | None = None
) -> list[LogRecord]:
    """Return the records of all logs in the store, or of the named ones, sorted by run, sensor, start and key.

    One that is damaged is an error, or joins `damaged` and is left out.
    """
    records: list[LogRecord] = []
    for key in log_keys(store) if keys is None else keys:
        path = record_path(key)
        try:
            records.append(parse_log_record(store.read_bytes(path), key, store.path(path)))
        except StoreError as error:
            if damaged is None:
                raise
            damaged.append(error)
    return sorted(records, key=lambda r: (r.run, r.sensor, _start(r), r.key))


def log_keys(store: Store) -> list[str]:
    """Return the keys of all logs in the store, including those with a damaged record."""
    return [path.rsplit("/", 1)[1].removesuffix(".json") for path in store.files(_FOLDER, ".json")]


def copies_alone(store: Store) -> list[str]:
    """Return the copies of records that are gone, or were never written: of a command that was killed."""
    keys = set(log_keys(store))
    return [path for path in store.files(_COPIES, ".json") if Path(path).stem not in keys]


def _start(record: LogRecord) -> int:
    """Return the first epoch (GPS ns) of a log, 0 for one without rows or epochs."""
    return min(((record.span(table) or (0, 0))[0] for table in record.tables), default=0)


def has_log(store: Store, key: str) -> bool:
    """Return True if the log of this key is in the store, even if its record is damaged."""
    return store.exists(record_path(key))


def retire_log(store: Store, record: LogRecord) -> None:
    """Move a log's record and rows below ``superseded/``, so that it leaves the tables without being lost.

    Used when the same bytes were read again under other settings (a corrected clock, say).
    """
    path = record_path(record.key)
    store.write_bytes(f"superseded/{path}", store.read_bytes(path))
    store.remove(copy_path(record.key))  # before the record by which it is found
    store.remove(path)  # before its rows, so that no log is partially present
    for table in record.tables:
        if store.is_folder and store.exists(record.folder(table)):
            aside = f"superseded/{record.folder(table)}"
            store.remove(aside)
            target = store.path(aside)
            store.fs.makedirs(target.rsplit("/", 1)[0], exist_ok=True)
            store.fs.mv(store.path(record.folder(table)), target, recursive=True)


def data_file(raw: Mapping[str, Any]) -> DataFile:
    """Return a data file from its entry in a record; older versions wrote each row group by itself."""
    rows, spans = raw["group_rows"], raw["group_spans"]
    if isinstance(spans, str):
        rows, spans = GroupRows.of_runs(rows), GroupSpans.of_text(spans)
    return DataFile(**{**raw, "group_rows": rows, "group_spans": spans})


def parse_log_record(content: bytes, key: str, path: str) -> LogRecord:
    """Return the record of the log `key`, from the content of the file `path`."""
    known = (path, bytes_digest(content))
    if (parsed := _HELD.get(known)) is not None:
        return parsed
    try:
        raw = parse_checked(content)
        raw["tables"] = {name: tuple(map(data_file, files)) for name, files in raw["tables"].items()}
        raw["findings"] = tuple(map(Finding.of, raw.get("findings", ())))
        record = LogRecord(**raw)
        if record.key != key:
            raise ValueError(f"it is the record of the log {record.key}")
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise DamagedError(
            f"the log record is damaged ({error})",
            change="the next run puts its copy in its place, or reads the log again",
            file=path,
        ) from error
    _HELD[known] = record
    return record


@dataclass(frozen=True)
class Fault:
    """A log that contributes nothing, or logs with one common fault, and why."""

    keys: tuple[str, ...]
    """Keys of the records of the log, or of all logs with this fault."""
    path: str
    """Path in the survey file, or several."""
    reason: str

    @property
    def told(self) -> tuple[str, str]:
        """Return unit and reason, as a run lists its failures."""
        return self.path, self.reason
