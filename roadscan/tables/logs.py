"""Log records: which raw logs the store holds, and where their rows lie."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

from roadscan.model.errors import StoreError
from roadscan.tables.store import Store

_FOLDER: Final = "manifest/logs"


@dataclass(frozen=True)
class DataFile:
    """One Parquet file of ingested rows."""

    path: str
    """Relative to the survey's root."""
    rows: int
    bytes: int
    digest: str
    """BLAKE3-128 of its bytes with the prefix ``blake3:``; without a prefix, BLAKE2b-128 (older versions)."""
    group_rows: tuple[int, ...]
    """Rows of each row group."""
    group_spans: tuple[tuple[int, int], ...]
    """First and last epoch (GPS ns) of each row group; empty for tables without epochs."""

    @cached_property
    def span(self) -> tuple[int, int] | None:
        """First and last epoch (GPS ns)."""
        if not self.group_spans:
            return None
        return min(s[0] for s in self.group_spans), max(s[1] for s in self.group_spans)


@dataclass(frozen=True)
class LogRecord:
    """What is known of one ingested log; written last, so a log is in the store whole or not at all."""

    key: str
    """Fingerprint of the log's bytes and of everything that shaped its rows."""
    run: str
    sensor: str
    """Sensor of the rig; 'trajectory' or 'control' for logs without one."""
    format: str
    path: str
    """Path in the survey file."""
    content: str
    """Fingerprint of the log's bytes alone."""
    source_bytes: int
    tables: dict[str, tuple[DataFile, ...]]
    attributes: dict[str, Any]
    rows: int
    rejected: int
    """Records listed in the table ``rejects``."""
    reject_reasons: dict[str, int]

    def span(self, table: str) -> tuple[int, int] | None:
        """First and last epoch (GPS ns) of the log's rows in a table."""
        spans = [f.span for f in self.tables.get(table, ()) if f.span is not None]
        return (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else None

    def folder(self, table: str) -> str:
        """Folder of the log's rows in a table, relative to the survey's root."""
        return log_folder(table, self.run, self.sensor, self.key)


def log_folder(table: str, run: str, sensor: str, key: str) -> str:
    """Folder of one log's rows in a table."""
    return f"tables/{table}/run={run}/sensor={sensor}/log={key}"


def write_log_record(store: Store, record: LogRecord) -> None:
    """Make a log part of the store."""
    text = json.dumps(dataclasses.asdict(record), indent=1, sort_keys=True)
    store.write_bytes(f"{_FOLDER}/{record.key}.json", text.encode())


def read_log_records(store: Store, keys: Iterable[str] | None = None) -> list[LogRecord]:
    """Records of all logs in the store, or of those named, sorted by run, sensor, start and key."""
    paths = store.files(_FOLDER, ".json") if keys is None else [f"{_FOLDER}/{k}.json" for k in keys]
    records = [_parse(store.read_bytes(p), store.path(p)) for p in paths]
    return sorted(records, key=lambda r: (r.run, r.sensor, _start(r), r.key))


def _start(record: LogRecord) -> int:
    """First epoch (GPS ns) of a log, 0 for one without rows or epochs."""
    return min(((record.span(table) or (0, 0))[0] for table in record.tables), default=0)


def has_log(store: Store, key: str) -> bool:
    """True if the log of this key is in the store."""
    return store.exists(f"{_FOLDER}/{key}.json")


def retire_log(store: Store, record: LogRecord) -> None:
    """Take a log out of the tables without losing it: its record and rows move below ``superseded/``.

    Used when the same bytes were read again under other settings (a corrected clock, say).
    """
    store.write_bytes(f"superseded/{_FOLDER}/{record.key}.json", store.read_bytes(f"{_FOLDER}/{record.key}.json"))
    store.remove(f"{_FOLDER}/{record.key}.json")  # before its rows go: no log is half there
    for table in record.tables:
        if store.is_folder and store.exists(record.folder(table)):
            aside = f"superseded/{record.folder(table)}"
            store.remove(aside)
            target = store.path(aside)
            store.fs.makedirs(target.rsplit("/", 1)[0], exist_ok=True)
            store.fs.mv(store.path(record.folder(table)), target, recursive=True)


def _parse(content: bytes, path: str) -> LogRecord:
    try:
        raw = json.loads(content)
        raw["tables"] = {
            name: tuple(
                DataFile(
                    **{
                        **f,
                        "group_rows": tuple(f["group_rows"]),
                        "group_spans": tuple((s[0], s[1]) for s in f["group_spans"]),
                    }
                )
                for f in files
            )
            for name, files in raw["tables"].items()
        }
        return LogRecord(**raw)
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"the log record cannot be read ({error})",
            change="remove it; the next run reads the log again",
            file=path,
        ) from error
