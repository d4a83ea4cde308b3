"""Puts rows in the order of their schema. A log is nearly in order of time, so its stretches are sorted one by one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.store.schema import TableSchema

_WORD_BITS: Final = 64

Array = npt.NDArray[Any]
Int64 = npt.NDArray[np.int64]


def sorted_rows(schema: TableSchema, rows: pa.Table) -> pa.Table:
    """Return rows in the schema's order; equal keys keep their input order."""
    batches, is_new = [], False
    for stretch in _stretches(rows, schema.sort[0]):
        keys = [stretch.column(name).to_numpy() for name in schema.sort]
        if in_order(keys):
            batches += stretch.to_batches()
        else:
            batches.append(_sorted(stretch, schema.sort, keys))
            is_new = True
    return pa.Table.from_batches(batches, rows.schema) if is_new else rows


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
    packed = np.zeros(rows, np.uint64)
    for key, low, width in zip(keys, lows, widths, strict=True):
        packed <<= np.uint64(width)
        packed |= (key - key.dtype.type(low)).view(f"u{key.itemsize}")  # differences fit, as numbers without a sign
    packed <<= np.uint64(row_bits)
    packed |= np.arange(rows, dtype=np.uint64)
    packed.sort()
    order = (packed & _low_bits(row_bits)).view(np.int64)
    packed >>= np.uint64(row_bits)
    found: list[Array] = []
    for key, low, width in zip(keys[::-1], lows[::-1], widths[::-1], strict=True):
        found.append((packed & _low_bits(width)).astype(key.dtype) + key.dtype.type(low))
        packed >>= np.uint64(width)
    return order, found[::-1]


def _low_bits(count: int) -> np.uint64:
    return np.uint64((1 << count) - 1)


def in_order(keys: Sequence[Array]) -> bool:
    """Return True if rows are in order of these keys, the first foremost; names are compared only where they lead."""
    tied = np.ones(max(keys[0].size - 1, 0), dtype=bool)
    for key in keys:
        if key.dtype.kind == "O" and len(keys) > 1:
            return not tied.any()
        if (tied & ~(key[1:] >= key[:-1])).any():  # also where one is no number
            return False
        tied &= key[1:] == key[:-1]
    return True


def _stretches(rows: pa.Table, leading: str) -> Iterator[pa.Table]:
    """Yield rows batch by batch, those that overlap in the leading column together."""
    if rows.schema.field(leading).type != pa.int64() or rows.column(leading).null_count:
        yield rows
        return
    held: list[pa.RecordBatch] = []
    top = 0
    for batch in filter(len, rows.to_batches()):
        keys = batch.column(leading).to_numpy()
        if held and keys.min() <= top:  # at one epoch, the next key decides
            top = max(top, keys.max())
        else:
            if held:
                yield pa.Table.from_batches(held)
            held, top = [], keys.max()
        held.append(batch)
    if held:
        yield pa.Table.from_batches(held)


def _sorted(rows: pa.Table, names: Sequence[str], keys: Sequence[Array]) -> pa.RecordBatch:
    """Return rows of one chunk a column in the order of their keys; columns that share their memory share it again."""
    order, found = ordered(keys)
    batch = rows.combine_chunks().to_batches()[0]
    done = {_place(batch.column(name)): pa.array(values) for name, values in zip(names, found, strict=True)}
    indices, columns = pa.array(order), []
    for column in batch.columns:
        if pa.types.is_primitive(column.type) and not column.null_count:
            place = _place(column)
            if place not in done:
                done[place] = _in(order, column)
            columns.append(done[place])
        else:
            columns.append(column.take(indices))
    return pa.RecordBatch.from_arrays(columns, schema=batch.schema)


def _place(column: pa.Array) -> tuple[object, ...]:
    """Return what the values of an array are read from."""
    return column.type, column.offset, *(buffer and buffer.address for buffer in column.buffers())


def _in(order: Int64, column: pa.Array) -> pa.Array:
    """Return numbers in an order: the same array where all of them are one whole number."""
    values = column.to_numpy(zero_copy_only=False)
    if values.dtype.kind in "iu" and values[0] == values[-1] and (values == values[0]).all():
        return column
    return pa.array(values[order], column.type)
