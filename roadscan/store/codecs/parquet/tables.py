"""Writes Parquet files of tables of numbers: with fixed-size lists of them, or in measured order.

General writers examine each value's place in its list; here lists have one size, and only the values are read.
Any reader of Parquet reads the files. In a table of lists, lists are DELTA_BINARY_PACKED, the rest is PLAIN, nothing is
compressed further (differences of a surface's ranges do not compress). Each page has its CRC-32, and so has the footer:
see `sealed`.

In a table of non-null numbers in measured order (returns of a lidar, cells) 64-bit numbers, which are epochs, are
differences, all others byte planes; both under LZ4. Planes of measured numbers are constant or noise: ZSTD's level 1
takes nearly twice the time of LZ4 for them and saves a fifth of the room.
"""

from __future__ import annotations

import base64
import functools
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.compute.kernel_options import read_only
from roadscan.store.codecs.kernels.byte_planes import LONGEST_RUN_BYTES, encode_runs
from roadscan.store.codecs.parquet import page_file
from roadscan.store.codecs.parquet.page_file import (
    MAGIC,
    SEAL,
    SEAL_DIGITS,
    Value,
    binary,
    boolean,
    i8,
    i16,
    i32,
    i64,
    listed,
    struct,
    varint,
    with_digits,
    zigzag,
)
from roadscan.store.codecs.zlib_stream import LIBRARY, crc32

_MOST_VALUES: Final = 1 << 28
"""Most values of a page, whose size is stated in 32 bits."""
_VERSION: Final = 2  # format version in the footer
_WRITER: Final = "roadscan"
_INT32, _INT64, _FLOAT, _DOUBLE = 1, 2, 4, 5  # physical types (parquet.thrift)
_REQUIRED, _OPTIONAL, _REPEATED = 0, 1, 2  # repetition types of a schema element (parquet.thrift)
_CONVERTED_LIST: Final = 3  # converted type LIST (parquet.thrift)
_LOGICAL_LIST, _LOGICAL_INTEGER = 3, 10  # logical types LIST and INTEGER (parquet.thrift)
_UNCOMPRESSED: Final = 0  # compression codec (parquet.thrift)
_LZ4_RAW: Final = 7  # compression codec (parquet.thrift)


class Kind(NamedTuple):
    """Parquet representation of a type of numbers."""

    physical: int
    stored: str
    """NumPy type of a PLAIN value."""
    bits: int = 0
    """Bits of an integer."""
    signed: bool = True
    converted: int = 0

    def fields(self) -> dict[int, Value]:
        """Return the fields of a schema element, beside its physical type."""
        if not self.bits:
            return {}
        integer = struct({1: i8(self.bits), 2: boolean(self.signed)})
        return {6: i32(self.converted), 10: struct({_LOGICAL_INTEGER: integer})}


KINDS: Final = {  # Parquet representation by Arrow type
    pa.uint8(): Kind(_INT32, "<u4", 8, False, 11),
    pa.uint16(): Kind(_INT32, "<u4", 16, False, 12),
    pa.uint32(): Kind(_INT32, "<u4", 32, False, 13),
    pa.int32(): Kind(_INT32, "<i4", 32, True, 17),
    pa.int64(): Kind(_INT64, "<i8", 64, True, 18),
    pa.float32(): Kind(_FLOAT, "<f4"),
    pa.float64(): Kind(_DOUBLE, "<f8"),
}
_LIST_TYPES: Final = (pa.uint8(), pa.uint16())


def is_list_table(schema: pa.Schema) -> bool:
    """Return True if the table has fixed-size lists and nothing that this writer does not know."""
    lists = [f.type for f in schema if pa.types.is_fixed_size_list(f.type)]
    flat = [f.type for f in schema if not pa.types.is_fixed_size_list(f.type)]
    known = all(t.value_type in _LIST_TYPES and not t.value_field.nullable and t.list_size for t in lists)
    return bool(lists) and known and all(t in KINDS and pa.types.is_integer(t) for t in flat)


