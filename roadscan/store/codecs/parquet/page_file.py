"""Parquet files as roadscan writes them: their pages, and their readers, for which any other content counts as damage.

Data pages (version 1) hold integers and fixed-size lists of them. A page is a header, then repetition levels (0 begins
a list, 1 continues it), then definition levels (how much of the value's path is there), then the values. Lists of a
fixed size have levels that can be stated without looking at the values, so a page's levels are compared with those that
it has to have, instead of being decoded. Headers and footers are written in Thrift's compact protocol.

(Apache Parquet format, *parquet.thrift*, and *Encodings.md*, "RLE / bit-packing hybrid"; Apache Thrift, *Thrift Compact
protocol encoding*.)

The footer has its CRC-32: see :func:`sealed`.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.store.codecs.kernels.byte_planes import LONGEST_RUN_BYTES, decode_runs
from roadscan.store.codecs.zlib_stream import crc32

_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _BINARY, _LIST, _STRUCT = 1, 2, 3, 4, 5, 6, 8, 9, 12  # type codes
_LONGEST_DELTA: Final = 15  # longer sizes and field deltas need a separate number
_SHORT: Final = [bytes([number]) for number in range(128)]  # varints of the numbers below 128


class Value(NamedTuple):
    """A value with its type."""

    kind: int
    content: bytes


def varint(number: int) -> bytes:
    """Return the varint of a non-negative number, seven bits per byte."""
    if number <= 127:
        return _SHORT[number]
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    out.append(number)
    return bytes(out)


def zigzag(number: int) -> bytes:
    """Return the varint of a signed number."""
    return varint(2 * number if number >= 0 else -2 * number - 1)


def boolean(value: bool) -> Value:
    """Return a boolean as a field of a struct."""
    return Value(_TRUE if value else _FALSE, b"")


def i8(number: int) -> Value:
    """Return an 8-bit number."""
    return Value(_BYTE, number.to_bytes(1, "little", signed=True))


def i16(number: int) -> Value:
    """Return a 16-bit number."""
    return Value(_I16, zigzag(number))


def i32(number: int) -> Value:
    """Return a 32-bit number."""
    return Value(_I32, zigzag(number))


def i64(number: int) -> Value:
    """Return a 64-bit number."""
    return Value(_I64, zigzag(number))


def binary(content: bytes | str) -> Value:
    """Return bytes, or text in UTF-8."""
    raw = content.encode() if isinstance(content, str) else content
    return Value(_BINARY, varint(len(raw)) + raw)


def listed(values: Sequence[Value]) -> Value:
    """Return a list of values of one type."""
    kind, count = values[0].kind if values else _STRUCT, len(values)
    head = bytes([count << 4 | kind]) if count < _LONGEST_DELTA else bytes([0xF0 | kind]) + varint(count)
    return Value(_LIST, head + b"".join(v.content for v in values))


def struct(fields: Mapping[int, Value]) -> Value:
    """Return a struct of fields by number, ascending."""
    out, before = bytearray(), 0
    for number, value in fields.items():
        delta = number - before
        out += bytes([delta << 4 | value.kind]) if delta <= _LONGEST_DELTA else bytes([value.kind]) + zigzag(number)
        out += value.content
        before = number
    return Value(_STRUCT, bytes(out) + b"\0")


PLAIN, RLE, DELTA_BINARY_PACKED, RLE_DICTIONARY, BYTE_STREAM_SPLIT = 0, 3, 5, 8, 9  # encodings (parquet.thrift)
_NUMBER: Final = b"\x15"
"""Compact-protocol header of the next field, if that is a 32-bit number."""
_DATA_PAGE: Final = _NUMBER + b"\x00"
"""First field of a page's header: its type, a data page."""
_DICTIONARY_PAGE: Final = _NUMBER + b"\x04"
"""First field of the header of a page with a dictionary."""
_LENGTH_BYTES: Final = 4  # bytes of the length before encoded levels
_SIZES_AND_CRC: Final = re.compile(
    rb"\x15[\x00\x04]" + 3 * rb"\x15((?:[\x80-\xFF]{0,3}[\x80-\xFF](?=[^\x00]))?[\x00-\x7F])", re.DOTALL
)
"""A page's type, its uncompressed and compressed bytes, its CRC, each after the byte that names the field."""
_LONGEST_HEADER: Final = 64  # bytes in which the header of a page has to end
_LIMIT: Final = 1 << 31
"""Exclusive limit of a 32-bit number."""

