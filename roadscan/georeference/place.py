"""Georeferences batches of readings: pose, mounting, map projection, filters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int32, Int64, UInt8
from roadscan.compute.kernel_options import read_only
from roadscan.core.crs import (
    Geoid,
    MapFrame,
    crs_from_text,
    height_operation,
    one_vertical_datum,
    vertical_of,
    world_frame_of,
)
from roadscan.core.errors import CrsError
from roadscan.core.grid import QUANTA_PER_M, LanePass
from roadscan.core.rig import Mounting, Mountings, ScanGeometry
from roadscan.georeference.charts import EVERY_RAW_RANGE, Charts, flat_profiles, georeference_of
from roadscan.georeference.kernels import readings as kernels
from roadscan.georeference.kernels.flat_profiles import georeference_flat_profiles
from roadscan.georeference.kernels.readings import FATES, Georeference, Limits, MirrorProfiles, Points, Returns
from roadscan.georeference.kernels.timed_readings import georeference_mirror, georeference_returns
from roadscan.georeference.road_profiles import (
    KEPT,
    NOT_ROAD,
    READING_CLASSES,
    TOO_HIGH,
    TOO_LOW,
    RoadFinder,
    RoadProfiles,
)
from roadscan.poses.trajectory import Trajectory

EIGHT_TO_SIXTEEN_BITS: Final = 257
"""Factor from 8-bit to 16-bit intensities: 255 becomes 65,535."""

FARTHEST_HEIGHT_M: Final = 21_000.0
"""Heights beyond this are invalid (some vendors write −99,999)."""

EXTRA_COLUMNS: Final = (
    "return_number", "number_of_returns", "scan_angle_deg", "flags", "user_data", "point_source_id",
    "red", "green", "blue",
)  # fmt: skip

FATE_NAMES: Final = (
    "kept", "no_pose", "range", "height", "outside", "no_return", *(READING_CLASSES[k] for k in NOT_ROAD),
    "outside_pass", "centre_line",
)  # fmt: skip
"""Outcomes of readings; the first six in the kernels' order, then the classes of the segmentation."""
COUNTED_FATES: Final = FATES + len(NOT_ROAD)
"""Number of outcomes that are counted, from the first on."""


@dataclass(frozen=True)
class HeightLimits:
    """Limits of realistic heights; infinite where there is none."""

    height_min_m: float = -np.inf
    height_max_m: float = np.inf
    above_body_min_m: float = -np.inf
    above_body_max_m: float = np.inf

    def absolute(self) -> tuple[float, float]:
        """Return the lowest and highest height kept (m), never beyond what 32 bits of 10 µm hold."""
        return max(float(self.height_min_m), -FARTHEST_HEIGHT_M), min(float(self.height_max_m), FARTHEST_HEIGHT_M)

    def classes(self, height_m: Float64) -> UInt8:
        """Return the class (n,) of points by their absolute heights (n,)."""
        lowest, highest = self.absolute()
        below = np.where(height_m < lowest, TOO_LOW, TOO_HIGH)
        return np.where((height_m >= lowest) & (height_m <= highest), KEPT, below).astype(np.uint8)


@dataclass(frozen=True)
class Window:
    """The tiles whose points are requested: columns and rows, ends exclusive."""

    first_column: int
    first_row: int
    end_column: int
    end_row: int


_NO_LIMITS: Final = Limits(0.0, np.inf, -FARTHEST_HEIGHT_M, FARTHEST_HEIGHT_M, -np.inf, np.inf)  # Valid heights only.
_NO_CLASSES: Final = np.empty(0, np.uint8)  # No classes are requested.
EVERYWHERE: Final = Window(-(2**30), -(2**30), 2**30, 2**30)  # Contains every tile.


