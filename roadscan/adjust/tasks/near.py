"""Readings near a place: read by row group and time span, georeferenced with the recorded poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.adjust.patches import PassReadings
from roadscan.adjust.places import Traverse
from roadscan.core.grid import QUANTA_PER_M
from roadscan.georeference.place import EIGHT_TO_SIXTEEN_BITS, EVERYWHERE, Placement
from roadscan.georeference.sources import Georeferencer, MapSettings, RawSlice, ReadingSource, geometry_of, read_rows
from roadscan.poses.level import LevelPoses, level_poses
from roadscan.store.logs import DataFile
from roadscan.store.store import Store

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

_POSE_STEP_NS: Final = 2_000_000
"""Readings this close in time (ns) share a pose: at 30 m/s that shifts arms by 60 mm."""
_KEPT_GROUPS: Final = 8
"""Row groups of profiles cached, as they are stored."""
_KEPT_RETURNS: Final = 6_000_000
"""Returns of a lidar cached, georeferenced: those of one place are near the next one, too. They take 34 bytes each."""


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
    def of(cls, source: ReadingSource, file: DataFile, spans_gps_ns: Sequence[tuple[int, int]]) -> NearFile | None:
        """Returns the row groups with readings of some spans; None where there are none."""
        own = np.array(source.spans(file.group_spans), np.int64).reshape(-1, 2)
        wanted = np.array(spans_gps_ns, np.int64).reshape(-1, 1, 2)
        near = np.flatnonzero(((own[:, 0] <= wanted[:, :, 1]) & (own[:, 1] >= wanted[:, :, 0])).any(axis=0))
        if not near.size:
            return None
        share = file.bytes * near.size // max(len(own), 1)
        spans = tuple((int(a), int(b)) for a, b in own[near])
        return cls(source, file.path, file.digest, tuple(near.tolist()), spans, share)

    @property
    def slice(self) -> RawSlice:
        """Returns the same for georeferencing."""
        return RawSlice(self.source, self.path, self.groups, self.spans, self.bytes)

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


@dataclass(frozen=True)
class Circle:
    """The circle in which readings are wanted."""

    easting_m: float
    northing_m: float
    radius_m: float


class NearReader:
    """Georeferences readings near places; caches the row groups that the next place may need as well."""

    def __init__(
        self, store: Store, ground: MapSettings, files: Sequence[NearFile], runs: Sequence[str], apart_m: float = 0.0
    ) -> None:
        """`runs` : all runs of the survey, in the order by which traverses number them.

        apart_m : profiles are thinned to at most this spacing.
        """
        self._store, self._frame, self._runs = store, ground.map, runs
        self._placer = Georeferencer(store, ground, [one.slice for one in files], recorded=True)
        self._files: dict[tuple[str, str], list[NearFile]] = {}
        for one in files:
            self._files.setdefault((one.source.run, one.source.sensor), []).append(one)
        self._kept: dict[tuple[str, int], pa.RecordBatch] = {}
        self._apart_m = apart_m
        self._returns: dict[tuple[str, int], PlacedReadings] = {}

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
            found = placed_readings(profiles, file.source, self._placer.placement(file.source))
            within = np.ones(len(found.points_m), np.bool_)
        east, north = found.points_m[:, 0] - circle.easting_m, found.points_m[:, 1] - circle.northing_m
        near = within & (east * east + north * north <= circle.radius_m**2)
        if near.any():
            yield found.chosen(near)

    def _placed_returns(self, file: NearFile, group: int) -> PlacedReadings:
        """Returns lidar returns of a row group; each is a separate row."""
        known = self._returns.get((file.path, group))
        if known is None:
            batch = read_rows(self._store, file.source, file.path, [group]).combine_chunks().to_batches()[0]
            known = placed_readings(batch, file.source, self._placer.placement(file.source))
            self._returns[file.path, group] = known
            while len(self._returns) > 1 and sum(len(one.points_m) for one in self._returns.values()) > _KEPT_RETURNS:
                self._returns.pop(next(iter(self._returns)))
        return known

    def _profiles(self, file: NearFile, group: int, span: tuple[int, int]) -> pa.RecordBatch | None:
        """Returns rows of a row group within a span of epochs, no closer than is wanted; None where there are none."""
        batch = self._batch(file, group)
        column = batch.column("epoch_gps_ns").to_numpy()
        rows = np.flatnonzero((column >= span[0]) & (column <= span[1]))
        if not rows.size:
            return None
        rows = rows[:: self._every(file.source, column[rows])]
        if rows.size == batch.num_rows:
            return batch
        return batch.slice(int(rows[0]), rows.size) if rows[-1] - rows[0] + 1 == rows.size else batch.take(rows)

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
            returns=bool(files) and files[0].source.table == "returns",
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

    def chosen(self, which: npt.NDArray[np.bool_]) -> PlacedReadings:
        """Returns a subset; of lidar returns also the rows, which are one each."""
        points, intensity, row = self.points_m[which], self.intensity[which], self.row[which]
        if len(which) == self.epoch_gps_ns.size and len(row) < len(which):
            return PlacedReadings(points, intensity, np.arange(row.size), self.epoch_gps_ns[row])
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
        )


def placed_readings(batch: pa.RecordBatch, source: ReadingSource, placement: Placement) -> PlacedReadings:
    """Returns readings from rows of a source's table that no filter leaves out."""
    geometry = geometry_of(source)
    if geometry is None:
        placed = placement.returns(batch, EVERYWHERE)
        corner = placed.tiles.astype(np.int64) * placement.tile_quanta
        east, north = ((corner[:, k] + placed.quanta[:, k]) / QUANTA_PER_M for k in (0, 1))
        points = np.stack([east, north, placed.quanta[:, 2] / QUANTA_PER_M], axis=-1)
        return PlacedReadings(points, placed.intensity, np.arange(len(points)), placed.epoch_gps_ns)
    profiles = placement.by_profile(batch, geometry)
    kept = np.flatnonzero(profiles.kept.ravel())
    columns = [profiles.easting_m, profiles.northing_m, profiles.height_m]
    points = np.stack([column.ravel()[kept] for column in columns], axis=-1)
    intensity = np.zeros(kept.size, np.uint16)
    if batch.column("intensity").null_count == 0:
        digital = batch.column("intensity").flatten().to_numpy(zero_copy_only=False)
        intensity = digital[kept].astype(np.uint16) * np.uint16(EIGHT_TO_SIXTEEN_BITS)
    return PlacedReadings(points, intensity, kept // geometry.readings, profiles.epoch_gps_ns)


def _ranked(numbers: Int64) -> tuple[Int64, Int64]:
    """Returns distinct numbers, ascending, and the rank (n,) of each among them; ascending numbers need no sorting."""
    step = np.diff(numbers)
    if (step < 0).any():
        return np.unique(numbers, return_inverse=True)
    new = np.concatenate([np.ones(min(numbers.size, 1), np.bool_), step > 0])
    return numbers[new], np.cumsum(new) - 1


def _no_poses() -> LevelPoses:
    return LevelPoses(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
