"""Returns of squares and their halos: read by row group, georeferenced with corrected poses, in canonical order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.assets.bins import distinct_steps, in_bins
from roadscan.assets.kernels.buckets import rows_within, sort_groups
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Returns, Scene, Statistics
from roadscan.assets.settings import GroundSettings
from roadscan.assets.tiling import AssetGrid
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.grid import QUANTA_PER_M, QUANTUM_M, TileId
from roadscan.core.rig import UNMOUNTED, Mountings, ScanGeometry
from roadscan.georeference.place import EIGHT_TO_SIXTEEN_BITS, Located, Window, passes_of
from roadscan.georeference.plan.road import CentreLineBuffer, load_buffer
from roadscan.georeference.sensor_places import sensor_places
from roadscan.georeference.sources import READING_COLUMNS, Georeferencer, RawSlice, ReadingSource, geometry_of
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_trajectory
from roadscan.poses.trajectory import Trajectory
from roadscan.tiles.tasks.tile_plan import TileTask

_DRIVE_TICK_NS: Final = 50_000_000  # Interval of the places of a drive (ns).
_DRIVE_STEP_M: Final = 0.25
"""A place of a drive is kept if it lies in another square of this edge (m) than the one before."""


@dataclass(frozen=True)
class ReturnsTask:
    """Sources of the returns of some squares. Sent to workers: it carries no data."""

    grid: AssetGrid
    squares: tuple[TileId, ...]
    readings: TileTask
    """Row groups that may touch them."""
    sensors: tuple[str, ...]
    """All sensors in whose returns the survey seeks assets, by name."""
    divergence_deg: tuple[float, ...]
    """Full angle of the beam of each, NaN where it is not known (degrees)."""
    ways: tuple[tuple[str, TrajectorySource], ...]
    """Trajectories of runs whose clouds are used, by run."""
    leading: tuple[ReadingSource, ...]
    """Of each run the sensor whose places are its drive, also while others alone record: so the drive is that of one
    place on the vehicle, and no sensor's gap interrupts or moves it."""


@dataclass(frozen=True, eq=False)
class LoadedSquare:
    """What was seen in a square, or in some together, and in their halos."""

    squares: tuple[TileId, ...]
    returns: Returns
    """Those of the window of the ground."""
    drive_xyh_m: Float64
    """(p, 4) drives through the window of its classes, as :class:`roadscan.assets.scene.Scene` has them."""


def load_squares(task: ReturnsTask, together: Sequence[tuple[TileId, ...]] = ()) -> Iterator[LoadedSquare]:
    """Yields returns of squares together, or of each square in the order of the task; ones without any with none."""
    block = _Block(task)
    for squares in together or [(square,) for square in task.squares]:
        yield block.squares(squares)


def scene_of(grid: AssetGrid, loaded: LoadedSquare, ground: GroundSettings, statistics: Statistics) -> Scene:
    """Returns the scene of a square, or of squares together."""
    squares, drive = loaded.squares, loaded.drive_xyh_m
    own, window, around = (
        grid.own_box(*squares),
        grid.scene_box(*squares),
        (grid.classes_box(*squares), grid.ground_box(*squares)),
    )
    return make_scene(loaded.returns, own, window, drive, ground, around, statistics)


class _Columns(NamedTuple):
    """Returns (n,) of a block of squares; x, y from the block's corner and height in quanta."""

    source: npt.NDArray[np.uint16]
    epoch_gps_ns: Int64
    laser: npt.NDArray[np.uint16]
    x: npt.NDArray[np.int32]
    y: npt.NDArray[np.int32]
    height: npt.NDArray[np.int32]
    intensity: npt.NDArray[np.uint16]
    pass_id: npt.NDArray[np.uint16]
    return_number: npt.NDArray[np.uint8]
    number_of_returns: npt.NDArray[np.uint8]

    def at(self, rows: Any) -> _Columns:
        """Returns a subset; columns without values stay so."""
        return _Columns._make(column[rows] if column.size else column for column in self)


