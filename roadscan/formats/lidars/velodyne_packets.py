"""Velodyne data packets: the maker's tables, tests for damage, and decoding.

A data packet has 1,206 bytes: 12 blocks of flag, azimuth (0.01°, clockwise seen from above) and 32 times distance
and reflectivity; then microseconds past the hour, return mode and product. A distance counts 2 mm (HDL-32E, VLP-16)
or 4 mm (VLP-32C, VLS-128). The return of slot j in block b is fired after the packet's stamp by

    HDL-32E  46.080 µs · b + 1.152 µs · j          (dual return: b // 2 in place of b)
    VLP-16   55.296 µs · (2 b + j // 16) + 2.304 µs · (j mod 16)
    VLP-32C  55.296 µs · b + 2.304 µs · (j // 2)
    VLS-128  53.300 µs · (b // 4) + 2.665 µs · (g + g // 8) − 8.7 µs,  g = 4 (b mod 4) + j // 8

(HDL-32E: application note 63-9277; VLP-16: user manual 63-9243, chapter 9; VLP-32C: 63-9325, 9.4; VLS-128: 63-9483,
9.4). A firing sequence of the VLS-128 takes four blocks with flags EEFF, DDFF, CCFF and BBFF; in dual return a packet
holds one sequence in eight blocks, and four blocks are filler. An azimuth is that of the first firing of its sequence,
and the head turns on meanwhile at its mean rate. A return's position, in axes ``flu``, is

    x = d cos ω cos α,  y = −d cos ω sin α,  z = d sin ω + v

with the azimuth α and the laser's part of it, its elevation ω and its vertical offset v (HDL-32E: drawing
86-0106; VLP-16: manual, table 9-1; VLP-16 Hi-Res, VLP-32C and VLS-128: the maker's calibration files, as VeloView has
them, and beams whose lenses are 41.8 mm, 42.4 mm and 58.63 mm from the axis, which they cross at v).

Decoding is done here and checked in the tests against ``velodyne-decoder``. That library emits whole
turns, rounds every azimuth to 0.01° (4 mm at 50 m) and gives float32 seconds relative to the turn; here
each return has its own whole-nanosecond time, and memory is bounded by the packet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Bool, Float32, Int32, Int64
from roadscan.compute.kernel_options import read_only
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import NS_PER_S
from roadscan.formats.lidars.kernels.packets import Firings, Room, returned
from roadscan.formats.lidars.packet_returns import TURN, Gap, jumps, mean_rate, steps, waits_ns
from roadscan.store.readings.packed_returns import BEAMS, PACKED, Beams
from roadscan.store.schema import table_schema

Numbers = npt.NDArray[Any]

DATA_BYTES: Final = 1206  # bytes of a data packet
BLOCKS: Final = 12  # blocks of a packet
SLOTS: Final = 32  # returns of a block

_BLOCK: Final = np.dtype(
    [("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("distance", "<u2"), ("reflectivity", "u1")], (SLOTS,))]
)
PACKET: Final = np.dtype([("blocks", _BLOCK, (BLOCKS,)), ("stamp_us", "<u4"), ("mode", "u1"), ("product", "u1")])
"""NumPy layout of a data packet."""
FLAGS: Final = (0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF)
"""First two bytes of a block: of every block, or of a firing sequence's four."""
DUAL: Final = 0x39  # mode byte of dual return
MODES: Final = {0x37: "strongest", 0x38: "last", DUAL: "dual"}
"""Return modes by their byte."""
LATEST_STAMP_US: Final = 3_660_000_000
"""Stamps run a little past the hour before they restart; beyond a minute they are wrong."""

_FASTEST_HZ: Final = 25.0  # fastest turn that is accepted
_LARGEST_STEP_CENTIDEG: Final = 300  # larger steps from block to block are no turn of a head (0.01°)
_SLACK_CENTIDEGREES: Final = 10  # tolerance of azimuth steps (0.01°)


