"""The manifest of outputs: which file has which key. Verified outputs are not made again."""

from __future__ import annotations

import io
import itertools
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from roadscan.core.errors import DamagedError, StoreError
from roadscan.store.digest import bytes_digest, bytes_hold, checked_json, parse_checked
from roadscan.store.records import RECORDS, OutputRecord, Packed, Row, latest, rows_of, sound_rows, table_of, unpacked
from roadscan.store.store import MADE_AGAIN, Store

__all__ = ["Manifest", "OutputRecord", "begin_changes", "end_changes", "read_failures", "write_failures"]

_FOLDER: Final = "manifest/outputs"
_FAILURES: Final = "manifest/failures.json"
_CHANGING: Final = "manifest/changing"
_OLDER: Final = b"older files, too"
_DAMAGED: Final = "damaged"
"""Key of outputs whose files are not as recorded."""
MISSING: Final = "missing"
"""Of an output that is due: it was never finished."""
CHANGED: Final = "changed"
"""Its inputs, settings or code are others than those that it was made with: a key does not tell which."""
DAMAGED: Final = "damaged"
"""Its file is not as recorded."""
_MOST_PARTS: Final = 256
"""Most parts before they are merged: a long run would start by reading thousands of files."""
_BATCH_ROWS: Final = 4096
"""Records that become Python objects together."""
_LOOKS: Final = 10
"""Most times that parts are listed while another run merges them."""

T = TypeVar("T")


@dataclass(frozen=True)
class _Part:
    """A file of records, written once. Parts contain changes, in the order of their numbers."""

    path: str
    rows: int
    records: Packed | None = None
    """Its records, where it was just written and will soon be merged."""