class _Block:
    """Returns of some neighbouring squares, georeferenced at once."""

    def __init__(self, task: ReturnsTask) -> None:
        self._task, readings = task, task.readings
        self._store, self._ground = readings.store, readings.ground
        self._centre: CentreLineBuffer | None = None
        if readings.centre_lines is not None:
            self._centre = load_buffer(readings.centre_lines, self._ground.map)
        self._placer = Georeferencer(self._store, self._ground, readings.slices)
        self._sources = _numbered([one.source for one in readings.slices])
        box = readings.block.box() if readings.block.tiles else (0, 0, 1, 1)
        self._corner, self._window = (box[0], box[1]), Window(*box)
        parts = [part for one in readings.slices for part in self._parts(one)]
        self._columns = in_order(_joined(parts))
        self._trajectories = [self._trajectory(source) for source in self._sources]

    def squares(self, squares: tuple[TileId, ...]) -> LoadedSquare:
        """Returns the returns of squares and their halos, and the drives through them."""
        grid, size = self._task.grid, self._ground.grid.size_quanta
        corner = grid.origin_m(squares[0])
        west, south = (round(at * QUANTA_PER_M) - first * size for at, first in zip(corner, self._corner, strict=True))
        c = self._columns
        ends = np.array([west, south, west, south]) + np.round(np.array(grid.ground_box(*squares)) * QUANTA_PER_M)
        rows = np.empty(c.x.size, np.int64)
        rows = rows[: rows_within(c.x, c.y, ends.astype(np.int64), rows)]
        x, y = _metres(c.x[rows] - np.int32(west)), _metres(c.y[rows] - np.int32(south))
        if self._centre is not None:
            w = grid.window(*squares)
            box = (w.easting_min_m, w.northing_min_m, w.easting_max_m, w.northing_max_m)
            near = self._centre.keeps(corner[0] + x, corner[1] + y, box)
            rows, x, y = rows[near], x[near], y[near]
        height, nothing = _metres(c.height[rows]), np.zeros(0, np.int32)
        own = c._replace(x=nothing, y=nothing, height=nothing).at(rows)
        places = self._sensor_places(own)
        returns = Returns(
            corner_m=corner,
            x_m=x,
            y_m=y,
            height_m=height,
            intensity=own.intensity.astype(np.float32),
            epoch_gps_ns=own.epoch_gps_ns,
            pass_id=own.pass_id,
            sensor=self._sensor_of_source[own.source],
            laser=own.laser,
            return_number=own.return_number,
            number_of_returns=own.number_of_returns,
            sensor_x_m=places[:, 0] - corner[0],
            sensor_y_m=places[:, 1] - corner[1],
            sensor_height_m=np.ascontiguousarray(places[:, 2]),
            sensors=self._task.sensors,
            divergence_deg=self._task.divergence_deg,
        )
        return LoadedSquare(squares, returns, self._drives(own, squares))

    @property
    def _sensor_of_source(self) -> npt.NDArray[np.uint8]:
        return np.array([self._task.sensors.index(s.sensor) for s in self._sources], np.uint8)

    def _parts(self, one: RawSlice) -> Iterator[_Columns]:
        """Yields returns of a slice, chunk by chunk."""
        number = self._sources.index(one.source)
        passes = [p for p in self._task.readings.passes if p.run == one.source.run]
        found = self._of_cloud(one) if one.source.table == "cloud" else self._of_sensor(one)
        for part in found:
            ids = passes_of(part.epoch_gps_ns, passes)
            part = part._replace(pass_id=ids, source=np.full(ids.size, number, np.uint16))  # noqa: PLW2901
            yield part if (ids > 0).all() else part.at(ids > 0)

    def _of_sensor(self, one: RawSlice) -> Iterator[_Columns]:
        geometry = geometry_of(one.source)
        for batch, found in self._placer.located(one, self._window, READING_COLUMNS[one.source.table]):
            if found.row.size:
                epochs, intensity, laser = _recorded(batch, geometry, found)
                single = np.ones(found.row.size, np.uint8)
                yield self._placed(found.tiles, found.quanta, epochs, intensity, laser, (single, single))

    def _of_cloud(self, one: RawSlice) -> Iterator[_Columns]:
        for _, found in self._placer.place(one, self._window):
            size = found.epoch_gps_ns.size
            if size:
                numbers = tuple(
                    found.extra.get(name, np.ones(size, np.uint8)) for name in ("return_number", "number_of_returns")
                )
                laser = np.zeros(size, np.uint16)
                yield self._placed(found.tiles, found.quanta, found.epoch_gps_ns, found.intensity, laser, numbers)

    def _placed(
        self,
        tiles: npt.NDArray[np.int32],
        quanta: npt.NDArray[np.int32],
        epochs: Int64,
        intensity: npt.NDArray[np.uint16],
        laser: npt.NDArray[np.uint16],
        numbers: Sequence[npt.NDArray[Any]],
    ) -> _Columns:
        """Returns columns of georeferenced readings; pass and source are filled in later."""
        size = self._ground.grid.size_quanta
        x, y = ((tiles[:, k] - self._corner[k]) * np.int32(size) + quanta[:, k] for k in range(2))
        unset = np.zeros(0, np.uint16)
        return _Columns(
            unset, epochs, laser, x, y, np.ascontiguousarray(quanta[:, 2]), intensity, unset,
            numbers[0].astype(np.uint8), numbers[1].astype(np.uint8),
        )  # fmt: skip

    def _trajectory(self, source: ReadingSource) -> Trajectory | None:
        """Returns the poses of a source's sensor; None where they are not known."""
        known = self._placer.trajectory(source)
        way = dict(self._task.ways).get(source.run)
        if known is not None or way is None:
            return known
        spans = [span for one in self._task.readings.slices if one.source == source for span in one.spans]
        return load_trajectory(self._store, way, spans, self._ground.max_gap_s)

    def _sensor_places(self, own: _Columns) -> Float64:
        """Returns easting, northing, height (n, 3) of the sensor; NaN where they are not known."""
        parts = [self._places(k, own.epoch_gps_ns[rows]) for k, rows in _by_source(own.source, len(self._sources))]
        return parts[0] if len(parts) == 1 else np.concatenate([np.zeros((0, 3)), *parts])

    def _places(self, number: int, epochs_gps_ns: Int64) -> Float64:
        return self._places_of(self._sources[number], self._trajectories[number], epochs_gps_ns)

    def _places_of(self, source: ReadingSource, trajectory: Trajectory | None, epochs_gps_ns: Int64) -> Float64:
        """Returns easting, northing, height (n, 3) of a source's sensor on a trajectory of its run."""
        if trajectory is None or trajectory.epochs_gps_ns.size < 2:
            return np.full((epochs_gps_ns.size, 3), np.nan)
        mountings = Mountings.one(UNMOUNTED) if source.table == "cloud" else source.adjusted_mountings
        return sensor_places(trajectory, self._ground.map, mountings, epochs_gps_ns)

    def _drives(self, own: _Columns, squares: tuple[TileId, ...]) -> Float64:
        """Places (p, 4) of each run's leading sensor within the window while any looked there, and the pass."""
        grid, leading = self._task.grid, {one.run: one for one in self._task.leading}
        found = [np.zeros((0, 5))]
        for number, rows in _by_source(own.source, len(self._sources)):
            ids, epochs = own.pass_id[rows], own.epoch_gps_ns[rows]
            held = [int(ids[0])] if ids.min() == ids.max() else np.flatnonzero(np.bincount(ids)).tolist()
            for one in held:
                tick = distinct_steps(epochs if len(held) == 1 else epochs[ids == one], _DRIVE_TICK_NS)
                middle, source = tick * _DRIVE_TICK_NS + _DRIVE_TICK_NS // 2, leading[self._sources[number].run]
                places = self._places_of(source, self._trajectories[number], middle)
                places[:, :2] -= grid.origin_m(squares[0])
                inside = grid.classes_box(*squares).holds(places[:, 0], places[:, 1])
                found.append(np.column_stack([places, np.full(tick.size, float(one)), tick])[inside])
        drives = np.concatenate(found)
        drives = drives[np.unique(drives[:, 3:], axis=0, return_index=True)[1], :4]  # sensors share ticks
        ends = np.flatnonzero(np.diff(drives[:, 3])) + 1
        return np.concatenate([thinned(part) for part in np.split(drives, ends)])


