"""Simulates the triangulation pair: profiles of the road as ``scans`` Parquet, one file per head and run."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.special import ndtri

from roadscan.compute.array_types import Float64, Int32, Int64
from roadscan.core.gpstime import TimeSystem
from roadscan.simulate.caster import SLOT_NS
from roadscan.simulate.drive import Drive
from roadscan.simulate.kernels import profiles as kernels
from roadscan.simulate.kernels.road import STATION
from roadscan.simulate.kernels.things import (
    BODY_COLUMNS,
    BOX,
    EASTING,
    HALF_LENGTH,
    HALF_WIDTH,
    HIGH,
    HIGH_END,
    KIND,
    LOW,
    LOW_END,
    NORTHING,
)
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import Mount, Profilers, Scene
from roadscan.simulate.scene.roadside import MovingCar
from roadscan.simulate.sensors.clock import SensorClock, WheelEncoder
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import Object, mover_bodies, moving_objects

BLOCK_PROFILES: Final = 512
"""Profiles measured together, and rows of a Parquet row group."""
BESIDE_M: Final = 4.0
"""Things farther from the middle of a head's profiles cannot be met (m)."""
_OUT_OF_REACH_M: Final = 1e9  # easting of bodies that cannot be met
_SPOT_PARTS: Final = (-0.4, -0.2, 0.0, 0.2, 0.4)
"""Places of the parts of a beam's spot, as shares of its width."""
_BENT_M: Final = 1e-7
"""Planes with a larger error in road coordinates are followed in the map (m), which takes longer."""
_REACH_M: Final = 0.3
"""Range around the middle range within which the planes are fitted (m)."""
GEOMETRY_KEY: Final = "roadscan.scan_geometry"
BODY_FROM_AXES: Final = np.eye(3)
"""Axes frd: y to the right, z down along the range."""


@dataclass(frozen=True)
class Head:
    """One profiler head on one drive."""

    name: str
    mount: Mount
    settings: Profilers

    @property
    def y_sensor_m(self) -> Float64:
        """Return the transverse position of the readings (n,)."""
        first, step = self.first_step_m
        return np.asarray(first + step * np.arange(self.settings.readings, dtype=np.float64))

    @property
    def first_step_m(self) -> tuple[float, float]:
        """Return the transverse position of the first reading and the step from reading to reading (m)."""
        return -self.settings.width_m / 2, self.settings.width_m / (self.settings.readings - 1)

    def geometry(self) -> dict[str, object]:
        """Return the geometry of the readings in the sensor's frame, for the log's metadata."""
        first, step = self.first_step_m
        return {
            "kind": "cartesian",
            "readings": self.settings.readings,
            "first": first,
            "step": step,
            "range_offset_m": self.settings.range_offset_m,
            "range_step_m": self.settings.range_step_m,
            "reading_period_ns": 0.0,
        }


@dataclass(frozen=True)
class Profiles:
    """A block of measured profiles."""

    epoch_gps_ns: Int64
    encoder_ticks: Int64
    ranges: npt.NDArray[np.uint16]
    """(p, n)"""
    intensity: npt.NDArray[np.uint8]
    """(p, n)"""
    hits: Float64
    """(p, n, 4) easting, northing, height in the map, and exact range (m); (0, 0, 0) if not requested."""
    object_id: Int32
    """(p, n) 0: the road, −1: nothing; (0, 0) if not requested."""


def heads(settings: Profilers) -> list[Head]:
    """Return the heads of the rig; none where they are switched off."""
    if not settings.on:
        return []
    return [Head("profiler_left", settings.left, settings), Head("profiler_right", settings.right, settings)]