@dataclass(frozen=True)
class Georeferenced:
    """Points of one batch of readings, in the order of the batch."""

    tiles: Int32
    """(n, 2) column and row."""
    quanta: Int32
    """(n, 3) x and y from the tile's south-west corner, height; 10 µm."""
    epoch_gps_ns: Int64
    intensity: npt.NDArray[np.uint16]
    classification: npt.NDArray[np.uint8]
    fates: Int64
    """(11,) counts of readings by outcome (``FATE_NAMES``); of clouds the first six."""
    classes: UInt8 | None = None
    """(n,) class of each point's reading, where filtered readings were requested too."""
    extra: dict[str, npt.NDArray[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class ProfilePoints:
    """Map positions of the readings of n profiles; arrays (n, m)."""

    epoch_gps_ns: Int64
    """(n,) of the profiles."""
    easting_m: Float64
    northing_m: Float64
    height_m: Float64
    kept: npt.NDArray[np.bool_]
    """False for readings that a filter leaves out; their positions are 0."""


@dataclass(frozen=True)
class Located:
    """Readings of a batch that pass all filters, by their rows in it; arrays (n, …)."""

    row: Int32
    reading: Int32
    """Number of the reading in its profile; not set for returns."""
    tiles: Int32
    """(n, 2) column and row."""
    quanta: Int32
    """(n, 3) x and y from the tile's south-west corner, height; 10 µm."""


@dataclass(frozen=True)
class Placement:
    """Georeferencing of the readings of one sensor in one run."""

    trajectory: Trajectory
    charts: Charts
    mountings: Mountings
    range_min_m: float
    range_max_m: float
    heights: HeightLimits
    tile_quanta: int
    road: RoadFinder | None = None
    """Finder of the road in profiles, whose other readings are left out; None where all count."""

    def georeference(self, mounting: Mounting, *, limited: bool = True) -> Georeference:
        """What kernels need to georeference with a mounting; unless `limited`, without limits of range and height."""
        return georeference_of(mounting, self.trajectory, self.charts, self.limits if limited else _NO_LIMITS)

    @property
    def limits(self) -> Limits:
        """Return the limits of ranges and heights."""
        h = self.heights
        return Limits(
            float(self.range_min_m), float(self.range_max_m), *h.absolute(),
            float(h.above_body_min_m), float(h.above_body_max_m),
        )  # fmt: skip

    @cached_property
    def interval_sigmas_m(self) -> Float64:
        """(knots − 1, 2) largest horizontal and vertical 1 σ of the poses of each interval; inf where not known."""
        return self.trajectory.interval_sigmas_m()

    def returns(self, batch: pa.RecordBatch, window: Window, *, marked: bool = False) -> Georeferenced:
        """Georeference rows of the table ``returns``; `marked`: include filtered ones, with their classes."""
        work = self._work(batch, None, window, marked)
        kept = work.rows
        return Georeferenced(
            work.tiles,
            work.quanta,
            _numpy(batch, "epoch_gps_ns")[kept],
            _numpy(batch, "intensity")[kept],
            np.ones(kept.size, np.uint8),
            work.fates,
            None if work.classes is None else work.classes[kept],
        )

    def profiles(
        self, batch: pa.RecordBatch, geometry: ScanGeometry, window: Window, *, marked: bool = False
    ) -> Georeferenced:
        """Georeference rows of the table ``scans``; `marked` as for :meth:`returns`."""
        work = self._work(batch, geometry, window, marked)
        row, reading = work.rows, work.readings
        epoch = geometry.reading_epochs(_numpy(batch, "epoch_gps_ns")[row], reading)
        intensity = np.zeros(row.size, np.uint16)
        if batch.column("intensity").null_count == 0:
            digital = _lists(batch, "intensity", geometry.readings)[row, reading]
            intensity = digital.astype(np.uint16) * EIGHT_TO_SIXTEEN_BITS
        classes = None if work.classes is None else work.classes[row.astype(np.int64) * geometry.readings + reading]
        # Copied, because the working arrays are far larger where a window keeps little.
        return Georeferenced(
            work.tiles.copy(), work.quanta.copy(), epoch, intensity, np.ones(row.size, np.uint8), work.fates, classes
        )

    def located(self, batch: pa.RecordBatch, geometry: ScanGeometry | None, window: Window) -> Located:
        """Return positions of the readings of a batch within a window, with their rows; `geometry` for scans."""
        work = self._work(batch, geometry, window, marked=False)
        return Located(work.rows, work.readings, work.tiles, work.quanta)

    def by_profile(self, batch: pa.RecordBatch, geometry: ScanGeometry) -> ProfilePoints:
        """Return the map positions of the readings of rows of the table ``scans``, by profile."""
        work = self._work(batch, geometry, EVERYWHERE, marked=False)
        shape = batch.num_rows, geometry.readings
        east, north, height = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        kept = np.zeros(shape, bool)
        at = work.rows, work.readings
        corner = work.tiles.astype(np.int64) * self.tile_quanta
        east[at] = (corner[:, 0] + work.quanta[:, 0]) / QUANTA_PER_M
        north[at] = (corner[:, 1] + work.quanta[:, 1]) / QUANTA_PER_M
        height[at] = work.quanta[:, 2] / QUANTA_PER_M
        kept[at] = True
        return ProfilePoints(_numpy(batch, "epoch_gps_ns"), east, north, height, kept)

    def touched(
        self, batch: pa.RecordBatch, geometry: ScanGeometry | None, *, marked: bool = False
    ) -> tuple[Int32, Int64]:
        """Return the tiles (n, 2) of all points of a batch, and the counts of its readings; `geometry` for scans.

        `marked`: include tiles of filtered readings. Profiles are not segmented.
        """
        work = replace(self, road=None)._work(batch, geometry, EVERYWHERE, marked)
        return work.tiles, work.fates

    def classes(self, batch: pa.RecordBatch, geometry: ScanGeometry | None) -> UInt8:
        """Return the class of every reading of a batch, in its order; `geometry` for scans.

        Returns
        -------
        (n,) for returns, (n · readings,) profile by profile for scans, of ``READING_CLASSES``; passes and centre
        lines are ignored.
        """
        classes = np.zeros(_readings(batch, geometry), np.uint8)
        self._filtered(batch, geometry, EVERYWHERE, classes)
        return classes

    def _work(self, batch: pa.RecordBatch, geometry: ScanGeometry | None, window: Window, marked: bool) -> _Work:
        if not marked:
            return self._filtered(batch, geometry, window)
        classes = np.zeros(_readings(batch, geometry), np.uint8)
        limited = self._filtered(batch, geometry, window, classes)
        every = self._place(batch, geometry, window, limited=False)
        return replace(every, fates=limited.fates, classes=classes)

    def _filtered(
        self, batch: pa.RecordBatch, geometry: ScanGeometry | None, window: Window, classes: UInt8 | None = None
    ) -> _Work:
        """Georeference the readings that pass all filters, and write the classes of all where requested."""
        if self.road is None or geometry is None:
            return self._place(batch, geometry, window, classes)
        road = self.road.profiles(_numpy(batch, "epoch_gps_ns"), _lists(batch, "range", geometry.readings), geometry)
        work = self._place(batch, geometry, window, classes, road)
        road.tell(work.fates)
        if classes is not None:
            road.mark(classes)
        return work

    def _place(
        self,
        batch: pa.RecordBatch,
        geometry: ScanGeometry | None,
        window: Window,
        classes: UInt8 | None = None,
        road: RoadProfiles | None = None,
        *,
        limited: bool = True,
    ) -> _Work:
        work = _Work.of(_readings(batch, geometry))
        epochs = _numpy(batch, "pose_epoch_gps_ns" if geometry is None else "epoch_gps_ns")
        wanted = kernels.Window(self.tile_quanta, astuple(window))
        made = 0
        for rows, mounting in self.mountings.pieces(epochs):
            georeference = self.georeference(mounting, limited=limited)
            piece = batch.slice(rows.start, rows.stop - rows.start)
            if geometry is None:
                out = work.points(made, classes, rows)
                x, y, z = (_numpy(piece, f"{a}_sensor_m") for a in "xyz")
                count = georeference_returns(Returns(epochs[rows], x, y, z), georeference, wanted, out)
            else:
                out = work.points(made, classes, slice(rows.start * geometry.readings, rows.stop * geometry.readings))
                ranges = _lists(piece, "range", geometry.readings) if road is None else read_only(road.ranges[rows])
                flat = flat_profiles(geometry, self.range_min_m, self.range_max_m)
                if flat is None:
                    profiles = mirror_profiles(geometry, epochs[rows], ranges)
                    count = georeference_mirror(profiles, georeference, wanted, out)
                else:
                    flat = flat if limited else flat._replace(raw_limits=EVERY_RAW_RANGE)
                    count = georeference_flat_profiles(epochs[rows], ranges, flat, georeference, wanted, out)
            out.rows[:count] += rows.start
            made += count
        return work.first(made)


def mirror_profiles(geometry: ScanGeometry, epochs_gps_ns: Int64, ranges: npt.NDArray[np.uint16]) -> MirrorProfiles:
    """Return profiles (n,) of a rotating mirror in the form that kernels take; ranges: (n, m) raw."""
    scale = geometry.range_offset_m, geometry.range_step_m
    epochs, raw = read_only(epochs_gps_ns), read_only(ranges)
    return MirrorProfiles(epochs, raw, *geometry.rays(), scale, geometry.reading_period_ns)


@dataclass(frozen=True)
class _Work:
    """Output arrays of the kernels."""

    rows: Int32
    readings: Int32
    tiles: Int32
    quanta: Int32
    fates: Int64
    classes: UInt8 | None = None
    """Classes of all readings, kept or not, where requested."""

    @classmethod
    def of(cls, n: int) -> _Work:
        return cls(
            np.empty(n, np.int32), np.empty(n, np.int32), np.empty((n, 2), np.int32), np.empty((n, 3), np.int32),
            np.zeros(COUNTED_FATES, np.int64),
        )  # fmt: skip

    def points(self, made: int, classes: UInt8 | None, readings: slice) -> Points:
        """Return the output for points after the first `made`, and for the classes of some readings where requested."""
        own = _NO_CLASSES if classes is None else classes[readings]
        return Points(
            self.rows[made:], self.readings[made:], self.tiles[made:], self.quanta[made:], self.fates, own
        )  # fmt: skip

    def first(self, n: int) -> _Work:
        return _Work(self.rows[:n], self.readings[:n], self.tiles[:n], self.quanta[:n], self.fates)


def _readings(batch: pa.RecordBatch, geometry: ScanGeometry | None) -> int:
    return int(batch.num_rows * (1 if geometry is None else geometry.readings))


def place_cloud(
    batch: pa.RecordBatch,
    cloud: CloudFrame,
    frame: MapFrame,
    heights: HeightLimits,
    tile_quanta: int,
    window: Window,
    *,
    marked: bool = False,
) -> Georeferenced:
    """Convert rows of the table ``cloud``, whose points are already georeferenced.

    Of the filters only the absolute heights hold for them. `marked`: those too that these leave out, with their
    classes.
    """
    enh = cloud.to_map(np.stack([_numpy(batch, f"{a}_m") for a in "xyz"], axis=-1), frame)
    whole = np.floor(enh * QUANTA_PER_M + 0.5).astype(np.int64)
    tiles = whole[:, :2] // tile_quanta
    classes = heights.classes(enh[:, 2])
    high = classes == KEPT
    wanted = (
        (tiles[:, 0] >= window.first_column) & (tiles[:, 0] < window.end_column)
        & (tiles[:, 1] >= window.first_row) & (tiles[:, 1] < window.end_row)
    )  # fmt: skip
    keep = wanted & (high if not marked else HeightLimits().classes(enh[:, 2]) == KEPT)
    quanta = np.column_stack([whole[:, :2] - tiles * tile_quanta, whole[:, 2]])[keep].astype(np.int32)
    fates = np.array([(high & wanted).sum(), 0, 0, (~high).sum(), (high & ~wanted).sum(), 0], dtype=np.int64)
    return Georeferenced(
        tiles[keep].astype(np.int32),
        quanta,
        _numpy(batch, "epoch_gps_ns")[keep],
        _numpy(batch, "intensity")[keep],
        _numpy(batch, "classification")[keep],
        fates,
        classes[keep] if marked else None,
        {c: _numpy(batch, c)[keep] for c in EXTRA_COLUMNS if batch.column(c).null_count == 0},
    )


def cloud_classes(batch: pa.RecordBatch, cloud: CloudFrame, frame: MapFrame, heights: HeightLimits) -> UInt8:
    """Return the class (n,) of rows of the table ``cloud``, by their heights."""
    return heights.classes(cloud.to_map(np.stack([_numpy(batch, f"{a}_m") for a in "xyz"], axis=-1), frame)[:, 2])


@dataclass(frozen=True)
class CloudFrame:
    """The coordinate system of a vendor's cloud."""

    crs: str
    height: str
    geoid: Geoid | None = None
    """Grid that orthometric heights refer to; None for the map's grid, where that has the same kind of heights."""
    vertical: str | None = None
    """Vertical CRS that the file names, where PROJ knows it."""

    def check(self, frame: MapFrame) -> None:
        """Raise :class:`CrsError` where the cloud's heights cannot be converted into those of the map."""
        if self.crs != "local" and not frame.is_local:
            self.to_map(np.zeros((0, 3)), frame)

    def to_map(self, xyz_m: Float64, frame: MapFrame) -> Float64:
        """Return easting, northing, height (n, 3) in the survey's map, metres."""
        if self.is_in(frame):
            return xyz_m
        if self.is_by_proj(frame):
            return self._by_proj(xyz_m, frame)
        if self.height == "orthometric" and self.geoid is None:
            raise CrsError(
                f"the cloud has orthometric heights in {self.crs}, the map {frame.height} heights in {frame.crs}",
                expected="the geoid that the cloud's heights were made with",
                change="name it as geoid of the log, or choose the cloud's own CRS and height for the map",
            )
        own = MapFrame(
            crs=self.crs,
            height="orthometric" if self.height == "orthometric" else "ellipsoidal",
            geoid=self.geoid if self.height == "orthometric" else None,
        )
        world = world_frame_of(self.crs)
        return frame.map_from_world(world, own.world_from_map(world, xyz_m))

    def is_in(self, frame: MapFrame) -> bool:
        """Return whether the coordinates are those of the map, heights included."""
        same_height = self.height == frame.height and not self._other_geoid(frame) and not self._other_datum(frame)
        return (self.crs == frame.crs or (self.crs == "local" and frame.is_local)) and same_height

    def is_by_proj(self, frame: MapFrame) -> bool:
        """Return whether PROJ's operation between two vertical CRS converts the coordinates, and no geoid does."""
        return self._other_datum(frame) and (self.geoid is None or frame.geoid is None)

    def _other_datum(self, frame: MapFrame) -> bool:
        """Return whether both name a vertical CRS, with different datums."""
        if self.vertical is None or frame.vertical_crs is None or self.height != frame.height:
            return False
        theirs = vertical_of(crs_from_text(frame.vertical_crs))
        return theirs is not None and not one_vertical_datum(self.vertical, theirs)

    def _by_proj(self, xyz_m: Float64, frame: MapFrame) -> Float64:
        """Convert coordinates (n, 3) to the map by PROJ's operation between the two vertical CRS."""
        vertical = crs_from_text(str(self.vertical))
        own_m = float(crs_from_text(self.crs).axis_info[0].unit_conversion_factor)
        units = np.array([own_m, own_m, float(vertical.axis_info[-1].unit_conversion_factor)])
        theirs = np.array([frame.horizontal_unit_m] * 2 + [frame.vertical_unit_m])
        operation = height_operation(self.crs, str(self.vertical), frame)
        out: Float64 = np.stack(operation.transform(*(xyz_m / units).T), axis=-1) * theirs
        if not np.isfinite(out).all():
            raise CrsError(
                f"the change from {vertical.name} to {frame.vertical_crs} does not cover all points of the cloud",
                expected="grids of the survey's region",
                change="name the geoid grids of both: geoid of the log and map.geoid",
            )
        return out

    def _other_geoid(self, frame: MapFrame) -> bool:
        """Return whether the heights refer to a grid with other content than the map's."""
        if self.height != "orthometric" or self.geoid is None or frame.geoid is None:
            return False
        return self.geoid.content != frame.geoid.content


def passes_of(epochs_gps_ns: Int64, passes: Sequence[LanePass]) -> npt.NDArray[np.uint16]:
    """Return the pass of each epoch, (n,), 0 where none: `passes` are those of one run."""
    ids = np.array(sorted(one.pass_id for one in passes), dtype=np.uint16)
    return np.append(ids, np.uint16(0))[pass_numbers(epochs_gps_ns, passes, ids)]


def pass_numbers(
    epochs_gps_ns: Int64, passes: Sequence[LanePass], ids: npt.NDArray[np.uint16]
) -> npt.NDArray[np.int32]:
    """Return the index (n,) of each epoch's pass in the ascending `ids` (p,), −1 where none; as :func:`passes_of`."""
    if epochs_gps_ns.size and len(passes) == 1:
        low, high, only = epochs_gps_ns.min(), epochs_gps_ns.max(), passes[0]
        if only.start_gps_ns <= low and high < only.end_gps_ns:
            return np.full(epochs_gps_ns.size, np.searchsorted(ids, only.pass_id), dtype=np.int32)
    out = np.full(epochs_gps_ns.size, -1, dtype=np.int32)
    in_order = bool((epochs_gps_ns[1:] >= epochs_gps_ns[:-1]).all())
    for one in passes:
        number = int(np.searchsorted(ids, one.pass_id))
        if in_order:
            first, end = np.searchsorted(epochs_gps_ns, (one.start_gps_ns, one.end_gps_ns))
            out[first:end] = number
        else:
            out[(epochs_gps_ns >= one.start_gps_ns) & (epochs_gps_ns < one.end_gps_ns)] = number
    return out


def _numpy(batch: pa.RecordBatch, column: str) -> npt.NDArray[Any]:
    values: npt.NDArray[Any] = batch.column(column).to_numpy(zero_copy_only=False)
    return values


def _lists(batch: pa.RecordBatch, column: str, size: int) -> npt.NDArray[Any]:
    """Return a (n, size) view of a fixed-size list column."""
    flat: npt.NDArray[Any] = batch.column(column).flatten().to_numpy(zero_copy_only=False)
    return flat.reshape(batch.num_rows, size)
