"""The manifest of outputs: which file has which key. What is there and verified is not made again."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeAlias

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.tables.store import Store

_FOLDER: Final = "manifest/outputs"
_MOST_PARTS: Final = 64
"""More parts than that are merged: a long run would begin with thousands of files to read."""
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


class OutputRecord(NamedTuple):
    """One finished file (or a finished unit without a file, where `path` is empty). A network has millions."""

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


_Row: TypeAlias = tuple[str, str, str, str, int, str, str]


@dataclass(frozen=True)
class _Part:
    """A file of records, written once. Parts hold what changed, in the order of their numbers."""

    path: str
    rows: int
    table: pa.Table | None = None
    """Its rows, where they were written a moment ago and are soon merged."""

    @property
    def number(self) -> int:
        """Its place among the parts."""
        return int(self.path.rsplit("-", 1)[1].removesuffix(".parquet"))


class Manifest:
    """All output records; one writer at a time (the run that holds the store's lock).

    What changes is written as a part of its own. Parts are merged with those before them that are no more than twice
    as large, so a record is written again as often as the survey doubles, not each time that some tasks end.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._parts: list[_Part] = []
        # Bare tuples by product and unit: Python's collector walks over every named one again and again.
        self._rows: dict[str, dict[str, _Row]] = {}
        for path in store.files(_FOLDER, ".parquet"):
            table = self._read(path)
            self._parts.append(_Part(path, table.num_rows))
            for row in zip(*(table.column(field.name).to_pylist() for field in _SCHEMA), strict=True):
                if row[2]:
                    self._keep(row)
                else:
                    self._drop(row[0], row[1])

    def get(self, product: str, unit: str) -> OutputRecord | None:
        """Record of an output, None where it was never finished."""
        row = self._rows.get(product, {}).get(unit)
        return None if row is None else OutputRecord._make(row)

    def of(self, product: str) -> dict[str, OutputRecord]:
        """Records of one product by unit."""
        return {unit: OutputRecord._make(row) for unit, row in self._rows.get(product, {}).items()}

    def all(self) -> list[OutputRecord]:
        """All records, by product and unit."""
        return list(map(OutputRecord._make, self._sorted()))

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
        known = [self._rows.get(r.product, {}).get(r.unit) for r in added]
        for r in added:
            self._keep((*r,))
        self._append(added)
        for old, new in zip(known, added, strict=True):
            if old is not None and old[3] not in ("", new.path):
                self._store.remove(old[3])

    def remove(self, records: Iterable[OutputRecord]) -> None:
        """Forget outputs and remove their files."""
        gone = list(records)
        if not gone:
            return
        for r in gone:
            self._drop(r.product, r.unit)
        self._append([OutputRecord(r.product, r.unit, "", "", 0, "") for r in gone])
        for r in gone:
            if r.path:
                self._store.remove(r.path)

    def forget(self, product: str, units: Iterable[str]) -> None:
        """Drop the records of outputs that could not be made again: their files stay, but count as stale."""
        known = [u for u in units if self._drop(product, u) is not None]
        if known:
            self._append([OutputRecord(product, u, "", "", 0, "") for u in known])

    def _keep(self, row: _Row) -> None:
        self._rows.setdefault(row[0], {})[row[1]] = row

    def _drop(self, product: str, unit: str) -> _Row | None:
        return self._rows.get(product, {}).pop(unit, None)

    def _sorted(self) -> list[_Row]:
        return [own[unit] for _, own in sorted(self._rows.items()) for unit in sorted(own)]

    def compact(self) -> None:
        """Bring all parts into one, without what is no more."""
        old, self._parts = self._parts, []
        self._write(_table(self._sorted()), old[-1].number + 1 if old else 0)
        for part in old:
            self._store.remove(part.path)

    def _append(self, records: list[OutputRecord]) -> None:
        table = _table(records)
        self._write(table, self._parts[-1].number + 1 if self._parts else 0, keep=True)
        if len(self._parts) > _MOST_PARTS:
            self._merge()

    def _merge(self) -> None:
        """Bring the last parts into one, which says the same as these in their order."""
        rows = self._parts[-1].rows
        first = len(self._parts) - 1
        while first and (first > _MOST_PARTS // 2 or self._parts[first - 1].rows <= 2 * rows):
            first -= 1
            rows += self._parts[first].rows
        old = self._parts[first:]
        self._parts = self._parts[:first]
        tables = [self._read(part.path) if part.table is None else part.table for part in old]
        self._write(pa.concat_tables(tables), old[-1].number + 1)
        for part in old:  # where these stay, the new part says once more what they say
            self._store.remove(part.path)

    def _read(self, path: str) -> pa.Table:
        return self._store.read_table(path)

    def _write(self, table: pa.Table, number: int, keep: bool = False) -> None:
        path = f"{_FOLDER}/part-{number:08d}.parquet"
        buffer = io.BytesIO()
        pq.write_table(table, buffer, use_dictionary=["product"], write_statistics=False)
        self._store.write_bytes(path, buffer.getvalue())
        self._parts.append(_Part(path, table.num_rows, table if keep else None))


def _table(rows: Sequence[_Row]) -> pa.Table:
    columns = list(zip(*rows, strict=True)) or [()] * len(_SCHEMA)
    return pa.Table.from_arrays([pa.array(c, f.type) for c, f in zip(columns, _SCHEMA, strict=True)], schema=_SCHEMA)


def write_failures(store: Store, failures: list[dict[str, str]]) -> None:
    """Keep what failed in the last run, for `roadscan status`."""
    store.write_bytes("manifest/failures.json", json.dumps(failures, indent=1).encode())


def read_failures(store: Store) -> list[dict[str, str]]:
    """What failed in the last run: unit, error."""
    if not store.exists("manifest/failures.json"):
        return []
    return list(json.loads(store.read_bytes("manifest/failures.json")))