def write_profiles(
    scene: Scene,
    surface: Surface,
    drive: Drive,
    head: Head,
    clock: SensorClock,
    file: Path,
    hits_file: Path | None,
    things: Sequence[Object] = (),
) -> Iterator[int]:
    """Write the profiles of one head, one row group per step; yields the readings of each.

    things : what stands on or beside the road, and may stand in the beams' way.
    """
    readings = head.settings.readings
    stamp = "epoch_gps_ns" if clock.error.is_right and clock.system is TimeSystem.GPS else "time"
    schema = _scans_schema(head, stamp)
    hits_schema = _hits_schema(readings)
    hits_writer = pq.ParquetWriter(hits_file, hits_schema, use_dictionary=False) if hits_file else None
    with pq.ParquetWriter(
        file,
        schema,
        compression="NONE",
        use_dictionary=False,
        column_encoding={
            stamp: "DELTA_BINARY_PACKED",
            "range.list.element": "DELTA_BINARY_PACKED",
            "intensity.list.element": "DELTA_BINARY_PACKED",
            "encoder_ticks": "DELTA_BINARY_PACKED",
        },
        write_statistics=[stamp, "encoder_ticks"],
    ) as writer:
        for block in measure(scene, surface, drive, head, things, with_hits=hits_file is not None):
            columns = [
                pa.array(clock.stamps_ns(block.epoch_gps_ns)),
                _lists(block.ranges, schema.field("range").type),
                _lists(block.intensity, schema.field("intensity").type),
                pa.array(block.encoder_ticks),
            ]
            writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema), row_group_size=BLOCK_PROFILES)
            if hits_writer is not None:
                kind = hits_schema.field("easting_m").type
                places = [_lists(np.ascontiguousarray(block.hits[:, :, i]), kind) for i in range(4)]
                hits_writer.write_batch(
                    pa.RecordBatch.from_arrays(
                        [pa.array(block.epoch_gps_ns), *places, _lists(block.object_id, hits_schema.field(5).type)],
                        schema=hits_schema,
                    )
                )
            yield block.ranges.size
    if hits_writer is not None:
        hits_writer.close()


def measure(
    scene: Scene,
    surface: Surface,
    drive: Drive,
    head: Head,
    things: Sequence[Object] = (),
    *,
    with_hits: bool = False,
) -> Iterator[Profiles]:
    """Yield profiles of a whole pass, one each `spacing_m` driven, in blocks of :data:`BLOCK_PROFILES`."""
    spacing = head.settings.spacing_m
    count = math.floor(drive.length_m / spacing + 1e-9) + 1
    encoder, movers = WheelEncoder(scene, drive), _Movers.of(scene, surface, drive)
    measured = _Pass(scene, surface, drive, head, encoder, _Near.of(things), movers)
    for first in range(0, count, BLOCK_PROFILES):
        driven = np.asarray(spacing * np.arange(first, min(first + BLOCK_PROFILES, count), dtype=np.float64))
        yield measured.block(driven, first, with_hits=with_hits)


