"""Kernels of packets and compressed clouds: Ouster's pixels and checksum, LZF."""

from __future__ import annotations

import struct

import lzf
import numpy as np

from roadscan.compute.kernel_options import read_only
from roadscan.formats.clouds.kernels.lzf import expand
from roadscan.formats.lidars.kernels.packets import (
    Firings,
    Layout,
    Optics,
    Returns,
    Room,
    checksum_tables,
    checksums,
    decode,
    returned,
)
from roadscan.store.codecs.kernels.byte_planes import LONGEST_RUN_BYTES, decode_runs, encode_runs
from roadscan.store.readings.kernels.firings import SLOTS, BeamTable, Packed, Turned, positions


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
        packed = np.frombuffer(lzf.compress(content), np.uint8)  # read-only, as in a file
        out = np.zeros(len(content), np.uint8)
        assert expand(packed, out) == len(content)
        assert out.tobytes() == content
        assert expand(packed[: packed.size // 2], out) < len(content)
        assert expand(packed, out[:100]) <= 100
    assert expand(np.frombuffer(b"\x20\x00\x05", np.uint8), out) == 0  # a copy from before the start


def test_slots_of_velodyne_packets_become_packed_returns() -> None:
    """Two blocks of a dual return: empty slots are left out, and what the second block repeats."""
    packet = np.zeros((1, 1206), np.uint8)
    for block, (slot, far, bright) in ((0, (3, 515, 7)), (1, (3, 515, 7)), (1, (4, 256, 9)), (0, (31, 1, 255))):
        at = 100 * block + 4 + 3 * slot
        packet[0, at : at + 3] = far % 256, far // 256, bright
    slots = np.tile(np.arange(32, dtype=np.uint8), (2, 1))
    firings = Firings(
        np.array([[1_000, 2_000]]), np.array([[[10], [20]]], np.uint16), np.array([0.5]), np.array([[6, 7]], np.int32),
        np.tile(np.arange(32, dtype=np.int64), (2, 1)), slots,
    )  # fmt: skip
    kinds = (np.int64, np.uint16, np.float64, np.uint16, np.uint8, np.uint8, np.int32)
    for dual, rows in ((True, [(0, 3, 515, 7), (0, 31, 1, 255), (1, 4, 256, 9)]), (False, None)):
        room = Room(*(np.zeros(4, kind) for kind in kinds))
        count = returned(packet, firings, dual, room)
        if rows is None:
            assert count == 4
            continue
        found = [c[:count].tolist() for c in room]
        assert found[0] == [1_000 * (1 + b) + s for b, s, _, _ in rows] and found[1] == [10 + 10 * r[0] for r in rows]
        assert found[2] == [0.5] * 3 and found[6] == [6 + r[0] for r in rows]
        assert [(s, d, i) for s, d, i in zip(found[5], found[3], found[4], strict=True)] == [r[1:] for r in rows]


def test_positions_are_those_of_the_manuals_formula() -> None:
    """Distance, elevation, azimuth at the firing and offsets of each beam, in double precision."""
    random = np.random.default_rng(0)
    n, slots = 400, 16
    head_end, rate_end = np.array([150, 151, 400]), np.array([100, 400])
    head, rate = np.array([0, 9_000, 35_999], np.uint16), np.array([6e-8, -1.2e-7])
    distance, slot = random.integers(1, 1 << 16, n).astype(np.uint16), random.integers(0, slots, n).astype(np.uint8)
    after_ns = 2_304.0 * np.arange(slots)
    elevation, own = random.uniform(-0.5, 0.3, slots), random.uniform(-0.1, 0.1, slots)
    offsets = random.normal(0, 0.05, (4, slots))
    heads = np.radians(np.arange(1 << 16) * 0.01)
    for turn, moved in ((own, offsets), (0 * own, np.vstack([offsets[:1], 0 * offsets[1:]]))):
        padded = np.zeros((8, SLOTS), np.float32)
        padded[:, :slots] = *np.stack([np.cos(elevation), np.sin(elevation), np.cos(turn), np.sin(turn)]), *moved
        level, rise, turns, rest = padded[:2], padded[4], padded[2:4], padded[5:]
        turned = turns if turn.any() else turns[:, :0]
        beams = BeamTable(
            after_ns, np.full(1, 0.002, np.float32), level[0], level[1], rise, *np.ascontiguousarray(turned),
            *np.ascontiguousarray(rest if moved[1:].any() else rest[:, :0]),
        )  # fmt: skip
        out = np.zeros((3, n), np.float32)
        turned = Turned(*np.zeros((4, SLOTS), np.float32))
        positions(
            Packed(*map(read_only, (head, head_end, rate, rate_end, distance, slot))), beams,
            np.stack([np.sin(heads), np.cos(heads)]).astype(np.float32), turned, *out,
        )  # fmt: skip
        rows = np.arange(n)
        angle = np.radians(head[np.searchsorted(head_end, rows, "right")] * 0.01) + turn[slot]
        angle = angle + rate[np.searchsorted(rate_end, rows, "right")] * after_ns[slot]
        far = distance * 0.002 + moved[1][slot]
        flat = far * np.cos(elevation[slot]) + moved[2][slot]
        x = flat * np.cos(angle) + moved[3][slot] * np.sin(angle)
        y = -flat * np.sin(angle) + moved[3][slot] * np.cos(angle)
        assert np.abs(out - [x, y, far * np.sin(elevation[slot]) + moved[0][slot]]).max() < 5e-5


def test_runs_of_dictionary_indices_come_back() -> None:
    """The bytes follow Encodings.md: twice the length as a varint, then the index."""
    page = np.zeros(1 + 2 * LONGEST_RUN_BYTES, np.uint8)
    size = encode_runs(np.array([3, 200]), np.array([5, 258]), 9, page)
    assert page[:size].tolist() == [9, 6, 5, 0, 0x90, 0x03, 2, 1]
    ends, indices = np.zeros(size, np.int64), np.zeros(size, np.int64)
    assert decode_runs(page[:size], 203, 259, ends, indices) == 2
    assert ends[:2].tolist() == [3, 203] and indices[:2].tolist() == [5, 258]
    assert decode_runs(page[:size], 203, 258, ends, indices) == -1  # an index outside of the dictionary
    assert decode_runs(page[:size], 204, 259, ends, indices) == -1 == decode_runs(page[:size], 202, 259, ends, indices)
    assert all(decode_runs(page[:k], 203, 259, ends, indices) == -1 for k in range(size))
    packed = page[:size].copy()
    packed[1] |= 1  # a bit-packed group
    assert decode_runs(packed, 203, 259, ends, indices) == -1
