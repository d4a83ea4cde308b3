"""Memory for buckets of readings by row of cells (``tiles.kernels.row_buckets``)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.tiles.kernels.row_buckets import BLOCK, PASS, Buckets

_FIRST_BLOCKS: Final = 4096  # Blocks of new buckets, at least.
_RECORD, _BLOCK_NUMBERS = 8, 4 * 4  # Bytes of a reading, and of a block's four numbers.
BLOCK_BYTES: Final = BLOCK * _RECORD + _BLOCK_NUMBERS
"""Bytes of a block."""


class RowBuckets:
    """Blocks of readings; the memory grows and never shrinks."""

    def __init__(self) -> None:
        self.held = np.zeros(2, np.int64)
        self._make(0)
        self.clear()

    @property
    def size(self) -> int:
        """Number of blocks."""
        return int(self.free.size)

    @property
    def arrays(self) -> Buckets:
        """The blocks in the form that kernels take."""
        return Buckets(self.records, self.before, self.sizes, self.owners, self.free, self.held)

    def make_room(self, blocks: int, most_bytes: int) -> bool:
        """Grow until so many blocks are free; False where that takes more than `most_bytes` and some are in use."""
        needed = int(self.held[0]) + blocks
        if needed <= self.size:
            return True
        if needed * BLOCK_BYTES > most_bytes and self.held[0]:
            return False
        size = max(needed, min(self.size * 4, most_bytes // BLOCK_BYTES), _FIRST_BLOCKS)
        kept: tuple[npt.NDArray[Any], ...] = self.arrays[:-1]
        self._make(size)
        made: tuple[npt.NDArray[Any], ...] = self.arrays[:-1]
        for new, old in zip(made, kept, strict=True):
            new[: old.size] = old
        return True

    def clear(self) -> None:
        """Return every block to the free list."""
        self.held[:] = 0
        self.held[PASS] = -1
        self.free[:] = np.arange(self.size, dtype=np.int32)

    def _make(self, size: int) -> None:
        self.records = np.empty(size * BLOCK, np.uint64)
        self.before, self.sizes, self.owners = (np.empty(size, np.int32) for _ in range(3))
        self.free = np.arange(size, dtype=np.int32)