@dataclass(frozen=True)
class _Pass:
    """One pass of one head along the road."""

    scene: Scene
    surface: Surface
    drive: Drive
    head: Head
    encoder: WheelEncoder
    near: _Near
    movers: _Movers

    def block(self, driven_m: Float64, first: int, *, with_hits: bool) -> Profiles:
        """Return profiles (p,) at distances driven; first : number of the first one."""
        head, drive, surface = self.head, self.drive, self.surface
        epochs = drive.epoch_gps_ns(driven_m)
        origins, rotations = drive.poses(epochs).sensor(head.mount, BODY_FROM_AXES)
        y = head.y_sensor_m
        middle = self.scene.vehicle.imu_height_m - head.mount.lever_arm_body_m[2]
        planes = _planes(surface, drive, origins, rotations, float(y[-1]), middle)
        path = planes.in_map[:, :2, 0]
        standing, owners = self.near.within(path)
        moving, movers_owners = self.movers.at(epochs, path)
        owners = np.concatenate([owners, movers_owners])
        obstacles = kernels.Bodies(np.concatenate([standing, np.zeros(moving.shape[1:])]), moving)
        shape, wanted = (epochs.size, y.size), (epochs.size, y.size) if with_hits else (0, 0)
        ranges, intensity = np.empty(shape, np.uint16), np.empty(shape, np.uint8)
        out = kernels.Measured(ranges, intensity, np.empty(wanted), np.empty(wanted, np.int32))
        kernels.scan_profiles(surface.arrays, planes, obstacles, self._head(first), np.empty((3, 3)), out)
        hits = _hits(drive, origins, rotations, y, out.true_range_m) if with_hits else np.empty((0, 0, 0))
        object_id = _object_ids(out.body_hit, owners, out.true_range_m)
        return Profiles(epochs, self.encoder.ticks(epochs), ranges, intensity, hits, object_id)

    def _head(self, first: int) -> kernels.Head:
        settings, noise, y = self.head.settings, self.scene.noise, self.head.y_sensor_m
        errors = noise.dropout, noise.profiler_range_m, noise.intensity, noise.impulse
        return kernels.Head(
            y_sensor_m=y,
            range_offset_m=float(settings.range_offset_m),
            range_step_m=float(settings.range_step_m),
            lost_share=float(noise.dropout),
            range_noise_m=float(noise.profiler_range_m),
            intensity_noise=float(noise.intensity),
            wrong_share=float(noise.impulse),
            wrong_within_m=float(noise.impulse_m),
            normal=_normal_numbers() if any(errors) else np.zeros(0, np.float32),
            random_from=np.uint64(_random_from(self.scene, self.drive, self.head) + first * y.size),
            spot=_spot(settings),
            camera=math.tan(math.radians(settings.camera_deg)),
        )


@dataclass(frozen=True)
class _Near:
    """Bodies of all things, for selection by distance."""

    bodies: Float64
    """(b, 18)"""
    object_id: Int32
    """(b,)"""

    @classmethod
    def of(cls, things: Sequence[Object]) -> Self:
        """Return all bodies of the standing things."""
        rows = [np.zeros((0, BODY_COLUMNS)), *(thing.bodies for thing in things)]
        owners = [np.zeros(0, np.int32), *(np.full(len(thing.bodies), thing.id, np.int32) for thing in things)]
        return cls(np.concatenate(rows), np.concatenate(owners))

    def within(self, path_m: Float64) -> tuple[Float64, Int32]:
        """Return bodies (m, 18) that profiles through map points (p, 2) can meet, and their objects (m,)."""
        if not self.bodies.size:
            return self.bodies, self.object_id
        low, high = path_m.min(axis=0) - BESIDE_M, path_m.max(axis=0) + BESIDE_M
        middle = self.bodies[:, [EASTING, NORTHING]]
        reach = np.hypot(self.bodies[:, HALF_LENGTH], self.bodies[:, HALF_WIDTH])[:, None]
        chosen = np.all((middle + reach >= low) & (middle - reach <= high), axis=1)
        return np.ascontiguousarray(self.bodies[chosen]), self.object_id[chosen]


