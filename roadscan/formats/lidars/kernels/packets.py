"""Kernels that unpack packets of Ouster and of Velodyne."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, kernel

_POLYNOMIAL = np.uint64(0xC96C5795D7870F42)  # ECMA-182, bits reversed
_WORD = 8  # bytes that are taken at once
_U = np.uint64
_BYTE, _ALL = _U(0xFF), _U(0xFFFF_FFFF_FFFF_FFFF)  # masks of one byte, of all bits
_FULL_BYTE = np.uint32(257)  # scales 255 to 65,535


class Layout(NamedTuple):
    """Bytes of a packet, all int64."""

    header: int
    """Bytes before the first column."""
    column: int
    """Bytes of a column."""
    column_header: int
    """Bytes before a column's first pixel."""
    pixel: int
    """Bytes of a pixel."""
    rows: int
    """Pixels of a column."""


class Optics(NamedTuple):
    """Where the beams of each column go, in the sensor's axes."""

    directions: npt.NDArray[np.float32]
    """(columns, rows, 3) unit vectors."""
    origins_m: npt.NDArray[np.float32]
    """(columns, 3) where the beams begin."""
    origin_mm: np.float32
    """Distance from the lidar's origin to the beams' origin, which a range contains."""


class Returns(NamedTuple):
    """Room for returns, (n,) each."""

    epoch_gps_ns: npt.NDArray[np.int64]
    x_m: npt.NDArray[np.float32]
    y_m: npt.NDArray[np.float32]
    z_m: npt.NDArray[np.float32]
    intensity: npt.NDArray[np.uint16]
    laser: npt.NDArray[np.uint8]
    sweep: npt.NDArray[np.int32]


def checksum_tables() -> npt.NDArray[np.uint64]:
    """Return the tables (8, 256) of `checksums`: row k is a byte's share, k bytes before the last of a word."""
    tables = np.zeros((_WORD, 256), np.uint64)
    tables[0] = np.arange(256)
    for _ in range(8):
        tables[0] = (tables[0] >> _U(1)) ^ np.where(tables[0] & _U(1), _POLYNOMIAL, _U(0))
    for k in range(1, _WORD):
        tables[k] = tables[0][(tables[k - 1] & _BYTE).astype(np.int64)] ^ (tables[k - 1] >> _U(8))
    return tables


