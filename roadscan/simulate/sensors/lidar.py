"""Simulates the lidar: firings of a model's lasers while the head turns, and the capture of its maker's packets.

When the lasers fire and where they look are the figures of the model's file (:mod:`roadscan.simulate.lidar_model`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.simulate.caster import Hits, Pattern, World, ray_key, steps_within
from roadscan.simulate.drive import RUN_UP_S, Drive
from roadscan.simulate.lidar_model import LidarModel, ModelErrors, lidar_model
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import Scene

INTERVALS: Final = 4
"""Intervals of a block of cycles (an HDL-32E's packet), within which the sensor moves evenly."""
GROUP_PACKETS: Final = 8
"""Packets whose firings are neighbours of each other. A pass has whole groups of them."""
BLOCK_PACKETS: Final = 128
"""Packets measured together, whole groups: the noise is drawn by block, so this changes bytes."""
BODY_FROM_AXES: Final = np.diag([1.0, -1.0, -1.0])
"""Axes flu: x forward, y left, z up."""
REFLECTIVITY: Final = 0.35
"""Lidar intensity for one digital number of a profiler."""
_CLUTTER_INTENSITY: Final = 3  # of a drop of rain
PACKET_COLUMNS: Final = 16
"""Columns of an Ouster's packet, of which a pass has whole ones."""


@dataclass(frozen=True)
class Packets:
    """A block of p measured packets of c firing cycles of n lasers."""

    model: LidarModel
    epoch_gps_ns: Int64
    """(p,) first firing of each packet."""
    block_azimuth: npt.NDArray[np.uint16]
    """(p, c) hundredths of a degree at each cycle's first firing, as stated."""
    azimuth_deg: Float64
    """(p, c, n) azimuth of each firing, clockwise from the sensor's x, seen from above."""
    elevation_deg: Float64
    """(p, c, n) and its elevation: both by the model's figures, beside which the beam went by its `errors.angle_deg`.
    """
    found: Hits
    """(p, c · n) what each firing met, in the order fired."""
    ranges: npt.NDArray[np.uint32]
    """(p, c, n) in the model's unit, 0: no return."""
    intensity: npt.NDArray[np.uint8]
    """(p, c, n)"""
    late_ns: Int64
    """(p,) jitter of the stamps."""

    def firing_gps_ns(self) -> Int64:
        """Return the epoch of each firing (p, c, n)."""
        figures = self.model.figures
        offsets = figures.cycle_ns * np.arange(figures.cycles)[:, None] + self.model.firing_ns
        out: Int64 = self.epoch_gps_ns[:, None, None] + offsets
        return out

    def stamped_gps_ns(self) -> Int64:
        """Return the same (p, c, n) with the jitter of the stamps."""
        return self.firing_gps_ns() + self.late_ns[:, None, None]


class Aim(NamedTuple):
    """Where the lasers of p packets look, by the model's figures."""

    stated: npt.NDArray[np.uint16]
    """(p, c) hundredths of a degree at each cycle's first firing."""
    azimuth_deg: Float64
    """(p, c, n) clockwise."""
    elevation_deg: Float64
    """(n,) or (p, c, n)"""


def starts_gps_ns(drive: Drive) -> int:
    """Return the epoch of a pass's first firing."""
    return drive.start_gps_ns - round(RUN_UP_S / 2 * 1e9)


def measure(scene: Scene, world: World, drive: Drive) -> Iterator[Packets]:
    """Yield packets of a whole pass, in blocks of :data:`BLOCK_PACKETS`."""
    first = starts_gps_ns(drive)
    span = drive.duration_s + RUN_UP_S
    model = lidar_model(scene.lidar.model)
    packet_ns, rays = model.block_ns, model.figures.cycles * model.lasers
    count = GROUP_PACKETS * math.ceil(span * 1e9 / (GROUP_PACKETS * packet_ns))
    start_deg = float(stream(scene.seed, drive.number, "lidar head").integers(0, 36_000)) / 100.0
    key = ray_key(scene, drive, "lidar")
    for block, packet in enumerate(range(0, count, BLOCK_PACKETS)):
        numbers = np.arange(packet, min(packet + BLOCK_PACKETS, count))
        yield _measure_block(scene, world, drive, first + numbers * packet_ns, _aim(scene, start_deg, numbers),
                             key + packet * rays, block)  # fmt: skip


def _measure_block(
    scene: Scene,
    world: World,
    drive: Drive,
    epochs: Int64,
    aim: Aim,
    key: int,
    block: int,
) -> Packets:
    model, errors = lidar_model(scene.lidar.model), errors_of(scene)
    elevation, azimuth = np.radians(aim.elevation_deg), np.radians(aim.azimuth_deg)
    flat = np.cos(elevation)
    up = np.broadcast_to(np.sin(elevation), azimuth.shape)
    direction = np.stack([flat * np.cos(azimuth), -flat * np.sin(azimuth), up], axis=-1)
    if errors.angle_deg > 0.0:
        aside = stream(scene.seed, drive.number, "lidar angles", block).standard_normal(direction.shape)
        direction += math.radians(errors.angle_deg) * aside
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    intervals = model.block_ns // INTERVALS * (np.arange(GROUP_PACKETS * INTERVALS)[:, None] + np.arange(2))
    groups = world.cast(
        drive,
        scene.lidar.mount,
        BODY_FROM_AXES,
        epochs[::GROUP_PACKETS, None, None] + intervals,
        direction.reshape(epochs.size // GROUP_PACKETS, -1, 3),
        _pattern(scene, model),
        key,
    )
    found = groups.of_groups(epochs.size)
    if scene.lidar.false_returns > 0.0:
        _blind(scene, stream(scene.seed, drive.number, "lidar sun", block), found)
    if errors.clutter > 0.0:
        _strew(stream(scene.seed, drive.number, "lidar clutter", block), model, errors, found)
    ranges, intensity = _recorded(scene, drive, block, found)
    late_ns = errors.stamp_ns * stream(scene.seed, drive.number, "lidar stamps", block).standard_normal(epochs.size)
    everywhere = np.broadcast_to(aim.elevation_deg, azimuth.shape)
    return Packets(
        model, epochs, aim.stated, aim.azimuth_deg, everywhere, found, ranges, intensity, late_ns.astype(np.int64)
    )


def errors_of(scene: Scene) -> ModelErrors:
    """Return the lidar's errors: those of the scene's noise, and those of the model where the scene asks for them."""
    noise = scene.noise
    none = ModelErrors(
        range_m=noise.lidar_range_m, angle_deg=0.0, dropout=noise.dropout, clutter=0.0, clutter_m=1.0, stamp_ns=0.0
    )
    if scene.lidar.errors == "noise":
        return none
    stated = lidar_model(scene.lidar.model).figures.errors
    lost = stated.dropout + noise.dropout - stated.dropout * noise.dropout
    return stated.model_copy(update={"range_m": math.hypot(stated.range_m, noise.lidar_range_m), "dropout": lost})


def _strew(rng: np.random.Generator, model: LidarModel, errors: ModelErrors, found: Hits) -> None:
    """Put drops before what the beams met: they are on no object, and nobody knows where."""
    met = rng.random(found.range_m.shape) < errors.clutter
    near = model.figures.range_min_m + rng.exponential(errors.clutter_m, found.range_m.shape)
    met &= ~(found.range_m <= near)
    found.range_m[met], found.enh_m[met], found.object_id[met] = near[met], np.nan, -1
    found.intensity[met], found.is_mixed[met] = _CLUTTER_INTENSITY / REFLECTIVITY, False


def _blind(scene: Scene, rng: np.random.Generator, found: Hits) -> None:
    """Give some firings that met nothing a range anywhere: they are on no object."""
    lost = np.isnan(found.range_m) & (rng.random(found.range_m.shape) < scene.lidar.false_returns)
    found.range_m[lost] = rng.uniform(1.0, scene.lidar.range_max_m, np.count_nonzero(lost))
    found.enh_m[lost], found.object_id[lost], found.part[lost], found.is_mixed[lost] = np.nan, -1, 0, False
    found.intensity[lost] = rng.uniform(3.0, 40.0, np.count_nonzero(lost)) / REFLECTIVITY


def _lost_in_the_dark(scene: Scene, rng: np.random.Generator, exact: Float64, intensity: Float64) -> Bool:
    """Return which firings (p, c, n) are lost because too little light comes back."""
    signal = np.nan_to_num(intensity.reshape(exact.shape)) / 10.0 * ((scene.lidar.dark_m or np.inf) / exact) ** 2
    return np.asarray(rng.random(exact.shape) < np.exp(-signal))


def laser_errors(scene: Scene, lasers: int) -> tuple[Float64, Float64]:
    """Return how far each laser's ranges are off for good (n,; m), and its gain of intensity (n,)."""
    rng = stream(scene.seed, 0, "lasers")
    offset, gain = rng.standard_normal((2, lasers))
    return scene.lidar.laser_range_m * offset, np.exp(scene.lidar.laser_gain * gain)


def beam_width_deg(scene: Scene) -> float:
    """Return the full angle of the lidar's beam (degrees)."""
    stated = scene.lidar.divergence_deg
    return lidar_model(scene.lidar.model).figures.divergence_deg if stated == "data sheet" else stated


def _pattern(scene: Scene, model: LidarModel) -> Pattern:
    """Return the firings of a group of packets."""
    figures, interval_ns = model.figures, model.block_ns // INTERVALS
    cycles = GROUP_PACKETS * figures.cycles
    origin = np.zeros((cycles, model.lasers, 3))
    origin[:, :, 2] = model.rise_m
    past_ns = (figures.cycle_ns * np.arange(cycles)[:, None] + model.firing_ns).ravel()
    wide_deg = beam_width_deg(scene)
    return Pattern(
        origin.reshape(-1, 3),
        past_ns // interval_ns,
        past_ns % interval_ns / interval_ns,
        wide_deg,
        (figures.range_min_m, scene.lidar.range_max_m),
        None if figures.rosette is not None else _beside(model, cycles),
        (steps_within(wide_deg, _degrees_a_cycle(scene, model)), steps_within(wide_deg, model.spacing_deg)),
    )


def _degrees_a_cycle(scene: Scene, model: LidarModel) -> float:
    """Return the rotation of the head in a cycle."""
    return scene.lidar.turns_per_s * 360.0 * model.figures.cycle_ns * 1e-9


def _beside(model: LidarModel, cycles: int) -> Int64:
    """Return neighbours (n · cycles, 4) of firings: the laser a cycle later and earlier, those above and below."""
    lasers = model.lasers
    number = np.full((cycles + 2, lasers + 2), -1)
    order = np.argsort(model.elevation_deg)
    number[1:-1, 1:-1] = np.arange(cycles * lasers).reshape(cycles, lasers)[:, order]
    sides = np.stack([number[2:, 1:-1], number[:-2, 1:-1], number[1:-1, 2:], number[1:-1, :-2]], axis=-1)
    beside = np.empty_like(sides)
    beside[:, order] = sides
    return beside.reshape(-1, 4)


def _aim(scene: Scene, start_deg: float, numbers: Int64) -> Aim:
    """Return where the lasers of packets look, by their numbers (p,)."""
    model = lidar_model(scene.lidar.model)
    figures = model.figures
    per_cycle = scene.lidar.turns_per_s * 36_000.0 * figures.cycle_ns * 1e-9
    cycle = numbers[:, None] * figures.cycles + np.arange(figures.cycles)
    share = model.firing_ns / figures.cycle_ns
    if figures.rosette is not None:
        fired_s = 1e-9 * (figures.cycle_ns * cycle[:, :, None] + model.firing_ns).astype(np.float64)
        azimuth_deg, elevation_deg = figures.rosette.aimed(fired_s, start_deg, model.elevation_deg)
        return Aim(np.zeros(cycle.shape, np.uint16), np.mod(azimuth_deg, 360.0), elevation_deg)
    if figures.columns is not None and not scene.bag.on:  # columns begin at their angles, packets with whole ones
        per_cycle = 36_000.0 / figures.columns
        start_deg = PACKET_COLUMNS * 360.0 / figures.columns * (int(start_deg) % (figures.columns // PACKET_COLUMNS))
    elif scene.lidar.on_azimuth_grid:
        per_cycle = float(round(per_cycle))
        start_deg = round(start_deg * 100.0) / 100.0
    begins = start_deg * 100.0 + per_cycle * cycle
    hundredths = begins[:, :, None] + per_cycle * share + 100.0 * model.azimuth_deg
    stated = np.mod(np.rint(begins).astype(np.int64), 36_000).astype(np.uint16)
    return Aim(stated, np.mod(hundredths, 36_000.0) / 100.0, model.elevation_deg)


def _recorded(
    scene: Scene, drive: Drive, block: int, found: Hits
) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint8]]:
    """Return ranges and intensities (p, c, n) with noise, as integers."""
    model = lidar_model(scene.lidar.model)
    rng = stream(scene.seed, drive.number, "lidar", block)
    wrong = errors_of(scene)
    exact = found.range_m.reshape(-1, model.figures.cycles, model.lasers)
    seen = np.isfinite(exact)
    if wrong.dropout > 0.0:
        seen &= rng.random(seen.shape, dtype=np.float32) >= wrong.dropout
    if scene.lidar.dark_m is not None:
        dark = stream(scene.seed, drive.number, "lidar dark", block)
        seen &= ~_lost_in_the_dark(scene, dark, exact, found.intensity)
    if scene.lidar.laser_range_m > 0.0:
        exact = exact + laser_errors(scene, model.lasers)[0]
    errors = rng.standard_normal((2, np.count_nonzero(seen)), dtype=np.float32)
    ranges, intensity = np.zeros(seen.shape, np.uint32), np.zeros(seen.shape, np.uint8)
    units = np.rint((exact[seen] + wrong.range_m * errors[0]) / model.figures.range_step_m)
    ranges[seen] = np.maximum(units, 1)
    value = REFLECTIVITY * (found.intensity.reshape(seen.shape)[seen] + scene.noise.intensity * errors[1])
    if scene.lidar.laser_gain > 0.0:
        value *= np.broadcast_to(laser_errors(scene, model.lasers)[1], seen.shape)[seen]
    intensity[seen] = np.clip(np.rint(value), 1, 100 if scene.lidar.laser_gain == 0.0 else 255)
    return ranges, intensity


HITS_SCHEMA: Final = pa.schema(
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


def hits_of(block: Packets) -> pa.RecordBatch:
    """Return the origins of a block's returns, one row for each recorded return."""
    seen = block.ranges > 0
    flat = seen.reshape(len(seen), -1)
    laser = np.broadcast_to(np.arange(block.model.lasers, dtype=np.uint8), seen.shape)
    found = block.found
    columns = [block.firing_gps_ns()[seen], laser[seen], block.azimuth_deg[seen], found.range_m[flat]]
    columns += [*found.enh_m[flat].T, found.object_id[flat], found.is_mixed[flat]]
    return pa.RecordBatch.from_arrays([pa.array(np.ascontiguousarray(c)) for c in columns], schema=HITS_SCHEMA)
