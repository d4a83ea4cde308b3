"""Writes Parquet files of tables of non-null numbers in measured order: returns of a lidar, cells.

64-bit numbers, which are epochs, are differences, all others byte planes; both under LZ4. Planes of measured numbers
are constant or noise: ZSTD's level 1 takes nearly twice the time of LZ4 for them and saves a fifth of the room. Each
page has its CRC-32 and so has the footer (`list_table`); any reader of Parquet reads the file.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.store.codecs.kernels.byte_planes import LONGEST_RUN_BYTES, encode_runs
from roadscan.store.codecs.parquet import page_file
from roadscan.store.codecs.parquet.list_table import KINDS, Packed, Page, Writer, chunk
from roadscan.store.codecs.parquet.page_file import Value, binary, i64, struct, varint, zigzag
from roadscan.store.codecs.zlib_stream import LIBRARY

_SCRATCH: Final = 2048  # values of the scratch line that the kernels need

Array = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]


class Lists(NamedTuple):
    """Lists of bytes or 16-bit numbers, one after another."""

    sizes: npt.NDArray[np.int64]
    """(n,) numbers of each."""
    values: Array

    def __len__(self) -> int:
        return self.sizes.size


Columns = Mapping[str, Array | Lists]


def is_number_table(schema: pa.Schema) -> bool:
    """Return True if all columns are of non-null numbers."""
    return all(field.type in KINDS and not field.nullable for field in schema)


def write_number_table(path: Path, rows: pa.Table, group_rows: int, runs: Collection[str] = ()) -> None:
    """Write rows in row groups of `group_rows`; equal rows give equal bytes. The table satisfies `is_number_table`."""
    parts = (rows.slice(first, group_rows) for first in range(0, rows.num_rows, group_rows))
    groups = ({name: _values(part.column(name)) for name in rows.column_names} for part in parts)
    write_number_groups(path, rows.schema, groups, runs=runs)


def _values(column: pa.ChunkedArray) -> Array:
    """Return non-null numbers as one array, without a copy where they already are one."""
    chunks = [chunk.to_numpy() for chunk in column.chunks]
    return chunks[0] if len(chunks) == 1 else np.concatenate(chunks)


def write_number_groups(
    path: Path,
    schema: pa.Schema,
    groups: Iterable[Columns],
    steps: Mapping[str, float] | None = None,
    stated: Collection[str] | None = None,
    runs: Collection[str] = (),
) -> None:
    """Write a row group for each of `groups`; equal rows give equal bytes.

    Parameters
    ----------
    schema : one of `is_number_table`.
    groups : arrays of each column by its name, of the schema's types; `Lists` of a column of lists.
    steps : columns of floats that are rounded to a multiple of a power of two.
    stated : columns whose least and largest value stand in the footer; all where it is left out.
    runs : columns that are written as a dictionary and indices: bytes, and numbers that stay the same for many rows.
    """
    steps = steps or {}
    stated = schema.names if stated is None else stated
    if LIBRARY:
        _write_by_arrow(path, schema, groups, steps, runs)
        return
    with path.open("wb") as stream:
        writer = _Numbers(stream)
        written, rows = [], 0
        for number, columns in enumerate(groups):
            size = len(columns[schema.names[0]])
            chunks = [
                writer.lists(field, values)
                if isinstance(values := columns[field.name], Lists)
                else writer.runs(field, values, field.name in stated)
                if field.name in runs
                else writer.column(field, values, steps.get(field.name), field.name in stated)
                for field in schema
            ]
            written.append(writer.row_group(chunks, size, number))
            rows += size
        writer.finish(schema, rows, written)


class _Numbers(Writer):
    """Writes columns, with buffers that they share."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._planes = np.empty(0, np.uint8)
        self._room = np.empty(0, np.uint64)
        self._epochs: tuple[Array, int, Packed] | None = None
        """The 64-bit numbers that were packed last: a return's pose is of its epoch mostly."""

    def column(self, field: pa.Field, values: Array, step: float | None, stated: bool) -> Value:
        """Write a column chunk; return its part of the footer."""
        if values.dtype != np.int64:
            encoding, packed = page_file.BYTE_STREAM_SPLIT, self.pack(self._split(field, values, step))
        elif self._epochs is not None and np.array_equal(values, self._epochs[0]):
            _, encoding, packed = self._epochs
        else:
            encoding, content = self._differences(values)
            packed = self.pack(content)
            self._epochs = values, encoding, packed
        return self.compressed(field, encoding, packed, values.size, _stated(field, values, stated))

    def runs(self, field: pa.Field, values: Array, stated: bool) -> Value:
        """Write a column chunk as a dictionary and indices of its values; return its part of the footer."""
        known, page = _as_bytes(values) if values.dtype == np.uint8 else _as_runs(values)
        dictionary = self.pack(known.astype(KINDS[field.type].stored).view(np.uint8))
        more = _stated(field, values if values.dtype == np.uint8 else known, stated)
        return self.with_dictionary(field, dictionary, known.size, self.pack(page), values.size, more)

    def lists(self, field: pa.Field, lists: Lists) -> Value:
        """Write a column chunk of non-null lists; return its part of the footer."""
        levels, count = page_file.varied_list_levels(lists.sizes)
        packed = self.pack(np.concatenate([np.frombuffer(levels, np.uint8), self.steps(lists.values)]))
        at, size = self.page(b"", packed.content, count, page_file.DELTA_BINARY_PACKED, packed.raw)
        place = Page(at, size, size - packed.content.size + packed.raw)
        kind, path = KINDS[field.type.value_type], (field.name, "list", "element")
        return chunk(kind, path, page_file.DELTA_BINARY_PACKED, count, place, {})

    def _differences(self, values: Array) -> tuple[int, Bytes]:
        from roadscan.store.codecs.kernels.delta_packing import BLOCK, MINIBLOCKS, TOO_FAR, encode_long, room_words_long

        if self._room.size < room_words_long(values.size):
            self._room = np.empty(room_words_long(values.size), np.uint64)
        packed = encode_long(np.ascontiguousarray(values), self._room)
        if packed == TOO_FAR:
            return page_file.PLAIN, values.astype("<i8").view(np.uint8)
        head = varint(BLOCK) + varint(MINIBLOCKS) + varint(values.size) + zigzag(int(values[0]))
        content = np.concatenate([np.frombuffer(head, np.uint8), self._room.view(np.uint8)[:packed]])
        return page_file.DELTA_BINARY_PACKED, content

    def _split(self, field: pa.Field, values: Array, step: float | None) -> Bytes:
        from roadscan.store.codecs.kernels.byte_planes import split, split_rounded

        width = np.dtype(KINDS[field.type].stored).itemsize
        if self._planes.size < width * values.size:
            self._planes = np.empty(width * values.size, np.uint8)
        planes = self._planes[: width * values.size]
        if step is None:
            split(np.ascontiguousarray(values).view(f"u{values.itemsize}"), width, planes)
        else:
            line, number = np.empty(_SCRATCH, values.dtype), values.dtype.type
            split_rounded(values, number(1 / step), number(step), line, line.view(f"u{width}"), planes)
        return planes


