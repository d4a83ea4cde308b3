"""Loads raw readings and what georeferences them, for one span of time at once; the centre lines that limit them."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.crs import Geoid, MapFrame
from roadscan.core.errors import ConfigError, NavigationError
from roadscan.core.frames import rotation_from_quaternion
from roadscan.core.grid import TileGrid
from roadscan.core.rig import Mounting, Mountings, ScanGeometry
from roadscan.core.settings.segmentation import RoadSegmentation
from roadscan.georeference.charts import Charts, charts_along
from roadscan.georeference.place import (
    EVERYWHERE,
    CloudFrame,
    Georeferenced,
    HeightLimits,
    Located,
    Placement,
    Window,
    cloud_classes,
    place_cloud,
)
from roadscan.georeference.road_profiles import TICK_NS, WINDOW_NS, RoadFinder
from roadscan.ingest.clock_correction import ClockCorrection
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_recorded, load_trajectory
from roadscan.poses.trajectory import NO_CORRECTION, Allowance, MountingChange, Trajectory
from roadscan.store.logs import DataFile
from roadscan.store.readings.row_groups import distances_m, read_groups
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import read_small
from roadscan.store.store import Store

_CHUNK_READINGS = 1 << 20  # Readings per chunk, for which the working arrays are sized.
_MAP_SCALE = 2.0
"""Upper bound on the scale of a map: Web Mercator reaches it at 60° latitude."""
_EPOCH_COLUMNS = ("epoch_gps_ns", "pose_epoch_gps_ns")
READING_COLUMNS: Final = {
    "scans": ["epoch_gps_ns", "range", "intensity"],
    "returns": [*_EPOCH_COLUMNS, "x_sensor_m", "y_sensor_m", "z_sensor_m", "intensity", "laser"],
}
"""Columns of each table of readings that say where on the map, how bright, and of which laser each is."""
MOUNTING_COLUMNS: Final = (
    "lever_forward_m", "lever_right_m", "lever_down_m", "roll_rad", "pitch_rad", "heading_rad", "range_scale",
)  # fmt: skip
"""Columns of the table `mounting_corrections`."""
MOUNTING_SIGMAS: Final = (
    "sigma_lever_forward_m", "sigma_lever_right_m", "sigma_lever_down_m",
    "sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg",
)  # fmt: skip
"""Columns of σ of a calibrated mounting in the table `mountings`."""


@dataclass(frozen=True)
class ReadingSource:
    """One sensor's readings in one run, and what georeferences them. Sent to workers: it holds no data."""

    run: str
    sensor: str
    table: str
    attributes: tuple[tuple[str, Any], ...]
    """Attributes of the readings: scan geometry, or the cloud's CRS."""
    trajectory: TrajectorySource | None
    """None for clouds, which are georeferenced already."""
    mountings: Mountings
    range_min_m: float
    range_max_m: float
    key: str
    """Hash of all that georeferences the readings: recorded poses, mounting, clock, range limits, map, grid. Pose
    corrections are part of the keys of outputs in their span of time, the code of the keys of its outputs."""
    clock: ClockCorrection | None = None
    """Estimated correction of the ingested epochs; None where the sensor's clock is right as ingested."""
    road: RoadSegmentation | None = None
    """Segmentation of profiles, after which only road readings count; None where all count. Not in `key`: it
    belongs to the keys of tiles."""
    geoid: Geoid | None = None
    """Grid that a cloud's orthometric heights refer to."""
    mounting_change: MountingChange | None = None
    """Change of the mountings by an adjustment. Not in `key`, as corrections of the poses are not."""
    allowance: Allowance = NO_CORRECTION
    """Corrections of the poses that footprints allow for. Not in `key`: it belongs to the keys of footprints."""

    def spans(self, ingested: Sequence[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
        """Return first and last epochs (GPS ns), with the clock corrected, of spans of ingested epochs."""
        if self.clock is None:
            return tuple(ingested)
        ends = self.clock.applied(np.array(ingested, dtype=np.int64).ravel()).reshape(-1, 2)
        return tuple((int(a), int(b)) for a, b in ends)

    @property
    def adjusted_mountings(self) -> Mountings:
        """Return the mountings with the adjustment's change, for use with corrected poses."""
        if self.mounting_change is None:
            return self.mountings
        return self.mounting_change.applied(self.mountings, parallel=self.has_parallel_beams)

    @property
    def has_parallel_beams(self) -> bool:
        """Whether all readings are measured along the sensor's z, so that only z is a range."""
        geometry = geometry_of(self)
        return geometry is not None and geometry.kind == "cartesian"

    @property
    def attribute(self) -> dict[str, Any]:
        """Return the attributes by name."""
        return dict(self.attributes)


@dataclass(frozen=True)
class MapSettings:
    """Settings of the map: its projection, its grid, and limits of heights."""

    map: MapFrame
    grid: TileGrid
    heights: HeightLimits
    max_gap_s: float
    marks: bool = False
    """Whether filtered readings are georeferenced too, with their classes."""


@dataclass(frozen=True)
class RawSlice:
    """Row groups of one data file. Sent to workers: the epochs of single row groups stay in the store."""

    source: ReadingSource
    file: str
    groups: Sequence[int]
    """Ascending, and so in the order of time; a range where they are consecutive."""
    spans: tuple[tuple[int, int], ...]
    """First and last epoch (GPS ns, clock corrected) of each run of consecutive groups."""
    bytes: int
    """Approximate compressed bytes of the groups."""

    @classmethod
    def whole(cls, source: ReadingSource, file: DataFile) -> RawSlice:
        """Return all row groups of a data file."""
        spans = () if file.span is None else source.spans([file.span])
        return cls(source, file.path, range(len(file.group_rows)), spans, file.bytes)


def read_rows(
    store: Store, source: ReadingSource, file: str, groups: Sequence[int], columns: list[str] | None = None
) -> pa.Table:
    """Read row groups of a source's data file, with the clock of their epochs corrected."""
    rows = read_groups(store, file, groups, columns)
    if source.clock is None:
        return rows
    for name in _EPOCH_COLUMNS:
        if name in rows.column_names:
            index = rows.column_names.index(name)
            corrected = source.clock.applied(rows.column(name).to_numpy())
            rows = rows.set_column(index, rows.schema.field(name), pa.array(corrected))
    return rows


class Georeferencer:
    """Georeferences the readings of slices; it loads the poses once for each source."""

    def __init__(
        self, store: Store, ground: MapSettings, slices: Sequence[RawSlice], *, recorded: bool = False
    ) -> None:
        """Load the poses. `recorded`: use recorded poses and stated mountings, without corrections."""
        self._store = store
        self._ground = ground
        self._load, self._recorded = load_recorded if recorded else load_trajectory, recorded
        self._placements: dict[str, Placement] = {}
        spans: dict[str, list[tuple[int, int]]] = {}
        sources: dict[str, ReadingSource] = {}
        for one in slices:
            spans.setdefault(one.source.key, []).extend(one.spans)
            sources[one.source.key] = one.source
        for key, source in sources.items():
            if source.trajectory is not None:
                self._placements[key] = self._placement(source, spans[key])

    def place(self, one: RawSlice, window: Window) -> Iterator[tuple[int, Georeferenced]]:
        """Yield points of a slice, chunk by chunk, with the row group each chunk starts with."""
        for groups in _chunks(one):
            rows = read_rows(self._store, one.source, one.file, groups).combine_chunks()
            for batch in rows.to_batches():
                yield groups[0], self._place_batch(one.source, batch, window, self._ground.marks)

    def located(self, one: RawSlice, window: Window, columns: list[str]) -> Iterator[tuple[pa.RecordBatch, Located]]:
        """Yield columns of a slice of scans or returns, chunk by chunk, and its readings' positions within a window."""
        placement, geometry = self._placements[one.source.key], geometry_of(one.source)
        for groups in _chunks(one):
            rows = read_rows(self._store, one.source, one.file, groups, columns).combine_chunks()
            for batch in rows.to_batches():
                yield batch, placement.located(batch, geometry, window)

    def placement(self, source: ReadingSource) -> Placement:
        """Return the georeferencing of a source's readings; the source is no cloud."""
        return self._placements[source.key]

    def trajectory(self, source: ReadingSource) -> Trajectory | None:
        """Return poses around the slices of a source; None for clouds."""
        placement = self._placements.get(source.key)
        return None if placement is None else placement.trajectory

    def touched(self, one: RawSlice, group: int) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
        """Return the tiles (n, 2) of the points of one row group, and the counts of its readings."""
        batch = read_rows(self._store, one.source, one.file, [group]).combine_chunks().to_batches()[0]
        if one.source.table == "cloud":
            placed = self._place_batch(one.source, batch, EVERYWHERE, self._ground.marks)
            return placed.tiles, placed.fates
        return self._placements[one.source.key].touched(batch, geometry_of(one.source), marked=self._ground.marks)

    def moved_tiles(self, one: RawSlice, group: int) -> int:
        """Return by how many tiles, at most, corrections may move the points of one row group."""
        source = one.source
        if source.trajectory is None or source.allowance.is_none:
            return 0
        batch = read_rows(self._store, source, one.file, [group]).combine_chunks().to_batches()[0]
        arm = min(farthest_m(batch, geometry_of(source)), source.range_max_m) + source.mountings.longest_lever_m()
        return math.ceil(_MAP_SCALE * source.allowance.moved_m(arm) / self._ground.grid.size_m)

    def classified(self, one: RawSlice) -> Iterator[tuple[pa.RecordBatch, npt.NDArray[np.uint8], Georeferenced]]:
        """Yield rows of a slice, chunk by chunk, with the class of every reading in order, and the points kept.

        Passes and centre lines are ignored.
        """
        for groups in _chunks(one):
            for batch in read_rows(self._store, one.source, one.file, groups).combine_chunks().to_batches():
                kept = self._place_batch(one.source, batch, EVERYWHERE, marked=False)
                yield batch, self._classes(one.source, batch), kept

    def _classes(self, source: ReadingSource, batch: pa.RecordBatch) -> npt.NDArray[np.uint8]:
        if source.table == "cloud":
            return cloud_classes(batch, _cloud_frame(source), self._ground.map, self._ground.heights)
        return self._placements[source.key].classes(batch, geometry_of(source))

    def _place_batch(self, source: ReadingSource, batch: pa.RecordBatch, window: Window, marked: bool) -> Georeferenced:
        ground = self._ground
        if source.table == "cloud":
            cloud = _cloud_frame(source)
            return place_cloud(batch, cloud, ground.map, ground.heights, ground.grid.size_quanta, window, marked=marked)
        placement, geometry = self._placements[source.key], geometry_of(source)
        if geometry is None:
            return placement.returns(batch, window, marked=marked)
        return placement.profiles(batch, geometry, window, marked=marked)

    def _placement(self, source: ReadingSource, spans: list[tuple[int, int]]) -> Placement:
        if source.trajectory is None:
            raise NavigationError(f"run '{source.run}' has no trajectory", expected="a trajectory log in the run")
        wide = WINDOW_NS + TICK_NS if source.road is not None and source.road.turns is not None else 0
        around = [(first - wide, last + wide) for first, last in spans]
        trajectory = self._load(self._store, source.trajectory, around, self._ground.max_gap_s)
        limits = source.range_min_m, source.range_max_m
        mountings = source.mountings if self._recorded else source.adjusted_mountings
        return Placement(
            trajectory=trajectory,
            charts=_charts(self._ground.map, trajectory),
            mountings=mountings,
            range_min_m=source.range_min_m,
            range_max_m=source.range_max_m,
            heights=self._ground.heights,
            tile_quanta=self._ground.grid.size_quanta,
            road=None if source.road is None else RoadFinder(source.road, trajectory, mountings, *limits),
        )


MountingChanges: TypeAlias = Mapping[tuple[str, str], MountingChange]
"""Changes by run and sensor; "*" stands for all runs without an entry."""


def load_mounting_changes(store: Store) -> MountingChanges:
    """Read an adjustment's changes to the mountings of sensors."""
    table = read_small(store, "mounting_corrections")
    return {key_of_row(row): mounting_change_of(row) for row in ([] if table is None else table.to_pylist())}


def key_of_row(row: Mapping[str, Any]) -> tuple[str, str]:
    """Return run, "*" for all, and sensor of a row of `mounting_corrections`."""
    return row.get("run") or "*", row["sensor"]


def change_of(changes: MountingChanges, run: str, sensor: str) -> MountingChange | None:
    """Return the change of a sensor's mounting in a run; None where the stated mounting applies."""
    return changes.get((run, sensor), changes.get(("*", sensor)))


def mounting_change_of(row: Mapping[str, Any]) -> MountingChange:
    """Return the change that a row of `mounting_corrections` states; a missing value counts as 0."""
    return MountingChange.of(np.array([row.get(name) or 0.0 for name in MOUNTING_COLUMNS]))


def load_mountings(store: Store) -> dict[tuple[str, str], list[tuple[int, Mounting]]]:
    """Read calibrated mountings by run ('*' for all) and sensor, with the epochs from which they apply, ascending."""
    table = read_small(store, "mountings")
    found: dict[tuple[str, str], list[tuple[int, Mounting]]] = {}
    for row in () if table is None else table.sort_by("valid_from_gps_ns").to_pylist():
        rotation = rotation_from_quaternion(np.array([row["qw"], row["qx"], row["qy"], row["qz"]]))
        rows = tuple((float(r[0]), float(r[1]), float(r[2])) for r in rotation)
        lever = (row["lever_forward_m"], row["lever_right_m"], row["lever_down_m"])
        found.setdefault((row["run"], row["sensor"]), []).append((row["valid_from_gps_ns"], Mounting(lever, rows)))
    return found


def _charts(frame: MapFrame, trajectory: Trajectory) -> Charts:
    if trajectory.epochs_gps_ns.size == 0:
        return Charts(np.ones(4), np.full((1, 1, 1), -1, np.int32), np.zeros((1, 3)), np.zeros((1, 3, 10)))
    return charts_along(frame, trajectory.world, trajectory.position_world_m)


@functools.lru_cache(maxsize=64)
def _geometry_of(items: tuple[tuple[str, Any], ...]) -> ScanGeometry:
    return ScanGeometry.parse(dict(items))


def geometry_of(source: ReadingSource) -> ScanGeometry | None:
    """Return the scan geometry of a source of scans, None for other readings."""
    if source.table != "scans":
        return None
    stated = source.attribute.get("scan_geometry")
    if stated is None:
        raise ConfigError(f"the scans of {source.run}/{source.sensor} state no geometry", expected="scan_geometry")
    return _geometry_of(tuple(sorted(stated.items())))


def _cloud_frame(source: ReadingSource) -> CloudFrame:
    attributes = source.attribute
    return CloudFrame(attributes["crs"], attributes["height"], source.geoid, attributes.get("vertical_crs"))


def _chunks(one: RawSlice) -> Iterator[list[int]]:
    """Return the row groups in chunks of about `_CHUNK_READINGS` readings."""
    geometry = geometry_of(one.source)
    readings = table_schema(one.source.table).row_group_rows * (1 if geometry is None else geometry.readings)
    step = max(_CHUNK_READINGS // readings, 1)
    for start in range(0, len(one.groups), step):
        yield list(one.groups[start : start + step])


def farthest_m(batch: pa.RecordBatch, geometry: ScanGeometry | None) -> float:
    """Greatest distance (m) of readings from the sensor, in rows of ``scans`` or (without `geometry`) ``returns``."""
    if geometry is None:
        return float(distances_m(batch).max(initial=0.0))
    raw = int(batch.column("range").flatten().to_numpy(zero_copy_only=False).max(initial=0))
    across = max(abs(geometry.first), abs(geometry.first + geometry.step * (geometry.readings - 1)))
    along = geometry.range_offset_m + geometry.range_step_m * raw
    return float(np.hypot(along, across if geometry.kind == "cartesian" else 0.0))


@dataclass(frozen=True)
class CentreLines:
    """The centre-line layer and the distances kept beside its lines. Sent to workers: it holds no data."""

    path: Path
    digests: tuple[str, ...]
    """Digests of the layer's files, so that a changed layer counts as another one."""
    crs: str | None
    width: str
    """"buffer", "class", or the attribute with the road's width."""
    buffer_m: float
    margin_m: float
    options: str
    """Settings of the layer (JSON of ``RoadLinesOptions``)."""


def road_key(source: ReadingSource) -> list[object]:
    """Return the key by which tiles become stale when a source's segmentation changes; empty where it has none."""
    return [] if source.road is None else [source.road.model_dump(mode="json", exclude={"sensors"})]