@dataclass(frozen=True)
class Model:
    """The maker's data of a sensor; tables are by laser."""

    name: str
    product: int
    """Product byte of its packets."""
    lasers: int
    cycle_ns: int
    """Time from one firing sequence to the next (ns)."""
    firing_ns: int
    """Time from one firing to the next (ns)."""
    elevations_deg: tuple[float, ...]
    rises_mm: tuple[float, ...] = (0.0,)
    """Height of each beam's origin above the sensor's (mm)."""
    azimuths_deg: tuple[float, ...] = (0.0,)
    """Each laser's part of the azimuth (°, clockwise)."""
    distance_mm: float = 2.0
    """Unit of distance."""
    at_once: int = 1
    """Lasers that fire together."""
    rest_after: int = 16
    """Firings of a sequence after which one is left out."""
    first_ns: int = 0
    """Time of the packet's first firing after its stamp."""
    extra_mm: tuple[float, ...] = (0.0,)
    """Range that is added to each laser's distances."""
    reaches_mm: tuple[float, ...] = (0.0,)
    sides_mm: tuple[float, ...] = (0.0,)
    """Horizontal position of each beam's origin along the beam and to its left."""

    @property
    def banks(self) -> int:
        """Return the blocks of a firing sequence, 1 for sensors with up to 32 lasers."""
        return max(1, self.lasers // SLOTS)

    def blocks(self, dual: bool) -> int:
        """Return how many of the packet's blocks hold returns: whole firing sequences."""
        return BLOCKS // (per := self.banks * (1 + dual)) * per

    def flags(self, dual: bool) -> npt.NDArray[np.uint16]:
        """Return the flag (blocks,) of each block."""
        bank = np.arange(self.blocks(dual)) // (1 + dual) % self.banks
        return np.array(FLAGS, dtype=np.uint16)[bank]

    def slot_lasers(self, dual: bool) -> npt.NDArray[np.uint8]:
        """Return (blocks, 32) laser of each slot."""
        bank = np.arange(self.blocks(dual))[:, None] // (1 + dual) % self.banks
        return ((bank * SLOTS + np.arange(SLOTS)) % self.lasers).astype(np.uint8)

    def azimuth_times_ns(self, dual: bool) -> Int64:
        """Return (blocks,) time of the firing that each block's azimuth belongs to, after the packet's stamp."""
        block = np.arange(self.blocks(dual), dtype=np.int64) // (1 + dual)
        return self.first_ns + block // self.banks * max(1, SLOTS // self.lasers) * self.cycle_ns

    def slot_times_ns(self, dual: bool) -> Int64:
        """Return (blocks, 32) time of each slot after the packet's stamp."""
        firing = self.slot_lasers(dual).astype(np.int64) // self.at_once
        firing += 0 if self.banks == 1 else firing // self.rest_after
        sequence = np.arange(SLOTS) // self.lasers
        return self.azimuth_times_ns(dual)[:, None] + sequence * self.cycle_ns + firing * self.firing_ns

    def slots(self, dual: bool) -> npt.NDArray[np.uint8]:
        """Return (blocks, 32) place of each return in its firing sequence, or sequences where a block holds two."""
        bank = np.arange(self.blocks(dual))[:, None] // (1 + dual) % self.banks
        return (bank * SLOTS + np.arange(SLOTS)).astype(np.uint8)

    def beams(self, dual: bool) -> Beams:
        """Return the beams by slot."""
        own = slice(0, self.banks * (1 + dual), 1 + dual)  # a block of each bank
        lasers = self.slot_lasers(dual)[own].reshape(-1)
        after_ns = (self.slot_times_ns(dual) - self.azimuth_times_ns(dual)[:, None])[own].reshape(-1)

        def of(values: Numbers) -> Float32:
            return np.broadcast_to(values, self.lasers)[lasers].astype(np.float32)

        elevation, azimuth = np.radians(self.elevations_deg), np.radians(self.azimuths_deg)
        return Beams(
            {
                "slot": np.arange(lasers.size, dtype=np.uint8),
                "laser": lasers,
                "after_ns": after_ns,
                "unit_m": of(np.array(self.distance_mm * 1e-3)),
                "extra_m": of(np.array(self.extra_mm) * 1e-3),
                "cos_elevation": of(np.cos(elevation)),
                "sin_elevation": of(np.sin(elevation)),
                "cos_azimuth": of(np.cos(azimuth)),
                "sin_azimuth": of(np.sin(azimuth)),
                "reach_m": of(np.array(self.reaches_mm) * 1e-3),
                "side_m": of(np.array(self.sides_mm) * 1e-3),
                "rise_m": of(np.array(self.rises_mm) * 1e-3),
            }
        )

    def calibrated(self, file: Path) -> Model:
        """Return the model with the angles and offsets of a calibration file (YAML, as VeloView's are converted).

        Raises
        ------
        ConfigError
            if the file is none, or one of another sensor.
        """
        import yaml

        try:
            content = yaml.safe_load(file.read_text(encoding="utf-8"))
            lasers = sorted(content["lasers"], key=lambda one: int(one["laser_id"]))
            numbers = [int(one["laser_id"]) for one in lasers]
            keys = ("vert_correction", "rot_correction", "vert_offset_correction", "horiz_offset_correction")
            rows = [[float(one.get(key, 0.0)) for key in (*keys, "dist_correction")] for one in lasers]
            unit_mm = float(content.get("distance_resolution", self.distance_mm * 1e-3)) * 1e3
            two_points = any(one.get("two_pt_correction_available") for one in lasers)
        except (OSError, ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError) as error:
            raise ConfigError(
                "options.calibration names no calibration file of a Velodyne",
                expected="YAML with lasers: laser_id, rot_correction, vert_correction (rad)",
                file=file,
            ) from error
        table = np.array(rows)
        if numbers != list(range(self.lasers)) or two_points or not np.isfinite(table).all():
            raise ConfigError(
                f"the calibration is not of a {self.name}: {len(numbers)} lasers",
                expected=f"lasers 0 to {self.lasers - 1}, without corrections at two distances (HDL-64E)",
                file=file,
            )
        if round(unit_mm, 3) != self.distance_mm:
            raise ConfigError(
                f"the calibration's distance unit is {unit_mm:g} mm, {self.distance_mm:g} expected", file=file
            )
        elevation, azimuth, up, side, extra = table.T
        return replace(
            self,
            elevations_deg=tuple(np.degrees(elevation).tolist()),
            azimuths_deg=tuple((-np.degrees(azimuth)).tolist()),
            rises_mm=tuple((up * np.cos(elevation) * 1e3).tolist()),
            reaches_mm=tuple((-up * np.sin(elevation) * 1e3).tolist()),
            sides_mm=tuple((side * 1e3).tolist()),
            extra_mm=tuple((extra * 1e3).tolist()),
        )


_HI_RES_DEG: Final = (
    -10.0, 0.667, -8.667, 2.0, -7.333, 3.333, -6.0, 4.667, -4.667, 6.0, -3.333, 7.333, -2.0, 8.667, -0.667, 10.0,
)  # fmt: skip
_VLP_32C_DEG: Final = (
    -25.0, -1.0, -1.667, -15.639, -11.31, 0.0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333,
    0.667, -4.0, -4.667, 1.667, 1.0, -3.667, -3.333, 3.333, 2.333, -2.667, -3.0, 7.0, 4.667, -2.333, -2.0, 15.0,
    10.333, -1.333,
)  # fmt: skip
_VLS_128_DEG: Final = (
    -11.742, -1.99, 3.4, -5.29, -0.78, 4.61, -4.08, 1.31, -6.5, -1.11, 4.28, -4.41, 0.1, 6.48, -3.2, 2.19,
    -3.86, 1.53, -9.244, -1.77, 2.74, -5.95, -0.56, 4.83, -2.98, 2.41, -6.28, -0.89, 3.62, -5.07, 0.32, 7.58,
    -0.34, 5.18, -3.64, 1.75, -25.0, -2.43, 2.96, -5.73, 0.54, 9.7, -2.76, 2.63, -7.65, -1.55, 3.84, -4.85,
    3.18, -5.51, -0.12, 5.73, -4.3, 1.09, -16.042, -2.21, 4.06, -4.63, 0.76, 15.0, -3.42, 1.97, -6.85, -1.33,
    -5.62, -0.23, 5.43, -3.53, 0.98, -19.582, -2.32, 3.07, -4.74, 0.65, 11.75, -2.65, 1.86, -7.15, -1.44, 3.95,
    -2.1, 3.29, -5.4, -0.01, 4.5, -4.19, 1.2, -13.565, -1.22, 4.17, -4.52, 0.87, 6.08, -3.31, 2.08, -6.65, 1.42,
    -10.346, -1.88, 3.51, -6.06, -0.67, 4.72, -3.97, 2.3, -6.39, -1.0, 4.39, -5.18, 0.21, 6.98, -3.09, 4.98,
    -3.75, 1.64, -8.352, -2.54, 2.85, -5.84, -0.45, 8.43, -2.87, 2.52, -6.17, -1.66, 3.73, -4.96, 0.43,
)  # fmt: skip
"""Elevations by design (°)."""


def _rises(lens_mm: float, elevations_deg: tuple[float, ...]) -> tuple[float, ...]:
    """Return where beams through lenses at `lens_mm` from the axis of rotation cross it (mm above the origin)."""
    return tuple((-lens_mm * np.tan(np.radians(elevations_deg))).tolist())


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
    Model(
        "VLP-16 Hi-Res", 0x24, 16, 55_296, 2_304,
        _HI_RES_DEG,
        _rises(41.8, _HI_RES_DEG),
    ),
    Model(
        "VLP-32C", 0x28, 32, 55_296, 2_304,
        _VLP_32C_DEG,
        azimuths_deg=(
            1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4,
            -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4,
        ),
        rises_mm=_rises(42.4, _VLP_32C_DEG), distance_mm=4.0, at_once=2,
    ),
    Model(
        "VLS-128", 0xA1, 128, 53_300, 2_665,
        _VLS_128_DEG,
        azimuths_deg=(6.354, 4.548, 2.732, 0.911, -0.911, -2.732, -4.548, -6.354) * 16,
        rises_mm=_rises(58.63, _VLS_128_DEG), distance_mm=4.0, at_once=8, rest_after=8, first_ns=-8_700,
    ),
)  # fmt: skip
"""Supported sensors."""


