"""Simulates the spinning lidar: firings of a Velodyne HDL-32E and its PCAP log.

32 lasers fire one after another 1.152 µs apart, a cycle each 46.08 µs, 12 cycles a packet, while the head turns.
The beams' elevations and the heights of their origins are those of the maker's drawing 86-0106.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.simulate.caster import Hits, Pattern, World, ray_key, steps_within
from roadscan.simulate.drive import RUN_UP_S, Drive
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import Scene
from roadscan.simulate.sensors.pcap import PcapWriter

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

LASERS: Final = 32  # lasers of the HDL-32E
CYCLES: Final = 12  # firing cycles of a packet
FIRING_NS: Final = 1_152  # time between two lasers
CYCLE_NS: Final = 46_080  # time of a firing cycle
PACKET_NS: Final = CYCLES * CYCLE_NS
INTERVALS: Final = 4
"""Intervals of a packet, within which the sensor moves evenly."""
GROUP_PACKETS: Final = 8
"""Packets whose firings are neighbours of each other. A pass has whole groups of them."""
_INTERVAL_NS: Final = PACKET_NS // INTERVALS
RANGE_STEP_M: Final = 0.002  # unit of ranges in packets
RANGE_MIN_M: Final = 0.9  # shorter ranges are not measured
_LONGEST_RAW: Final = 65_535  # largest raw range
BLOCK_PACKETS: Final = 128
"""Packets measured together, whole groups: the noise is drawn by block, so this changes bytes."""
BODY_FROM_AXES: Final = np.diag([1.0, -1.0, -1.0])
"""Axes flu: x forward, y left, z up."""
REFLECTIVITY: Final = 0.35
"""Lidar intensity for one digital number of a profiler."""

_LOWEST_DEG: Final = -92.0 / 3.0  # elevation of the lowest beam
_LOWER_HALF_RISE_MM: Final = (
    17.17, 16.27, 15.40, 14.54, 13.71, 12.89, 12.09, 11.31, 10.54, 9.78, 9.04, 8.30, 7.58, 6.86, 6.15, 5.45,
)  # fmt: skip
_UPPER_HALF_RISE_MM: Final = (
    4.76, 4.07, 3.38, 2.70, 2.02, 1.35, 0.67, 0.0, -0.67, -1.35, -2.02, -2.70, -3.38, -4.07, -4.76, -5.45,
)  # fmt: skip


@dataclass(frozen=True)
class Beams:
    """Geometry of the lasers in firing order (32,): even ones look lower, odd ones higher."""

    elevation_deg: Float64
    rise_m: Float64
    """Height of a beam's origin along the sensor's z."""


def hdl32e_beams() -> Beams:
    """Return elevations −30.67° … +10.67° in firing order, to the hundredth as the maker prints them."""
    ascending = np.round(_LOWEST_DEG + 4.0 / 3.0 * np.arange(LASERS), 2)
    elevation, rise = np.empty(LASERS), np.empty(LASERS)
    elevation[0::2], elevation[1::2] = ascending[:16], ascending[16:]
    rise[0::2], rise[1::2] = _LOWER_HALF_RISE_MM, _UPPER_HALF_RISE_MM
    return Beams(elevation, rise / 1000.0)


@dataclass(frozen=True)
class Packets:
    """A block of p measured packets."""

    epoch_gps_ns: Int64
    """(p,) first firing of each packet."""
    block_azimuth: npt.NDArray[np.uint16]
    """(p, 12) hundredths of a degree at each cycle's first firing, as stated."""
    azimuth_deg: Float64
    """(p, 12, 32) true azimuth of each firing, clockwise from the sensor's x, seen from above."""
    found: Hits
    """(p, 384) what each firing met, in the order fired."""
    ranges: npt.NDArray[np.uint16]
    """(p, 12, 32) units of 2 mm, 0: no return."""
    intensity: npt.NDArray[np.uint8]
    """(p, 12, 32)"""

    def firing_gps_ns(self) -> Int64:
        """Return the epoch of each firing (p, 12, 32)."""
        offsets = CYCLE_NS * np.arange(CYCLES)[:, None] + FIRING_NS * np.arange(LASERS)
        out: Int64 = self.epoch_gps_ns[:, None, None] + offsets
        return out