@kernel
def checksums(packets, words, tables, out):
    """Compute CRC-64 (ECMA-182, bits reversed, as in XZ) of each packet but its last eight bytes, eight at a time.

    Parameters
    ----------
    packets : (n, b) uint8; words : (n, b // 8) uint64, the same bytes, little-endian.
    tables : (8, 256) uint64, of `checksum_tables`; out : (n,) uint64.
    """
    size = packets.shape[1] - 8
    for i in range(packets.shape[0]):
        crc = _ALL
        for j in range(size // 8):
            crc ^= words[i, j]
            crc = (
                tables[7, np.int64(crc & _BYTE)]
                ^ tables[6, np.int64((crc >> _U(8)) & _BYTE)]
                ^ tables[5, np.int64((crc >> _U(16)) & _BYTE)]
                ^ tables[4, np.int64((crc >> _U(24)) & _BYTE)]
                ^ tables[3, np.int64((crc >> _U(32)) & _BYTE)]
                ^ tables[2, np.int64((crc >> _U(40)) & _BYTE)]
                ^ tables[1, np.int64((crc >> _U(48)) & _BYTE)]
                ^ tables[0, np.int64(crc >> _U(56))]
            )
        for j in range(size // 8 * 8, size):
            crc = tables[0, np.int64((crc ^ _U(packets[i, j])) & _BYTE)] ^ (crc >> _U(8))
        out[i] = ~crc


@inlined
def _two_bytes(packet, at):
    return np.uint32(packet[at]) | np.uint32(packet[at + 1]) << np.uint32(8)


@kernel
def decode(packets, layout, returns, columns, epochs, sweeps, optics, out):
    """Write the returns of packets in the order of columns, pixels and returns; leave out pixels without one.

    Parameters
    ----------
    packets : (n, b) uint8; layout : Layout.
    returns : (r, 5) int64, a return a row: first byte, bits and unit (mm) of its range, first byte and bits of its
        intensity (8, scaled to 16; or 16).
    columns : (n, c) int64, number of each column in the turn, −1 for those that are not to be read.
    epochs : (n, c) int64, GPS ns of each column; sweeps : (n,) int32.
    optics : Optics; out : Returns, with room for all pixels.

    Returns
    -------
    (int, int), how many returns were written, and how many were left out since they lie inside the sensor.
    """
    written, inside = 0, 0
    for i in range(packets.shape[0]):
        packet = packets[i]
        for c in range(columns.shape[1]):
            column = columns[i, c]
            if column < 0:
                continue
            first = layout.header + c * layout.column + layout.column_header
            for row in range(layout.rows):
                pixel = first + row * layout.pixel
                for k in range(returns.shape[0]):
                    at = pixel + returns[k, 0]
                    raw = _two_bytes(packet, at)
                    if returns[k, 1] > 16:
                        raw |= _two_bytes(packet, at + 2) << np.uint32(16)
                    raw &= (np.uint32(1) << np.uint32(returns[k, 1])) - np.uint32(1)
                    if raw == 0:
                        continue
                    range_mm = np.float32(raw * np.uint32(returns[k, 2]))
                    if range_mm <= optics.origin_mm:
                        inside += 1
                        continue
                    beyond_m = (range_mm - optics.origin_mm) * np.float32(0.001)
                    out.epoch_gps_ns[written] = epochs[i, c]
                    out.x_m[written] = optics.origins_m[column, 0] + beyond_m * optics.directions[column, row, 0]
                    out.y_m[written] = optics.origins_m[column, 1] + beyond_m * optics.directions[column, row, 1]
                    out.z_m[written] = optics.origins_m[column, 2] + beyond_m * optics.directions[column, row, 2]
                    bright = pixel + returns[k, 3]
                    if returns[k, 4] == 16:
                        out.intensity[written] = np.uint16(_two_bytes(packet, bright))
                    else:
                        out.intensity[written] = np.uint16(packet[bright] * _FULL_BYTE)
                    out.laser[written] = np.uint8(row)
                    out.sweep[written] = sweeps[i]
                    written += 1
    return written, inside


_BLOCK, _RETURN = 100, 3  # bytes of a block, and of a return in it
_FIRST_RETURN = 4  # bytes of a block before its first return
_SLOTS = 32  # returns of a block


class Firings(NamedTuple):
    """What is known of n packets beside their returns."""

    epoch_gps_ns: npt.NDArray[np.int64]
    """(n, blocks) GPS time of each block's packet, and the block's wait at a gap of the view."""
    head: npt.NDArray[np.uint16]
    """(n, blocks, 1 or 32) azimuth of the head (0.01°), of a block or of each slot."""
    rate: npt.NDArray[np.float64]
    """(n,) rate of the head (rad/ns)."""
    sweep: npt.NDArray[np.int32]
    """(n, blocks or more)."""
    time_ns: npt.NDArray[np.int64]
    """(blocks, 32) time of each return after the packet's."""
    slot: npt.NDArray[np.uint8]
    """(blocks, 32) slot of each return."""


class Room(NamedTuple):
    """Room for m returns, (m,) each."""

    epoch_gps_ns: npt.NDArray[np.int64]
    head: npt.NDArray[np.uint16]
    rate: npt.NDArray[np.float64]
    distance: npt.NDArray[np.uint16]
    intensity: npt.NDArray[np.uint8]
    slot: npt.NDArray[np.uint8]
    sweep: npt.NDArray[np.int32]


@kernel
def returned(packets, firings, dual, room):
    """Write the returns of packets, slot by slot, without empty slots; return their number.

    Parameters
    ----------
    packets : (n, bytes) uint8.
    firings : Firings.
    dual : whether every second block repeats the one before with the other return: equal ones count once.
    room : Room for all slots.
    """
    count = 0
    ways = firings.head.shape[2]
    for p in range(packets.shape[0]):
        for b in range(firings.slot.shape[0]):
            epoch, sweep = firings.epoch_gps_ns[p, b], firings.sweep[p, b]
            for j in range(_SLOTS):
                at = _BLOCK * b + _FIRST_RETURN + _RETURN * j
                low, high, bright = packets[p, at], packets[p, at + 1], packets[p, at + 2]
                if low == 0 and high == 0:
                    continue
                if dual and b % 2:
                    other = at - _BLOCK
                    if packets[p, other] == low and packets[p, other + 1] == high and packets[p, other + 2] == bright:
                        continue
                room.epoch_gps_ns[count] = epoch + firings.time_ns[b, j]
                room.head[count] = firings.head[p, b, j % ways]
                room.rate[count] = firings.rate[p]
                room.distance[count] = np.uint16(low) | (np.uint16(high) << np.uint16(8))
                room.intensity[count] = bright
                room.slot[count] = firings.slot[b, j]
                room.sweep[count] = sweep
                count += 1
    return count
