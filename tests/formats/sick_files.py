"""Telegrams of SICK LMS 2xx scanners, written for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import FormatError
from roadscan.formats.scanners.sick_telegrams import (
    ALL_VALUES,
    COUNT_MASK,
    FROM_SCANNER,
    LONGEST_PAYLOAD,
    PARTIAL_BIT,
    QUARTER_BIT,
    STX,
    UNITS,
    VALUES_AND_REMISSION,
    Unit,
    checksum,
)

UInt8 = npt.NDArray[np.uint8]
UInt16 = npt.NDArray[np.uint16]
Int64 = npt.NDArray[np.int64]


def encode_telegram(payload: bytes, address: int = FROM_SCANNER) -> bytes:
    """A telegram with its CRC.

    Parameters
    ----------
    payload : command, data and (from a scanner) status byte.

    Raises
    ------
    FormatError
        if no telegram holds so much.
    """
    if not 1 <= len(payload) <= LONGEST_PAYLOAD:
        raise FormatError(f"a telegram of {len(payload)} bytes", expected=f"1 to {LONGEST_PAYLOAD}")
    body = bytes((STX, address)) + len(payload).to_bytes(2, "little") + payload
    return body + checksum(body).to_bytes(2, "little")


def write_telegrams(path: Path, telegrams: UInt8, stamps: Int64 | None = None) -> None:
    """Write telegrams one after another, each behind its stamp where there are any.

    Parameters
    ----------
    telegrams : (n, bytes), of :func:`encode_scans`.
    stamps : (n,) int64, written as 8 bytes, little-endian.
    """
    rows = telegrams
    if stamps is not None:
        heads = np.ascontiguousarray(stamps.astype("<i8"))[:, None].view(np.uint8)
        rows = np.concatenate([heads, telegrams], axis=1)
    path.write_bytes(rows.tobytes())


def encode_scans(
    ranges: UInt16,
    unit: Unit,
    *,
    remission: UInt8 | None = None,
    quarter: int | None = None,
    status: int = 0x10,
) -> UInt8:
    """Return telegrams of measured values, one per scan.

    Parameters
    ----------
    ranges : (n, readings) as the scanner counts them, flag bits and codes included.
    remission : (n, readings); telegrams are then of command 0xC4, which carries both.
    quarter : 0 to 3: partial scans whose first reading lies that many quarters of a degree beside the first angle;
        None for complete scans.

    Returns
    -------
    (n, bytes), a telegram a row.

    Raises
    ------
    FormatError
        if no telegram holds so many readings.
    """
    count, readings = ranges.shape
    word = readings | UNITS.index(unit) << 14 | (0 if quarter is None else 1 << PARTIAL_BIT | quarter << QUARTER_BIT)
    command = ALL_VALUES if remission is None else VALUES_AND_REMISSION
    values = np.ascontiguousarray(ranges.astype("<u2")).view(np.uint8).reshape(count, 2 * readings)
    parts = [np.array([command, word & 0xFF, word >> 8]), values]
    if remission is not None:
        parts += [np.array([readings, 1, readings], dtype="<u2").view(np.uint8), remission]
    parts.append(np.array([status]))
    payload = np.concatenate([np.broadcast_to(p, (count, p.shape[-1])).astype(np.uint8) for p in parts], axis=1)
    length = payload.shape[1]
    if readings > COUNT_MASK or length > LONGEST_PAYLOAD:
        raise FormatError(f"{readings} readings a telegram, {length} bytes", expected=f"{LONGEST_PAYLOAD} bytes")
    head = np.array([STX, FROM_SCANNER, length & 0xFF, length >> 8], dtype=np.uint8)
    body = np.concatenate([np.broadcast_to(head, (count, head.size)), payload], axis=1)
    crc = _checksum_of_rows(body).astype("<u2")[:, None].view(np.uint8)
    return np.concatenate([body, crc], axis=1)


def _checksum_of_rows(rows: UInt8) -> UInt16:
    """Return the CRC (n,) of each row of (n, bytes)."""
    state, before = np.zeros((2, rows.shape[0]), np.uint16)
    for column in rows.T.astype(np.uint16):
        state = (state << np.uint16(1)) ^ np.where(state & np.uint16(0x8000), np.uint16(0x8005), np.uint16(0))
        state ^= column ^ (before << np.uint16(8))
        before = column
    return state