def write_list_table(path: Path, rows: pa.Table, group_rows: int) -> None:
    """Write rows in row groups of `group_rows`; equal rows give equal bytes. The table satisfies `is_list_table`."""
    if LIBRARY:
        _write_by_arrow(path, rows, group_rows)
        return
    longest = max(f.type.list_size for f in rows.schema if pa.types.is_fixed_size_list(f.type))
    step = max(min(group_rows, _MOST_VALUES // longest), 1)
    with path.open("wb") as stream:
        writer = Writer(stream)
        groups = [writer.group(rows.slice(first, step), k) for k, first in enumerate(range(0, rows.num_rows, step))]
        writer.finish(rows.schema, rows.num_rows, groups)


class Writer:
    """Writes consecutive pages, and the footer with their places."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._at = self._group = stream.write(MAGIC)
        self._words = np.empty(0, np.uint64)
        self._codec = pa.Codec("lz4_raw")

    def group(self, rows: pa.Table, number: int) -> Value:
        """Write a row group; return its part of the footer."""
        columns = [
            self._lists(field, _whole(rows.column(k)))
            if pa.types.is_fixed_size_list(field.type)
            else self._flat(field, _whole(rows.column(k)))
            for k, field in enumerate(rows.schema)
        ]
        return self.row_group(columns, rows.num_rows, number)

    def row_group(self, columns: list[Value], rows: int, number: int) -> Value:
        """Return the footer's entry of the row group whose columns were written last."""
        start, size = self._group, self._at - self._group
        self._group = self._at
        about = {1: listed(columns), 2: i64(size), 3: i64(rows), 5: i64(start), 6: i64(size)}
        return struct(about | ({7: i16(number)} if number < 1 << 15 else {}))

    def finish(self, schema: pa.Schema, rows: int, groups: list[Value]) -> None:
        """Write the footer."""
        arrow = base64.b64encode(schema.serialize().to_pybytes())
        own = (schema.metadata or {}).items()
        entries = [*own, (b"ARROW:schema", arrow), (SEAL, b"0" * SEAL_DIGITS)]
        fields = {
            1: i32(_VERSION),
            2: listed(list(_elements(schema))),
            3: i64(rows),
            4: listed(groups),
            5: listed([struct({1: binary(k), 2: binary(v)}) for k, v in entries]),
            6: binary(_WRITER),
            7: listed([struct({1: struct({})})] * len(schema)),  # order of values: that of their type
        }
        footer = struct(fields).content
        at = footer.rindex(SEAL) + len(SEAL) + 2
        footer = with_digits(footer, at, b"%08x" % crc32(footer))
        self._stream.write(footer + len(footer).to_bytes(4, "little") + MAGIC)

    def _flat(self, field: pa.Field, column: pa.Array) -> Value:
        kind = KINDS[field.type]
        values = (column.drop_null() if column.null_count else column).to_numpy().astype(kind.stored)
        levels = page_file.flat_levels(_valid(field, column))
        at, size = self.page(levels, values.view(np.uint8), len(column), page_file.PLAIN)
        statistics = {3: i64(column.null_count)}
        if values.size:
            low, high = values.min().tobytes(), values.max().tobytes()
            statistics |= {5: binary(high), 6: binary(low)}
        return chunk(kind, (field.name,), page_file.PLAIN, len(column), Page(at, size), {12: struct(statistics)})

    def _lists(self, field: pa.Field, column: pa.Array) -> Value:
        values = column.flatten().to_numpy()
        levels = page_file.list_levels(len(column), field.type.list_size, _valid(field, column))
        packed = self.steps(values)
        count = values.size + column.null_count
        at, size = self.page(levels, packed, count, page_file.DELTA_BINARY_PACKED)
        path = (field.name, "list", "element")
        return chunk(KINDS[field.type.value_type], path, page_file.DELTA_BINARY_PACKED, count, Page(at, size), {})

    def steps(self, values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        """Return the content of a page of differences of bytes or 16-bit numbers (n,), valid until the next one."""
        from roadscan.store.codecs.kernels import delta_packing, wide_packing

        if self._words.size < (room := delta_packing.room_words(values.size)):
            self._words = np.empty(room, np.uint64)
        encode = wide_packing.encode if wide_packing.THERE else delta_packing.encode
        return self._words.view(np.uint8)[: encode(read_only(values), self._words)]

    def pack(self, content: npt.NDArray[np.uint8]) -> Packed:
        """Return the content of a page under LZ4."""
        return Packed(np.frombuffer(self._codec.compress(content), np.uint8), content.size)

    def compressed(self, field: pa.Field, encoding: int, packed: Packed, count: int, more: dict[int, Value]) -> Value:
        """Write a column of non-null numbers as a page that was packed; return its part of the footer."""
        at, size = self.page(b"", packed.content, count, encoding, packed.raw)
        raw = size - packed.content.size + packed.raw
        return chunk(KINDS[field.type], (field.name,), encoding, count, Page(at, size, raw), more)

    def with_dictionary(
        self, field: pa.Field, dictionary: Packed, known: int, packed: Packed, count: int, more: dict[int, Value]
    ) -> Value:
        """Write a column of non-null numbers as a page of a dictionary of `known` values and a page of indices."""
        start = self._at
        head = page_file.dictionary_header(dictionary.content.size, crc32(dictionary.content), known, dictionary.raw)
        self._at += self._stream.write(head) + self._stream.write(dictionary.content.data)
        first = self._at - start
        at, size = self.page(b"", packed.content, count, page_file.RLE_DICTIONARY, packed.raw)
        raw = first - dictionary.content.size + dictionary.raw + size - packed.content.size + packed.raw
        kind, whole = KINDS[field.type], Page(at, first + size, raw, start)
        return chunk(kind, (field.name,), page_file.RLE_DICTIONARY, count, whole, more)

    def page(self, levels: bytes, values: Any, count: int, encoding: int, raw: int | None = None) -> tuple[int, int]:
        """Write a page, of `raw` bytes before compression; return where it starts, and its whole size."""
        start = self._at
        crc = crc32(values, crc32(levels))
        self._at += self._stream.write(
            page_file.page_header(len(levels) + values.size, crc, count, encoding, raw) + levels
        )
        self._at += self._stream.write(values)
        return start, self._at - start


def _valid(field: pa.Field, column: pa.Array) -> page_file.Bools | None:
    """Return which values are present; None for a column that is never null."""
    if not field.nullable:
        return None
    return np.asarray(column.is_valid()) if column.null_count else np.ones(len(column), np.bool_)


def _whole(column: pa.ChunkedArray) -> pa.Array:
    """Return the column as one array, without a copy where it already is one."""
    return column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()


class Packed(NamedTuple):
    """The content of a page under LZ4."""

    content: npt.NDArray[np.uint8]
    raw: int
    """Its bytes before compression."""


class Page(NamedTuple):
    """Place of the one page of a column chunk in the file."""

    at: int
    """Its first byte."""
    size: int
    """Its bytes in the file."""
    raw: int | None = None
    """Its bytes before compression; None where it is not compressed."""
    dictionary_at: int | None = None
    """First byte of the page of its dictionary, which `size` and `raw` contain."""


def chunk(kind: Kind, path: tuple[str, ...], encoding: int, count: int, page: Page, more: dict[int, Value]) -> Value:
    """Return the footer's entry of a column chunk of one page."""
    start, length = i64(page.at), i64(page.size)
    before, codec = (length, _UNCOMPRESSED) if page.raw is None else (i64(page.raw), _LZ4_RAW)
    metadata = _about(kind, path, encoding, codec) | {5: i64(count), 6: before, 7: length, 9: start}
    if page.dictionary_at is not None:
        metadata |= {11: i64(page.dictionary_at)}
    return struct({2: start, 3: struct(metadata | more)})


@functools.lru_cache(maxsize=64)
def _about(kind: Kind, path: tuple[str, ...], encoding: int, codec: int) -> dict[int, Value]:
    """Return the common metadata of all chunks of a column."""
    return {
        1: i32(kind.physical),
        2: listed(
            [*([i32(page_file.PLAIN)] * (encoding == page_file.RLE_DICTIONARY)), i32(page_file.RLE), i32(encoding)]
        ),
        3: listed([binary(name) for name in path]),
        4: i32(codec),
    }


def _elements(schema: pa.Schema) -> Iterator[Value]:
    """Yield the schema elements as Parquet lists them, depth first."""
    yield struct({3: i32(_REQUIRED), 4: binary("schema"), 5: i32(len(schema))})
    for field in schema:
        own = {3: i32(_OPTIONAL if field.nullable else _REQUIRED), 4: binary(field.name)}
        if not pa.types.is_nested(field.type):
            kind = KINDS[field.type]
            yield struct({1: i32(kind.physical)} | own | kind.fields())
            continue
        kind = KINDS[field.type.value_type]
        logical = struct({_LOGICAL_LIST: struct({})})
        yield struct(own | {5: i32(1), 6: i32(_CONVERTED_LIST), 10: logical})
        yield struct({3: i32(_REPEATED), 4: binary("list"), 5: i32(1)})
        yield struct({1: i32(kind.physical), 3: i32(_REQUIRED), 4: binary("element")} | kind.fields())


def _write_by_arrow(path: Path, rows: pa.Table, group_rows: int) -> None:
    encodings = {
        f"{f.name}.list.element": "DELTA_BINARY_PACKED" for f in rows.schema if pa.types.is_fixed_size_list(f.type)
    }
    settings = {"compression": "none", "use_dictionary": False, "write_page_checksum": True}
    pq.write_table(rows, path, row_group_size=group_rows, column_encoding=encodings, **settings)


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
        _write_numbers_by_arrow(path, schema, groups, steps, runs)
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
        packed = encode_long(read_only(np.ascontiguousarray(values)), self._room)
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
            split(read_only(np.ascontiguousarray(values).view(f"u{values.itemsize}")), width, planes)
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


def _write_numbers_by_arrow(
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
