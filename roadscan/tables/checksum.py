"""CRC-32 of pages, at the speed of memory."""

from __future__ import annotations

import zlib
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.kernels import crc32, crc32_carryless

_WORD: Final = 8
_ONES: Final = 0xFFFF_FFFF
_SHORT_BYTES: Final = 4 * crc32_carryless.STEP_BYTES
_SHORT_WORDS_BYTES: Final = 4 * crc32.FAR * _WORD
"""Below them, zlib is as fast."""

Bytes = npt.NDArray[np.uint8]


class CarrylessChecksum:
    """CRC-32 as zlib computes it, about twenty times as fast, on processors that can do it."""

    def __init__(self) -> None:
        self._rest = np.empty(crc32_carryless.STEP_BYTES, np.uint8)

    def of(self, data: Bytes, before: int = 0) -> int:
        """CRC-32 of bytes that follow others whose CRC-32 is `before`."""
        if data.size < _SHORT_BYTES:
            return zlib.crc32(data.data, before)
        crc32_carryless.fold(data, np.uint64(before ^ _ONES), self._rest)
        left = data.size % crc32_carryless.STEP_BYTES
        return zlib.crc32(data[data.size - left :].data, zlib.crc32(self._rest.data, _ONES))


class FoldedChecksum:
    """CRC-32 as zlib computes it, two to three times as fast."""

    def __init__(self) -> None:
        self._window = np.empty(crc32.WINDOW, np.uint64)
        self._rest = np.empty(crc32.FAR, np.uint64)

    def of(self, data: Bytes, before: int = 0) -> int:
        """CRC-32 of bytes that follow others whose CRC-32 is `before`."""
        if data.size < _SHORT_WORDS_BYTES:
            return zlib.crc32(data.data, before)
        skipped = -data.ctypes.data % _WORD
        end = data.size - (data.size - skipped) % _WORD
        register = zlib.crc32(data[:skipped].data, before) ^ _ONES
        crc32.fold(data[skipped:end].view(np.uint64), np.uint64(register), self._window, self._rest)
        return zlib.crc32(data[end:].data, zlib.crc32(self._rest.data, _ONES))


def checksum() -> CarrylessChecksum | FoldedChecksum:
    """The faster way of this processor; it holds working arrays, so one a thread."""
    return CarrylessChecksum() if crc32_carryless.THERE else FoldedChecksum()
