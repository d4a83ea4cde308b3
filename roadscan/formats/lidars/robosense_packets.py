"""RoboSense data packets: the maker's tables, their layout, tests for damage, and decoding.

A spinning sensor sends MSOP packets of 1,248 bytes: a header, blocks of azimuth (0.01°, clockwise seen from above) with
one distance and intensity a channel, all big-endian; and DIFOP packets, also of 1,248 bytes, with the unit's angles.

    ============================  =======================  ========  ======  =====================
    sensor                        header begins            blocks    unit    stamp
    ============================  =======================  ========  ======  =====================
    RS-LiDAR-16, -32, Bpearl      55AA050A5AA550A0, 42 B   12 × 32   5 mm    date, ms, µs
    Helios                        55AA055A, 42 bytes       12 × 32   2.5 mm  seconds since 1970, µs
    Ruby, Ruby Plus               55AA055A, 80 bytes       3 × 128   5 mm    seconds since 1970, µs
    M1 (MEMS, 1,210 bytes)        55AA5AA5, 32 bytes       25 × 5    5 mm    seconds since 1970, µs
    ============================  =======================  ========  ======  =====================

The return of channel c in a block is fired at the packet's time + the blocks' time + t(c), and the head turns on
meanwhile. With azimuth α then, the channel's part β of it, elevation ω and the radius r of the lens, it lies at

    x = d cos ω cos(α + β) + r cos α,  y = −d cos ω sin(α + β) − r sin α,  z = d sin ω + h

A point of an M1 has its own yaw and pitch. Layout and figures are those of the maker's driver (rs_driver 1.5); firing
times of the Helios those of its manual, as tier4/nebula has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Bool, Float32, Float64, Int32, Int64
from roadscan.core.errors import ConfigError
from roadscan.formats.lidars.packet_returns import TURN, Gap, jumps, returns_batch, steps
from roadscan.store.readings.packed_returns import EIGHT_TO_SIXTEEN_BITS

Raw: TypeAlias = npt.NDArray[np.void]

DIFOP_ID: Final = bytes.fromhex("a5ff005a11115555")
"""First bytes of a DIFOP packet."""
DIFOP_BYTES: Final = 1248  # of a spinning sensor
_OLD_ID: Final = bytes.fromhex("55aa050a5aa550a0")
_NEW_ID: Final = bytes.fromhex("55aa055a")
_M1_ID: Final = bytes.fromhex("55aa5aa5")
_ANGLES_AT, _PITCH_16_AT = 468, 1165  # bytes of a DIFOP packet before the angles; of an RS-LiDAR-16 before its own
_UNSET: Final = 0xFF  # sign of an angle that nobody wrote
_LARGEST_DEG: Final = 90.0  # larger angles are damage
_FASTEST_HZ: Final = 25.0  # fastest turn that is accepted
_SLACK_CENTIDEG: Final = 10  # tolerance of azimuth steps (0.01°)
_MILLION: Final = 1_000_000  # microseconds of a second
_YAW_ZERO: Final = 32_768  # yaw and pitch 0 of an M1
_BPEARL_V4: Final = b"\x03\x04"  # bytes 31 and 32 of the header of one with other figures, which is not read
_OLD_TYPES: Final = {1: "RS-LiDAR-16", 2: "RS-LiDAR-32", 3: "Bpearl"}
"""Sensors by byte 30 of the older header."""


def _evenly(step: float, count: int, first: float = 0.0) -> tuple[float, ...]:
    return tuple(round(first + step * k, 3) for k in range(count))


@dataclass(frozen=True)
class Model:
    """The maker's data of a sensor; tables are by channel of a block."""

    name: str
    head: bytes
    """First bytes of its MSOP packets."""
    fired_us: tuple[float, ...] = ()
    """Firing times after the block's; empty where each block states its own."""
    block_us: float = 0.0
    """Time from one firing sequence to the next."""
    lasers: int = 32
    unit_m: float = 0.005
    """Unit of distance."""
    radius_m: float = 0.0
    height_m: float = 0.0
    """Lens: from the axis, and above the origin."""
    angle_deg: float = 0.01
    """Unit of the angles in its DIFOP packets."""
    dated: bool = False
    """Whether stamps are date and time, and not seconds since 1970."""

    @property
    def twice(self) -> bool:
        """True where a block of 32 channels holds 16 lasers twice: two firings, or both returns of one."""
        return self.lasers == 16

    @property
    def layout(self) -> np.dtype[np.void]:
        """Return the NumPy layout of its MSOP packets."""
        if self.head == _M1_ID:
            point = np.dtype(
                [("distance", ">u2"), ("pitch", ">u2"), ("yaw", ">u2"), ("intensity", "u1"), ("more", "V2")]
            )
            block = np.dtype([("late_us", "u1"), ("number", "u1"), ("returns", point, (5,))])
            return _packet(block, 25, 32, 1210, stamp=10, more={"sequence": (">u2", 4)})
        returns = np.dtype([("distance", ">u2"), ("intensity", "u1")])
        many = self.lasers == 128
        block = np.dtype([("mark", "u1" if many else ">u2"), *([("number", "u1")] if many else []),
                          ("azimuth", ">u2"), ("returns", returns, (128 if many else 32,))])  # fmt: skip
        return _packet(block, 3 if many else 12, 80 if many else 42, 1248, stamp=10 if many else 20)


