"""Simulates the line scanner: a SICK LMS 200, its telegrams as a byte log, and their stamps in a CSV beside it.

The mirror turns 75 times a second. Readings run from right to left, seen from behind the scanner with its lid up:
reading i lies at the angle 90° − i · resolution from z towards y, in the sensor's y-z plane, x out of the lid. It is
measured i · resolution / 360° of a turn after the scan's first reading; so a scan of 180° takes half a turn, 6.667 ms.
Where scans are interlaced, the even readings are measured in one turn and the odd ones in the next, 13.333 ms later.

Telegrams are those of the maker's listing (*Telegrams for Configuring and Operating the LMS2xx*, 8007954): 0x02,
address 0x80, length, command 0xB0, count of readings with the unit in its two highest bits, readings, status, CRC-16.
A reading holds millimetres; its highest nine values are codes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.compute.array_types import Float64, Int64, UInt8, UInt16
from roadscan.core.gpstime import NS_PER_S
from roadscan.simulate.caster import Hits, Pattern, World, ray_key, steps_within
from roadscan.simulate.drive import RUN_UP_S, Drive
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import Scene, Sick
from roadscan.simulate.sensors.clock import SensorClock

TURN_NS: Final = round(NS_PER_S / 75)
"""Duration of one turn of the mirror (ns)."""
RANGE_MIN_M: Final = 0.05  # nearer things are not met
BLOCK_SCANS: Final = 32
"""Scans measured together: the noise is drawn by block, so this changes bytes."""
BODY_FROM_AXES: Final = np.eye(3)
"""Axes frd: y to the right, z down along the middle reading."""
STAMPS_FILE: Final = "sick_stamps.csv"
STAMP_COLUMN: Final = "time_ns"
OFFSET_COLUMN: Final = "byte"

_PIECES: Final = 10
"""Parts of a scan's half turn, within which the sensor moves evenly."""
_PIECE_NS: Final = TURN_NS // (2 * _PIECES) + 1  # duration of such a part
_CODES: Final = 9  # highest values that are codes
_TOO_FAR: Final = 0
"""Code of a reading out of range."""
_HEAD: Final = (0x02, 0x80)  # first byte and a scanner's address
_ALL_VALUES: Final = 0xB0  # command of complete scans
_MILLIMETRES: Final = 1 << 14  # bits of the count word: readings in mm
_STATUS: Final = 0x10  # status without faults
_POLYNOMIAL: Final = 0x8005  # SICK's CRC-16 without its highest term