class Manifest:
    """All output records, with one writer at a time (the run with the store's lock).

    Changes are written as a separate part. Parts are merged with those before them that are no more than twice
    as large, so a record is written again as often as the survey doubles, not each time that some tasks end.

    Records stay in tables; only those of products that are asked for one by one become Python's.
    """

    def __init__(self, store: Store, damaged: list[StoreError] | None = None) -> None:
        """Read the parts. A damaged part is an error, or is added to `damaged`, and its sound records are used."""
        self._store = store
        read = read_parts(store)
        faults = [one.fault for one in read if one.fault is not None]
        if faults and damaged is None:
            raise faults[0]
        if damaged is not None:
            damaged += faults
        self._parts = [_Part(one.path, one.table.num_rows) for one in read if one.fault is None]
        self._next = read[-1].number + 1 if read else 0
        self._table, self._moved = latest(pa.concat_tables([RECORDS.empty_table(), *(one.table for one in read)]))
        pa.default_memory_pool().release_unused()  # what was read and merged is as large as the records
        self._behind: list[_Part] = []  # parts that the table does not include yet
        self._rows: dict[str, dict[str, Row]] = {}  # by product and unit, for requested products
        self._found: dict[Callable[[Manifest], Any], Any] = {}
        self._places: dict[str, tuple[int, int]] = {}  # first row and rows of each product

    def get(self, product: str, unit: str) -> OutputRecord | None:
        """Return the record of an output, None where it was never finished."""
        row = self._of(product).get(unit)
        return None if row is None else OutputRecord._make(row)

    def of(self, product: str) -> dict[str, OutputRecord]:
        """Return the records of one product by unit."""
        return {unit: OutputRecord._make(row) for unit, row in self._of(product).items()}

    def all(self) -> list[OutputRecord]:
        """Return all records, by product and unit."""
        return list(map(OutputRecord._make, rows_of(self.table())))

    def beside(self, products: Collection[str], units: Collection[str]) -> list[OutputRecord]:
        """Return the records of some products for all units except these."""
        table = self.table()
        of_products = pc.is_in(table.column("product"), pa.array(sorted(products), pa.string()))
        due = pc.is_in(table.column("unit"), pa.array(list(units), pa.string()))
        return list(map(OutputRecord._make, rows_of(table.filter(pc.and_not(of_products, due)))))

    def chosen(self, product: str, units: Collection[str]) -> list[OutputRecord]:
        """Return the records of some units of a product, without those that have none."""
        table = self.own(product)
        named = pc.is_in(table.column("unit"), pa.array(list(units), pa.string()))
        return list(map(OutputRecord._make, rows_of(table.filter(named))))

    def column(self, product: str, *names: str) -> Iterator[tuple[Any, ...]]:
        """Yield some values of each record of a product, by unit; few of them are Python objects at a time."""
        for batch in self.own(product).select(names).to_batches(max_chunksize=_BATCH_ROWS):
            yield from zip(*(column.to_pylist() for column in batch.columns), strict=True)

    def found(self, make: Callable[[Manifest], T]) -> T:
        """Return what `make` says of the records, as long as they are the same."""
        if make not in self._found:
            self._found[make] = make(self)
        return cast("T", self._found[make])

    def without_file(self, product: str) -> set[str]:
        """Return the units of a product that are finished and have no file."""
        table = self.table()
        found = pc.and_(pc.equal(table.column("product"), product), pc.equal(table.column("path"), ""))
        return set(table.column("unit").filter(found).to_pylist())

    def files(self) -> dict[str, int]:
        """Return the number of files by product."""
        table = self.table()
        found = table.column("product").filter(pc.not_equal(table.column("path"), ""))
        return {one["values"]: one["counts"] for one in found.value_counts().to_pylist()}

    def is_current(self, product: str, unit: str, key: str) -> bool:
        """True if the output has this key and its file is there in its recorded size."""
        return not self.why_due(product, unit, key)

    def why_due(self, product: str, unit: str, key: str) -> str:
        """Why an output is due: `MISSING`, `CHANGED` or `DAMAGED`; empty where it is current."""
        record = self.get(product, unit)
        if record is None:
            return MISSING
        if record.key != key:
            return DAMAGED if record.key == _DAMAGED else CHANGED
        return DAMAGED if record.path and self._store.size(record.path) != record.bytes else ""

    def reasons(self, product: str, units: Sequence[str], keys: Sequence[str]) -> dict[str, str]:
        """Return why outputs are due (:meth:`why_due`), by unit, without those that are current: of many at once."""
        records = self.own(product)
        at = pc.index_in(pa.array(units, pa.string()), records.column("unit"))
        known = records.select(["key", "path", "bytes"]).take(at)
        same = pc.fill_null(pc.equal(known.column("key"), pa.array(keys, pa.string())), False).to_numpy()
        batches = (batch.column(0).to_pylist() for batch in known.select(["path"]).to_batches(_BATCH_ROWS))
        sizes = self._store.sizes(path or "" for paths in batches for path in paths)
        present = np.fromiter((-1 if size is None else size for size in sizes), np.int64, known.num_rows)
        whole = pc.fill_null(pc.equal(known.column("path"), ""), False).to_numpy()
        whole = whole | (present == pc.fill_null(known.column("bytes"), -1).to_numpy())
        odd = np.flatnonzero(~(same & whole))
        stored, is_same = known.column("key").take(pa.array(odd)).to_pylist(), same[odd].tolist()
        return {
            units[place]: MISSING if key is None else DAMAGED if fits or key == _DAMAGED else CHANGED
            for place, key, fits in zip(odd.tolist(), stored, is_same, strict=True)
        }

    def add(self, records: Iterable[OutputRecord]) -> None:
        """Record finished outputs durably. :meth:`settle` removes files under older names."""
        added = list(records)
        if not added:
            return
        known = [self._of(r.product).get(r.unit) for r in added]
        for r in added:
            self._rows[r.product][r.unit] = (*r,)
        self._store.told((r.path, r.bytes) for r in added if r.path and r.key != _DAMAGED)
        self._append(Packed.of(table_of(added)))
        pairs = zip(known, added, strict=True)
        self._moved += [old[3] for old, new in pairs if old is not None and old[3] not in ("", new.path)]

    def add_packed(self, records: Packed) -> None:
        """Record many outputs as a worker packed them."""
        if records.rows:
            self._rows.clear()
            if not self._store.is_folder:
                table = records.table()
                paths, sizes = (table.column(name).to_pylist() for name in ("path", "bytes"))
                self._store.told(pair for pair in zip(paths, sizes, strict=True) if pair[0])
            self._append(records)

    def settle(self) -> None:
        """Remove files under older names that no output has any more, including those that a killed run left."""
        table = self.table()
        if self._moved:
            moved = pa.array(sorted(set(self._moved)), pa.string())
            for path in moved.filter(pc.invert(pc.is_in(moved, table.column("path")))).to_pylist():
                self._store.remove(path)
            self._moved.clear()

    def remove(self, records: Iterable[OutputRecord]) -> None:
        """Forget outputs and remove their files."""
        gone = list(records)
        if not gone:
            return
        self._forget([(r.product, r.unit) for r in gone])
        for r in gone:
            if r.path:
                self._store.remove(r.path)

    def forget(self, product: str, units: Iterable[str]) -> None:
        """Delete the records of outputs that could not be made again: their files stay, but count as stale."""
        known = [(product, u) for u in units if u in self._of(product)]
        if known:
            begin_changes(self._store, older=True)
            self._forget(known)

    def doubt(self, records: Iterable[OutputRecord]) -> None:
        """Mark outputs with damaged files as stale; their records stay, so that readers get an error."""
        self.add(record._replace(key=_DAMAGED) for record in records)

    def doubt_files(self, paths: Collection[str]) -> None:
        """Mark the outputs of files as stale, given their full paths as in errors; unknown files are ignored."""
        if paths:
            table = self.table()
            below_root = pa.array(sorted(path.removeprefix(f"{self._store.root}/") for path in paths), pa.string())
            self.doubt(map(OutputRecord._make, rows_of(table.filter(pc.is_in(table.column("path"), below_root)))))

    def compact(self) -> None:
        """Merge all parts into one, without deleted records."""
        self.settle()
        old, self._parts = self._parts, []
        self._write(Packed.of(self._table, "lz4"))
        for part in old:
            self._store.remove(part.path)

    def _of(self, product: str) -> dict[str, Row]:
        """Return the rows of a product by unit."""
        rows = self._rows.get(product)
        if rows is None:
            rows = self._rows[product] = {row[1]: row for row in rows_of(self.own(product))}
        return rows

    def own(self, product: str) -> pa.Table:
        """Return the records of a product, which stand together."""
        table = self.table()
        if not self._places:
            counts = table.column("product").value_counts().to_pylist()
            ends = itertools.accumulate(one["counts"] for one in counts)
            self._places = {
                one["values"]: (end - one["counts"], one["counts"]) for one, end in zip(counts, ends, strict=True)
            }
        return table.slice(*self._places.get(product, (0, 0)))

    def table(self) -> pa.Table:
        """Return every record, by product and unit."""
        if self._behind:
            news, self._behind = list(map(self._read, self._behind)), []
            self._table, moved = latest(pa.concat_tables([self._table, *news]))
            self._places.clear()
            self._moved += moved
        return self._table

    def _forget(self, outputs: list[tuple[str, str]]) -> None:
        for product, unit in outputs:
            self._rows.get(product, {}).pop(unit, None)
        self._append(Packed.of(table_of([(product, unit, "", "", 0, "", "") for product, unit in outputs])))

    def _append(self, records: Packed) -> None:
        self._found.clear()
        self._behind.append(self._write(records, keep=True))
        if len(self._parts) > _MOST_PARTS:
            self._merge()

    def _merge(self) -> None:
        """Merge the last parts into an equivalent one, without recording which files moved."""
        self.settle()
        rows = self._parts[-1].rows
        first = len(self._parts) - 1
        while first and (first > _MOST_PARTS // 2 or self._parts[first - 1].rows <= 2 * rows):
            first -= 1
            rows += self._parts[first].rows
        old = self._parts[first:]
        table, _ = latest(pa.concat_tables(list(map(self._read, old))), forgotten=True)
        del self._parts[first:]
        self._write(Packed.of(table, "lz4"))
        for part in old:  # where these stay, the new part repeats their records
            self._store.remove(part.path)

    def _read(self, part: _Part) -> pa.Table:
        return unpacked(self._store.read_bytes(part.path)) if part.records is None else part.records.table()

    def _write(self, records: Packed, keep: bool = False) -> _Part:
        path = part_path(self._next)
        self._store.write_bytes(path, records.content)
        self._next += 1
        self._parts.append(_Part(path, records.rows, records if keep else None))
        return self._parts[-1]


@dataclass(frozen=True)
class ReadPart:
    """A part as it was read."""

    path: str
    table: pa.Table
    """Its records; the sound ones where it is damaged."""
    fault: StoreError | None

    @property
    def number(self) -> int:
        """Number that orders the parts."""
        return int(self.path.rsplit("-", 1)[1].removesuffix(".parquet"))


def part_path(number: int) -> str:
    """Return the file of a part, relative to the survey's root."""
    return f"{_FOLDER}/part-{number:08d}.parquet"


def read_parts(store: Store) -> list[ReadPart]:
    """Return the parts with their records, in order; they are listed again if a running merge removed some.

    Raises
    ------
    StoreError
        Parts vanish again and again while they are read.
    """
    looks = 0
    while True:
        looks += 1
        paths = store.files(_FOLDER, ".parquet")
        try:
            return [_read_part(store, path) for path in paths]
        except StoreError:
            if looks == _LOOKS:
                raise


def _read_part(store: Store, path: str) -> ReadPart:
    try:
        content = store.read_bytes(path)
    except StoreError as error:
        if not store.exists(path):
            raise
        return ReadPart(path, RECORDS.empty_table(), error)
    table, reason = sound_rows(content)
    fault = DamagedError(
        f"this part of the manifest is damaged: {reason}",
        expected="a Parquet file of records of outputs",
        change="the next run sets it aside and makes again what it alone told of",
        file=store.path(path),
    )
    return ReadPart(path, table, fault if reason else None)


def read_recorded(store: Store, record: OutputRecord) -> bytes:
    """Return the content of an output's file, verified against its record.

    Raises
    ------
    DamagedError
        It is missing, or another.
    """
    try:
        content = store.read_bytes(record.path)
    except StoreError as error:
        if store.exists(record.path):
            raise
        raise DamagedError(error.arrived, change=MADE_AGAIN, file=error.file) from error
    if record.digest and not bytes_hold(content, record.digest):
        raise DamagedError("the file is not as it was recorded", change=MADE_AGAIN, file=store.path(record.path))
    return content


def recorded_table(store: Store, record: OutputRecord, columns: Sequence[str] | None = None) -> pa.Table:
    """Return an output that is a Parquet file, or some of its columns, verified as by :func:`read_recorded`."""
    return store.parse_table(read_recorded(store, record), record.path, columns)


def publish_table(store: Store, rows: pa.Table, name: str, unit: str, key: str, detail: str) -> OutputRecord:
    """Write the rows of a unit as a file of that name's table; return its record for the manifest."""
    stream = io.BytesIO()
    pq.write_table(rows, stream, compression="zstd", write_page_checksum=True, version="2.6")
    content, target = stream.getvalue(), f"tables/{name}/{unit}.parquet"
    store.write_bytes(target, content, lasting=False)
    return OutputRecord(name, unit, key, target, len(content), bytes_digest(content), detail)


def recorded_rows(store: Store, records: Iterable[OutputRecord]) -> list[dict[str, Any]]:
    """Return the rows of outputs that are Parquet files, each verified as by :func:`read_recorded`."""
    files = (record for record in records if record.path)
    return [row for r in files for row in recorded_table(store, r).to_pylist()]


def is_changing(store: Store) -> bool:
    """Return whether a run is at work, or ended before all was done."""
    return store.exists(_CHANGING)


def begin_changes(store: Store, *, older: bool = False) -> bool:
    """Note that the store may contain unrecorded files from now on; return True where that was already noted.

    A run that is killed leaves files that it had not recorded yet. With other settings the next one would make others,
    and those would stay. `older` says that files which lie there already lost their record, too.
    """
    before = store.exists(_CHANGING)
    if not before or (older and not store.read_bytes(_CHANGING)):
        store.write_bytes(_CHANGING, _OLDER if older else b"")
    return before


def end_changes(store: Store, manifest: Manifest, folders: Iterable[str]) -> list[str]:
    """Remove unrecorded files below some folders once every due output has a record; return their paths.

    What lay there before the run that was killed began is nothing of its making, and stays.
    """
    listed = set(manifest.table().column("path").to_pylist())
    began = 0 if store.exists(_CHANGING) and store.read_bytes(_CHANGING) else _changed_ns(store, _CHANGING)
    removed = [
        path
        for folder in folders
        for path in store.files(folder)
        if path not in listed and _changed_ns(store, path) >= began
    ]
    for path in removed:
        store.remove(path)
    store.remove(_CHANGING)
    return removed


def _changed_ns(store: Store, path: str) -> int:
    """Return when a file was written (Unix ns), 0 where the store is no folder."""
    return Path(store.path(path)).stat().st_mtime_ns if store.is_folder and store.exists(path) else 0


def write_failures(store: Store, failures: list[dict[str, str]]) -> None:
    """Store what failed in the last run, for `roadscan status`."""
    store.write_bytes(_FAILURES, checked_json({"failures": failures}), lasting=False)


def read_failures(store: Store) -> list[dict[str, str]]:
    """Return what failed in the last run: unit, error."""
    if not store.exists(_FAILURES):
        return []
    try:
        content = store.read_bytes(_FAILURES)
        # older versions wrote a list without a checksum
        listed = json.loads(content) if content.startswith(b"[") else parse_checked(content)["failures"]
        return [{name: str(failure[name]) for name in ("stage", "unit", "reason")} for failure in listed]
    except (StoreError, ValueError, KeyError, TypeError) as error:
        return [{"stage": "the list of failures", "unit": _FAILURES, "reason": f"it is damaged ({error}); run again"}]