def _packet(
    block: np.dtype[np.void],
    blocks: int,
    first: int,
    size: int,
    stamp: int,
    more: dict[str, tuple[str, int]] | None = None,
) -> np.dtype[np.void]:
    fields: dict[str, tuple[Any, int]] = {"block": ((block, (blocks,)), first), "stamp": (("u1", (10,)), stamp)}
    fields |= more or {}
    return np.dtype({"names": list(fields), "formats": [f for f, _ in fields.values()],
                     "offsets": [at for _, at in fields.values()], "itemsize": size})  # fmt: skip


# Times (µs) of the channels of a block from its stamp on.
_RS_32_US: Final = (*_evenly(2.88, 15), 44.64, *_evenly(2.88, 15, 1.44), 46.08)
_HELIOS_US: Final = (
    0.0, 1.57, 3.15, 4.72, 6.3, 7.87, 9.45, 11.36, 13.26, 15.17, 17.08, 18.99, 20.56, 22.14, 23.71, 25.29, 26.53, 29.01,
    27.77, 30.25, 31.49, 33.98, 32.73, 35.22, 36.46, 37.7, 38.94, 40.18, 41.42, 42.67, 43.91, 45.15,
)  # fmt: skip
_RUBY_PLUS_US: Final = (
    0.0, 1.217, 2.434, 3.652, 4.869, 6.086, 7.304, 8.521, 9.739, 11.323, 12.907, 14.924, 16.941, 18.959, 20.976, 23.127,
    25.278, 27.428, 29.579, 31.963, 34.347, 36.498, 38.648, 40.666, 42.683, 44.267, 45.851, 47.435, 49.019, 50.603,
    52.187, 53.771,
)  # fmt: skip

