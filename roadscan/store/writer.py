"""Writes rows as sorted partitions of GPS time, and merges sorted files of one partition, both in bounded memory.

Computes columns from incoming rows, so that no log has to contain them.

They stand beside the raw readings for their statistics: a reader learns what a row group holds without decoding it.
"""

from __future__ import annotations

import itertools
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.compute.array_types import Int64
from roadscan.compute.kernels.arrays import range_bounds
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding
from roadscan.store.digest import file_digest
from roadscan.store.logs import DataFile, log_folder
from roadscan.store.readings.packed_returns import PACKED, as_returns, stored_columns, write_packed_returns
from roadscan.store.schema import TableSchema, table_schema
from roadscan.store.small_tables import parquet_bytes, write_by_arrow  # noqa: F401 — stages elsewhere import it here
from roadscan.store.store import Store, count_put

_WORD_BITS: Final = 64  # bits of the number that rows are sorted by: key and row number

Array = npt.NDArray[Any]


def sorted_rows(schema: TableSchema, rows: pa.Table) -> pa.Table:
    """Return rows in the schema's order; equal keys keep their input order."""
    pieces, is_new = list[pa.RecordBatch](), False
    for stretch in _stretches(rows, schema.sort[0]):
        if in_order(_keys(schema, stretch)):
            pieces += stretch.to_batches()
        else:
            pieces.append(sorted_batch(schema, stretch.combine_chunks().to_batches()[0]))
            is_new = True
    return pa.Table.from_batches(pieces, rows.schema) if is_new else rows


def sorted_batch(schema: TableSchema, rows: pa.RecordBatch) -> pa.RecordBatch:
    """Return the same of a batch. Columns that share their memory share it again."""
    keys = _keys(schema, rows)
    if in_order(keys):
        return rows
    order, found = ordered(keys)
    done = {_place(rows.column(name)): values for name, values in zip(schema.sort, found, strict=True)}
    indices, columns = pa.array(order), []
    for column in rows.columns:
        place = _place(column)
        if not pa.types.is_primitive(column.type) or column.null_count:
            columns.append(column.take(indices))
            continue
        if place not in done:
            done[place] = _in(order, column.to_numpy(zero_copy_only=False))
        columns.append(pa.array(done[place], column.type))
    return pa.RecordBatch.from_arrays(columns, schema=rows.schema)


def ordered(keys: Sequence[Array]) -> tuple[Int64, list[Array]]:
    """Return the stable order (n,) of rows by their keys (n,), the first key foremost, and the keys in that order.

    Where keys and row numbers fit into 64 bits together, such numbers are sorted: that is faster than by key and key.
    """
    rows = keys[0].size
    row_bits = max(rows - 1, 0).bit_length()
    lows, widths = [0], [_WORD_BITS + 1]
    if rows and all(key.dtype.kind in "iu" for key in keys):
        lows = [int(key.min()) for key in keys]
        widths = [(int(key.max()) - low).bit_length() for key, low in zip(keys, lows, strict=True)]
    if sum(widths) + row_bits > _WORD_BITS:
        order = np.lexsort(keys[::-1])
        return order, [key[order] for key in keys]
    # Differences fit as numbers without a sign, those of the widest integers too.
    above = [(key - key.dtype.type(low)).view(f"u{key.itemsize}") for key, low in zip(keys, lows, strict=True)]
    packed = above[0].astype(np.uint64)
    for values, width in zip([*above[1:], np.arange(rows)], [*widths[1:], row_bits], strict=True):
        packed <<= np.uint64(width)
        packed |= values.astype(np.uint64, copy=False)
    packed.sort()
    order = (packed & _low_bits(row_bits)).view(np.int64)
    packed >>= np.uint64(row_bits)
    found: list[Array] = []
    for key, low, width in zip(keys[:0:-1], lows[:0:-1], widths[:0:-1], strict=True):
        found.append((packed & _low_bits(width)).astype(key.dtype) + key.dtype.type(low))
        packed >>= np.uint64(width)
    found.append(packed.astype(keys[0].dtype) + keys[0].dtype.type(lows[0]))
    return order, found[::-1]


