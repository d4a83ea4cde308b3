"""CRC-32 by folding: zlib's figures."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import pytest

from roadscan.kernels import crc32_carryless
from roadscan.kernels.crc32 import FAR, WINDOW
from roadscan.tables.checksum import CarrylessChecksum, FoldedChecksum, checksum

BYTES = np.random.default_rng(0).integers(0, 256, 8 * (WINDOW + 2 * FAR), dtype=np.uint8)
SIZES = [0, 1, 1000, 32 * FAR - 1, 32 * FAR, 32 * FAR + 3, 8 * WINDOW, 8 * WINDOW + 17, BYTES.size - 9]


WAYS = [FoldedChecksum] + [CarrylessChecksum] * crc32_carryless.THERE


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("size", [*SIZES, 1024, 1025, 1279, 1280])
@pytest.mark.parametrize("start", [0, 3])
def test_checksum_is_that_of_zlib(size: int, start: int, way: Any) -> None:
    data = BYTES[start : start + size]
    assert way().of(data) == zlib.crc32(data)
    assert way().of(data, 0x1234_5678) == zlib.crc32(data, 0x1234_5678)


def test_a_flipped_bit_is_seen() -> None:
    data = BYTES[: 40 * FAR].copy()
    before = checksum().of(data)
    for bit in np.random.default_rng(1).integers(0, data.size * 8, 20):
        data[bit // 8] ^= 1 << bit % 8
        assert checksum().of(data) != before
        data[bit // 8] ^= 1 << bit % 8