def write_lidar(scene: Scene, world: World, drive: Drive, file: Path, hits_file: Path | None) -> Iterator[int]:
    """Write the capture of one pass, a block of packets a step; yields the returns of each."""
    hits = pq.ParquetWriter(hits_file, _HITS_SCHEMA, use_dictionary=False) if hits_file else None
    with PcapWriter(file, scene, drive) as capture:
        for block in measure(scene, world, drive):
            capture.write(block.epoch_gps_ns, block.block_azimuth, block.ranges, block.intensity)
            if hits is not None:
                hits.write_batch(_hits(block))
            yield int(np.count_nonzero(block.ranges))
    if hits is not None:
        hits.close()


def starts_gps_ns(drive: Drive) -> int:
    """Return the epoch of a pass's first firing."""
    return drive.start_gps_ns - round(RUN_UP_S / 2 * 1e9)


def measure(scene: Scene, world: World, drive: Drive) -> Iterator[Packets]:
    """Yield packets of a whole pass, in blocks of :data:`BLOCK_PACKETS`."""
    first = starts_gps_ns(drive)
    span = drive.duration_s + RUN_UP_S
    count = GROUP_PACKETS * math.ceil(span * 1e9 / (GROUP_PACKETS * PACKET_NS))
    start_deg = float(stream(scene.seed, drive.number, "lidar head").integers(0, 36_000)) / 100.0
    key = ray_key(scene, drive, "lidar")
    for block, packet in enumerate(range(0, count, BLOCK_PACKETS)):
        numbers = np.arange(packet, min(packet + BLOCK_PACKETS, count))
        yield _measure_block(scene, world, drive, first + numbers * PACKET_NS, _azimuths(scene, start_deg, numbers),
                             key + packet * CYCLES * LASERS, block)  # fmt: skip