def _low_bits(count: int) -> np.uint64:
    return np.uint64((1 << count) - 1)


def in_order(keys: Sequence[Array]) -> bool:
    """Return True if rows are in order of these keys, the first foremost; names are compared only where they lead."""
    if keys[0].size < 2:
        return True
    tied: npt.NDArray[np.bool_] | None = None  # rows that equal the row before them so far
    for key in keys:
        if key.dtype.kind == "O" and len(keys) > 1:
            return tied is not None and not tied.any()
        rises = key[1:] >= key[:-1]  # false also where one is no number
        if not (rises.all() if tied is None else (rises | ~tied).all()):
            return False
        same = key[1:] == key[:-1]
        tied = same if tied is None else tied & same
        if not tied.any():
            return True
    return True


def _stretches(rows: pa.Table, leading: str) -> Iterator[pa.Table]:
    """Yield rows batch by batch in the order of the leading column, those that overlap in it together."""
    if rows.schema.field(leading).type != pa.int64() or rows.column(leading).null_count:
        yield rows
        return
    found: list[tuple[list[pa.RecordBatch], int]] = []  # batches of each stretch, and its last epoch
    for batch in filter(len, rows.to_batches()):
        keys = batch.column(leading).to_numpy()
        own, first, last = [batch], keys.min(), keys.max()
        while found and first <= found[-1][1]:  # at one epoch, the next key decides
            before, end = found.pop()
            before += own
            own, last = before, max(last, end)
        found.append((own, last))
    yield from (pa.Table.from_batches(own) for own, _ in found)


def _keys(schema: TableSchema, rows: pa.Table | pa.RecordBatch) -> list[Array]:
    return [np.asarray(rows.column(name)) for name in schema.sort]


def _place(column: pa.Array) -> tuple[object, ...]:
    """Return the memory of an array: equal for arrays that share it."""
    return column.type, column.offset, *(buffer and buffer.address for buffer in column.buffers())


def _in(order: Int64, values: Array) -> Array:
    """Return numbers (n,) in an order; whole numbers that are all equal are returned as they are, without a copy."""
    if values.dtype.kind in "iu" and values[0] == values[-1] and (values == values[0]).all():
        return values
    return np.asarray(values[order])


BUDGET_BYTES: Final = 128 << 20
"""Bytes of rows in memory before the fullest partitions are written."""

_LATE_NS: Final = 50_000_000
"""Rows of so much time at the end of a partition stay in memory while more may come: stamps of a log jitter, and a few
rows that come late would make a whole partition be merged."""


@dataclass
class _Bin:
    batches: list[pa.RecordBatch] = field(default_factory=list)
    bytes: int = 0
    row_bytes: float = 1.0
    """Bytes of a row: the largest average of a batch."""
    parts: list[tuple[Path, int, int]] = field(default_factory=list)
    """Written parts with their first and last epoch."""


def _once(
    faults: Sequence[tuple[npt.NDArray[np.int64], str]]
) -> list[tuple[npt.NDArray[np.int64], str]]:  # fmt: skip
    """Return the faults with each row only under its first reason."""
    found: list[tuple[npt.NDArray[np.int64], str]] = []
    for rows, reason in faults:
        rest = np.setdiff1d(rows, np.concatenate([bad for bad, _ in found])) if found else rows
        if rest.size:
            found.append((rest, reason))
    return found


