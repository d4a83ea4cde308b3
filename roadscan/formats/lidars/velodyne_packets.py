"""Velodyne data packets: the maker's tables, tests for damage, and decoding.

A data packet has 1,206 bytes: 12 blocks of flag 0xEEFF, azimuth (0.01°, clockwise seen from above) and 32
times distance (2 mm) and reflectivity; then microseconds past the hour, return mode and product (HDL-32E
application note 63-9277; VLP-16 user manual 63-9243, chapter 9). The return of slot j in block b is fired
after the packet's first firing by

    HDL-32E  46.080 µs · b + 1.152 µs · j          (dual return: b // 2 in place of b)
    VLP-16   55.296 µs · (2 b + j // 16) + 2.304 µs · (j mod 16)

and the head turns on meanwhile at the packet's mean rate. Its position, in axes ``flu``, is

    x = d cos ω cos α,  y = −d cos ω sin α,  z = d sin ω + v

with the azimuth α, the laser's elevation ω and its vertical offset v (HDL-32E: drawing 86-0106;
VLP-16: manual, table 9-1).

Decoding is done here and checked in the tests against ``velodyne-decoder``. That library emits whole
turns, rounds every azimuth to 0.01° (4 mm at 50 m) and gives float32 seconds relative to the turn; here
each return has its own whole-nanosecond time, and memory is bounded by the packet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.gpstime import NS_PER_S

Bool = npt.NDArray[np.bool_]
Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]

DATA_BYTES: Final = 1206  # bytes of a data packet
BLOCKS: Final = 12  # blocks of a packet
SLOTS: Final = 32  # returns of a block

_BLOCK: Final = np.dtype(
    [("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("distance", "<u2"), ("reflectivity", "u1")], (SLOTS,))]
)
PACKET: Final = np.dtype([("blocks", _BLOCK, (BLOCKS,)), ("stamp_us", "<u4"), ("mode", "u1"), ("product", "u1")])
"""NumPy layout of a data packet."""
FLAG: Final = b"\xff\xee"
"""First bytes of every block."""
DUAL: Final = 0x39  # mode byte of dual return
MODES: Final = {0x37: "strongest", 0x38: "last", DUAL: "dual"}
"""Return modes by their byte."""
LATEST_STAMP_US: Final = 3_660_000_000
"""Stamps run a little past the hour before they restart; beyond a minute they are wrong."""

_DISTANCE_M: Final = np.float32(0.002)  # unit of distance
_EIGHT_TO_SIXTEEN_BITS: Final = np.uint16(257)  # scales 255 to 65,535
_FASTEST_HZ: Final = 25.0  # fastest turn that is accepted
_SLACK_CENTIDEGREES: Final = 10  # tolerance of azimuth steps (0.01°)
_TURN: Final = 36_000
"""A full turn in 0.01°."""


@dataclass(frozen=True)
class Model:
    """The maker's data of a sensor; tables cover the 32 slots of a block."""

    name: str
    product: int
    """Product byte of its packets."""
    lasers: int
    cycle_ns: int
    """Time from one firing sequence to the next (ns)."""
    firing_ns: int
    """Time from one laser to the next (ns)."""
    elevations_deg: tuple[float, ...]
    offsets_mm: tuple[float, ...]
    """Height of each beam's origin above the sensor's (mm)."""

    def slot_times_ns(self, dual: bool) -> Int64:
        """Return (12, 32) time of each slot after the packet's first firing."""
        sequences = SLOTS // self.lasers
        block = np.arange(BLOCKS)[:, None] // (2 if dual else 1)
        slot = np.arange(SLOTS)
        sequence = block * sequences + slot // self.lasers
        return np.asarray(sequence * self.cycle_ns + slot % self.lasers * self.firing_ns, dtype=np.int64)

    def slot_lasers(self) -> npt.NDArray[np.uint8]:
        """Return (32,) laser of each slot."""
        return (np.arange(SLOTS) % self.lasers).astype(np.uint8)


MODELS: Final = (
    Model(
        "HDL-32E", 0x21, 32, 46_080, 1_152,
        (
            -30.67, -9.33, -29.33, -8.00, -28.00, -6.67, -26.67, -5.33, -25.33, -4.00, -24.00, -2.67, -22.67, -1.33,
            -21.33, 0.00, -20.00, 1.33, -18.67, 2.67, -17.33, 4.00, -16.00, 5.33, -14.67, 6.67, -13.33, 8.00, -12.00,
            9.33, -10.67, 10.67,
        ),
        (
            17.17, 4.76, 16.27, 4.07, 15.40, 3.38, 14.54, 2.70, 13.71, 2.02, 12.89, 1.35, 12.09, 0.67, 11.31, 0.00,
            10.54, -0.67, 9.78, -1.35, 9.04, -2.02, 8.30, -2.70, 7.58, -3.38, 6.86, -4.07, 6.15, -4.76, 5.45, -5.45,
        ),
    ),
    Model(
        "VLP-16", 0x22, 16, 55_296, 2_304,
        (-15.0, 1.0, -13.0, 3.0, -11.0, 5.0, -9.0, 7.0, -7.0, 9.0, -5.0, 11.0, -3.0, 13.0, -1.0, 15.0),
        (11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2),
    ),
)  # fmt: skip
"""Supported sensors."""