def _measure_block(
    scene: Scene,
    world: World,
    drive: Drive,
    epochs: Int64,
    azimuths: tuple[npt.NDArray[np.uint16], Float64],
    key: int,
    block: int,
) -> Packets:
    stated, azimuth_deg = azimuths
    beams = hdl32e_beams()
    elevation, azimuth = np.radians(beams.elevation_deg), np.radians(azimuth_deg)
    flat = np.cos(elevation)
    up = np.broadcast_to(np.sin(elevation), azimuth.shape)
    direction = np.stack([flat * np.cos(azimuth), -flat * np.sin(azimuth), up], axis=-1)
    intervals = _INTERVAL_NS * (np.arange(GROUP_PACKETS * INTERVALS)[:, None] + np.arange(2))
    groups = world.cast(
        drive,
        scene.lidar.mount,
        BODY_FROM_AXES,
        epochs[::GROUP_PACKETS, None, None] + intervals,
        direction.reshape(epochs.size // GROUP_PACKETS, -1, 3),
        _pattern(scene, beams),
        key,
    )
    found = groups.of_groups(epochs.size)
    ranges, intensity = _recorded(scene, drive, block, found)
    return Packets(epochs, stated, azimuth_deg, found, ranges, intensity)


def _pattern(scene: Scene, beams: Beams) -> Pattern:
    """Return the firings of a group of packets."""
    cycles = GROUP_PACKETS * CYCLES
    origin = np.zeros((cycles, LASERS, 3))
    origin[:, :, 2] = beams.rise_m
    past_ns = (CYCLE_NS * np.arange(cycles)[:, None] + FIRING_NS * np.arange(LASERS)).ravel()
    return Pattern(
        origin.reshape(-1, 3),
        past_ns // _INTERVAL_NS,
        past_ns % _INTERVAL_NS / _INTERVAL_NS,
        scene.lidar.divergence_deg,
        (RANGE_MIN_M, scene.lidar.range_max_m),
        _beside(beams, cycles),
        (
            steps_within(scene.lidar.divergence_deg, _degrees_a_cycle(scene)),
            steps_within(scene.lidar.divergence_deg, 4.0 / 3.0),
        ),
    )


def _degrees_a_cycle(scene: Scene) -> float:
    """Return the rotation of the head in a cycle."""
    return scene.lidar.turns_per_s * 360.0 * CYCLE_NS * 1e-9


def _beside(beams: Beams, cycles: int) -> Int64:
    """Return neighbours (32 · cycles, 4) of firings: the laser a cycle later and earlier, those above and below."""
    number = np.full((cycles + 2, LASERS + 2), -1)
    order = np.argsort(beams.elevation_deg)
    number[1:-1, 1:-1] = np.arange(cycles * LASERS).reshape(cycles, LASERS)[:, order]
    sides = np.stack([number[2:, 1:-1], number[:-2, 1:-1], number[1:-1, 2:], number[1:-1, :-2]], axis=-1)
    beside = np.empty_like(sides)
    beside[:, order] = sides
    return beside.reshape(-1, 4)


def _azimuths(scene: Scene, start_deg: float, numbers: Int64) -> tuple[npt.NDArray[np.uint16], Float64]:
    """Return the stated azimuth of each cycle (p, 12), hundredths, and that of each firing (p, 12, 32), degrees."""
    per_cycle = scene.lidar.turns_per_s * 36_000.0 * CYCLE_NS * 1e-9
    cycle = numbers[:, None] * CYCLES + np.arange(CYCLES)
    share = FIRING_NS / CYCLE_NS * np.arange(LASERS)
    if scene.lidar.on_azimuth_grid:
        per_cycle = float(round(per_cycle))
        start_deg = round(start_deg * 100.0) / 100.0
    begins = start_deg * 100.0 + per_cycle * cycle
    hundredths = begins[:, :, None] + per_cycle * share
    stated = np.mod(np.rint(begins).astype(np.int64), 36_000).astype(np.uint16)
    return stated, np.mod(hundredths, 36_000.0) / 100.0


def _recorded(
    scene: Scene, drive: Drive, block: int, found: Hits
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint8]]:
    """Return ranges and intensities (p, 12, 32) with noise, as integers."""
    rng = stream(scene.seed, drive.number, "lidar", block)
    noise = scene.noise
    exact = found.range_m.reshape(-1, CYCLES, LASERS)
    seen = np.isfinite(exact)
    if noise.dropout > 0.0:
        seen &= rng.random(seen.shape, dtype=np.float32) >= noise.dropout
    errors = rng.standard_normal((2, np.count_nonzero(seen)), dtype=np.float32)
    ranges, intensity = np.zeros(seen.shape, np.uint16), np.zeros(seen.shape, np.uint8)
    units = np.rint((exact[seen] + noise.lidar_range_m * errors[0]) / RANGE_STEP_M)
    ranges[seen] = np.clip(units, 1, _LONGEST_RAW)
    value = REFLECTIVITY * (found.intensity.reshape(seen.shape)[seen] + noise.intensity * errors[1])
    intensity[seen] = np.clip(np.rint(value), 1, 100)
    return ranges, intensity


_HITS_SCHEMA: Final = pa.schema(
    [
        pa.field("epoch_gps_ns", pa.int64()),
        pa.field("laser", pa.uint8()),
        pa.field("azimuth_deg", pa.float64()),
        pa.field("range_m", pa.float64()),
        pa.field("easting_m", pa.float64()),
        pa.field("northing_m", pa.float64()),
        pa.field("height_m", pa.float64()),
        pa.field("object_id", pa.int32()),
        pa.field("is_mixed", pa.bool_()),
    ]
)


def _hits(block: Packets) -> pa.RecordBatch:
    """Return the origins of a block's returns, one row for each recorded return."""
    seen = block.ranges > 0
    flat = seen.reshape(len(seen), -1)
    laser = np.broadcast_to(np.arange(LASERS, dtype=np.uint8), seen.shape)
    found = block.found
    columns = [block.firing_gps_ns()[seen], laser[seen], block.azimuth_deg[seen], found.range_m[flat]]
    columns += [*found.enh_m[flat].T, found.object_id[flat], found.is_mixed[flat]]
    return pa.RecordBatch.from_arrays([pa.array(np.ascontiguousarray(c)) for c in columns], schema=_HITS_SCHEMA)