class LogWriter:
    """Writes the rows of one log; nothing is visible before :meth:`publish`."""

    def __init__(self, folder: Path, list_size: int | None) -> None:
        self._folder = folder
        self._list_size = list_size
        self._bins: dict[tuple[str, int], _Bin] = defaultdict(_Bin)
        self._held = 0
        self.rows: Counter[str] = Counter()
        self.reject_reasons: Counter[str] = Counter()
        self.findings: list[Finding] = []
        """Findings on the log; stored in its record."""

    def add(
        self, table: str, batch: pa.RecordBatch, refused: Sequence[tuple[npt.NDArray[np.int64], str]] = ()
    ) -> list[tuple[npt.NDArray[np.int64], str]]:
        """Add rows of a table; return the rows refused, with their reasons: those `refused` already, and others."""
        schema = table_schema(table)
        rows = schema.conform(batch, self._list_size)
        faults = _once([*refused, *schema.faults(rows)])
        if faults:
            good = np.ones(rows.num_rows, dtype=bool)
            for bad, _ in faults:
                good[bad] = False
            rows = rows.filter(pa.array(good))
        rows = with_derived(schema, rows)
        for start, part in _by_bin(schema, rows):
            held = self._bins[(table, start)]
            held.batches.append(sorted_batch(schema, part))  # while it is in the processor's cache
            held.bytes += part.nbytes
            held.row_bytes = max(held.row_bytes, part.nbytes / part.num_rows)
            self._held += part.nbytes
        self.rows[schema.rows_of] += rows.num_rows
        while self._held > BUDGET_BYTES:
            self._flush(max(self._bins, key=lambda k: self._bins[k].bytes), may_go_on=True)
        return faults

    def reject(self, file: str, record: int, offset: int, records: int, reason: str) -> None:
        """List a record that could not be used."""
        row = {"file": [file], "record": [record], "offset": [offset], "records": [records], "reason": [reason]}
        self.add("rejects", pa.RecordBatch.from_pydict(row))
        self.reject_reasons[reason] += records

    def finish(self) -> None:
        """Write the remaining rows and merge parts that overlap in time."""
        for key in sorted(self._bins):
            self._flush(key)
        for (table, start), held in sorted(self._bins.items()):
            if _overlap(held.parts):
                held.parts = self._merge(table, start, held)

    def tables(self, table: str, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """Yield the rows of a finished table, file by file, in order of time."""
        for key in self._keys_of(table):
            for path, _, _ in self._bins[key].parts:
                own = stored_columns(columns, [c.name for c in table_schema(key[0]).columns])
                yield as_returns(pq.read_table(path, columns=own, partitioning=None), columns)

    def _keys_of(self, table: str) -> list[tuple[str, int]]:
        """Return the keys of the bins with rows of a table, in any form, in order of time."""
        return sorted(key for key in self._bins if table_schema(key[0]).rows_of == table)

    def leave_out(
        self,
        table: str,
        is_out: Callable[[pa.Table], npt.NDArray[np.bool_]],
        may_be_out: Callable[[npt.NDArray[np.int64]], bool] = lambda _: True,
    ) -> int:
        """Take rows out of a finished table; return how many.

        Parameters
        ----------
        is_out : returns which rows of a file (n,), in order of time, are taken out.
        may_be_out : returns, by the epochs of a file, whether any of its rows can be.
        """
        left_out = 0
        for key in self._keys_of(table):
            parts, self._bins[key].parts = self._bins[key].parts, []
            for path, first, last in parts:
                epochs = pq.read_table(path, columns=["epoch_gps_ns"], partitioning=None).column(0).to_numpy()
                rows = pq.read_table(path, partitioning=None) if may_be_out(epochs) else None
                out = np.zeros(epochs.size, dtype=bool) if rows is None else is_out(as_returns(rows))
                if rows is not None and out.any():
                    path.unlink()
                    if not out.all():
                        write_parquet(path, rows.filter(pa.array(~out)), table_schema(key[0]))
                if not out.all():
                    self._bins[key].parts.append((path, first, last))
                left_out += int(out.sum())
        self.rows[table] -= left_out
        return left_out

    def publish(self, store: Store, run: str, sensor: str, key: str) -> dict[str, tuple[DataFile, ...]]:
        """Move the finished tables into the store, each atomically."""
        out = self.files(run, sensor, key)
        for table in {t for t, _ in self._bins}:
            store.publish_folder(self._folder / table, log_folder(table, run, sensor, key))
        count_put(sum(file.bytes for own in out.values() for file in own.values()))
        return {table: tuple(files.values()) for table, files in out.items()}

    def files(self, run: str, sensor: str, key: str) -> dict[str, dict[Path, DataFile]]:
        """Return finished files by table and present path, as :meth:`publish` would record them."""
        out: dict[str, dict[Path, DataFile]] = {}
        for table in sorted({t for t, _ in self._bins}):
            local = self._folder / table
            target = log_folder(table, run, sensor, key)
            found = sorted(local.rglob("*.parquet"))
            out[table_schema(table).rows_of] = {
                p: describe(p, f"{target}/{p.relative_to(local).as_posix()}") for p in found
            }
        return out

    def _flush(self, key: tuple[str, int], *, may_go_on: bool = False) -> None:
        """Write the rows of a partition; the latest of them stay where more may come."""
        held = self._bins[key]
        if not held.batches:
            return
        table, start = key
        rows, late = pa.Table.from_batches(held.batches), None
        if may_go_on:
            rows, late = _parted(table_schema(table), rows)
        self._held -= held.bytes
        held.batches = [] if late is None else [late]
        held.bytes = 0 if late is None else late.nbytes
        self._held += held.bytes
        held.parts.append(self._write(table, start, len(held.parts), rows))

    def _merge(self, table: str, start: int, held: _Bin) -> list[tuple[Path, int, int]]:
        """Merge parts into consecutive ones in time, none larger than the rows in memory."""
        apart = held.parts[0][0].parent / "overlapping"
        apart.mkdir()
        moved = [path.rename(apart / path.name) for path, _, _ in held.parts]
        rows = max(1, int(BUDGET_BYTES / held.row_bytes))
        parts = [
            self._write(table, start, number, piece)
            for number, piece in enumerate(merged(moved, table_schema(table), rows))
        ]
        shutil.rmtree(apart)
        return parts

    def _write(self, table: str, start: int, number: int, rows: pa.Table) -> tuple[Path, int, int]:
        schema = table_schema(table)
        folder = self._folder / table
        if schema.partition_s is not None:
            folder = folder / f"gps_bin_s={start}"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"part-{number:05d}.parquet"
        rows = sorted_rows(schema, rows)
        write_parquet(path, rows, schema)
        if schema.partition_s is None:
            return path, number, number
        epochs = rows.column("epoch_gps_ns")
        return path, epochs[0].as_py(), epochs[-1].as_py()


def write_parquet(path: Path, rows: pa.Table, schema: TableSchema) -> None:
    """Write rows in the encodings that measured best for their kind; equal rows give equal bytes."""
    if schema.name == PACKED:
        write_packed_returns(path, rows, schema.row_group_rows)
        return
    from roadscan.store.codecs.parquet.tables import (
        is_list_table,
        is_number_table,
        write_list_table,
        write_number_table,
    )

    if is_list_table(rows.schema):
        write_list_table(path, rows, schema.row_group_rows)
        return
    if schema.compression == "lz4" and is_number_table(rows.schema):
        write_number_table(path, rows, schema.row_group_rows)
        return
    write_by_arrow(path, rows, schema)


def _by_bin(schema: TableSchema, rows: pa.RecordBatch) -> list[tuple[int, pa.RecordBatch]]:
    if rows.num_rows == 0:
        return []
    if schema.partition_s is None:
        return [(0, rows)]
    epochs = rows.column("epoch_gps_ns").to_numpy()
    bin_ns = schema.partition_s * NS_PER_S
    if (first := int(epochs.min()) // bin_ns) == int(epochs.max()) // bin_ns:
        return [(first * schema.partition_s, rows)]
    starts = epochs // bin_ns * schema.partition_s
    return [(int(s), rows.filter(pa.array(starts == s))) for s in np.unique(starts)]


def _parted(schema: TableSchema, rows: pa.Table) -> tuple[pa.Table, pa.RecordBatch | None]:
    """Return rows without the latest ones, in order, and a copy of these; None where none is earlier."""
    if schema.partition_s is None:
        return rows, None
    ordered = sorted_rows(schema, rows)
    epochs = ordered.column("epoch_gps_ns").to_numpy()
    count = int(np.searchsorted(epochs, epochs[-1] - _LATE_NS, side="right"))
    if count == 0:
        return rows, None
    # A slice would keep all rows in memory.
    late = ordered.slice(count).take(pa.array(np.arange(ordered.num_rows - count))).combine_chunks()
    return ordered.slice(0, count), late.to_batches()[0]


def _overlap(parts: list[tuple[Path, int, int]]) -> bool:
    return any(later[1] < earlier[2] for earlier, later in itertools.pairwise(parts))


def describe(path: Path, relative: str) -> DataFile:
    """Return a record's entry for a finished local file that will be at `relative`."""
    metadata = pq.read_metadata(path)
    groups = [metadata.row_group(k) for k in range(metadata.num_row_groups)]
    spans: list[tuple[int, int]] = []
    if metadata.num_row_groups and "epoch_gps_ns" in metadata.schema.names:
        column = metadata.schema.names.index("epoch_gps_ns")
        statistics: list[Any] = [g.column(column).statistics for g in groups]
        spans = [(int(s.min), int(s.max)) for s in statistics]
    return DataFile(
        path=relative,
        rows=metadata.num_rows,
        bytes=path.stat().st_size,
        digest=file_digest(path),
        group_rows=[g.num_rows for g in groups],
        group_spans=spans,
    )


def with_derived(schema: TableSchema, rows: pa.RecordBatch) -> pa.RecordBatch:
    """Return the rows of a table with computed derived columns, whatever these contained."""
    if schema.name != "scans":
        return rows
    lists = rows.column("range")
    ranges = lists.flatten().to_numpy().reshape(rows.num_rows, lists.type.list_size)
    low, high = np.empty(rows.num_rows, np.uint16), np.empty(rows.num_rows, np.uint16)
    range_bounds(ranges, low, high)
    for name, values in (("range_low", low), ("range_high", high)):
        at = rows.schema.get_field_index(name)
        rows = rows.set_column(at, rows.schema.field(at), pa.array(values))
    return rows


def merged(paths: Sequence[Path], schema: TableSchema, rows: int) -> Iterator[pa.Table]:
    """Yield the rows of files that are each sorted by the schema, in common order; equal keys keep the files' order.

    Only the sort columns are in memory as a whole. Of each file, a piece of the result needs rows that follow one
    another, so just their row groups are read.

    Parameters
    ----------
    rows : rows of each table that is yielded; the last holds what remains.
    """
    files = [pq.ParquetFile(path) for path in paths]
    keys = [pa.concat_tables([f.read(columns=[name]) for f in files]).column(0).to_numpy() for name in schema.sort]
    order = np.lexsort(keys[::-1])
    starts = np.cumsum([0, *(f.metadata.num_rows for f in files)])
    for first in range(0, order.size, rows):
        chosen = order[first : first + rows]
        place = np.empty(chosen.size, np.int64)
        pieces: list[pa.Table] = []
        held = 0
        for file, low, high in zip(files, starts[:-1], starts[1:], strict=True):
            own = (chosen >= low) & (chosen < high)
            if not own.any():
                continue
            begin, end = int(chosen[own].min() - low), int(chosen[own].max() - low) + 1
            place[own] = chosen[own] - low - begin + held
            pieces.append(_rows(file, begin, end))
            held += end - begin
        table = pa.concat_tables(pieces)
        yield table if np.array_equal(place, np.arange(held)) else table.take(pa.array(place))


def _rows(file: pq.ParquetFile, begin: int, end: int) -> pa.Table:
    """Return rows [begin, end) of a file."""
    counts = [file.metadata.row_group(k).num_rows for k in range(file.metadata.num_row_groups)]
    starts = np.cumsum([0, *counts])
    one = int(np.searchsorted(starts, begin, "right")) - 1
    other = int(np.searchsorted(starts, end, "left"))
    return file.read_row_groups(list(range(one, other))).slice(begin - int(starts[one]), end - begin)
