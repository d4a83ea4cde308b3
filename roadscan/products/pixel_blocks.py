"""Compressed blocks of a GeoTIFF from sparse cells: two ways, the same pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.kernels.deflate import SYMBOLS
from roadscan.kernels.raster_blocks import encode_block
from roadscan.kernels.scattered_block import deflate_scattered, room_words
from roadscan.products.packer import Packer

Lines = npt.NDArray[np.int64]


class DenseBlocks:
    """Blocks where cells lie side by side: TIFF's floating-point predictor, then the compressor of rasters."""

    def __init__(
        self, column: npt.NDArray[np.uint16], values: npt.NDArray[np.float32], edge: int, packer: Packer
    ) -> None:
        """Of cells (n,) by row and column; `values` may change from block to block."""
        self._column, self._values, self._packer = column, values, packer
        self._out = packer.data(edge * edge * 4)
        line, differences = np.empty(edge, np.float32), np.empty(edge, np.uint32)
        self._lines = line, line.view(np.uint8), differences, differences.view(np.uint8)

    def block(self, first: Lines, last: Lines, west: int) -> bytes:
        """The block whose first column is `west`; first cell of each line from the north, and the first beyond it."""
        encode_block(self._column, self._values, first, last, west, self._out, *self._lines)
        return self._packer.pack(self._out)


class ScatteredBlocks:
    """Blocks where hardly a cell has one beside it, without predictor: what they cost goes by cells, not by pixels."""

    def __init__(self, column: npt.NDArray[np.uint16], values: npt.NDArray[np.float32], edge: int) -> None:
        """As for :class:`DenseBlocks`."""
        self._column, self._words, self._edge = column, values.view(np.uint32), edge
        self._scratch: tuple[Any, ...] = (
            np.empty(SYMBOLS, np.int64),
            np.empty(SYMBOLS, np.uint32),
            np.empty(room_words(edge * edge), np.uint64),
        )

    def block(self, first: Lines, last: Lines, west: int) -> bytes:
        """As :meth:`DenseBlocks.block`."""
        return deflate_scattered(self._column, self._words, first, last, west, self._edge, *self._scratch)
