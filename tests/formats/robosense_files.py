"""RoboSense packets written byte by byte from the maker's descriptions (MSOP and DIFOP)."""

from __future__ import annotations

import datetime as dt
import struct
from pathlib import Path

import numpy as np

from tests.formats import ros_files
from tests.formats.test_velodyne_pcap import capture, frame, posix_ns

MOMENT = dt.datetime(2026, 5, 4, 9, 0, 10, tzinfo=dt.UTC)
RATE_DEG_PER_S = 3_600.0
BLOCK_US = {
    "RS-LiDAR-16": 111.0, "RS-LiDAR-32": 55.52, "Bpearl": 55.52, "Helios": 55.56, "Ruby": 55.55, "Ruby Plus": 55.56,
}  # fmt: skip
"""Time from block to block in single return (µs)."""
TYPES = {"RS-LiDAR-16": 1, "RS-LiDAR-32": 2, "Bpearl": 3}
MSOP, DIFOP = 6699, 7788


def lasers_of(model: str) -> int:
    return {"RS-LiDAR-16": 16, "Ruby": 128, "Ruby Plus": 128}.get(model, 32)


def angles_of(model: str) -> tuple[np.ndarray, np.ndarray]:
    """Elevations and azimuths (°) as a DIFOP packet can hold them; of an RS-LiDAR-16 the first eight point down."""
    rng = np.random.default_rng(3)
    count = lasers_of(model)
    elevation, azimuth = rng.uniform(-25, 15, count).round(2), rng.uniform(-6, 6, count).round(2)
    if model == "RS-LiDAR-16":
        return np.where(np.arange(16) < 8, -1, 1) * np.abs(elevation), np.zeros(16)
    return elevation, azimuth


def stamp(model: str, us: int) -> bytes:
    at = MOMENT + dt.timedelta(microseconds=us)
    if model in TYPES:
        parts = (at.year - 2000, at.month, at.day, at.hour, at.minute, at.second)
        return bytes(parts) + struct.pack(">HH", *divmod(at.microsecond, 1000))
    return int(at.timestamp()).to_bytes(6, "big") + at.microsecond.to_bytes(4, "big")


def msop(
    model: str, azimuths: list[int], us: int, far: np.ndarray | int = 2_000, bright: np.ndarray | int = 7
) -> bytes:
    """One MSOP packet; distances and intensities are (blocks, channels)."""
    many = lasers_of(model) == 128
    shape = (3, 128) if many else (12, 32)
    far, bright = np.broadcast_to(far, shape), np.broadcast_to(bright, shape)
    if model in TYPES:
        head = bytes.fromhex("55aa050a5aa550a0") + bytes(12) + stamp(model, us) + bytes([TYPES[model]]) + bytes(11)
    elif many:
        head = bytes.fromhex("55aa055a") + bytes(6) + stamp(model, us) + bytes(60)
    else:
        head = bytes.fromhex("55aa055a") + bytes(16) + stamp(model, us) + bytes(12)
    body = b"".join(
        (b"\xfe\x01" if many else b"\xff\xee")
        + struct.pack(">H", azimuths[b] % 36_000)
        + b"".join(struct.pack(">HB", int(far[b, c]), int(bright[b, c])) for c in range(shape[1]))
        for b in range(shape[0])
    )
    return (head + body).ljust(1248, b"\0")


def difop(model: str) -> bytes:
    """The unit's angles; nothing else in it counts."""
    elevation, azimuth = angles_of(model)
    start = bytes.fromhex("a5ff005a11115555") + bytes(460)
    if model == "RS-LiDAR-16":
        pitch = b"".join(round(abs(e) * 1e4).to_bytes(3, "big") for e in elevation)
        return start + bytes(697) + pitch + bytes(35)
    unit = 1e-3 if model == "RS-LiDAR-32" else 1e-2
    table = [struct.pack(">BH", int(a < 0), round(abs(a) / unit)) for a in (*elevation, *azimuth)]
    return (start + b"".join(table)).ljust(1248, b"\0")


def turning(model: str, count: int, *, both: bool = False, **more: object) -> list[bytes]:
    """`count` packets of a head that turns evenly from 20°."""
    blocks = 3 if lasers_of(model) == 128 else 12
    block_us = BLOCK_US[model] / (2 if both and model == "RS-LiDAR-16" else 1)
    out = []
    for k in range(count):
        at = [(k * blocks + b) // (2 if both and model != "RS-LiDAR-16" else 1) for b in range(blocks)]
        azimuths = [round(100 * (20 + RATE_DEG_PER_S * 1e-6 * f * block_us)) for f in at]
        out.append(msop(model, azimuths, round(at[0] * block_us), **more))  # type: ignore[arg-type]
    return out


def m1(sequence: int, us: int, points: np.ndarray) -> bytes:
    """One packet of an M1; `points` is (25, 5, 4): distance, pitch, yaw as sent, and intensity."""
    head = bytes.fromhex("55aa5aa5") + struct.pack(">HHBB", sequence, 1, 4, 0) + stamp("M1", us) + bytes(12)
    blocks = b"".join(
        bytes([b, 0]) + b"".join(struct.pack(">HHHBBB", *(int(v) for v in points[b, c]), 0, 0) for c in range(5))
        for b in range(25)
    )
    return head + blocks + bytes(3)


def log_of(folder: Path, payloads: list[bytes], info: bytes | None = None, late_s: float = 0.001) -> Path:
    """A capture of MSOP packets, with a DIFOP packet first."""
    begin = posix_ns(MOMENT) + round(late_s * 1e9)
    frames = [] if info is None else [(begin, frame(info, DIFOP))]
    frames += [(begin + k * 600_000, frame(p, MSOP)) for k, p in enumerate(payloads)]
    return capture(folder / "a.pcap", frames, nanoseconds=True)


def frames(folder: Path) -> Path:
    """A capture of an M1: two frames of six packets."""
    rng = np.random.default_rng(5)
    points = rng.integers((0, 31_500, 27_000, 0), (4_000, 34_000, 38_000, 255), (12, 25, 5, 4))
    return log_of(folder, [m1(k % 6 + 1, 200 * k, points[k]) for k in range(12)])


def bag(folder: Path, kind: str, count: int = 6) -> Path:
    """A bag of a Helios whose topic holds both kinds of packets."""
    begin = posix_ns(MOMENT) + 1_000_000
    rows = []
    for k, payload in enumerate([difop("Helios"), *turning("Helios", count)]):
        head = ros_files.header(begin + k * 600_000)
        fields = {"header": head, "is_difop": int(k == 0), "data": np.frombuffer(payload, np.uint8)}
        rows.append((begin + k * 600_000, fields))
    return ros_files.write_bag(folder / "bag", kind, {"/packets": ("rslidar_msg/msg/RslidarPacket", rows)})