Bools = np.ndarray[Any, np.dtype[np.bool_]]


def flat_levels(valid: npt.NDArray[np.bool_] | None) -> bytes:
    """Return the encoded levels of (n,) values; None for a column without nulls, which has none."""
    if valid is None:
        return b""
    if valid.all():
        return _section(_run(valid.size, 1) if valid.size else b"")
    return _section(b"".join(_run(len(list(same)), int(there)) for there, same in groupby(valid.tolist())))


def list_levels(rows: int, size: int, valid: npt.NDArray[np.bool_] | None) -> bytes:
    """Return the levels of non-null lists of `size` (1 or more) values; `valid` is None where no value is null."""
    own = _run(1, 0) + (_run(size - 1, 1) if size > 1 else b"")
    if valid is None or valid.all():
        repetition = own * rows if size > 1 else _run(rows, 0)
        return _section(repetition) + _section(_run(rows * size, 1 if valid is None else 2))
    repetition = b"".join(own if there else _run(1, 0) for there in valid.tolist())
    runs = ((there, len(list(same))) for there, same in groupby(valid.tolist()))
    return _section(repetition) + _section(b"".join(_run(n * size, 2) if there else _run(n, 0) for there, n in runs))


def varied_list_levels(sizes: npt.NDArray[np.int64]) -> tuple[bytes, int]:
    """Return the encoded levels of non-null lists of so many (n,) non-null values each, and the number of levels."""
    slots = np.maximum(sizes, 1)
    starts = np.cumsum(slots) - slots
    total = int(slots.sum())
    continues, filled = np.ones(total, np.bool_), np.ones(total, np.bool_)
    continues[starts] = False
    filled[starts[sizes == 0]] = False
    return _section(_bits(continues)) + _section(_bits(filled)), total