def _metres(quanta: npt.NDArray[np.integer[Any]]) -> Float64:
    return np.asarray(quanta * QUANTUM_M, np.float64)


def _numbered(sources: Sequence[ReadingSource]) -> list[ReadingSource]:
    """Returns each source once, in an order that does not depend on the other sources."""
    held = {one.key: one for one in sources}
    return sorted(held.values(), key=lambda s: (s.run, s.sensor, s.table, s.key))


def _recorded(
    batch: pa.RecordBatch, geometry: ScanGeometry | None, found: Located
) -> tuple[Int64, npt.NDArray[np.uint16], npt.NDArray[np.uint16]]:
    """Returns epoch, intensity and laser (n,) of georeferenced readings."""
    epochs = batch.column("epoch_gps_ns").to_numpy()
    if geometry is None:
        intensity, laser = (batch.column(name).to_numpy()[found.row] for name in ("intensity", "laser"))
        return epochs[found.row], intensity.astype(np.uint16), laser.astype(np.uint16)
    own = geometry.reading_epochs(epochs[found.row], found.reading)
    laser = np.zeros(found.row.size, np.uint16)
    recorded = batch.column("intensity")
    if recorded.null_count:
        return own, np.zeros(found.row.size, np.uint16), laser
    digital = recorded.flatten().to_numpy(zero_copy_only=False).reshape(batch.num_rows, geometry.readings)
    scaled = digital[found.row, found.reading].astype(np.uint16) * np.uint16(EIGHT_TO_SIXTEEN_BITS)
    return own, scaled, laser


