"""CRC-32 of pages, at the speed of memory."""

from __future__ import annotations

import zlib
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.kernels.crc32 import FAR, WINDOW, fold

_WORD: Final = 8
_ONES: Final = 0xFFFF_FFFF
_SHORT_BYTES: Final = 4 * FAR * _WORD
"""Below it, zlib is as fast."""


class Checksum:
    """CRC-32 as zlib computes it, two to three times as fast; holds working arrays, so one a thread."""

    def __init__(self) -> None:
        self._window = np.empty(WINDOW, np.uint64)
        self._rest = np.empty(FAR, np.uint64)

    def of(self, data: npt.NDArray[np.uint8], before: int = 0) -> int:
        """CRC-32 of bytes that follow others whose CRC-32 is `before`."""
        if data.size < _SHORT_BYTES:
            return zlib.crc32(data.data, before)
        skipped = -data.ctypes.data % _WORD
        end = data.size - (data.size - skipped) % _WORD
        register = zlib.crc32(data[:skipped].data, before) ^ _ONES
        fold(data[skipped:end].view(np.uint64), np.uint64(register), self._window, self._rest)
        return zlib.crc32(data[end:].data, zlib.crc32(self._rest.data, _ONES))
