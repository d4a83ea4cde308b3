"""Reads Parquet files that `number_table` wrote; any other content counts as damage."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

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
