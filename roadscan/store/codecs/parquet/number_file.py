"""Reads Parquet files that `number_table` wrote; any other content counts as damage."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.store.codecs.kernels.run_lengths import LONGEST_RUN_BYTES, decode_runs
from roadscan.store.codecs.parquet import pages
from roadscan.store.codecs.parquet.page_file import DamageError, PageFile

_PLANES: Final = 4  # byte planes of a 32-bit number
_WORD: Final = 8  # bytes of a 64-bit word
_ENCODINGS: Final = {
    "PLAIN": pages.PLAIN,
    "DELTA_BINARY_PACKED": pages.DELTA_BINARY_PACKED,
    "BYTE_STREAM_SPLIT": pages.BYTE_STREAM_SPLIT,
}

Array = npt.NDArray[Any]
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
        known, page = self._indexed(name, rows, np.dtype("<i4"), 2 * _WORD + rows)
        head = b"\x08" + pages.bit_packed(rows)
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
        _, page_at, page_end, page_size = self.page(name, pages.RLE_DICTIONARY, end)
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
