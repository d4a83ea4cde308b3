"""Writes Parquet files of flat tables of numbers without nulls, as they are measured: returns of a lidar.

64-bit numbers, which are epochs, are differences, all others byte planes; both under LZ4. Each page has its CRC-32 and
so has the footer (`list_table`); any reader of Parquet reads the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.kernels.byte_planes import split
from roadscan.kernels.delta_packing import BLOCK, MINIBLOCKS
from roadscan.kernels.long_packing import TOO_FAR, encode_long, room_words
from roadscan.tables import pages
from roadscan.tables.list_table import KINDS, Writer
from roadscan.tables.thrift import Value, binary, i64, struct, varint, zigzag

_WORD: Final = 4
"""Bytes of the shortest numbers that Parquet knows."""

Array = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]


def is_number_table(schema: pa.Schema) -> bool:
    """True if all columns are of numbers that are always there."""
    return all(field.type in KINDS and not field.nullable for field in schema)


def write_number_table(path: Path, rows: pa.Table, group_rows: int) -> None:
    """Write rows in row groups of `group_rows`; same rows, same bytes. The table is one of `is_number_table`."""
    with path.open("wb") as stream:
        writer = _Numbers(stream)
        columns = [rows.column(name).to_numpy() for name in rows.column_names]
        groups = []
        for number, first in enumerate(range(0, rows.num_rows, group_rows)):
            own = [values[first : first + group_rows] for values in columns]
            chunks = [writer.column(field, values) for field, values in zip(rows.schema, own, strict=True)]
            groups.append(writer.row_group(chunks, own[0].size, number))
        writer.finish(rows.schema, rows.num_rows, groups)


class _Numbers(Writer):
    """Holds the buffers that columns share."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._planes = np.empty(0, np.uint8)
        self._room = np.empty(0, np.uint64)

    def column(self, field: pa.Field, values: Array) -> Value:
        """Write a column chunk; returns its part of the footer."""
        encoding, content = self._differences(values) if values.dtype == np.int64 else self._split(values)
        more = {12: struct(_statistics(values, KINDS[field.type].stored))}
        return self.compressed(field, encoding, content, values.size, more)

    def _differences(self, values: Array) -> tuple[int, Bytes]:
        if self._room.size < room_words(values.size):
            self._room = np.empty(room_words(values.size), np.uint64)
        packed = encode_long(np.ascontiguousarray(values), self._room)
        if packed == TOO_FAR:
            return pages.PLAIN, values.astype("<i8").view(np.uint8)
        head = varint(BLOCK) + varint(MINIBLOCKS) + varint(values.size) + zigzag(int(values[0]))
        content = np.concatenate([np.frombuffer(head, np.uint8), self._room.view(np.uint8)[:packed]])
        return pages.DELTA_BINARY_PACKED, content

    def _split(self, values: Array) -> tuple[int, Bytes]:
        size = max(values.itemsize, _WORD) * values.size
        if self._planes.size < size:
            self._planes = np.empty(size, np.uint8)
        split(np.ascontiguousarray(values).view(f"u{values.itemsize}"), size // values.size, self._planes[:size])
        return pages.BYTE_STREAM_SPLIT, self._planes[:size]


def _statistics(values: Array, stored: str) -> dict[int, Value]:
    """What the footer says of values: no nulls, the least and the greatest, zeros with the sign that Parquet wants."""
    low, high = values.min(), values.max()
    none = {3: i64(0)}
    if np.isnan(low):  # not a number: there is no least one
        return none
    if values.dtype.kind == "f":
        low, high = (low or -abs(low)), (high or abs(high))
    return none | {5: binary(np.array(high, stored).tobytes()), 6: binary(np.array(low, stored).tobytes())}
