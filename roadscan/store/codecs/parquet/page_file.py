"""Reads pages of Parquet files that `list_table.Writer` wrote; any other content counts as damage."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.store.codecs.parquet import pages
from roadscan.store.codecs.zlib_stream import crc32

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
    from roadscan.store.codecs.parquet.list_table import MAGIC

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
    from roadscan.store.codecs.parquet.list_table import sealed

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