def faults(raw: npt.NDArray[np.void], model: Model, unstated: bool, gap: Gap | None = None) -> list[tuple[Bool, str]]:
    """Return masks (n,) of damaged packets, each with its reason.

    Parameters
    ----------
    raw : (n,) packets of dtype :data:`PACKET`.
    model : the sensor.
    unstated : whether mode and product may be 0, as old firmware writes them.
    gap : of the sensor's view.
    """
    dual = (raw["mode"] == DUAL) & (model.banks > 1)
    azimuth = np.where(dual[:, None], raw["blocks"]["azimuth"][:, :1], raw["blocks"]["azimuth"])
    flags = raw["blocks"]["flag"]
    unflagged = np.where(
        dual,
        (flags[:, : model.blocks(True)] != model.flags(True)).any(axis=1),
        (flags != model.flags(False)).any(axis=1),
    )
    silent = (raw["mode"] == 0) & (raw["product"] == 0) & unstated
    known = np.isin(raw["mode"], list(MODES))
    return [
        (unflagged, "a block does not begin with 0x" + (" 0x".join(f"{f:X}" for f in FLAGS[: model.banks]))),
        ((raw["product"] != model.product) & ~silent, "the product byte is not the sensor's"),
        (~known & ~silent, "the return mode is unknown"),
        ((azimuth >= TURN).any(axis=1), "an azimuth is 360° or more"),
        (jumps(azimuth, odd_steps(azimuth, model), gap), "the azimuth jumps inside the packet"),
        (raw["stamp_us"] > LATEST_STAMP_US, "the stamp is more than 3,660 s past the hour"),
    ]


