"""The compressor of rasters: zlib unpacks what it made, and needs little more room."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from roadscan.products.packer import Packer
from roadscan.products.pixel_blocks import DenseBlocks, ScatteredBlocks

RNG = np.random.default_rng(5)


def with_runs(size: int, symbols: int) -> np.ndarray:
    """Noise of so many symbols, cut by runs of zeros and of other bytes."""
    data = RNG.integers(0, symbols, size).astype(np.uint8)
    for _ in range(6):
        start, end = sorted(RNG.integers(0, size + 1, 2))
        data[start:end] = RNG.integers(0, 2) * RNG.integers(0, 256)
    return data


def test_zlib_unpacks_it() -> None:
    packer = Packer()  # its buffers are used again for shorter and for longer data
    for size in [0, 1, 15, 16, 17, 33, *RNG.integers(1, 6000, 60).tolist()]:
        for symbols in (1, 2, 60, 256):
            data = with_runs(size, symbols)
            assert zlib.decompress(packer.pack(data)) == data.tobytes(), (size, symbols)


@pytest.mark.parametrize("fill", [0, 255])
def test_large_sums_of_adler_32(fill: int) -> None:
    data = np.full(3 << 20, fill, np.uint8)
    packed = Packer().pack(data)
    assert zlib.decompress(packed) == data.tobytes()
    assert fill or len(packed) < data.size / 200


def test_room_is_that_of_zlibs_huffman_codes() -> None:
    data = np.rint(RNG.normal(0, 9, 1 << 17)).astype(np.int64).astype(np.uint8)
    data[20_000:60_000] = 0
    packer = zlib.compressobj(6, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_RLE)
    theirs = len(packer.compress(data.tobytes()) + packer.flush())
    assert len(Packer().pack(data)) < 1.02 * theirs


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 1.0])
def test_scattered_cells_are_the_pixels_of_numpy(share: float) -> None:
    edge, west = 48, 96
    there = RNG.random((edge, edge)) < share
    there[RNG.integers(edge), RNG.integers(edge)] = True
    row, column = np.nonzero(there)
    starts = np.searchsorted(row, np.arange(edge + 1)).astype(np.int64)
    first, last = starts[:-1][::-1].copy(), starts[1:][::-1].copy()  # from the north
    values = np.empty(row.size, np.float32)
    columns = (column + west).astype(np.uint16)
    blocks = ScatteredBlocks(columns, values, edge)  # its buffers are used again
    dense = DenseBlocks(columns, values, edge, Packer())
    for own in (RNG.normal(100, 1, row.size), RNG.integers(0, 2**31, row.size).astype(np.uint32).view(np.float32)):
        values[:] = own
        pixels = np.full((edge, edge), np.nan, np.float32)
        pixels[row, column] = values
        assert zlib.decompress(blocks.block(first, last, west)) == pixels[::-1].tobytes()
        planes = np.ascontiguousarray(pixels[::-1]).astype(">f4").view(np.uint8).reshape(edge, edge, 4)
        lines = planes.transpose(0, 2, 1).reshape(edge, 4 * edge)  # TIFF Technical Note 3
        coded = np.diff(lines, axis=1, prepend=np.zeros((edge, 1), np.uint8))
        assert zlib.decompress(dense.block(first, last, west)) == coded.tobytes()
