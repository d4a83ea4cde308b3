"""Readings near a place: read by row group and time span, georeferenced with the recorded poses."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.adjust.places import PassReadings, Traverse
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.grid import QUANTA_PER_M
from roadscan.core.rig import Mountings, ScanGeometry
from roadscan.georeference.place import EIGHT_TO_SIXTEEN_BITS, EVERYWHERE, Placement
from roadscan.georeference.sources import (
    READING_COLUMNS,
    Georeferencer,
    MapSettings,
    MountingChanges,
    RawSlice,
    ReadingSource,
    change_of,
    geometry_of,
    read_rows,
)
from roadscan.poses.trajectory import LevelPoses, MountingChange, Seat, level_poses
from roadscan.run.stage import BYTES_PER_READING, WORKER_BASE_BYTES
from roadscan.store.logs import DataFile
from roadscan.store.store import Store

_POSE_STEP_NS: Final = 2_000_000
"""Readings this close in time (ns) share a pose: at 30 m/s that shifts arms by 60 mm."""
_PROBES: Final = 3
"""Profiles of those near a place that show which of their readings lie there."""
_AT_ONCE: Final = 64
"""Readings of profiles are cut off by so many."""
_BESIDE_M: Final = 0.2
"""Other profiles see the place with readings so much farther to the side (m)."""
_KEPT_GROUPS: Final = 8
"""Row groups of profiles cached, as they are stored."""
_KEPT_RETURNS: Final = 6_000_000
"""Returns of a lidar cached, georeferenced: those of one place are near the next one, too."""
_BYTES_PER_KEPT_RETURN: Final = 34  # place, intensity, row, epoch and laser of a cached return (bytes)
_BYTES_PER_STORED_READING: Final = 3  # range and intensity of a reading of a profile, as stored (bytes)


Sources: TypeAlias = Sequence[tuple[ReadingSource, tuple[DataFile, ...]]]
"""Readings of sensors in runs, with their data files."""


@dataclass(frozen=True)
class NearFile:
    """Row groups of a data file that are needed. Sent to workers: it carries no data."""

    source: ReadingSource
    path: str
    digest: str
    groups: tuple[int, ...]
    spans: tuple[tuple[int, int], ...]
    """First and last epoch (GPS ns), on time, of each of the groups."""
    bytes: int
    """Approximate number of compressed bytes of the groups."""

    @classmethod
    def of(
        cls,
        source: ReadingSource,
        file: DataFile,
        spans_gps_ns: Sequence[tuple[int, int]],
    ) -> NearFile | None:
        """Returns the row groups with readings of some spans; None where there are none."""
        own = np.array(source.spans(file.group_spans), np.int64).reshape(-1, 2)
        wanted = np.array(spans_gps_ns, np.int64).reshape(-1, 1, 2)
        inside = ((own[:, 0] <= wanted[:, :, 1]) & (own[:, 1] >= wanted[:, :, 0])).any(axis=0)
        near = np.flatnonzero(inside)
        if not near.size:
            return None
        share = file.bytes * near.size // max(len(own), 1)
        spans = tuple((int(a), int(b)) for a, b in own[near])
        return cls(source, file.path, file.digest, tuple(near.tolist()), spans, share)

    @property
    def slice(self) -> RawSlice:
        """Returns the same for georeferencing."""
        return RawSlice(self.source, self.path, self.groups, self.spans, self.bytes)

    def remounted(self, changes: MountingChanges) -> NearFile:
        """Returns the same, whose readings are placed with the changed mounting of their sensor, if it has one."""
        source = replace(self.source, mounting_change=change_of(changes, self.source.run, self.source.sensor))
        return replace(self, source=replace(source, mountings=source.adjusted_mountings))

    def key(self, road: Sequence[object]) -> list[object]:
        """Returns a key of all that affects readings near a place; `road` : how the road is classified."""
        return [self.source.key, *road, self.digest, list(self.groups)]


def near_files(sources: Sources, traverses: Iterable[Traverse], runs: Sequence[str]) -> list[NearFile]:
    """Returns row groups of all sources with readings of some traverses, which number the runs as in `runs`."""
    spans: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for one in traverses:
        spans.setdefault((runs[one.run], one.sensor), []).append((one.first_gps_ns, one.last_gps_ns))
    found = [
        NearFile.of(source, file, wanted)
        for source, files in sources
        if (wanted := spans.get((source.run, source.sensor)))
        for file in files
        if file.group_spans
    ]
    return [one for one in found if one is not None]


class Remounted(NamedTuple):
    """A sensor whose readings a changed mounting places, and what is stated of it."""

    change: MountingChange
    stated: Mountings
    parallel: bool
    """Whether its beams are."""

    def seat(self, epochs_gps_ns: Int64 | int) -> Seat:
        """Returns the stated seats (n, 3) at epochs (n,), or (3,) at one."""
        return Seat.of(self.stated, epochs_gps_ns, parallel=self.parallel)


def remounted_of(files: Sequence[NearFile], changes: MountingChanges) -> dict[tuple[str, str], Remounted]:
    """Returns the sensors of files, by run and name, whose mounting changed."""
    found = dict[tuple[str, str], Remounted]()
    for source in (one.source for one in files):
        change = change_of(changes, source.run, source.sensor)
        if change is not None:
            found[source.run, source.sensor] = Remounted(change, source.mountings, source.has_parallel_beams)
    return found


def changes_key(files: Sequence[NearFile], changes: MountingChanges) -> list[tuple[tuple[str, str], list[float]]]:
    """Returns what the changes of mountings add to the key of what is read from files."""
    return sorted((sensor, one.change.values.tolist()) for sensor, one in remounted_of(files, changes).items())


def memory_of(sources: Sources) -> int:
    """Returns the approximate memory (bytes) of a worker at most: what it caches, and a row group that is placed."""
    returns, largest, stored = 0, 0, 0
    for source, files in sources:
        geometry = geometry_of(source)
        groups = [rows * (1 if geometry is None else geometry.readings) for file in files for rows in file.group_rows]
        largest = max(largest, *groups) if groups else largest
        if source.table == "returns":
            returns += sum(groups)
        else:
            stored = max(stored, sum(sorted(groups)[-_KEPT_GROUPS:]))
    kept = min(returns, _KEPT_RETURNS + largest) * _BYTES_PER_KEPT_RETURN + stored * _BYTES_PER_STORED_READING
    return WORKER_BASE_BYTES + kept + largest * BYTES_PER_READING


@dataclass(frozen=True)
class Circle:
    """The circle in which readings are wanted, or a strip through its middle."""

    easting_m: float
    northing_m: float
    radius_m: float
    aside_m: float = math.inf
    """Half the width of the strip."""
    heading_rad: float = 0.0
    """Direction of the strip, clockwise from grid north."""

    def holds(self, easting_m: Float64, northing_m: Float64) -> Bool:
        """Returns a mask of points inside."""
        east, north = easting_m - self.easting_m, northing_m - self.northing_m
        inside = np.asarray(east * east + north * north <= self.radius_m**2)
        if self.aside_m < self.radius_m:
            inside &= np.abs(east * math.cos(self.heading_rad) - north * math.sin(self.heading_rad)) <= self.aside_m
        return inside


class NearReader:
    """Georeferences readings near places; caches the row groups that the next place may need as well."""

    def __init__(
        self,
        store: Store,
        ground: MapSettings,
        files: Sequence[NearFile],
        runs: Sequence[str],
        apart_m: float = 0.0,
        one_return_in: int = 1,
    ) -> None:
        """`runs` : all runs of the survey, in the order by which traverses number them.

        apart_m : profiles are thinned to at most this spacing. one_return_in : of so many of a lidar one is placed.
        """
        self._store, self._frame, self._runs = store, ground.map, runs
        self._placer = Georeferencer(store, ground, [one.slice for one in files], recorded=True)
        self._files: dict[tuple[str, str], list[NearFile]] = {}
        for one in files:
            self._files.setdefault((one.source.run, one.source.sensor), []).append(one)
        self._kept: dict[tuple[str, int], pa.RecordBatch] = {}
        self._apart_m, self._one_return_in = apart_m, one_return_in
        self._returns: dict[tuple[str, int], PlacedReadings] = {}
        self._held = 0

    def of(self, traverse: Traverse, circle: Circle) -> PassReadings:
        """Returns readings of one traverse within a circle."""
        run = self._runs[traverse.run]
        parts = [
            part
            for file in self._files.get((run, traverse.sensor), [])
            for group, (first, last) in zip(file.groups, file.spans, strict=True)
            if first <= traverse.last_gps_ns and last >= traverse.first_gps_ns
            for part in self._placed(file, group, traverse, circle)
        ]
        return self._joined(traverse, run, parts)

    def _placed(self, file: NearFile, group: int, traverse: Traverse, circle: Circle) -> Iterator[PlacedReadings]:
        """Yields readings of a row group within the traverse and the circle."""
        span = traverse.first_gps_ns, traverse.last_gps_ns
        if file.source.table == "returns":
            found = self._placed_returns(file, group)
            within = (found.epoch_gps_ns >= span[0]) & (found.epoch_gps_ns <= span[1])
        else:
            profiles = self._profiles(file, group, span)
            if profiles is None:
                return
            placement = self._placer.placement(file.source)
            found = placed_readings(*_cut(profiles, file.source, placement, circle), placement)
            within = np.ones(len(found.points_m), np.bool_)
        near = within & circle.holds(found.points_m[:, 0], found.points_m[:, 1])
        if near.any():
            yield found.chosen(near)

    def _placed_returns(self, file: NearFile, group: int) -> PlacedReadings:
        """Returns lidar returns of a row group; each is a separate row."""
        known = self._returns.get((file.path, group))
        if known is None:
            rows = read_rows(self._store, file.source, file.path, [group], READING_COLUMNS["returns"])
            batch = rows.combine_chunks().to_batches()[0]
            if self._one_return_in > 1:
                batch = batch.take(np.arange(0, batch.num_rows, self._one_return_in))
            known = placed_readings(batch, None, self._placer.placement(file.source))
            self._returns[file.path, group] = known
            self._held += len(known.points_m)
            while len(self._returns) > 1 and self._held > _KEPT_RETURNS:
                self._held -= len(self._returns.pop(next(iter(self._returns))).points_m)
        return known

    def _profiles(self, file: NearFile, group: int, span: tuple[int, int]) -> pa.RecordBatch | None:
        """Returns rows of a row group within a span of epochs, no closer than is wanted; None where there are none."""
        batch = self._batch(file, group)
        column = batch.column("epoch_gps_ns").to_numpy()
        rows = np.flatnonzero((column >= span[0]) & (column <= span[1]))
        if not rows.size:
            return None
        return _taken(batch, rows[:: self._every(file.source, column[rows])])

    def _every(self, source: ReadingSource, epochs_gps_ns: Int64) -> int:
        """Returns the stride by which profiles are thinned."""
        trajectory = self._placer.trajectory(source)
        if not self._apart_m or trajectory is None or epochs_gps_ns.size < 3:
            return 1
        poses = trajectory.poses(epochs_gps_ns[[0, -1]])
        if not poses.found.all():
            return 1
        driven_m = float(np.linalg.norm(np.diff(poses.position_world_m, axis=0)))
        return max(1, int(self._apart_m * (epochs_gps_ns.size - 1) / max(driven_m, 1e-3)))

    def _batch(self, file: NearFile, group: int) -> pa.RecordBatch:
        known = self._kept.get((file.path, group))
        if known is None:
            known = read_rows(self._store, file.source, file.path, [group]).combine_chunks().to_batches()[0]
            self._kept[file.path, group] = known
            while len(self._kept) > _KEPT_GROUPS:
                self._kept.pop(next(iter(self._kept)))
        return known

    def _joined(self, traverse: Traverse, run: str, parts: Sequence[PlacedReadings]) -> PassReadings:
        files = self._files.get((run, traverse.sensor), [])
        found = PlacedReadings.joined(parts)
        trajectory = self._placer.trajectory(files[0].source) if files else None
        steps, pose = _ranked(found.epoch_gps_ns // _POSE_STEP_NS)
        if trajectory is None or not steps.size:
            poses = _no_poses()
        else:
            poses = level_poses(trajectory, self._frame, steps * _POSE_STEP_NS + _POSE_STEP_NS // 2)
        has_pose = np.isin(steps, poses.epoch_gps_ns // _POSE_STEP_NS)
        of_reading = pose[found.row]
        keep = has_pose[of_reading]
        found, of_reading = found.chosen(keep), (np.cumsum(has_pose) - 1)[of_reading[keep]]
        turned = float(poses.convergence_rad[0]) if poses.epoch_gps_ns.size else 0.0
        easting, northing, height = (np.ascontiguousarray(found.points_m[:, k]) for k in range(3))
        return PassReadings(
            run=traverse.run,
            sensor=traverse.sensor,
            easting_m=easting,
            northing_m=northing,
            height_m=height,
            intensity=found.intensity,
            pose=of_reading.astype(np.int32),
            epoch_gps_ns=poses.epoch_gps_ns,
            body_m=poses.body_m,
            level_from_body=poses.level_from_body,
            convergence_rad=turned,
            laser=found.laser,
        )


@dataclass(frozen=True)
class PlacedReadings:
    """n readings that count, of profiles (or returns) at r epochs."""

    points_m: Float64
    """(n, 3) easting, northing, height."""
    intensity: npt.NDArray[np.uint16]
    """(n,)"""
    row: Int64
    """(n,) profile of each."""
    epoch_gps_ns: Int64
    """(r,)"""
    laser: npt.NDArray[np.uint8] | None = None
    """(n,) of the returns of a lidar, 0 where the log does not say."""

    def chosen(self, which: npt.NDArray[np.bool_]) -> PlacedReadings:
        """Returns a subset; of lidar returns also the rows, which are one each."""
        if which.all():
            return self
        rows = np.flatnonzero(which)
        points, intensity, row = self.points_m[rows], self.intensity[rows], self.row[rows]
        if self.laser is not None:
            return PlacedReadings(points, intensity, np.arange(row.size), self.epoch_gps_ns[row], self.laser[rows])
        return PlacedReadings(points, intensity, row, self.epoch_gps_ns)

    @classmethod
    def joined(cls, parts: Sequence[PlacedReadings]) -> PlacedReadings:
        """Returns all of them, in order."""
        if not parts:
            return cls(np.zeros((0, 3)), np.zeros(0, np.uint16), np.zeros(0, np.int64), np.zeros(0, np.int64))
        first = np.cumsum([0, *(p.epoch_gps_ns.size for p in parts[:-1])])
        return cls(
            np.concatenate([p.points_m for p in parts]),
            np.concatenate([p.intensity for p in parts]),
            np.concatenate([p.row + start for p, start in zip(parts, first, strict=True)]),
            np.concatenate([p.epoch_gps_ns for p in parts]),
            None if any(p.laser is None for p in parts) else np.concatenate([p.laser for p in parts]),
        )


def placed_readings(batch: pa.RecordBatch, geometry: ScanGeometry | None, placement: Placement) -> PlacedReadings:
    """Returns readings from rows of a source's table that no filter leaves out; geometry : of scans."""
    if geometry is None:
        placed = placement.located(batch, None, EVERYWHERE)
        corner = placed.tiles.astype(np.int64) * placement.tile_quanta
        east, north = ((corner[:, k] + placed.quanta[:, k]) / QUANTA_PER_M for k in (0, 1))
        points = np.stack([east, north, placed.quanta[:, 2] / QUANTA_PER_M], axis=-1)
        names = "epoch_gps_ns", "intensity", "laser"
        epoch, intensity, laser = (batch.column(name).to_numpy()[placed.row] for name in names)
        return PlacedReadings(points, intensity, np.arange(len(points)), epoch, laser)
    profiles = placement.by_profile(batch, geometry)
    kept = np.flatnonzero(profiles.kept.ravel())
    columns = [profiles.easting_m, profiles.northing_m, profiles.height_m]
    points = np.stack([column.ravel()[kept] for column in columns], axis=-1)
    intensity = np.zeros(kept.size, np.uint16)
    if batch.column("intensity").null_count == 0:
        digital = batch.column("intensity").flatten().to_numpy(zero_copy_only=False)
        intensity = digital[kept].astype(np.uint16) * np.uint16(EIGHT_TO_SIXTEEN_BITS)
    return PlacedReadings(points, intensity, kept // geometry.readings, profiles.epoch_gps_ns)


def _cut(
    batch: pa.RecordBatch, source: ReadingSource, placement: Placement, circle: Circle
) -> tuple[pa.RecordBatch, ScanGeometry | None]:
    """Returns profiles without the readings at both ends that lie outside a circle, and their geometry.

    Some of the profiles show which readings these are. Where the road is found in profiles, and where readings of a
    profile follow one another in time, profiles stay whole.
    """
    geometry = geometry_of(source)
    if geometry is None or placement.road is not None or geometry.reading_period_ns:
        return batch, geometry
    some = np.unique(np.linspace(0, batch.num_rows - 1, _PROBES).round().astype(np.int64))
    shown = placement.by_profile(batch.take(some), geometry)
    near = np.zeros(geometry.readings, np.bool_)
    for kept, easting, northing in zip(shown.kept, shown.easting_m, shown.northing_m, strict=True):
        ends = np.flatnonzero(kept)[[0, -1]] if kept.any() else np.zeros(2, np.int64)
        east, north = np.diff(easting[ends])[0], np.diff(northing[ends])[0]
        length = max(math.hypot(east, north), 1e-9)
        # How far along its profile each reading lies from the point that is nearest to the middle.
        along = ((easting - circle.easting_m) * east + (northing - circle.northing_m) * north) / length
        near |= kept & (np.abs(along) <= min(circle.radius_m, circle.aside_m) + _BESIDE_M)
    columns = np.flatnonzero(near)
    if not columns.size:
        return batch.slice(0, 0), geometry
    # Whole multiples: what follows from a geometry is kept, and neighbours share it.
    low = int(columns[0]) // _AT_ONCE * _AT_ONCE
    end = min((int(columns[-1]) // _AT_ONCE + 1) * _AT_ONCE, geometry.readings)
    if end - low == geometry.readings:
        return batch, geometry
    arrays = [_columns(one, low, end) if pa.types.is_fixed_size_list(one.type) else one for one in batch.columns]
    changed = {"first": geometry.first + low * geometry.step, "readings": end - low}
    return pa.RecordBatch.from_arrays(arrays, batch.schema.names), geometry.model_copy(update=changed)


def _columns(lists: pa.FixedSizeListArray, low: int, end: int) -> pa.FixedSizeListArray:
    """Returns the elements from `low` to below `end` of each list; where lists are missing, all are."""
    if lists.null_count:
        return pa.nulls(len(lists), pa.list_(lists.type.value_type, end - low))
    values = lists.flatten().to_numpy().reshape(len(lists), -1)[:, low:end]
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), end - low)


def _taken(batch: pa.RecordBatch, rows: Int64) -> pa.RecordBatch:
    """Returns rows of a batch, ascending; those that follow one another are not copied."""
    if rows.size and rows[-1] - rows[0] + 1 == rows.size:
        return batch.slice(int(rows[0]), rows.size)
    return batch.take(rows)


def _ranked(numbers: Int64) -> tuple[Int64, Int64]:
    """Returns distinct numbers, ascending, and the rank (n,) of each among them; ascending numbers need no sorting."""
    step = np.diff(numbers)
    if (step < 0).any():
        return np.unique(numbers, return_inverse=True)
    new = np.concatenate([np.ones(min(numbers.size, 1), np.bool_), step > 0])
    return numbers[new], np.cumsum(new) - 1


def _no_poses() -> LevelPoses:
    return LevelPoses(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