def bit_packed(values: int) -> bytes:
    """Return what precedes one group of bit-packed dictionary indices, which come in eights."""
    return varint(-(-values // 8) << 1 | 1)


def page_header(size: int, crc: int, values: int, encoding: int, raw: int | None = None) -> bytes:
    """Return the header of a page of `size` bytes (`raw` before compression) and `values` levels.

    The CRC-32 is over levels and values as they are stored.
    """
    return _DATA_PAGE + _sizes(size, crc, raw) + _about(values, encoding)


def dictionary_header(size: int, crc: int, values: int, raw: int) -> bytes:
    """Return the same of a page with the dictionary of a column, PLAIN."""
    return _DICTIONARY_PAGE + _sizes(size, crc, raw) + _about_dictionary(values)


def _sizes(size: int, crc: int, raw: int | None) -> bytes:
    signed = crc - (1 << 32) if crc >> 31 else crc
    sizes = _NUMBER + zigzag(size if raw is None else raw) + _NUMBER + zigzag(size)
    return sizes + _NUMBER + zigzag(signed)


def _about_dictionary(values: int) -> bytes:
    """Return the end of a dictionary's header: the seventh field, a struct, and the stop mark."""
    return struct({3: struct({1: i32(values), 2: i32(PLAIN)})}).content


@functools.lru_cache(maxsize=64)
def _about(values: int, encoding: int) -> bytes:
    """Return the end of a page's header: its fifth field, a struct, and the stop mark."""
    own = struct({k: i32(v) for k, v in {1: values, 2: encoding, 3: RLE, 4: RLE}.items()})
    return struct({1: own}).content


class PageHeader(NamedTuple):
    """Fields of the header of a page."""

    length: int
    """Bytes of the header."""
    crc: int
    size: int
    """Bytes of the page."""
    raw: int
    """Bytes of the page before compression."""


def read_page_header(chunk: npt.NDArray[np.uint8], values: int, encoding: int) -> PageHeader | None:
    """Return the header of the one page of a column chunk; None if it is not as `page_header` writes it."""
    found = _header(chunk, _DATA_PAGE, lambda _: _about(values, encoding))
    return found if found is not None and found.length + found.size == chunk.size else None


def read_dictionary_header(chunk: npt.NDArray[np.uint8], width: int) -> PageHeader | None:
    """Return the header of a column chunk's first page, a dictionary of numbers of `width` bytes; None if it is not."""
    return _header(chunk, _DICTIONARY_PAGE, lambda raw: _about_dictionary(raw // width))


def _header(chunk: npt.NDArray[np.uint8], kind: bytes, rest_of: Callable[[int], bytes]) -> PageHeader | None:
    """Return the header of a page of a kind; its end follows from the bytes before compression."""
    head = chunk[:_LONGEST_HEADER].tobytes()
    found = _SIZES_AND_CRC.match(head)
    if found is None or not head.startswith(kind):
        return None
    raw, size, crc = (_number(varint) for varint in found.groups())
    if not (0 <= raw < _LIMIT and 0 <= size < _LIMIT and -_LIMIT <= crc < _LIMIT):
        return None
    rest = rest_of(raw)
    length = found.end() + len(rest)
    if length + size > chunk.size or head[found.end() : length] != rest:
        return None
    return PageHeader(length, crc % (1 << 32), size, raw)


def _number(varint: bytes) -> int:
    """Return the signed number of a varint."""
    value = 0
    for byte in reversed(varint):
        value = value << 7 | byte & 127
    return (value >> 1) ^ -(value & 1)


def _section(runs: bytes) -> bytes:
    return len(runs).to_bytes(_LENGTH_BYTES, "little") + runs


def _bits(levels: Bools) -> bytes:
    """Return levels (n,) of one bit: a run where all are equal."""
    if not levels.size or (levels == levels[0]).all():
        return _run(levels.size, int(levels[0])) if levels.size else b""
    return bit_packed(levels.size) + np.packbits(levels, bitorder="little").tobytes()


def _run(count: int, level: int) -> bytes:
    """Return a level repeated `count` times, for a column whose levels fit in a byte."""
    return varint(count << 1) + bytes([level])


MAGIC: Final = b"PAR1"  # begins and ends a Parquet file
SEAL: Final = b"roadscan.footer_crc32"  # key of the footer's entry with its CRC-32
SEAL_DIGITS: Final = 8  # hexadecimal digits of the footer's CRC-32
_SEALED: Final = re.compile(SEAL + rb"\x18\x08(.{8})", re.DOTALL)
_MARRED: Final = re.compile(re.escape(SEAL) + rb"|\x18%c.{%d}\x18\x08[0-9a-f]{8}" % (len(SEAL), len(SEAL)), re.DOTALL)
"""What is left of such an entry where one of its bytes is another."""


def sealed(footer: bytes) -> bool | None:
    """Return True if a footer is as `list_table` left it, False if it is damaged, None if another program wrote it.

    The last of the footer's entries is the CRC-32 of the footer with the CRC's digits set to 0.
    """
    found = list(_SEALED.finditer(footer))
    if not found:
        return False if _MARRED.search(footer) else None
    digits = found[-1].span(1)
    return b"%08x" % crc32(with_digits(footer, digits[0], b"0" * SEAL_DIGITS)) == footer[slice(*digits)]


def with_digits(footer: bytes, at: int, digits: bytes) -> bytes:
    """Return a footer with these digits of its CRC-32."""
    return footer[:at] + digits + footer[at + SEAL_DIGITS :]


TAIL_BYTES: Final = 8
"""Bytes of the footer's length and of the mark that ends a Parquet file."""
_FOOTER_BYTES: Final = 64 << 10
"""Bytes from the end of a file that are read at first: most footers are shorter, and each read is a request to an
object store."""
_KEPT_FOOTERS: Final = 8
"""Footers that are kept as they were parsed, a few MB each: the files of a place's passes are read in turns."""
_WORD: Final = 8  # bytes of a 64-bit word
_LISTED: Final = ".list.element"


class DamageError(ValueError):
    """Damage of a file; the message says what is wrong."""


class ByteSource(Protocol):
    """Source of a file's bytes."""

    stream: Any

    def expect(self, start: int, end: int) -> None:
        """Start to read bytes `start` to `end` ahead."""

    def read_into(self, start: int, room: memoryview) -> bool:
        """Fill `room` with the bytes from `start` on; return False where the file is too short."""


@dataclass(frozen=True)
class _Chunk:
    """A column of a row group."""

    start: int
    """First byte in the file."""
    size: int
    values: int
    nullable: bool
    encoding: str


def read_footer(stream: Any) -> tuple[pq.FileMetaData, bool]:
    """Return the footer of a Parquet file, and whether `list_table` wrote it; DamageError where it is damaged."""
    size = stream.seek(0, os.SEEK_END)
    tail = _read(stream, max(size - _FOOTER_BYTES, 0), size)
    length = int.from_bytes(tail[-TAIL_BYTES:-4], "little")
    if tail[-4:] != MAGIC or length > size - TAIL_BYTES:
        raise DamageError("it does not end as a Parquet file")
    footer = TAIL_BYTES + length
    return _parsed(tail[-footer:] if footer <= len(tail) else _read(stream, size - footer, size))


@functools.lru_cache(maxsize=_KEPT_FOOTERS)
def _parsed(tail: bytes) -> tuple[pq.FileMetaData, bool]:
    """Return what the end of a file from its footer on says; rows of a file are read some row groups at a time."""
    ours = sealed(tail[:-TAIL_BYTES])
    if ours is False:
        raise DamageError("its footer does not have its checksum")
    return pq.read_metadata(pa.BufferReader(tail)), ours is True


def opened_parquet(stream: Any) -> pq.ParquetFile:
    """Return a Parquet file of which the footer was checked before Arrow reads it: a damaged one can end the process.

    A footer without a checksum is read as it is. Checksums of pages are verified in reading.
    """
    metadata, _ = read_footer(stream)
    stream.seek(0)
    return pq.ParquetFile(stream, metadata=metadata, page_checksum_verification=True)


def _read(stream: Any, start: int, end: int) -> bytes:
    stream.seek(start)
    return bytes(stream.read(end - start))


class PageFile:
    """Pages of row groups, one row group at a time; it owns its buffer, so use one per thread.

    Bytes are read at once for all columns wanted; the CRC-32 of each page is verified before it is decoded.
    """

    def __init__(self, source: ByteSource, metadata: pq.FileMetaData) -> None:
        self._source = source
        self._size = source.stream.seek(0, os.SEEK_END)
        self._metadata = metadata
        self.words = np.empty(0, np.uint64)
        """The buffer."""
        self._columns = _columns(metadata)
        self._known: dict[tuple[int, str], _Chunk] = {}
        self._chunks: dict[str, _Chunk] = {}
        self._origin = 0

    def load(self, group: int, names: Sequence[str]) -> None:
        """Read columns of a row group into the buffer."""
        from roadscan.store.codecs.kernels.delta_packing import SLACK_BYTES

        self._chunks = {name: self._located(group, name) for name in names}
        self._origin, end = _span(self._chunks.values())
        words = -(-(end - self._origin + SLACK_BYTES) // _WORD)
        if self.words.size < words:
            self.words = np.empty(words, np.uint64)
        room = self.words.view(np.uint8).data[: end - self._origin]
        if not self._source.read_into(self._origin, room):
            raise DamageError("it is cut short")

    def expect(self, groups: Sequence[int], names: Sequence[str]) -> None:
        """Start to read row groups ahead that will be loaded soon; consecutive groups in one piece."""
        for _, run in groupby(enumerate(groups), lambda pair: pair[1] - pair[0]):
            self._source.expect(*_span([self._located(group, name) for _, group in run for name in names]))

    def encoding(self, name: str) -> str:
        """Return Parquet's name for the encoding of a loaded column's values."""
        return self._chunks[name].encoding

    def content(self, name: str) -> npt.NDArray[np.uint8]:
        """Return the stored bytes of a loaded column."""
        chunk, data = self._chunks[name], self.words.view(np.uint8)
        return data[chunk.start - self._origin : chunk.start - self._origin + chunk.size]

    def page(self, name: str, encoding: int, after: int = 0) -> tuple[npt.NDArray[np.uint8], int, int, int]:
        """Return the buffer, the begin and end of a loaded column's page in it, and the page's unpacked bytes.

        The page has its checksum. Where a dictionary precedes it, `after` is the end of that.
        """
        chunk, data = self._chunks[name], self.words.view(np.uint8)
        start, end = chunk.start - self._origin, chunk.start - self._origin + chunk.size
        start = max(start, after)
        header = read_page_header(data[start:end], chunk.values, encoding)
        return self._checked(name, data, start, header)

    def dictionary(self, name: str, width: int) -> tuple[npt.NDArray[np.uint8], int, int, int]:
        """Return the same of the dictionary of a loaded column, numbers of `width` bytes."""
        data = self.words.view(np.uint8)
        start = self._chunks[name].start - self._origin
        return self._checked(name, data, start, read_dictionary_header(self.content(name), width))

    def _checked(
        self, name: str, data: npt.NDArray[np.uint8], start: int, header: PageHeader | None
    ) -> tuple[npt.NDArray[np.uint8], int, int, int]:
        if header is None:
            raise DamageError(f"column '{name}': a page's header is damaged")
        begin, end = start + header.length, start + header.length + header.size
        if crc32(data[begin:end]) != header.crc:
            raise DamageError(f"column '{name}': a page does not have its checksum")
        return data, begin, end, header.raw

    def _located(self, group: int, name: str) -> _Chunk:
        known = self._known.get((group, name))
        if known is not None:
            return known
        number, nullable = self._columns[name]
        column = self._metadata.row_group(group).column(number)
        size, encoding = column.total_compressed_size, column.encodings[-1]
        start = column.dictionary_page_offset if column.has_dictionary_page else column.data_page_offset
        chunk = _Chunk(start, size, column.num_values, nullable, encoding)
        if not 0 <= chunk.start <= chunk.start + chunk.size <= self._size:
            raise DamageError("its footer speaks of pages outside of it")
        self._known[group, name] = chunk
        return chunk


def _span(chunks: Iterable[_Chunk]) -> tuple[int, int]:
    """Return the first byte of some chunks, and the one after the last."""
    ends = [(c.start, c.start + c.size) for c in chunks]
    return min(start for start, _ in ends), max(end for _, end in ends)


def _columns(metadata: pq.FileMetaData) -> dict[str, tuple[int, bool]]:
    """Return each column's number by its name, and whether it may have nulls."""
    found = {}
    for k in range(metadata.num_columns):
        column = metadata.schema.column(k)
        is_list = column.path.endswith(_LISTED)
        found[column.path.removesuffix(_LISTED)] = k, column.max_definition_level > is_list
    return found


Array = npt.NDArray[Any]


class ListTableFile(PageFile):
    """Columns of row groups."""

    def flat(self, name: str, values: Array) -> None:
        """Write a loaded column of non-null int64 to (n,) `values`."""
        data, at, end, _ = self.page(name, PLAIN)
        if self._chunks[name].nullable or end - at != values.nbytes:
            raise DamageError(f"column '{name}' does not hold {values.size} values")
        values[:] = data[at:end].view("<i8")

    def lists(self, name: str, values: Array) -> bool:
        """Write a loaded column of lists to (n, m) `values`; return False, without writing, where a list is null."""
        from roadscan.store.codecs.kernels.delta_packing import FAULTS, WHOLE, decode

        chunk = self._chunks[name]
        data, at, end, _ = self.page(name, DELTA_BINARY_PACKED)
        rows, size = values.shape
        levels = list_levels(rows, size, np.ones(rows, np.bool_) if chunk.nullable else None)
        begin = at + len(levels)
        if data[at:begin].tobytes() != levels:
            if chunk.nullable:
                return False
            raise DamageError(f"column '{name}' does not hold {rows} lists of {size} values")
        fault = decode(data, self.words, begin, end, values.reshape(-1))
        if fault != WHOLE:
            raise DamageError(f"column '{name}': {FAULTS[fault]}")
        return True


_PLANES: Final = 4  # byte planes of a 32-bit number
_ENCODINGS: Final = {
    "PLAIN": PLAIN,
    "DELTA_BINARY_PACKED": DELTA_BINARY_PACKED,
    "BYTE_STREAM_SPLIT": BYTE_STREAM_SPLIT,
}

Bytes = npt.NDArray[np.uint8]


class NumberFile(PageFile):
    """Columns of row groups as `number_table` writes them."""

    def __init__(self, source: Any, metadata: pq.FileMetaData) -> None:
        super().__init__(source, metadata)
        self._codec = pa.Codec("lz4_raw")
        self._unpacked = np.empty(0, np.uint64)

    def same(self, name: str, other: str) -> bool:
        """Return True if two loaded columns are stored in the same bytes."""
        return np.array_equal(self.content(name), self.content(other))

    def numbers(self, name: str, values: Array) -> None:
        """Write a loaded column to (n,) `values` of the column's type."""
        from roadscan.store.codecs.kernels.byte_planes import join, join_low

        encoding = _ENCODINGS.get(self.encoding(name), -1)
        data, at, end, size = self.page(name, encoding)
        if not 0 <= size <= _most_bytes(values.size):
            raise DamageError(f"column '{name}' does not hold {values.size} values")
        page = np.frombuffer(self._codec.decompress(data[at:end], size), np.uint8)
        if encoding == DELTA_BINARY_PACKED and values.dtype == np.int64:
            self._differences(name, page, values)
        elif encoding == PLAIN and values.dtype == np.int64 and size == values.nbytes:
            values[:] = page.view("<i8")
        elif encoding == BYTE_STREAM_SPLIT and size == _PLANES * values.size and values.itemsize in (2, 4):
            planes = [page[k * values.size : (k + 1) * values.size] for k in range(_PLANES)]
            if values.itemsize == _PLANES:
                join(*planes, values.view(np.uint32))
            else:
                join_low(*planes[:2], values)
        else:
            raise DamageError(f"column '{name}' does not hold {values.size} values")

    def bytes(self, name: str, rows: int) -> Bytes:
        """Return the values (rows,) of a loaded column of bytes that has a dictionary."""
        known, page = self._indexed(name, rows, np.dtype("<i4"), 2 * _WORD + rows)
        head = b"\x08" + bit_packed(rows)
        values = page[len(head) : len(head) + rows]
        whole = page.size == len(head) + -(-rows // 8) * 8 and page[: len(head)].tobytes() == head
        if not whole or not np.array_equal(known, np.arange(int(values.max(initial=0)) + 1)):
            raise DamageError(f"column '{name}' does not hold {rows} values")
        return values

    def runs(self, name: str, rows: int, kind: np.dtype[Any]) -> tuple[npt.NDArray[np.int64], Array]:
        """Return the runs of a loaded column of `rows` numbers that has a dictionary: the row after each, its value."""
        stored = kind if kind.itemsize >= _PLANES else np.dtype("<i4")
        known, page = self._indexed(name, rows, stored, 1 + LONGEST_RUN_BYTES * rows)
        ends, indices = np.empty((2, max(page.size, 1)), np.int64)
        count = decode_runs(page, rows, known.size, ends, indices)
        if count < 0:
            raise DamageError(f"column '{name}' does not hold {rows} values")
        return ends[:count], known[indices[:count]].astype(kind)

    def _indexed(self, name: str, rows: int, kind: np.dtype[Any], most: int) -> tuple[Array, Bytes]:
        """Return the dictionary of a loaded column of `rows` numbers, and its page of indices of `most` bytes."""
        data, at, end, size = self.dictionary(name, kind.itemsize)
        _, page_at, page_end, page_size = self.page(name, RLE_DICTIONARY, end)
        if size % kind.itemsize or size > _most_bytes(max(rows, 256)) or page_size > most:
            raise DamageError(f"column '{name}' does not hold {rows} values")
        known = np.frombuffer(self._codec.decompress(data[at:end], size), kind)
        return known, np.frombuffer(self._codec.decompress(data[page_at:page_end], page_size), np.uint8)

    def _differences(self, name: str, page: Bytes, values: Array) -> None:
        from roadscan.store.codecs.kernels.delta_packing import FAULTS, SLACK_BYTES, WHOLE, decode

        words = -(-(page.size + SLACK_BYTES) // _WORD)
        if self._unpacked.size < words:
            self._unpacked = np.empty(words, np.uint64)
        room = self._unpacked.view(np.uint8)
        room[: page.size] = page
        fault = decode(room, self._unpacked, 0, page.size, values)
        if fault != WHOLE:
            raise DamageError(f"column '{name}': {FAULTS[fault]}")


def _most_bytes(count: int) -> int:
    """Return the bytes that an unpacked page of this many numbers may take."""
    return _WORD * count + count // 4 + 1024