def faults(raw: npt.NDArray[np.void], model: Model, unstated: bool) -> list[tuple[Bool, str]]:
    """Return masks (n,) of damaged packets, each with its reason.

    Parameters
    ----------
    raw : (n,) packets of dtype :data:`PACKET`.
    model : the sensor.
    unstated : whether mode and product may be 0, as old firmware writes them.
    """
    azimuth = raw["blocks"]["azimuth"]
    steps = _steps(azimuth)
    block_s = SLOTS // model.lasers * model.cycle_ns / NS_PER_S
    farthest = _TURN * _FASTEST_HZ * block_s + _SLACK_CENTIDEGREES
    silent = (raw["mode"] == 0) & (raw["product"] == 0) & unstated
    known = np.isin(raw["mode"], list(MODES))
    return [
        ((raw["blocks"]["flag"] != int.from_bytes(FLAG, "little")).any(axis=1), "a block does not begin with 0xEEFF"),
        ((raw["product"] != model.product) & ~silent, "the product byte is not the sensor's"),
        (~known & ~silent, "the return mode is unknown"),
        ((azimuth >= _TURN).any(axis=1), "an azimuth is 360° or more"),
        (
            ((steps < -_SLACK_CENTIDEGREES) | (steps > farthest)).any(axis=1),
            "the azimuth jumps inside the packet (damage, or a limited field of view)",
        ),
        (raw["stamp_us"] > LATEST_STAMP_US, "the stamp is more than 3,660 s past the hour"),
    ]


def _steps(azimuth: npt.NDArray[np.uint16]) -> Int32:
    """Return (n, 11) turn from block to block, 0.01°, within half a turn either way."""
    return np.asarray(np.mod(np.diff(azimuth.astype(np.int32), axis=1) + _TURN // 2, _TURN) - _TURN // 2)


def decode(raw: npt.NDArray[np.void], epochs: Int64, sweeps: Int32, model: Model, dual: bool) -> pa.RecordBatch:
    """Return the returns of sound packets.

    Parameters
    ----------
    raw : (n,) packets.
    epochs : (n,) GPS ns of each packet's first firing.
    sweeps : (n, 12) sweep of each block.
    dual : whether blocks come in pairs of last and strongest return.

    Returns
    -------
    Batch of the table ``returns``, in the order of the packets' slots, without empty slots.
    """
    measured = raw["blocks"]["returns"]
    distance = np.ascontiguousarray(measured["distance"])  # (n, 12, 32)
    reflectivity = np.ascontiguousarray(measured["reflectivity"])
    wanted = distance != 0
    if dual:
        last, strongest = slice(0, None, 2), slice(1, None, 2)
        twice = (distance[:, last] == distance[:, strongest]) & (reflectivity[:, last] == reflectivity[:, strongest])
        wanted[:, strongest] &= ~twice
    times_ns = model.slot_times_ns(dual)
    rows = np.flatnonzero(wanted)
    sines, cosines = _directions(raw["blocks"]["azimuth"], times_ns)
    tables = 2 if model.lasers < SLOTS else 1
    elevation = np.radians(np.tile(model.elevations_deg, tables))
    offset_m = np.tile(model.offsets_mm, tables).astype(np.float32) * np.float32(1e-3)
    range_m = distance.astype(np.float32) * _DISTANCE_M
    level_m = range_m * np.cos(elevation).astype(np.float32)
    height_m = range_m * np.sin(elevation).astype(np.float32) + offset_m
    shape = distance.shape
    epoch = np.add(epochs[:, None, None], times_ns).reshape(-1)[rows]
    columns: dict[str, npt.NDArray[Any]] = {
        "epoch_gps_ns": epoch,
        "pose_epoch_gps_ns": epoch,
        "x_sensor_m": (level_m * cosines).reshape(-1)[rows],
        "y_sensor_m": (level_m * -sines).reshape(-1)[rows],
        "z_sensor_m": height_m.reshape(-1)[rows],
        "intensity": reflectivity.reshape(-1)[rows] * _EIGHT_TO_SIXTEEN_BITS,
        "laser": np.broadcast_to(model.slot_lasers(), shape).reshape(-1)[rows],
        "sweep": np.broadcast_to(sweeps[:, :, None], shape).reshape(-1)[rows],
    }
    return pa.RecordBatch.from_pydict({k: pa.array(v) for k, v in columns.items()})


def _directions(azimuth: npt.NDArray[np.uint16], times_ns: Int64) -> tuple[Float32, Float32]:
    """Return sine and cosine (n, 12, 32) of each slot's azimuth.

    Parameters
    ----------
    azimuth : (n, 12) of the blocks' first firings, 0.01°.
    times_ns : (12, 32) of the slots.

    Notes
    -----
    Within a block the head turns by less than 0.02 rad; the series of sine and cosine to the third
    order are exact there to 1e-8.
    """
    start = np.radians(azimuth * 0.01)[:, :, None]
    rate = np.radians(_steps(azimuth).sum(axis=1) * 0.01) / float(times_ns[-1, 0])  # rad/ns, mean of the packet
    turned = (rate[:, None] * (times_ns[0] - times_ns[0, 0]))[:, None, :]
    square = turned * turned
    small_sine = (turned * (1.0 - square / 6.0)).astype(np.float32)
    small_cosine = (1.0 - square / 2.0).astype(np.float32)
    sine, cosine = np.sin(start).astype(np.float32), np.cos(start).astype(np.float32)
    return sine * small_cosine + cosine * small_sine, cosine * small_cosine - sine * small_sine
