"""Writes Parquet files of tables with fixed-size lists of numbers.

General writers examine each value's place in its list; here lists have one size, and only the values are read.
Any reader of Parquet reads the file: lists are DELTA_BINARY_PACKED, the rest is PLAIN, nothing is compressed further
(differences of a surface's ranges do not compress). Each page has its CRC-32, and so has the footer: see `sealed`.
"""

from __future__ import annotations

import base64
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

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
    with_digits,
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
        return self._words.view(np.uint8)[: encode(values, self._words)]

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
