"""Counts raw readings into the cells of a task's tiles: each row group is read once, and no point is written.

Tiles are finished one after another, in driving order. For the next tile, the row groups that may touch it and have not
been read yet are counted into all tiles of the task that they touch. So a row group is read once, and memory contains
only the cells of the few tiles that are started and not finished.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int32, Int64
from roadscan.compute.kernel_options import read_only
from roadscan.core.errors import StoreError
from roadscan.core.grid import LanePass, TileId
from roadscan.core.rig import ScanGeometry
from roadscan.georeference.charts import flat_profiles
from roadscan.georeference.kernels.flat_profiles import FlatProfiles
from roadscan.georeference.kernels.readings import Georeference, MirrorProfiles, Returns
from roadscan.georeference.kernels.timed_readings import CHUNK
from roadscan.georeference.place import COUNTED_FATES, EIGHT_TO_SIXTEEN_BITS, Placement, mirror_profiles, pass_numbers
from roadscan.georeference.reading_counts import ReadingCounts
from roadscan.georeference.sources import Georeferencer, RawSlice, geometry_of
from roadscan.store.readings.row_groups import ProfileReader, ReturnsReader
from roadscan.store.schema import table_schema
from roadscan.tiles.accumulator import Accumulator, PoolExhaustedError
from roadscan.tiles.accumulator import Pool as TilePool
from roadscan.tiles.cells import TileCells, TileEvidence
from roadscan.tiles.kernels.accumulate import CountingWork, Pool, accumulate_profiles
from roadscan.tiles.kernels.bucket_statistics import bucket_mirror, bucket_returns
from roadscan.tiles.kernels.row_buckets import ActiveTiles, Buckets, Measured
from roadscan.tiles.tasks.tile_plan import TileTask

_EIGHT_BITS: Final = np.uint32(EIGHT_TO_SIXTEEN_BITS)
_SIXTEEN_BITS: Final = np.uint32(1)  # Factor on intensities that have 16 bits already.


@dataclass(frozen=True)
class Counting:
    """Counts the readings of one source into an accumulator."""

    placement: Placement
    accumulator: Accumulator
    geometry: ScanGeometry | None
    """None for returns."""
    fates: Int64 = field(default_factory=lambda: np.zeros(COUNTED_FATES, np.int64))
    """Readings by outcome (``FATE_NAMES``); readings in inactive tiles count as outside."""

    def profiles(
        self,
        epochs_gps_ns: Int64,
        ranges: npt.NDArray[np.uint16],
        intensity: npt.NDArray[np.uint8] | None,
        passes: Int32,
    ) -> None:
        """Count n profiles.

        Parameters
        ----------
        epochs_gps_ns : (n,) of the first readings; ranges, intensity : (n, m), raw; no intensity counts as 0.
        passes : (n,), or (n · m,) where a mirror measures one reading after another: index into the accumulator's
        passes, −1 for none.
        """
        geometry = self.geometry
        if geometry is None:
            raise ValueError("profiles need a scan geometry")
        bright = np.zeros(ranges.shape, np.uint8) if intensity is None else intensity
        flat = flat_profiles(geometry, self.placement.range_min_m, self.placement.range_max_m)
        if self.placement.road is not None:
            road = self.placement.road.profiles(epochs_gps_ns, ranges, geometry)
            road.tell(self.fates)
            ranges = road.ranges
        for rows, mounting in self.placement.mountings.pieces(epochs_gps_ns):
            georeference = self.placement.georeference(mounting)
            epochs, raw, shine = epochs_gps_ns[rows], ranges[rows], bright[rows]
            if flat is None:
                m = geometry.readings
                own = passes[rows.start * m : rows.stop * m]
                measured = self._measured(geometry.all_epochs(epochs), own, shine.reshape(-1), _EIGHT_BITS)
                self._mirror(mirror_profiles(geometry, epochs, raw), measured, georeference)
            else:
                self._flat(raw, self._measured(epochs, passes[rows], shine, _EIGHT_BITS), flat, georeference)

    def returns(
        self,
        epochs_gps_ns: Int64,
        pose_epochs_gps_ns: Int64,
        xyz_sensor_m: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.float32]],
        intensity: npt.NDArray[np.uint16],
        passes: Int32,
    ) -> None:
        """Count n returns; all arrays are (n,), `passes` as in :meth:`profiles`."""
        for rows, mounting in self.placement.mountings.pieces(pose_epochs_gps_ns):
            returns = Returns(*(read_only(column[rows]) for column in (pose_epochs_gps_ns, *xyz_sensor_m)))
            measured = self._measured(epochs_gps_ns[rows], passes[rows], intensity[rows], _SIXTEEN_BITS)
            self._returns(returns, measured, self.placement.georeference(mounting))

    def _measured(self, epochs: Int64, passes: Int32, intensity: npt.NDArray[Any], gain: np.uint32) -> Measured:
        return Measured(epochs, passes, intensity, gain, self.placement.interval_sigmas_m)

    def _flat(
        self, ranges: npt.NDArray[np.uint16], measured: Measured, flat: FlatProfiles, georeference: Georeference
    ) -> None:
        def count(active: ActiveTiles, pool: Pool, work: CountingWork, first: int) -> int:
            done: int = accumulate_profiles(
                ranges, measured, flat, georeference, active, pool, work, self.fates, first
            )  # fmt: skip
            return done

        self.accumulator.run(count, len(ranges), 2 * ranges.shape[1])

    def _returns(self, returns: Returns, measured: Measured, georeference: Georeference) -> None:
        def fill(active: ActiveTiles, buckets: Buckets, first: int) -> int:
            done: int = bucket_returns(returns, measured, georeference, active, buckets, self.fates, first)
            return done

        self.accumulator.fill(fill, returns.epochs.size, CHUNK)

    def _mirror(self, profiles: MirrorProfiles, measured: Measured, georeference: Georeference) -> None:
        def fill(active: ActiveTiles, buckets: Buckets, first: int) -> int:
            done: int = bucket_mirror(profiles, measured, georeference, active, buckets, self.fates, first)
            return done

        self.accumulator.fill(fill, profiles.epochs.size, max(CHUNK, profiles.ranges.shape[1]))


_RETURNS_AT_ONCE = 1 << 18  # Returns that are read together, at most.
_READINGS_AT_ONCE = 1 << 20  # Readings of profiles that are read together, at most.
_PIECES_AHEAD = 4
"""Number of pieces of 2 to 3 MB that are prefetched; several, because requests wait for a network."""
_KEPT = threading.local()


@dataclass(frozen=True)
class CountedTile:
    """A finished tile, or the reason why there is none."""

    tile: TileId
    cells: TileCells | None
    """Cells of the tile; None where no reading fell into it."""
    evidence: TileEvidence | None
    failure: str = ""


def count_tiles(task: TileTask, fates: ReadingCounts) -> Iterator[CountedTile]:
    """Yield the cells of all tiles of a task that needs no points, in the task's order."""
    yield from _TileWorker(task, fates).tiles(range(len(task.block.tiles)))


