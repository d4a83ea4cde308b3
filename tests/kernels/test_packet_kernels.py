"""Kernels of packets and compressed clouds: Ouster's pixels and checksum, LZF."""

from __future__ import annotations

import struct

import lzf
import numpy as np

from roadscan.formats.clouds.kernels.lzf import expand
from roadscan.formats.lidars.kernels.ouster import Layout, Optics, Returns, checksum_tables, checksums, decode


def crc64(data: bytes) -> int:
    """CRC-64 of ECMA-182 with reversed bits, bit by bit."""
    register = (1 << 64) - 1
    for octet in data:
        register ^= octet
        for _ in range(8):
            register = register >> 1 ^ (0xC96C5795D7870F42 if register & 1 else 0)
    return register ^ (1 << 64) - 1


def test_checksum_is_that_of_the_catalogue() -> None:
    """CRC-64/XZ of "123456789" is 0x995DC9BBDF1939FA (catalogue of parametrised CRC algorithms)."""
    assert crc64(b"123456789") == 0x995DC9BBDF1939FA
    for text in (b"123456789", b"12345678", bytes(range(40))):
        padded = np.frombuffer(text + bytes(8 + (-len(text)) % 8), np.uint8)[None]
        out = np.zeros(1, np.uint64)
        checksums(padded[:, : len(text) + 8], padded.view("<u8"), checksum_tables(), out)
        assert int(out[0]) == crc64(text)


def test_pixels_become_returns_along_their_beams() -> None:
    """Two columns of two pixels of two returns: 19 bits of range, reflectivity of 8 bits, signal of 16 bits."""
    pixels = [(1_000, 7, 300), (0, 9, 400), (15, 1, 1), (500_000, 255, 65_535)] * 2
    pairs = [
        struct.pack("<IIHHI", (b[0] | b[1] << 24), (c[0] | c[1] << 24), b[2], c[2], 0)
        for b, c in zip(pixels[::2], pixels[1::2], strict=True)
    ]
    packet = bytes(32) + bytes(12) + pairs[0] + pairs[1] + bytes(12) + pairs[2] + pairs[3]
    directions = np.zeros((4, 2, 3), np.float32)
    directions[:, 0, 0], directions[:, 1, 1] = 1.0, 1.0
    origins = np.array([[0.0, 0.0, 0.1 * k] for k in range(4)], np.float32)
    kinds = (np.int64, np.float32, np.float32, np.float32, np.uint16, np.uint8, np.int32)
    for bits, bright in ((8, (3, 7)), (16, (8, 10))):
        room = Returns(*(np.zeros(8, kind) for kind in kinds))
        written, inside = decode(
            np.frombuffer(packet, np.uint8)[None],
            Layout(32, 44, 12, 16, 2),
            np.array([[0, 19, 1, bright[0], bits], [4, 19, 1, bright[1], bits]]),
            np.array([[3, -1]]),
            np.array([[77, 88]]),
            np.array([5], np.int32),
            Optics(directions, origins, np.float32(20.0)),
            room,
        )
        assert (written, inside) == (2, 1)  # a range of 0, one inside the sensor, and the column that was not measured
        assert room.epoch_gps_ns[:2].tolist() == [77, 77]
        assert room.x_m[:2].tolist() == [np.float32(0.98), 0.0]
        assert abs(room.y_m[1] - 499.98) < 1e-4
        assert room.z_m[:2].tolist() == [np.float32(0.3)] * 2
        assert room.intensity[:2].tolist() == ([7 * 257, 65_535] if bits == 8 else [300, 65_535])
        assert (room.laser[:2].tolist(), room.sweep[:2].tolist()) == ([0, 1], [5, 5])


def test_lzf_expands_what_liblzf_compressed() -> None:
    random = np.random.default_rng(1)
    for content in (b"a" * 1_000, bytes(random.integers(0, 4, 2_000, dtype="u1")), b"abcabcabcabd" * 40):
        packed = np.frombuffer(lzf.compress(content), np.uint8)
        out = np.zeros(len(content), np.uint8)
        assert expand(packed, out) == len(content)
        assert out.tobytes() == content
        assert expand(packed[: packed.size // 2], out) < len(content)
        assert expand(packed, out[:100]) <= 100
    assert expand(np.array([0x20, 0x00, 5], np.uint8), out) == 0  # a copy from before the start
