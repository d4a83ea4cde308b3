"""Hesai packets written byte by byte from the maker's manuals, section 3.1 ("Point cloud data packet")."""

from __future__ import annotations

import datetime as dt
import struct
import zlib
from pathlib import Path

import numpy as np

SINGLE, DUAL, TRIPLE = 0x37, 0x39, 0x3D
MOMENT = dt.datetime(2026, 5, 4, 9, 0, 10, tzinfo=dt.UTC)
RATE_DEG_PER_S = 3_600.0  # 600 turns a minute
SHAPES = {
    "Pandar40P": (10, 40, 55.56), "Pandar64": (6, 64, 55.56), "PandarXT-16": (8, 16, 50.0),
    "PandarXT-32": (8, 32, 50.0), "XT32M": (6, 32, 50.0), "PandarQT": (4, 64, 500 / 3), "QT128": (2, 128, 111.11),
    "Pandar128": (2, 128, 55.556), "OT128": (2, 128, 55.556),
}  # fmt: skip
"""Blocks and channels of a packet, and the time from firing to firing (µs)."""

_RETURNS = {SINGLE: 1, DUAL: 2, TRIPLE: 3}


def packet(
    model: str,
    azimuths: list[int],
    stamp_us: int,
    distances: np.ndarray | int = 2_500,
    *,
    reflectivity: np.ndarray | int = 7,
    mode: int = SINGLE,
    sequence: int = 0,
    moment: dt.datetime = MOMENT,
    flag: int | None = None,
    crc: int | None = None,
) -> bytes:
    """One data packet; distances and reflectivities are (blocks, channels).

    Parameters
    ----------
    stamp_us : microseconds past `moment`.
    flag : the tail's mode flag (QT128) or operational state (Pandar128).
    crc : in place of the body's CRC-32.
    """
    blocks, channels, _ = SHAPES[model]
    far = np.broadcast_to(distances, (blocks, channels))
    bright = np.broadcast_to(reflectivity, (blocks, channels))
    at = moment + dt.timedelta(microseconds=stamp_us)
    old, guarded = model in ("Pandar40P", "Pandar64"), channels == 128
    unit = "<HB" if old or model in ("Pandar128", "OT128") else "<HBx"
    mark = b"\xff\xee" if model == "Pandar40P" else b""
    body = b"".join(
        mark
        + struct.pack("<H", azimuths[b] % 36_000)
        + b"".join(struct.pack(unit, int(far[b, c]), int(bright[b, c])) for c in range(channels))
        for b in range(blocks)
    )
    date = bytes([at.year - (2000 if old else 1900), at.month, at.day, at.hour, at.minute, at.second])
    micro, number = struct.pack("<I", at.microsecond), struct.pack("<I", sequence)
    speed, returns = struct.pack("<H", 600), _RETURNS[mode]
    if old:
        head = b"" if mark else bytes([0xEE, 0xFF, channels, blocks, 0, 4, 0, 0])
        return head + body + bytes(8) + speed + micro + bytes([mode, 0x42]) + date + number
    major, minor = {"QT128": (3, 2), "PandarQT": (3, 1)}.get(model, (1, 4) if guarded else (6, 1))
    flags = 5 if guarded else 1
    head = bytes([0xEE, 0xFF, major, minor, 0, 0, channels, blocks, 0, 4, returns, flags])
    if guarded:
        check = struct.pack("<I", zlib.crc32(body) if crc is None else crc)
        state = (1 if major == 3 else 2) if flag is None else flag
        first = bytes([*bytes(5), state, *bytes(6)]) if major == 3 else bytes([*bytes(11), state])
        tail = first + bytes([mode]) + speed + date + micro + b"\x42" + number + bytes(4)
        return head + body + check + bytes(17) + tail
    if model == "PandarQT":
        return head + body + bytes(10) + speed + micro + bytes([mode, 0x42]) + date + number
    return head + body + bytes(10) + bytes([mode]) + speed + date + micro + b"\x42" + number


def turning(model: str, count: int, *, mode: int = SINGLE, start_deg: float = 20.0, **more: object) -> list[bytes]:
    """`count` packets of a head that turns evenly, one after another."""
    blocks, _, cycle_us = SHAPES[model]
    returns = _RETURNS[mode]
    out = []
    for k in range(count):
        begin_us = 1_000_000 + k * blocks // returns * cycle_us
        turned = [start_deg + RATE_DEG_PER_S * 1e-6 * (begin_us + b // returns * cycle_us - 1e6) for b in range(blocks)]
        azimuths = [round(100 * a) for a in turned]
        out.append(packet(model, azimuths, round(begin_us), mode=mode, sequence=k, **more))  # type: ignore[arg-type]
    return out


def angle_file(path: Path, elevations: np.ndarray, azimuths: np.ndarray) -> Path:
    """The maker's angle file."""
    rows = [f"{k + 1},{e:.3f},{a:.3f}" for k, (e, a) in enumerate(zip(elevations, azimuths, strict=True))]
    path.write_text("\n".join(["Channel,Elevation,Azimuth", *rows, ""]))
    return path
