"""Buffers of the compressor of rasters (`roadscan/kernels/deflate.py`), used again from block to block."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.kernels.deflate import PAIRS, SEGMENT, deflate, room_words


class Packer:
    """Makes zlib streams; one a thread."""

    def __init__(self) -> None:
        self._segments = np.empty(0, np.int32)
        self._pairs = np.empty(PAIRS, np.uint32)
        self._out = np.empty(0, np.uint64)

    def pack(self, data: npt.NDArray[Any]) -> bytes:
        """Compress (n,) contiguous bytes."""
        whole = data.size // SEGMENT
        if self._segments.size < whole:
            self._segments = np.empty(whole, np.int32)
        if self._out.size < room_words(data.size):
            self._out = np.empty(room_words(data.size), np.uint64)
        words = data[: SEGMENT * whole].view(np.uint64)
        return deflate(data, words, self._segments, self._pairs, self._out)
