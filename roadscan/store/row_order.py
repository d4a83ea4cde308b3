"""Puts rows in the order of their schema. A log is nearly in order of time, so its stretches are sorted one by one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Int64
from roadscan.store.schema import TableSchema

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
    """Return the order (n,) of rows by their keys (n,), the first foremost, and the keys in it; ties stay as they are.

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
    """Return what the values of an array are read from."""
    return column.type, column.offset, *(buffer and buffer.address for buffer in column.buffers())


def _in(order: Int64, values: Array) -> Array:
    """Return numbers (n,) in an order: the same array where all of them are one whole number."""
    if values.dtype.kind in "iu" and values[0] == values[-1] and (values == values[0]).all():
        return values
    return np.asarray(values[order])