def _as_runs(values: Array) -> tuple[Array, Bytes]:
    """Return the different values, ascending, and the page of runs of them."""
    starts = np.flatnonzero(values[1:] != values[:-1]) + 1
    starts = np.concatenate([np.zeros(min(values.size, 1), np.int64), starts])
    known, indices = np.unique(values[starts], return_inverse=True)
    page = np.empty(1 + LONGEST_RUN_BYTES * starts.size, np.uint8)
    bits = max((known.size - 1).bit_length(), 1)
    return known, page[: encode_runs(np.diff(starts, append=values.size), indices.astype(np.int64), bits, page)]


def _as_bytes(values: Array) -> tuple[Array, Bytes]:
    """Return all bytes up to the largest, and the page of indices of 8 bits, which are the values (n,) themselves."""
    head = np.frombuffer(bytes([8]) + page_file.bit_packed(values.size), np.uint8)
    fill = np.zeros(-values.size % 8, np.uint8)
    return np.arange(int(values.max(initial=0)) + 1), np.concatenate([head, values, fill])


def _stated(field: pa.Field, values: Array, stated: bool) -> dict[int, Value]:
    """Return the field of the footer with the statistics of values; none where they are not stated."""
    return {12: struct(_statistics(values, KINDS[field.type].stored))} if stated and values.size else {}


def _statistics(values: Array, stored: str) -> dict[int, Value]:
    """Return the footer's statistics of values: no nulls, minimum, maximum, zeros with the sign that Parquet wants."""
    low, high = values.min(), values.max()
    none = {3: i64(0)}
    if np.isnan(low):  # with NaN there is no minimum
        return none
    if values.dtype.kind == "f":
        low, high = (low or -abs(low)), (high or abs(high))
    return none | {5: binary(np.array(high, stored).tobytes()), 6: binary(np.array(low, stored).tobytes())}


def _write_by_arrow(
    path: Path, schema: pa.Schema, groups: Iterable[Columns], steps: Mapping[str, float], runs: Collection[str]
) -> None:
    split = [f for f in schema if f.name not in runs and not pa.types.is_nested(f.type)]
    encodings = {f.name: "DELTA_BINARY_PACKED" if f.type == pa.int64() else "BYTE_STREAM_SPLIT" for f in split}
    settings = {"compression": "lz4", "use_dictionary": list(runs), "write_page_checksum": True}
    with pq.ParquetWriter(path, schema, column_encoding=encodings, **settings) as writer:
        for columns in groups:
            rounded = [_arrow(field, columns[field.name], steps.get(field.name)) for field in schema]
            writer.write_table(pa.table(rounded, schema=schema), row_group_size=max(1, len(rounded[0])))


def _arrow(field: pa.Field, values: Array | Lists, step: float | None) -> Array | pa.Array:
    if isinstance(values, Lists):
        offsets = np.concatenate([[0], np.cumsum(values.sizes)]).astype(np.int32)
        return pa.ListArray.from_arrays(offsets, values.values, type=field.type)
    return _rounded(values, step)


def _rounded(values: Array, step: float | None) -> Array:
    if step is None:
        return values
    number = values.dtype.type
    rounded: Array = np.rint(values * number(1 / step)) * number(step)
    return rounded
