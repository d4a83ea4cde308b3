"""Buffers of the compressor of rasters (`roadscan/kernels/deflate.py`), used again from block to block."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.kernels.deflate import PAIRS, SEGMENT, deflate, room_words

_KEPT = threading.local()


class Packer:
    """Makes zlib streams; one a thread."""

    def __init__(self) -> None:
        self._data = np.empty(0, np.uint8)
        self._segments = np.empty(0, np.int32)
        self._pairs = np.empty(PAIRS, np.uint32)
        self._out = np.empty(0, np.uint64)

    @classmethod
    def of_thread(cls) -> Packer:
        """The thread's own: fresh memory is dear."""
        kept: Packer | None = getattr(_KEPT, "packer", None)
        if kept is None:
            kept = _KEPT.packer = cls()
        return kept

    def data(self, size: int) -> npt.NDArray[np.uint8]:
        """Room for bytes to compress; what it held before is lost."""
        if self._data.size < size:
            self._data = np.empty(size, np.uint8)
        return self._data[:size]

    def pack(self, data: npt.NDArray[Any]) -> bytes:
        """Compress (n,) contiguous bytes."""
        whole = data.size // SEGMENT
        if self._segments.size < whole:
            self._segments = np.empty(whole, np.int32)
        if self._out.size < room_words(data.size):
            self._out = np.empty(room_words(data.size), np.uint64)
        words = data[: SEGMENT * whole].view(np.uint64)
        return deflate(data, words, self._segments, self._pairs, self._out)
