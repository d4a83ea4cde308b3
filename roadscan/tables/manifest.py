"""The manifest of outputs: which file has which key. What is there and verified is not made again."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.tables.store import Store

_FOLDER: Final = "manifest/outputs"
_COMPACT_AT: Final = 64
_SCHEMA: Final = pa.schema(
    [
        ("product", pa.string()),
        ("unit", pa.string()),
        ("key", pa.string()),
        ("path", pa.string()),
        ("bytes", pa.int64()),
        ("digest", pa.string()),
        ("detail", pa.string()),
    ]
)


@dataclass(frozen=True)
class OutputRecord:
    """One finished file (or a finished unit without a file, where `path` is empty)."""

    product: str
    """Product, or 'footprints', or 'tile' for the tile as a whole."""
    unit: str
    """Tile id, output name, or log key."""
    key: str
    """Hash of its inputs, of the configuration that matters to it, and of the code."""
    path: str
    """Relative to the survey's root."""
    bytes: int
    digest: str
    """BLAKE2b-128 of the file."""
    detail: str = ""
    """JSON with figures that later stages need."""

    def figures(self) -> dict[str, Any]:
        """The detail as values."""
        return dict(json.loads(self.detail)) if self.detail else {}


class Manifest:
    """All output records; one writer at a time (the run that holds the store's lock)."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._parts = store.files(_FOLDER, ".parquet")
        self._records: dict[tuple[str, str], OutputRecord] = {}
        for part in self._parts:
            for row in pq.read_table(io.BytesIO(store.read_bytes(part))).to_pylist():
                record = OutputRecord(**row)
                if record.key:
                    self._records[(record.product, record.unit)] = record
                else:
                    self._records.pop((record.product, record.unit), None)

    def get(self, product: str, unit: str) -> OutputRecord | None:
        """Record of an output, None where it was never finished."""
        return self._records.get((product, unit))

    def of(self, product: str) -> dict[str, OutputRecord]:
        """Records of one product by unit."""
        return {unit: r for (name, unit), r in self._records.items() if name == product}

    def all(self) -> list[OutputRecord]:
        """All records, by product and unit."""
        return [self._records[k] for k in sorted(self._records)]

    def is_current(self, product: str, unit: str, key: str) -> bool:
        """True if the output has this key and its file is there in its recorded size."""
        record = self.get(product, unit)
        if record is None or record.key != key:
            return False
        return not record.path or self._store.size(record.path) == record.bytes

    def add(self, records: Iterable[OutputRecord]) -> None:
        """Record finished outputs; durable when this returns. A file under an older name is removed."""
        added = list(records)
        if not added:
            return
        known = [self.get(r.product, r.unit) for r in added]
        for r in added:
            self._records[(r.product, r.unit)] = r
        self._append(added)
        for old, new in zip(known, added, strict=True):
            if old is not None and old.path not in ("", new.path):
                self._store.remove(old.path)

    def remove(self, records: Iterable[OutputRecord]) -> None:
        """Forget outputs and remove their files."""
        gone = list(records)
        if not gone:
            return
        for r in gone:
            self._records.pop((r.product, r.unit), None)
        self._append([OutputRecord(r.product, r.unit, "", "", 0, "") for r in gone])
        for r in gone:
            if r.path:
                self._store.remove(r.path)

    def forget(self, product: str, units: Iterable[str]) -> None:
        """Drop the records of outputs that could not be made again: their files stay, but count as stale."""
        known = [u for u in units if self._records.pop((product, u), None) is not None]
        if known:
            self._append([OutputRecord(product, u, "", "", 0, "") for u in known])

    def compact(self) -> None:
        """Bring all parts into one."""
        old = self._parts
        self._parts = []
        self._append(self.all(), number=_number(old[-1]) + 1 if old else 0)
        for part in old:
            self._store.remove(part)

    def _append(self, records: list[OutputRecord], number: int | None = None) -> None:
        if number is None:
            number = _number(self._parts[-1]) + 1 if self._parts else 0
        path = f"{_FOLDER}/part-{number:08d}.parquet"
        buffer = io.BytesIO()
        columns = [pa.array([getattr(r, field.name) for r in records], field.type) for field in _SCHEMA]
        pq.write_table(pa.Table.from_arrays(columns, schema=_SCHEMA), buffer)
        self._store.write_bytes(path, buffer.getvalue())
        self._parts.append(path)
        if len(self._parts) > _COMPACT_AT:
            self.compact()


def _number(part: str) -> int:
    return int(part.rsplit("-", 1)[1].removesuffix(".parquet"))


def write_failures(store: Store, failures: list[dict[str, str]]) -> None:
    """Keep what failed in the last run, for `roadscan status`."""
    store.write_bytes("manifest/failures.json", json.dumps(failures, indent=1).encode())


def read_failures(store: Store) -> list[dict[str, str]]:
    """What failed in the last run: unit, error."""
    if not store.exists("manifest/failures.json"):
        return []
    return list(json.loads(store.read_bytes("manifest/failures.json")))
