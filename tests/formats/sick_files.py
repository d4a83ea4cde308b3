"""Telegrams of SICK LMS 2xx scanners, written for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import FormatError
from roadscan.formats.scanners.sick_telegrams import FROM_SCANNER, LONGEST_PAYLOAD, STX, checksum

UInt8 = npt.NDArray[np.uint8]
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
