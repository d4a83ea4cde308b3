"""Reads Parquet files that `list_table` and `number_table` wrote; any other content counts as damage.

The footer has its CRC-32: see :func:`sealed`.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.store.codecs.kernels.byte_planes import LONGEST_RUN_BYTES, decode_runs
from roadscan.store.codecs.parquet import pages
from roadscan.store.codecs.zlib_stream import crc32

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
        header = pages.read_page_header(data[start:end], chunk.values, encoding)
        return self._checked(name, data, start, header)

    def dictionary(self, name: str, width: int) -> tuple[npt.NDArray[np.uint8], int, int, int]:
        """Return the same of the dictionary of a loaded column, numbers of `width` bytes."""
        data = self.words.view(np.uint8)
        start = self._chunks[name].start - self._origin
        return self._checked(name, data, start, pages.read_dictionary_header(self.content(name), width))

    def _checked(
        self, name: str, data: npt.NDArray[np.uint8], start: int, header: pages.PageHeader | None
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
        listed = column.path.endswith(_LISTED)
        found[column.path.removesuffix(_LISTED)] = k, column.max_definition_level > listed
    return found


Array = npt.NDArray[Any]


class ListTableFile(PageFile):
    """Columns of row groups."""

    def flat(self, name: str, values: Array) -> None:
        """Write a loaded column of non-null int64 to (n,) `values`."""
        data, at, end, _ = self.page(name, pages.PLAIN)
        if self._chunks[name].nullable or end - at != values.nbytes:
            raise DamageError(f"column '{name}' does not hold {values.size} values")
        values[:] = data[at:end].view("<i8")

    def lists(self, name: str, values: Array) -> bool:
        """Write a loaded column of lists to (n, m) `values`; return False, without writing, where a list is null."""
        from roadscan.store.codecs.kernels.delta_packing import FAULTS, WHOLE, decode

        chunk = self._chunks[name]
        data, at, end, _ = self.page(name, pages.DELTA_BINARY_PACKED)
        rows, size = values.shape
        levels = pages.list_levels(rows, size, np.ones(rows, np.bool_) if chunk.nullable else None)
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
_NUMBER_WORD: Final = 8  # bytes of a 64-bit word
_ENCODINGS: Final = {
    "PLAIN": pages.PLAIN,
    "DELTA_BINARY_PACKED": pages.DELTA_BINARY_PACKED,
    "BYTE_STREAM_SPLIT": pages.BYTE_STREAM_SPLIT,
}

NumberArray = npt.NDArray[Any]
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

    def numbers(self, name: str, values: NumberArray) -> None:
        """Write a loaded column to (n,) `values` of the column's type."""
        from roadscan.store.codecs.kernels.byte_planes import join, join_low

        encoding = _ENCODINGS.get(self.encoding(name), -1)
        data, at, end, size = self.page(name, encoding)
        if not 0 <= size <= _most_bytes(values.size):
            raise DamageError(f"column '{name}' does not hold {values.size} values")
        page = np.frombuffer(self._codec.decompress(data[at:end], size), np.uint8)
        if encoding == pages.DELTA_BINARY_PACKED and values.dtype == np.int64:
            self._differences(name, page, values)
        elif encoding == pages.PLAIN and values.dtype == np.int64 and size == values.nbytes:
            values[:] = page.view("<i8")
        elif encoding == pages.BYTE_STREAM_SPLIT and size == _PLANES * values.size and values.itemsize in (2, 4):
            planes = [page[k * values.size : (k + 1) * values.size] for k in range(_PLANES)]
            if values.itemsize == _PLANES:
                join(*planes, values.view(np.uint32))
            else:
                join_low(*planes[:2], values)
        else:
            raise DamageError(f"column '{name}' does not hold {values.size} values")

    def bytes(self, name: str, rows: int) -> Bytes:
        """Return the values (rows,) of a loaded column of bytes that has a dictionary."""
        known, page = self._indexed(name, rows, np.dtype("<i4"), 2 * _NUMBER_WORD + rows)
        head = b"\x08" + pages.bit_packed(rows)
        values = page[len(head) : len(head) + rows]
        whole = page.size == len(head) + -(-rows // 8) * 8 and page[: len(head)].tobytes() == head
        if not whole or not np.array_equal(known, np.arange(int(values.max(initial=0)) + 1)):
            raise DamageError(f"column '{name}' does not hold {rows} values")
        return values

    def runs(self, name: str, rows: int, kind: np.dtype[Any]) -> tuple[npt.NDArray[np.int64], NumberArray]:
        """Return the runs of a loaded column of `rows` numbers that has a dictionary: the row after each, its value."""
        stored = kind if kind.itemsize >= _PLANES else np.dtype("<i4")
        known, page = self._indexed(name, rows, stored, 1 + LONGEST_RUN_BYTES * rows)
        ends, indices = np.empty((2, max(page.size, 1)), np.int64)
        count = decode_runs(page, rows, known.size, ends, indices)
        if count < 0:
            raise DamageError(f"column '{name}' does not hold {rows} values")
        return ends[:count], known[indices[:count]].astype(kind)

    def _indexed(self, name: str, rows: int, kind: np.dtype[Any], most: int) -> tuple[NumberArray, Bytes]:
        """Return the dictionary of a loaded column of `rows` numbers, and its page of indices of `most` bytes."""
        data, at, end, size = self.dictionary(name, kind.itemsize)
        _, page_at, page_end, page_size = self.page(name, pages.RLE_DICTIONARY, end)
        if size % kind.itemsize or size > _most_bytes(max(rows, 256)) or page_size > most:
            raise DamageError(f"column '{name}' does not hold {rows} values")
        known = np.frombuffer(self._codec.decompress(data[at:end], size), kind)
        return known, np.frombuffer(self._codec.decompress(data[page_at:page_end], page_size), np.uint8)

    def _differences(self, name: str, page: Bytes, values: NumberArray) -> None:
        from roadscan.store.codecs.kernels.delta_packing import FAULTS, SLACK_BYTES, WHOLE, decode

        words = -(-(page.size + SLACK_BYTES) // _NUMBER_WORD)
        if self._unpacked.size < words:
            self._unpacked = np.empty(words, np.uint64)
        room = self._unpacked.view(np.uint8)
        room[: page.size] = page
        fault = decode(room, self._unpacked, 0, page.size, values)
        if fault != WHOLE:
            raise DamageError(f"column '{name}': {FAULTS[fault]}")


def _most_bytes(count: int) -> int:
    """Return the bytes that an unpacked page of this many numbers may take."""
    return _NUMBER_WORD * count + count // 4 + 1024