class _TileWorker:
    """Computes one task."""

    def __init__(self, task: TileTask, fates: ReadingCounts) -> None:
        self._task, self._fates = task, fates
        self._placer = Georeferencer(task.store, task.ground, task.slices)
        self._sources = [_Source.of(task, number) for number in range(len(task.slices))]
        self._accumulator = Accumulator(task.ground.grid, task.block.tiles, [p.pass_id for p in task.passes], _pool())
        self._counting = [self._counting_of(one) for one in task.slices]
        self._told: set[tuple[int, int]] = set()
        self._owners = {(s, k): tile for s, k, tile in task.owned}

    def tiles(self, numbers: Sequence[int]) -> Iterator[CountedTile]:
        """Yield finished tiles by their numbers in the task; half of them at a time where memory is too small."""
        left = list(numbers)
        try:
            for finished in self._finished(numbers):
                left.pop(0)
                yield finished
        except PoolExhaustedError:
            if len(left) == 1:
                raise
            self._accumulator.drop()
            yield from self.tiles(left[: len(left) // 2])
            yield from self.tiles(left[len(left) // 2 :])

    def _finished(self, numbers: Sequence[int]) -> Iterator[CountedTile]:
        wanted = set(numbers)
        done: set[tuple[int, int]] = set()
        damaged: dict[TileId, str] = {}
        begun: set[TileId] = set()
        touched = self._tiles_by_group(wanted)
        announced = self._announced(numbers)
        for number in numbers:
            tile = self._task.block.tiles[number]
            self._accumulator.activate([tile])
            begun.add(tile)
            for touch in self._task.touches[number]:
                for start, end in _unread(touch.slice_index, touch.first, touch.end, done):
                    for group in range(start, end):
                        near = touched[touch.slice_index, group]
                        self._accumulator.activate([t for t in near if t not in begun])
                        begun.update(near)
                    for first, last in self._sources[touch.slice_index].pieces(start, end):
                        next(announced, None)
                        try:
                            self._count(touch.slice_index, first, last)
                        except StoreError as error:
                            for group in range(first, last):
                                damaged |= dict.fromkeys(touched[touch.slice_index, group], str(error))
            finished = self._accumulator.finish(tile)
            if tile in damaged:
                yield CountedTile(tile, None, None, damaged[tile])
            else:
                yield CountedTile(tile, *(finished or (None, None)))

    def _announced(self, numbers: Sequence[int]) -> Iterator[None]:
        """Yields once per counted piece, after prefetching the next four."""
        done: set[tuple[int, int]] = set()
        pieces = (
            (touch.slice_index, *piece)
            for number in numbers
            for touch in self._task.touches[number]
            for run in _unread(touch.slice_index, touch.first, touch.end, done)
            for piece in self._sources[touch.slice_index].pieces(*run)
        )
        for k, (index, first, last) in enumerate(pieces):
            self._sources[index].expect(self._task.slices[index].groups[first:last])
            if k >= _PIECES_AHEAD:
                yield

    def _tiles_by_group(self, wanted: set[int]) -> dict[tuple[int, int], list[TileId]]:
        """Return the wanted tiles that each group of a slice may touch."""
        found: dict[tuple[int, int], list[TileId]] = defaultdict(list)
        for number in sorted(wanted):
            for touch in self._task.touches[number]:
                for group in range(touch.first, touch.end):
                    found[touch.slice_index, group].append(self._task.block.tiles[number])
        return found

    def _count(self, index: int, first: int, end: int) -> None:
        """Count the row groups `first` to `end` − 1 (positions) of a slice."""
        one, counting = self._task.slices[index], self._counting[index]
        owners = [self._owners.get((index, k)) for k in range(first, end)]
        start = first
        for k in range(first + 1, end + 1):
            if k == end or owners[k - first] != owners[start - first]:
                before = counting.fates.copy()
                self._sources[index].count(counting, self._accumulator, one.groups[start:k])
                owner = owners[start - first]
                if owner is not None and (index, start) not in self._told:
                    self._told.update((index, g) for g in range(start, k))
                    self._fates.add(owner, one.file, counting.fates - before)
                start = k

    def _counting_of(self, one: RawSlice) -> Counting:
        return Counting(self._placer.placement(one.source), self._accumulator, geometry_of(one.source))


def _unread(index: int, first: int, end: int, done: set[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Yield runs of positions from `first` to `end` − 1 that have not been read, and mark them as read."""
    start = first
    while start < end:
        if (index, start) in done:
            start += 1
            continue
        stop = start
        while stop < end and (index, stop) not in done:
            done.add((index, stop))
            stop += 1
        yield start, stop
        start = stop


@dataclass(frozen=True)
class _Source:
    """A data file whose readings are counted."""

    task: TileTask
    slice: RawSlice
    passes: tuple[LanePass, ...]
    """Passes of its run."""
    reader: ProfileReader | ReturnsReader
    at_once: int
    """Number of row groups that are read together."""

    @classmethod
    def of(cls, task: TileTask, number: int) -> _Source:
        one = task.slices[number]
        geometry = geometry_of(one.source)
        rows = table_schema(one.source.table).row_group_rows
        most = _RETURNS_AT_ONCE // rows if geometry is None else _READINGS_AT_ONCE // (rows * geometry.readings)
        reader = (ReturnsReader if geometry is None else ProfileReader)(task.store, one.file)
        return cls(task, one, tuple(p for p in task.passes if p.run == one.source.run), reader, max(1, most))

    def pieces(self, first: int, end: int) -> Iterator[tuple[int, int]]:
        """Yield positions `first` to `end` − 1 in pieces that are read together."""
        for start in range(first, end, self.at_once):
            yield start, min(start + self.at_once, end)

    def expect(self, groups: Sequence[int]) -> None:
        """Prefetch row groups that will be counted soon."""
        self.reader.expect(groups)

    def count(self, counting: Counting, accumulator: Accumulator, groups: Sequence[int]) -> None:
        """Read row groups and count their readings."""
        if isinstance(self.reader, ReturnsReader):
            self._count_returns(self.reader, counting, accumulator, groups)
        else:
            self._count_profiles(self.reader, counting, accumulator, groups)

    def _count_profiles(
        self, reader: ProfileReader, counting: Counting, accumulator: Accumulator, groups: Sequence[int]
    ) -> None:
        rows, clock, geometry = reader.read(groups), self.slice.source.clock, geometry_of(self.slice.source)
        epochs = rows.epoch_gps_ns if clock is None else clock.applied(rows.epoch_gps_ns)
        own = epochs
        if geometry is not None and geometry.reading_period_ns:
            own = geometry.all_epochs(epochs)
        counting.profiles(epochs, rows.range, rows.intensity, self._passes(own, accumulator))

    def _count_returns(
        self, reader: ReturnsReader, counting: Counting, accumulator: Accumulator, groups: Sequence[int]
    ) -> None:
        rows, clock = reader.read(groups), self.slice.source.clock
        epochs, pose_epochs = rows.epoch_gps_ns, rows.pose_epoch_gps_ns
        if clock is not None:
            epochs, pose_epochs = clock.applied(epochs), clock.applied(pose_epochs)
        xyz = rows.x_sensor_m, rows.y_sensor_m, rows.z_sensor_m
        counting.returns(epochs, pose_epochs, xyz, rows.intensity, self._passes(epochs, accumulator))

    def _passes(self, epochs: npt.NDArray[np.int64], accumulator: Accumulator) -> npt.NDArray[np.int32]:
        """Return the index of each epoch's pass among the accumulator's, −1 for none."""
        return pass_numbers(epochs, self.passes, accumulator.passes)


def _pool() -> TilePool:
    """Return the worker's memory for cells, which serves one task after another: fresh memory is slow."""
    pool: TilePool | None = getattr(_KEPT, "pool", None)
    if pool is None:
        pool = _KEPT.pool = TilePool()
    pool.clear()
    return pool