@dataclass(frozen=True)
class Scanner:
    """Settings of the scanner."""

    settings: Sick

    @property
    def readings(self) -> int:
        """Number of readings in a scan."""
        return round(180.0 / self.settings.resolution_deg) + 1

    @property
    def turns(self) -> int:
        """Number of turns of the mirror in a scan."""
        return 2 if self.settings.interlaced else 1

    @property
    def range_bits(self) -> int:
        """Bits of a reading that are its range, by the least measuring mode that reaches far enough: 8, 16 or 32 m."""
        return next(bits for bits in (13, 14, 15) if self.settings.range_max_m * 1000 < (1 << bits) - _CODES)

    @property
    def angles_rad(self) -> Float64:
        """Angle (n,) of each reading from z towards y."""
        angles: Float64 = np.radians(90.0 - self.settings.resolution_deg * np.arange(self.readings))
        return angles

    @property
    def turn_of(self) -> Int64:
        """Turn (n,) in which each reading is measured."""
        return np.arange(self.readings) % self.turns

    @property
    def past_ns(self) -> Float64:
        """Time (n,) of each reading since the beginning of its turn (ns)."""
        return np.arange(self.readings, dtype=np.float64) * (self.settings.resolution_deg / 360.0 * NS_PER_S / 75)

    def pattern(self) -> Pattern:
        """Return the readings of a scan."""
        piece = np.minimum(self.past_ns // _PIECE_NS, _PIECES - 1).astype(np.int64)
        return Pattern(
            np.zeros((self.readings, 3)),
            self.turn_of * _PIECES + piece,
            self.past_ns / _PIECE_NS - piece,
            self.settings.divergence_deg,
            (RANGE_MIN_M, self.settings.range_max_m),
            self.beside(),
            (steps_within(self.settings.divergence_deg, self.settings.resolution_deg * self.turns), 1),
        )

    def beside(self) -> Int64:
        """Return neighbours (n, 4) of each reading: next and last one of the same turn; none across the scan."""
        number = np.arange(self.readings)
        after, before = number + self.turns, number - self.turns
        after[after >= self.readings] = -1
        return np.stack([after, np.maximum(before, -1), np.full_like(number, -1), np.full_like(number, -1)], axis=-1)

    def options(self) -> str:
        """Return the log's ``options = …`` in the survey file."""
        parts = [f'stamps = "{STAMPS_FILE}"', f'stamp_column = "{STAMP_COLUMN}"', f'offset_column = "{OFFSET_COLUMN}"']
        return "{ " + ", ".join([*parts, f"turns = {self.turns}", f"range_bits = {self.range_bits}"]) + " }"


@dataclass(frozen=True)
class Scans:
    """A block of s scans."""

    epoch_gps_ns: Int64
    """(s,) first reading."""
    found: Hits
    """(s, n)"""
    values: UInt16
    """(s, n) as the telegrams state them: millimetres, or a code."""


def write_sick(
    scene: Scene, world: World, drive: Drive, clock: SensorClock, file: Path, hits_file: Path | None
) -> Iterator[int]:
    """Write the log of one pass and, beside it, the stamps; yields the scans of each block.

    Hits have one row a turn of the mirror: epoch of the turn's first reading, and lists over all readings of a scan,
    NaN (object −1) for those of other turns and without return.
    """
    scanner = Scanner(scene.sick)
    schema = _hits_schema(scanner.readings)
    hits = pq.ParquetWriter(hits_file, schema, use_dictionary=False) if hits_file else None
    written = 0
    with file.open("wb") as log, (file.parent / STAMPS_FILE).open("w", encoding="utf-8", newline="") as stamps:
        stamps.write(f"{STAMP_COLUMN},{OFFSET_COLUMN}\n")
        for block in measure(scene, world, drive):
            rows = telegrams(block.values)
            log.write(rows.tobytes())
            for stamp in clock.stamps_ns(block.epoch_gps_ns).tolist():
                stamps.write(f"{stamp},{written}\n")
                written += rows.shape[1]
            if hits is not None:
                hits.write_batch(_hits(scanner, block, schema))
            yield len(rows)
    if hits is not None:
        hits.close()


def measure(scene: Scene, world: World, drive: Drive) -> Iterator[Scans]:
    """Yield scans of a whole pass, in blocks of :data:`BLOCK_SCANS`."""
    scanner = Scanner(scene.sick)
    first = drive.start_gps_ns - round(RUN_UP_S / 2 * NS_PER_S)
    count = math.ceil((drive.duration_s + RUN_UP_S) * scene.sick.scans_per_s)
    key = ray_key(scene, drive, "sick")
    a = scanner.angles_rad
    direction = np.stack([np.zeros_like(a), np.sin(a), np.cos(a)], axis=-1)
    begins = TURN_NS * np.arange(scanner.turns)[:, None] + _PIECE_NS * np.arange(_PIECES)
    ends = begins.reshape(-1, 1) + _PIECE_NS * np.arange(2)
    for block, begin in enumerate(range(0, count, BLOCK_SCANS)):
        numbers = np.arange(begin, min(begin + BLOCK_SCANS, count))
        epochs = first + np.rint(numbers * (NS_PER_S / scene.sick.scans_per_s)).astype(np.int64)
        found = world.cast(
            drive,
            scene.sick.mount,
            BODY_FROM_AXES,
            epochs[:, None, None] + ends,
            np.ascontiguousarray(np.broadcast_to(direction, (epochs.size, *direction.shape))),
            scanner.pattern(),
            key + begin * scanner.readings,
        )
        yield Scans(epochs, found, _values(scene, drive, block, found.range_m))


def _values(scene: Scene, drive: Drive, block: int, exact_m: Float64) -> UInt16:
    """Return the readings as stated: with noise, rounded to millimetres, codes where there are none."""
    rng = stream(scene.seed, drive.number, "sick", block)
    seen = np.isfinite(exact_m)
    if scene.noise.dropout > 0.0:
        seen &= rng.random(seen.shape, dtype=np.float32) >= scene.noise.dropout
    errors = rng.standard_normal(np.count_nonzero(seen), dtype=np.float32)
    first_code = (1 << Scanner(scene.sick).range_bits) - _CODES
    values = np.full(seen.shape, first_code + _TOO_FAR, np.uint16)
    millimetres = np.rint(1000.0 * (exact_m[seen] + scene.noise.sick_range_m * errors))
    values[seen] = np.clip(millimetres, 1, first_code)
    return values


def telegrams(values: UInt16) -> UInt8:
    """Return telegrams (s, bytes) of scans (s, n)."""
    count, readings = values.shape
    size = 2 * readings + 4
    head = [*_HEAD, size & 0xFF, size >> 8, _ALL_VALUES, readings & 0xFF, (readings | _MILLIMETRES) >> 8]
    rows = np.empty((count, 4 + size + 2), np.uint8)
    rows[:, : len(head)] = head
    rows[:, len(head) : -3] = np.ascontiguousarray(values.astype("<u2")).view(np.uint8)
    rows[:, -3] = _STATUS
    crc = _crc(rows[:, :-2])
    rows[:, -2], rows[:, -1] = crc & 0xFF, crc >> 8
    return rows


def _crc(rows: UInt8) -> Int64:
    """Return the maker's CRC-16 (s,) of each row (s, bytes), as its listing computes it: shifted by a bit per byte."""
    crc = np.zeros(len(rows), np.int64)
    before = np.zeros(len(rows), np.int64)
    for byte in rows.T.astype(np.int64):
        shifted = (crc & 0x7FFF) << 1
        crc = np.where(crc & 0x8000, shifted ^ _POLYNOMIAL, shifted) ^ (byte | before << 8)
        before = byte
    return crc


def _hits_schema(readings: int) -> pa.Schema:
    def lists(kind: pa.DataType) -> pa.DataType:
        return pa.list_(pa.field("element", kind, nullable=False), readings)

    places = [pa.field(name, lists(pa.float64())) for name in ("easting_m", "northing_m", "height_m", "range_m")]
    others = [pa.field("object_id", lists(pa.int32())), pa.field("is_mixed", lists(pa.bool_()))]
    return pa.schema([pa.field("epoch_gps_ns", pa.int64()), *places, *others])


def _hits(scanner: Scanner, block: Scans, schema: pa.Schema) -> pa.RecordBatch:
    """Return the origins of a block's readings."""
    codes_from = (1 << scanner.range_bits) - _CODES
    in_turn = np.arange(scanner.turns)[:, None] == scanner.turn_of
    seen = (block.values < codes_from)[:, None, :] & in_turn
    found = block.found
    places = [*np.moveaxis(found.enh_m, -1, 0), found.range_m]
    columns = [np.where(seen, place[:, None, :], np.nan) for place in places]
    columns += [np.where(seen, found.object_id[:, None, :], np.int32(-1)), seen & found.is_mixed[:, None, :]]
    epochs = block.epoch_gps_ns[:, None] + TURN_NS * np.arange(scanner.turns)
    arrays = [
        pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), type=field.type)
        for values, field in zip(columns, list(schema)[1:], strict=True)
    ]
    return pa.RecordBatch.from_arrays([pa.array(epochs.ravel()), *arrays], schema=schema)