MODELS: Final = (
    Model("RS-LiDAR-16", _OLD_ID, _evenly(2.8, 16), 55.5, 16, radius_m=0.03825, angle_deg=1e-4, dated=True),
    Model("RS-LiDAR-32", _OLD_ID, _RS_32_US, 55.52, radius_m=0.03997, angle_deg=1e-3, dated=True),
    Model(
        "Bpearl", _OLD_ID,
        tuple(round(2.56 * (k % 16) + 5.2 * (k % 16 // 8) + 1.28 * (k // 16), 2) for k in range(32)),
        55.52, radius_m=0.01473, height_m=0.09427, dated=True,
    ),
    Model("Helios", _NEW_ID, _HELIOS_US, 55.56, unit_m=0.0025, radius_m=0.03498),
    Model("Ruby", _NEW_ID, tuple(3.236 * (k // 4 % 16) for k in range(128)), 55.55, 128, radius_m=0.03615),
    Model("Ruby Plus", _NEW_ID, tuple(t for t in _RUBY_PLUS_US for _ in range(4)), 55.56, 128, radius_m=0.02892),
    Model("M1", _M1_ID, lasers=5),
)  # fmt: skip
"""Supported sensors."""


def models_of(payload: bytes) -> list[Model]:
    """Return the sensors that may have sent a packet; none for bytes that are no MSOP packet."""
    if len(payload) == 1210 and payload.startswith(_M1_ID):
        return [MODELS[-1]]
    if len(payload) != 1248:
        return []
    if payload.startswith(_OLD_ID) and payload[31:33] != _BPEARL_V4:
        found = [one for one in MODELS if one.head == _OLD_ID]
        return [one for one in found if one.name == _OLD_TYPES.get(payload[30])] or found
    if payload.startswith(_NEW_ID):
        many = all(payload[at] == 0xFE for at in (80, 468, 856))
        if many or payload[42:44] == b"\xff\xee":
            return [one for one in MODELS if one.head == _NEW_ID and (one.lasers == 128) is many]
    return []


@dataclass(frozen=True)
class Angles:
    """Each laser's angles, (lasers,) in rad."""

    elevation: Float64
    azimuth: Float64

    @classmethod
    def of_difop(cls, payload: bytes, model: Model) -> Angles | None:
        """Return the angles of a DIFOP packet; None where it holds none."""
        if model.name == "RS-LiDAR-16":
            raw = np.frombuffer(payload, np.uint8, 48, _PITCH_16_AT).reshape(16, 3).astype(int) @ (65_536, 256, 1)
            table = np.stack([np.where(np.arange(16) < 8, -raw, raw), np.zeros(16)]) * model.angle_deg
            blank = not raw.any() or (raw == 0xFF_FF_FF).any()
        else:
            slots = max(model.lasers, 32)
            angle = np.dtype([("sign", "u1"), ("value", ">u2")])
            found = np.frombuffer(payload, angle, 2 * slots, _ANGLES_AT).reshape(2, slots)[:, : model.lasers]
            table = np.where(found["sign"] == 0, 1.0, -1.0) * found["value"] * model.angle_deg
            blank = bool((found["sign"] == _UNSET).any()) or len(np.unique(table[0])) < model.lasers // 2
        return None if blank or (np.abs(table) > _LARGEST_DEG).any() else cls(*np.radians(table))

    @classmethod
    def of_file(cls, file: Path, model: Model) -> Angles:
        """Return the angles of a file as the maker's driver reads it: a line a channel with elevation, azimuth (°).

        Raises
        ------
        ConfigError
            if the file is none, or one of another sensor.
        """
        try:
            table = np.array([[float(v) for v in line.split(",")[:2]] for line in file.read_text().split()])
        except (OSError, ValueError):
            table = np.empty(0)
        if table.shape != (model.lasers, 2) or not (np.abs(table) <= _LARGEST_DEG).all():
            raise ConfigError(
                "options.angles names no angle file",
                expected=f"{model.lasers} lines with elevation, azimuth (°) of a {model.name}",
                file=file,
            )
        return cls(*np.radians(table.T))


def posix_us(raw: Raw, model: Model) -> Int64:
    """Return the packets' times (n,) as microseconds since 1970 by the sensor's clock; −1 where impossible."""
    byte = raw["stamp"].astype(np.int64)
    big = 256 ** np.arange(5, -1, -1, dtype=np.int64)
    if not model.dated:
        us = byte[:, 6:] @ big[2:]
        return np.where(us < _MILLION, byte[:, :6] @ big * _MILLION + us, -1)
    parts_us = byte[:, 6:8] @ big[4:] * 1000 + byte[:, 8:] @ big[4:]
    months = (30 * 12 + byte[:, 0] * 12 + byte[:, 1] - 1).astype("datetime64[M]")
    days = months.astype("datetime64[D]").astype(np.int64) + byte[:, 2] - 1
    seconds = ((days * 24 + byte[:, 3]) * 60 + byte[:, 4]) * 60 + byte[:, 5]
    sound = (byte[:, 1:6] <= (12, 31, 23, 59, 60)).all(axis=1) & (byte[:, 1:3] > 0).all(axis=1) & (parts_us < _MILLION)
    return np.where(sound, seconds * _MILLION + parts_us, -1)


def faults(raw: Raw, model: Model, gap: Gap | None) -> list[tuple[Bool, str]]:
    """Return masks (n,) of damaged packets, each with its reason."""
    masks: list[tuple[Bool, str]] = [(np.asarray(posix_us(raw, model) < 0), "date or time are impossible")]
    if "azimuth" in (raw.dtype["block"].base.names or ()):
        azimuth, mark = raw["block"]["azimuth"], 0xFE if model.lasers == 128 else 0xFFEE
        masks += [
            (np.any(np.asarray(raw["block"]["mark"]) != mark, axis=1), f"a block does not begin with 0x{mark:X}"),
            (np.any(azimuth >= TURN, axis=1), "an azimuth is 360° or more"),
            (jumps(azimuth, odd_steps(azimuth, model), gap), "the azimuth jumps inside the packet"),
        ]
    return masks


def odd_steps(azimuth: npt.NDArray[np.uint16], model: Model) -> Bool:
    """Return which steps (n, blocks − 1) from block to block the head cannot have turned."""
    most = TURN * _FASTEST_HZ * model.block_us * 1e-6 * (1 + model.twice) + _SLACK_CENTIDEG
    return np.asarray(np.abs(steps(azimuth)) > most)


def firings(azimuth: Int64) -> Int64:
    """Return the firing (n, blocks) of each block: both returns of one have its azimuth."""
    return np.cumsum(np.pad(np.diff(azimuth, axis=1) != 0, ((0, 0), (1, 0))), axis=1)


def decode(
    raw: Raw, epochs: Int64, sweeps: Int32, model: Model, angles: Angles, rate: float, both: bool, waits: Int64
) -> pa.RecordBatch:
    """Return the returns of sound packets of a spinning sensor.

    Parameters
    ----------
    raw : (n,) packets.
    epochs : (n,) GPS ns of the packets.
    sweeps : (n, blocks) sweep of each block.
    rate : of the head (0.01°/ns).
    both : whether the packets hold two returns a firing.
    waits : (n, blocks) ns by which a block is later than firings one after another are.

    Returns
    -------
    Batch of the table ``returns``, without empty slots and without returns that stand twice.
    """
    azimuth = raw["block"]["azimuth"].astype(np.int64)
    distance = raw["block"]["returns"]["distance"].astype(np.float32)
    bright = raw["block"]["returns"]["intensity"]
    slots = distance.shape[2]
    wanted = distance != 0
    if model.twice:
        second = np.arange(slots) >= model.lasers
        fired_us = np.array(model.fired_us * 2) + np.where(second & (not both), model.block_us, 0.0)
        block_us = firings(azimuth) * model.block_us * (1 if both else 2)
        if both:
            wanted[:, :, 16:] &= (distance[:, :, 16:] != distance[:, :, :16]) | (bright[:, :, 16:] != bright[:, :, :16])
    else:
        fired_us, block_us = np.array(model.fired_us), firings(azimuth) * model.block_us
        row, far_row, bright_row = azimuth.reshape(-1), distance.reshape(-1, slots), bright.reshape(-1, slots)
        alike = (far_row[1:] == far_row[:-1]) & (bright_row[1:] == bright_row[:-1])
        wanted.reshape(-1, slots)[1:] &= ~((row[1:] == row[:-1])[:, None] & alike)
    rows = np.flatnonzero(wanted)
    late_ns = np.rint((block_us[:, :, None] + fired_us) * 1e3).astype(np.int64)
    late_ns += waits[:, :, None]
    lasers = (np.arange(slots) % model.lasers).astype(np.uint8)
    x, y, z = _positions(distance, azimuth, np.radians(rate * 0.01) * 1e3 * fired_us, model, angles, lasers)
    return returns_batch(
        np.add(late_ns, epochs[:, None, None], out=late_ns).reshape(-1)[rows],
        [one.reshape(-1)[rows] for one in (x, y, z)],
        bright.reshape(-1)[rows] * EIGHT_TO_SIXTEEN_BITS,
        np.broadcast_to(lasers, distance.shape).reshape(-1)[rows],
        np.broadcast_to(sweeps[:, :, None], distance.shape).reshape(-1)[rows],
    )


def _positions(
    distance: Float32, azimuth: Int64, turned: Float64, model: Model, angles: Angles, lasers: npt.NDArray[np.uint8]
) -> tuple[Float32, Float32, Float32]:
    """Return x, y, z (n, blocks, channels) in m.

    Parameters
    ----------
    turned : (channels,) by which the head turns on until the firing (rad).
    """
    elevation, own = angles.elevation[lasers], angles.azimuth[lasers] + turned
    range_m = distance * np.float32(model.unit_m)
    # In axes that turn with the head: forward along the block's azimuth, and to the right of it.
    forward = range_m * (np.cos(elevation) * np.cos(own)).astype(np.float32)
    forward += (model.radius_m * np.cos(turned)).astype(np.float32)
    right = range_m * (np.cos(elevation) * np.sin(own)).astype(np.float32)
    right += (model.radius_m * np.sin(turned)).astype(np.float32)
    head = np.radians(azimuth * 0.01)[:, :, None]
    sine, cosine = np.sin(head).astype(np.float32), np.cos(head).astype(np.float32)
    z = range_m * np.sin(elevation).astype(np.float32) + np.float32(model.height_m)
    return forward * cosine - right * sine, -(forward * sine + right * cosine), z


def decode_m1(raw: Raw, epochs: Int64, sweeps: Int32) -> pa.RecordBatch:
    """Return the returns of sound packets of an M1; `sweeps` (n,) is the frame of each."""
    block = raw["block"]
    points = block["returns"]
    rows = np.flatnonzero(points["distance"])
    shape = points["distance"].shape

    def of(values: npt.NDArray[np.generic]) -> Float64:
        return np.broadcast_to(values, shape).reshape(-1)[rows].astype(np.float64)

    far = of(points["distance"]) * MODELS[-1].unit_m
    pitch, yaw = (np.radians((of(points[name]) - _YAW_ZERO) * 0.01) for name in ("pitch", "yaw"))
    xyz = (far * np.cos(pitch) * np.cos(yaw), far * np.cos(pitch) * np.sin(yaw), far * np.sin(pitch))
    late_ns = block["late_us"].astype(np.int64)[:, :, None] * 1000
    return returns_batch(
        np.broadcast_to(epochs[:, None, None] + late_ns, shape).reshape(-1)[rows],
        [one.astype(np.float32) for one in xyz],
        points["intensity"].reshape(-1)[rows] * EIGHT_TO_SIXTEEN_BITS,
        np.broadcast_to(np.arange(5, dtype=np.uint8), shape).reshape(-1)[rows],
        np.broadcast_to(sweeps[:, None, None], shape).reshape(-1)[rows],
    )