def _joined(parts: list[_Columns]) -> _Columns:
    """Returns all parts as one; it empties them."""
    kinds = (np.uint16, np.int64, np.uint16, np.int32, np.int32, np.int32, np.uint16, np.uint16, np.uint8, np.uint8)
    if not parts:
        return _Columns._make(np.zeros(0, kind) for kind in kinds)
    joined = _Columns._make(np.concatenate(column) for column in zip(*parts, strict=True))
    parts.clear()
    return joined


def in_order(c: _Columns) -> _Columns:
    """Returns the returns by source, epoch and laser; where these repeat, by their places and intensities.

    Logs are sorted so, but for repeats, so usually little is moved.
    """
    if _falls(c).any():
        c = c.at(_by_laser(c))
    same = (c.source[1:] == c.source[:-1]) & (c.epoch_gps_ns[1:] == c.epoch_gps_ns[:-1]) & (c.laser[1:] == c.laser[:-1])
    if not same.any():
        return c
    tied = np.zeros(c.x.size, bool)
    tied[1:] |= same
    tied[:-1] |= same
    rows = np.flatnonzero(tied)
    group = np.append(0, np.cumsum(~same))[rows]
    t = c.at(rows)
    order = _by_place(t, group)
    if (order == np.arange(order.size)).all():
        return c
    moved = np.arange(c.x.size)
    moved[rows] = rows[order]
    return c.at(moved)


def _by_laser(c: _Columns) -> Int64:
    """Returns the order (n,) by source, epoch and laser: that of the runs of one epoch first, which are few."""
    new = np.append(True, (np.diff(c.source) != 0) | (np.diff(c.epoch_gps_ns) != 0))
    first, lasers = np.flatnonzero(new), int(c.laser.max()) + 1
    if first.size * lasers > c.x.size:
        return np.lexsort((c.laser, c.epoch_gps_ns, c.source))
    source, epoch = c.source[first], c.epoch_gps_ns[first]
    order = np.lexsort((epoch, source))
    other = np.append(False, (np.diff(source[order]) != 0) | (np.diff(epoch[order]) != 0))
    rank = np.empty(first.size, np.int64)
    rank[order] = np.cumsum(other)
    bins = np.repeat(rank, np.diff(np.append(first, c.x.size))) * lasers + c.laser
    return in_bins(bins, (int(rank.max()) + 1) * lasers)[1]


def _by_place(t: _Columns, group: Int64) -> Int64:
    """Returns the order (n,) of returns by group, which does not fall, place, intensity and number."""
    order = np.arange(group.size)
    place = ((t.x.astype(np.int64) << 32) + t.y) if group.size else group
    sort_groups(place, np.flatnonzero(np.append(np.append(True, np.diff(group) != 0), True)), order)
    same = (np.diff(group[order]) == 0) & (np.diff(place[order]) == 0)
    if not same.any():
        return order
    tied = np.append(same, False) | np.append(False, same)
    rows = order[tied]
    again = np.lexsort((
        t.number_of_returns[rows], t.return_number[rows], t.intensity[rows], t.height[rows], place[rows], group[rows],
    ))  # fmt: skip
    order[tied] = rows[again]
    return order


def _falls(c: _Columns) -> Bool:
    source = np.diff(c.source.astype(np.int32))
    epoch, laser = np.diff(c.epoch_gps_ns), np.diff(c.laser.astype(np.int32))
    falls: Bool = (source < 0) | ((source == 0) & ((epoch < 0) | ((epoch == 0) & (laser < 0))))
    return falls


def _by_source(source: npt.NDArray[np.uint16], count: int) -> Iterator[tuple[int, slice]]:
    """Yields the rows of each source, which are ascending."""
    ends = np.searchsorted(source, np.arange(count + 1, dtype=source.dtype))
    for number in range(count):
        if ends[number] < ends[number + 1]:
            yield number, slice(int(ends[number]), int(ends[number + 1]))


def thinned(places_m: Float64) -> Float64:
    """Returns places (k, …) of a drive, x and y first, without those where it has hardly moved."""
    cell = np.floor(places_m[:, :2] / _DRIVE_STEP_M)
    moved = np.ones(len(places_m), bool)
    moved[1:] = (np.diff(cell, axis=0) != 0).any(axis=1)
    return places_m[moved]