def odd_steps(azimuth: npt.NDArray[np.uint16], model: Model) -> Bool:
    """Return which steps (n, blocks − 1) from block to block the head cannot have turned."""
    block_s = max(1, SLOTS // model.lasers) * model.cycle_ns / NS_PER_S
    turn = steps(azimuth)
    return np.asarray((turn < -_SLACK_CENTIDEGREES) | (turn > TURN * _FASTEST_HZ * block_s + _SLACK_CENTIDEGREES))


def decode(
    raw: npt.NDArray[np.void], epochs: Int64, sweeps: Int32, model: Model, dual: bool, as_driver: bool = False
) -> pa.RecordBatch:
    """Return the returns of sound packets.

    Parameters
    ----------
    raw : (n,) packets.
    epochs : (n,) GPS ns of each packet's stamp.
    sweeps : (n, 12) sweep of each block.
    dual : whether blocks come in pairs of last and strongest return.
    as_driver : whether azimuths are those of ROS drivers (:func:`_driver_heads`).

    Returns
    -------
    Batch of the table ``packed_returns``, in the order of the packets' slots, without empty slots.
    """
    blocks = raw["blocks"][:, : model.blocks(dual)]
    azimuth = np.ascontiguousarray(blocks["azimuth"])
    if as_driver and model.at_once > 1:
        rates, head = np.zeros(len(raw)), _driver_heads(azimuth, model, dual)
    else:
        rates, head = _rates(azimuth, epochs, model.azimuth_times_ns(dual)), azimuth[:, :, None]
    epoch = np.broadcast_to(epochs[:, None], azimuth.shape)
    odd = odd_steps(azimuth, model)
    if odd.any():
        rate = mean_rate(azimuth, epochs)
        epoch = epoch + waits_ns(azimuth, odd, rate, max(1, SLOTS // model.lasers) * model.cycle_ns)
    firings = Firings(
        np.ascontiguousarray(epoch), head, rates, np.ascontiguousarray(sweeps),
        model.slot_times_ns(dual), model.slots(dual),
    )  # fmt: skip
    schema = table_schema(PACKED).arrow()
    room = Room(*(np.empty(azimuth.size * SLOTS, field.type.to_pandas_dtype()) for field in schema))
    packets = np.ascontiguousarray(raw).view(np.uint8).reshape(len(raw), DATA_BYTES)
    count = returned(read_only(packets), firings, dual, room)
    metadata = {BEAMS: model.beams(dual).encoded()}
    return pa.RecordBatch.from_arrays([pa.array(v[:count]) for v in room], schema=schema.with_metadata(metadata))


def _rates(azimuth: npt.NDArray[np.uint16], epochs: Int64, times_ns: Int64) -> npt.NDArray[np.float64]:
    """Return the head's rate (n,) in rad/ns: its mean in the packet, or to the next one where that holds one azimuth.

    Parameters
    ----------
    azimuth : (n, blocks) 0.01°.
    epochs : (n,) GPS ns of the packets.
    times_ns : (blocks,) of the azimuths.
    """
    span_ns = float(times_ns[-1] - times_ns[0])
    if span_ns:
        turn = steps(azimuth)
        whole = np.abs(turn).max(axis=1) <= _LARGEST_STEP_CENTIDEG  # no gap of the view lies in the packet
        rates = np.radians(turn.sum(axis=1) * 0.01) / span_ns
        return np.where(whole, rates, np.median(rates[whole]) if whole.any() else 0.0)
    if len(epochs) < 2:
        return np.zeros(len(epochs))
    passed_ns = np.maximum(np.diff(epochs), 1)
    rates = np.radians(steps(azimuth[:, :1].T)[0] * 0.01) / passed_ns
    near = passed_ns < 10 * np.median(passed_ns)
    rates = np.where(near, rates, np.median(rates[near]))
    return np.append(rates, rates[-1])


def _driver_heads(azimuth: npt.NDArray[np.uint16], model: Model, dual: bool) -> npt.NDArray[np.uint16]:
    """Return the head's azimuth (n, blocks, 32) at each firing as ROS drivers have it (0.01°).

    Each laser gets its share of the turn to the next block, none in the last. A VLP-32C's lasers count as fired one
    after another, which takes 71 µs of a cycle of 55; of a VLS-128, only the last of a sequence's blocks turns, as all
    four share an azimuth.
    """
    turn = steps(azimuth)
    turn = np.where(np.abs(turn) > _LARGEST_STEP_CENTIDEG, np.median(turn), turn)
    if model.banks > 1:
        per = 1 + dual
        ahead = turn.reshape(len(turn), -1)
        step = np.zeros(azimuth.shape)
        step[:, : ahead.shape[1] + 1 - per] = sum(ahead[:, k : ahead.shape[1] + 1 - per + k] for k in range(per))
        firing = model.slot_lasers(dual).astype(np.int64) // model.at_once
        share = (firing + firing // model.rest_after) * model.firing_ns / model.cycle_ns
    else:
        step = np.pad(turn, ((0, 0), (0, 1)))
        share = np.arange(SLOTS) * model.firing_ns / model.cycle_ns
    head = np.rint(azimuth[:, :, None] + step[:, :, None] * share).astype(np.int64)
    return np.where(head < 0, head + TURN, head).astype(np.uint16)
