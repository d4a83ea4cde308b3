"""Reads Parquet files as `list_table` writes them; anything else in such a file is damage."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.kernels.delta_packing import FAULTS, SLACK_BYTES, WHOLE, decode
from roadscan.tables import pages
from roadscan.tables.checksum import Checksum
from roadscan.tables.list_table import MAGIC, sealed

TAIL_BYTES: Final = 8
"""Length of the footer, and the mark that ends a Parquet file."""
_WORD: Final = 8
_LISTED: Final = ".list.element"

Array = npt.NDArray[Any]


class DamageError(Exception):
    """What is wrong with a file."""


@dataclass(frozen=True)
class _Chunk:
    """A column of a row group."""

    start: int
    """Byte of the file."""
    size: int
    values: int
    nullable: bool


def read_footer(stream: Any) -> tuple[pq.FileMetaData, bool]:
    """The footer of a Parquet file, and whether `list_table` wrote it; DamageError where it is damaged."""
    size = stream.seek(0, os.SEEK_END)
    tail = _read(stream, max(size - TAIL_BYTES, 0), size)
    length = int.from_bytes(tail[:4], "little")
    if tail[4:] != MAGIC or length > size - TAIL_BYTES:
        raise DamageError("it does not end as a Parquet file")
    tail = _read(stream, size - TAIL_BYTES - length, size)
    ours = sealed(tail[:-TAIL_BYTES])
    if ours is False:
        raise DamageError("its footer does not have its checksum")
    return pq.read_metadata(pa.BufferReader(tail)), ours is True


def _read(stream: Any, start: int, end: int) -> bytes:
    stream.seek(start)
    return bytes(stream.read(end - start))


class ListTableFile:
    """Columns of row groups, one row group at a time; holds its buffer, so one a thread.

    Bytes are read at once for all columns wanted; each page is held against its CRC-32 before it is looked at.
    """

    def __init__(self, stream: Any, metadata: pq.FileMetaData) -> None:
        self._stream = stream
        self._size = stream.seek(0, os.SEEK_END)
        self._metadata = metadata
        self._checksum = Checksum()
        self._words = np.empty(0, np.uint64)
        self._known: dict[int, dict[str, _Chunk]] = {}
        self._chunks: dict[str, _Chunk] = {}
        self._origin = 0

    def load(self, group: int, names: Sequence[str]) -> None:
        """Bring columns of a row group into the buffer."""
        if group not in self._known:
            self._known[group] = self._located(group)
        self._chunks = {name: self._known[group][name] for name in names}
        self._origin = min(c.start for c in self._chunks.values())
        end = max(c.start + c.size for c in self._chunks.values())
        words = -(-(end - self._origin + SLACK_BYTES) // _WORD)
        if self._words.size < words:
            self._words = np.empty(words, np.uint64)
        self._stream.seek(self._origin)
        left = self._words.view(np.uint8).data[: end - self._origin]
        while left:
            count = self._stream.readinto(left)
            if not count:
                raise DamageError("it is cut short")
            left = left[count:]

    def flat(self, name: str, values: Array) -> None:
        """Write a loaded column of int64 that is never null to (n,) `values`."""
        data, at, end = self._page(name, pages.PLAIN)
        if self._chunks[name].nullable or end - at != values.nbytes:
            raise DamageError(f"column '{name}' does not hold {values.size} values")
        values[:] = data[at:end].view("<i8")

    def lists(self, name: str, values: Array) -> bool:
        """Write a loaded column of lists to (n, m) `values`; False, and nothing written, where a list is null."""
        chunk = self._chunks[name]
        data, at, end = self._page(name, pages.DELTA_BINARY_PACKED)
        rows, size = values.shape
        levels = pages.list_levels(rows, size, np.ones(rows, np.bool_) if chunk.nullable else None)
        begin = at + len(levels)
        if data[at:begin].tobytes() != levels:
            if chunk.nullable:
                return False
            raise DamageError(f"column '{name}' does not hold {rows} lists of {size} values")
        fault = decode(data, self._words, begin, end, values.reshape(-1))
        if fault != WHOLE:
            raise DamageError(f"column '{name}': {FAULTS[fault]}")
        return True

    def _page(self, name: str, encoding: int) -> tuple[npt.NDArray[np.uint8], int, int]:
        """The buffer, and where in it a column's levels and values begin and end, once they have their checksum."""
        chunk, data = self._chunks[name], self._words.view(np.uint8)
        start = chunk.start - self._origin
        end = start + chunk.size
        header = pages.read_page_header(data[start:end], chunk.values, encoding)
        if header is None:
            raise DamageError(f"column '{name}': a page's header is damaged")
        start += header[0]
        if self._checksum.of(data[start:end]) != header[1]:
            raise DamageError(f"column '{name}': a page does not have its checksum")
        return data, start, end

    def _located(self, group: int) -> dict[str, _Chunk]:
        found, about = {}, self._metadata.row_group(group)
        for k in range(self._metadata.num_columns):
            column = about.column(k)
            chunk = _Chunk(
                start=column.data_page_offset,
                size=column.total_compressed_size,
                values=column.num_values,
                nullable=self._metadata.schema.column(k).max_definition_level > column.path_in_schema.endswith(_LISTED),
            )
            if not 0 <= chunk.start <= chunk.start + chunk.size <= self._size:
                raise DamageError("its footer speaks of pages outside of it")
            found[column.path_in_schema.removesuffix(_LISTED)] = chunk
        return found