@dataclass(frozen=True)
class _Movers:
    """Moving cars of a pass, and their bodies at an epoch."""

    surface: Surface
    start_gps_ns: int
    cars: tuple[tuple[MovingCar, Object], ...]

    @classmethod
    def of(cls, scene: Scene, surface: Surface, drive: Drive) -> Self:
        """Return the cars of this pass."""
        cars = zip(scene.roadside.moving_cars, moving_objects(scene, surface), strict=True)
        driving = ((car, known) for car, known in cars if not car.passes or drive.number + 1 in car.passes)
        return cls(surface, drive.start_gps_ns, tuple(driving))

    def at(self, epoch_gps_ns: Int64, path_m: Float64) -> tuple[Float64, Int32]:
        """Return car bodies (p, m, 18) that profiles (p,) through map points (p, 2) can meet, and their objects (m,).

        Cars move evenly within slots of time, as for all other rays, so blocks of profiles change nothing.
        """
        rows, owners = [np.zeros((epoch_gps_ns.size, 0, BODY_COLUMNS))], [np.zeros(0, np.int32)]
        for car, known in self.cars:
            near = self._near(car, epoch_gps_ns, path_m)
            if near.any():
                rows.append(self._moved(car, len(known.bodies), epoch_gps_ns, near))
                owners.append(np.full(len(known.bodies), known.id, np.int32))
        return np.concatenate(rows, axis=1), np.concatenate(owners)

    def _near(self, car: MovingCar, epoch_gps_ns: Int64, path_m: Float64) -> npt.NDArray[np.bool_]:
        """Return whether each profile (p,) can meet a car."""
        nodes = self.surface.arrays.nodes
        station = car.station_m + car.speed_m_per_s * (epoch_gps_ns - self.start_gps_ns) * 1e-9
        easting, northing, _ = self.surface.place(np.clip(station, nodes[0, STATION], nodes[-1, STATION]), car.offset_m)
        origin = self.surface.origin_enh_m
        away = np.hypot(easting - origin[0] - path_m[:, 0], northing - origin[1] - path_m[:, 1])
        return np.asarray(away < BESIDE_M + car.length_m + car.width_m)

    def _moved(self, car: MovingCar, count: int, epoch_gps_ns: Int64, near: npt.NDArray[np.bool_]) -> Float64:
        """Return bodies (p, count, 18) of a car at each profile; out of reach where not `near` or not on the road."""
        rows = np.zeros((epoch_gps_ns.size, count, BODY_COLUMNS))
        rows[..., KIND] = BOX
        rows[..., EASTING] = _OUT_OF_REACH_M
        slots = (epoch_gps_ns - self.start_gps_ns) // SLOT_NS
        for slot in np.unique(slots[near]).tolist():
            begin_s = slot * SLOT_NS * 1e-9
            placed = mover_bodies(car, self.surface, begin_s, (slot + 1) * SLOT_NS * 1e-9)
            if placed is None:
                continue
            inside = np.flatnonzero(near & (slots == slot))
            bodies, velocity = placed
            past = (epoch_gps_ns[inside] - self.start_gps_ns - slot * SLOT_NS) * 1e-9
            moved = np.repeat(bodies[None], inside.size, axis=0)
            for columns, speed in zip(((EASTING,), (NORTHING,), (LOW, HIGH, LOW_END, HIGH_END)), velocity, strict=True):
                moved[:, :, columns] += (past * speed)[:, None, None]
            rows[inside] = moved
        return rows


def _object_ids(body_hit: Int32, owners: Int32, range_m: Float64) -> Int32:
    """Return the object of each reading (p, n): 0 the road, −1 nothing."""
    if not body_hit.size:
        return body_hit
    ids = np.append(owners, 0).astype(np.int32)[body_hit]
    ids[np.isnan(range_m)] = -1
    return ids


