"""zlib's streams and checksums: zlib agrees."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from roadscan.store.codecs.zlib_stream import compressed, crc32

RNG = np.random.default_rng(5)


def with_runs(size: int, symbols: int) -> np.ndarray:
    """Noise of so many symbols, cut by runs of zeros and of other bytes."""
    data = RNG.integers(0, symbols, size).astype(np.uint8)
    for _ in range(6):
        start, end = sorted(RNG.integers(0, size + 1, 2))
        data[start:end] = RNG.integers(0, 2) * RNG.integers(0, 256)
    return data


@pytest.mark.parametrize("size", [0, 1, 15, 16, 17, 33, 1000, 70_001, 1 << 20])
def test_zlib_unpacks_it_and_has_its_checksum(size: int) -> None:
    for symbols in (1, 2, 60, 256):
        data = with_runs(size, symbols)
        assert zlib.decompress(compressed(data)) == data.tobytes()
        assert crc32(data) == zlib.crc32(data)
        assert crc32(data[3:], 0x1234_5678) == zlib.crc32(data[3:], 0x1234_5678)


@pytest.mark.own_codecs
def test_room_is_that_of_zlibs_huffman_codes() -> None:
    data = np.rint(RNG.normal(0, 9, 1 << 17)).astype(np.int64).astype(np.uint8)
    data[20_000:60_000] = 0
    packer = zlib.compressobj(6, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_RLE)
    assert len(compressed(data)) < 1.02 * len(packer.compress(data) + packer.flush())


@pytest.mark.own_codecs
@pytest.mark.parametrize("fill", [0, 255])
def test_large_sums_of_adler_32(fill: int) -> None:
    data = np.full(3 << 20, fill, np.uint8)
    packed = compressed(data)
    assert zlib.decompress(packed) == data.tobytes()
    assert fill or len(packed) < data.size / 200