def _planes(
    surface: Surface, drive: Drive, origins: Float64, rotations: Float64, half_width_m: float, middle_m: float
) -> kernels.Planes:
    """Return planes fitted to 15 exact points of each, around their middle range.

    What the planes in the map leave out is below 10⁻¹¹ m.
    """
    unit_y, unit_r = (a.ravel() for a in np.meshgrid([-1.0, -0.6, 0.0, 0.6, 1.0], [-1.0, 0.0, 1.0], indexing="ij"))
    points = np.stack([np.zeros_like(unit_y), half_width_m * unit_y, middle_m + _REACH_M * unit_r], axis=-1)
    ecef = origins[:, None] + points @ rotations.swapaxes(1, 2)
    in_map = drive.earth.map_from_ecef(ecef.reshape(-1, 3)).reshape(-1, unit_y.size, 3) - surface.origin_enh_m
    easting, northing = np.ascontiguousarray(in_map[:, :, 0]), np.ascontiguousarray(in_map[:, :, 1])
    in_road = np.empty((*easting.shape, 3))
    in_road[:, :, 2] = in_map[:, :, 2]
    middle = unit_y.size // 2
    near = surface.nearest_node(
        easting[:, middle] + surface.origin_enh_m[0], northing[:, middle] + surface.origin_enh_m[1]
    )
    kernels.survey_planes(surface.arrays, easting, northing, near, in_road)

    def fitted(values: Float64, powers: tuple[tuple[int, int], ...]) -> tuple[Float64, Float64]:
        terms = np.stack([unit_y**m * unit_r**n for m, n in powers], axis=-1)
        units = np.array([half_width_m**m * _REACH_M**n for m, n in powers])
        coefficients = np.linalg.pinv(terms) @ values
        left = values - terms @ coefficients
        return np.ascontiguousarray(coefficients.swapaxes(1, 2) / units), np.abs(left).max(axis=(1, 2))

    road, left = fitted(in_road, ((0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (0, 1), (1, 1), (2, 1), (0, 2)))
    exact, _ = fitted(in_map, ((0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (0, 2)))
    return kernels.Planes(road, exact, left > _BENT_M, float(middle_m))


def _hits(drive: Drive, origins: Float64, rotations: Float64, y_sensor_m: Float64, range_m: Float64) -> Float64:
    """Return map coordinates and ranges (p, n, 4) of the points at true ranges (p, n), by the exact projection."""
    sensor = np.zeros((*range_m.shape, 3))
    sensor[:, :, 1] = y_sensor_m
    sensor[:, :, 2] = range_m
    ecef = origins[:, None] + sensor @ rotations.swapaxes(1, 2)
    with np.errstate(invalid="ignore"):  # PROJ returns infinity for NaN
        enh = drive.earth.map_from_ecef(ecef.reshape(-1, 3)).reshape(ecef.shape)
    enh[np.isnan(range_m)] = np.nan
    return np.concatenate([enh, range_m[:, :, None]], axis=-1)


def _spot(settings: Profilers) -> Float64:
    """Return parts of a beam's spot (25, 2), along and across the profile (m); (0, 2) where it has no width."""
    if not settings.spot_along_m and not settings.spot_across_m:
        return np.zeros((0, 2))
    along = (settings.spot_along_m or settings.spot_across_m) * np.array(_SPOT_PARTS)
    across = settings.spot_across_m * np.array(_SPOT_PARTS)
    return np.stack(np.broadcast_arrays(along[:, None], across[None]), axis=-1).reshape(-1, 2)


@functools.cache
def _normal_numbers() -> npt.NDArray[np.float32]:
    """Return standard normal numbers (65536,) of equal probability."""
    numbers: npt.NDArray[np.float32] = ndtri((np.arange(65_536) + 0.5) / 65_536).astype(np.float32)
    return numbers


def _random_from(scene: Scene, drive: Drive, head: Head) -> int:
    """Return the key of the random numbers of a head's first reading in a pass."""
    return int(stream(scene.seed, drive.number, head.name).integers(0, 2**62))


def _scans_schema(head: Head, stamp: str) -> pa.Schema:
    size = head.settings.readings
    return pa.schema(
        [
            pa.field(stamp, pa.int64(), nullable=False),
            pa.field("range", _list_of(pa.uint16(), size), nullable=False),
            pa.field("intensity", _list_of(pa.uint8(), size)),
            pa.field("encoder_ticks", pa.int64()),
        ],
        metadata={GEOMETRY_KEY: json.dumps(head.geometry())},
    )


def _hits_schema(readings: int) -> pa.Schema:
    lists = _list_of(pa.float64(), readings)
    names = ("easting_m", "northing_m", "height_m", "range_m")
    places = [pa.field(name, lists) for name in names]
    return pa.schema([("epoch_gps_ns", pa.int64()), *places, ("object_id", _list_of(pa.int32(), readings))])


def _list_of(kind: pa.DataType, size: int) -> pa.DataType:
    return pa.list_(pa.field("element", kind, nullable=False), size)


def _lists(values: npt.NDArray[np.generic], kind: pa.DataType) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), type=kind)
