"""Readings of a batch become points: pose, mounting, map, filters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.kernels.georeference import FATES, georeference_profiles, georeference_returns
from roadscan.model.crs import Geoid, MapFrame, world_frame_of
from roadscan.model.errors import CrsError
from roadscan.model.ids import LanePass
from roadscan.model.rig import Mounting
from roadscan.navigation.trajectory import Trajectory
from roadscan.points.charts import Charts
from roadscan.points.cloud import QUANTA_PER_M
from roadscan.points.readings import ScanGeometry

Float64 = npt.NDArray[np.float64]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]

EIGHT_TO_SIXTEEN_BITS: Final = 257
"""An 8-bit intensity of 255 becomes 65,535."""

FARTHEST_HEIGHT_M: Final = 21_000.0
"""Heights beyond this are no heights (a vendor's −99,999, say)."""

EXTRA_COLUMNS: Final = (
    "return_number", "number_of_returns", "scan_angle_deg", "flags", "user_data", "point_source_id",
    "red", "green", "blue",
)  # fmt: skip

FATE_NAMES: Final = ("kept", "no_pose", "range", "height", "outside", "no_return", "outside_pass", "centre_line")
"""What can become of a reading; the first six in the kernels' order."""


@dataclass(frozen=True)
class HeightLimits:
    """Unrealistic heights are left out; infinite where not limited."""

    height_min_m: float = -np.inf
    height_max_m: float = np.inf
    above_body_min_m: float = -np.inf
    above_body_max_m: float = np.inf

    def absolute(self) -> tuple[float, float]:
        """Lowest and highest height kept (m), never beyond what 32 bits of 10 µm hold."""
        return max(float(self.height_min_m), -FARTHEST_HEIGHT_M), min(float(self.height_max_m), FARTHEST_HEIGHT_M)


@dataclass(frozen=True)
class Window:
    """Tiles whose points are wanted: columns and rows, end exclusive."""

    first_column: int
    first_row: int
    end_column: int
    end_row: int


EVERYWHERE: Final = Window(-(2**30), -(2**30), 2**30, 2**30)


@dataclass(frozen=True)
class Placed:
    """Points of one batch of readings, in the order of the batch."""

    tiles: Int32
    """(n, 2) column and row."""
    quanta: Int32
    """(n, 3) x and y from the tile's south-west corner, height; 10 µm."""
    epoch_gps_ns: Int64
    intensity: npt.NDArray[np.uint16]
    classification: npt.NDArray[np.uint8]
    fates: Int64
    """(6,) counts of readings by fate."""
    extra: dict[str, npt.NDArray[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Placement:
    """How the readings of one sensor in one run become points."""

    trajectory: Trajectory
    charts: Charts
    mounting: Mounting
    range_min_m: float
    range_max_m: float
    heights: HeightLimits
    tile_quanta: int

    def _common(self) -> tuple[Any, ...]:
        rotation, lever = self.mounting.arrays()
        coefficients, valid = self.trajectory.intervals
        return (
            (*rotation.ravel().tolist(), *lever.tolist()), self.trajectory.epochs_gps_ns, coefficients, valid,
            tuple(self.charts.lattice.tolist()), self.charts.table, self.charts.centres, self.charts.coefficients,
            self._limits(), float(QUANTA_PER_M), self.tile_quanta,
        )  # fmt: skip

    def _limits(self) -> tuple[float, ...]:
        h = self.heights
        return (
            float(self.range_min_m), float(self.range_max_m), *h.absolute(),
            float(h.above_body_min_m), float(h.above_body_max_m),
        )  # fmt: skip

    def returns(self, batch: pa.RecordBatch, window: Window) -> Placed:
        """Place rows of the table ``returns``."""
        work = self._place_returns(batch, window)
        kept = work.rows
        return Placed(
            work.tiles,
            work.quanta,
            _numpy(batch, "epoch_gps_ns")[kept],
            _numpy(batch, "intensity")[kept],
            np.ones(kept.size, np.uint8),
            work.fates,
        )

    def profiles(self, batch: pa.RecordBatch, geometry: ScanGeometry, window: Window) -> Placed:
        """Place rows of the table ``scans``."""
        work = self._place_profiles(batch, geometry, window)
        row, reading = work.rows, work.readings
        epoch = _numpy(batch, "epoch_gps_ns")[row]
        if geometry.reading_period_ns:
            epoch = epoch + np.floor(reading * geometry.reading_period_ns + 0.5).astype(np.int64)
        intensity = np.zeros(row.size, np.uint16)
        if batch.column("intensity").null_count == 0:
            digital = _lists(batch, "intensity", geometry.readings)[row, reading]
            intensity = digital.astype(np.uint16) * EIGHT_TO_SIXTEEN_BITS
        # Copies: the working arrays are far larger where a window keeps little.
        return Placed(work.tiles.copy(), work.quanta.copy(), epoch, intensity, np.ones(row.size, np.uint8), work.fates)

    def touched(self, batch: pa.RecordBatch, geometry: ScanGeometry | None) -> tuple[Int32, Int64]:
        """Tiles (n, 2) of all points of a batch, and the fates of its readings; `geometry` for scans."""
        if geometry is None:
            work = self._place_returns(batch, EVERYWHERE)
        else:
            work = self._place_profiles(batch, geometry, EVERYWHERE)
        return work.tiles, work.fates

    def _place_returns(self, batch: pa.RecordBatch, window: Window) -> _Work:
        n = batch.num_rows
        xyz = np.stack([_numpy(batch, f"{a}_sensor_m") for a in "xyz"], axis=-1)
        work = _Work.of(n)
        made = georeference_returns(
            _numpy(batch, "pose_epoch_gps_ns"), xyz, *self._common(), astuple(window),
            work.rows, work.tiles, work.quanta, work.fates,
        )  # fmt: skip
        return work.first(made)

    def _place_profiles(self, batch: pa.RecordBatch, geometry: ScanGeometry, window: Window) -> _Work:
        origins, directions = geometry.rays()
        work = _Work.of(batch.num_rows * geometry.readings)
        made = georeference_profiles(
            _numpy(batch, "epoch_gps_ns"), _lists(batch, "range", geometry.readings), origins, directions,
            (geometry.range_offset_m, geometry.range_step_m), geometry.reading_period_ns,
            *self._common(), astuple(window), work.rows, work.readings, work.tiles, work.quanta, work.fates,
        )  # fmt: skip
        return work.first(made)


@dataclass(frozen=True)
class _Work:
    """The kernels' output arrays."""

    rows: Int32
    readings: Int32
    tiles: Int32
    quanta: Int32
    fates: Int64

    @classmethod
    def of(cls, n: int) -> _Work:
        return cls(
            np.empty(n, np.int32), np.empty(n, np.int32), np.empty((n, 2), np.int32), np.empty((n, 3), np.int32),
            np.zeros(FATES, np.int64),
        )  # fmt: skip

    def first(self, n: int) -> _Work:
        return _Work(self.rows[:n], self.readings[:n], self.tiles[:n], self.quanta[:n], self.fates)


def place_cloud(
    batch: pa.RecordBatch, cloud: CloudFrame, frame: MapFrame, heights: HeightLimits, tile_quanta: int, window: Window
) -> Placed:
    """Place rows of the table ``cloud``: points that are already georeferenced."""
    enh = cloud.to_map(np.stack([_numpy(batch, f"{a}_m") for a in "xyz"], axis=-1), frame)
    whole = np.floor(enh * QUANTA_PER_M + 0.5).astype(np.int64)
    tiles = whole[:, :2] // tile_quanta
    lowest, highest = heights.absolute()
    high = (enh[:, 2] >= lowest) & (enh[:, 2] <= highest)
    wanted = (
        (tiles[:, 0] >= window.first_column) & (tiles[:, 0] < window.end_column)
        & (tiles[:, 1] >= window.first_row) & (tiles[:, 1] < window.end_row)
    )  # fmt: skip
    keep = high & wanted
    quanta = np.column_stack([whole[:, :2] - tiles * tile_quanta, whole[:, 2]])[keep].astype(np.int32)
    fates = np.array([keep.sum(), 0, 0, (~high).sum(), (high & ~wanted).sum(), 0], dtype=np.int64)
    return Placed(
        tiles[keep].astype(np.int32),
        quanta,
        _numpy(batch, "epoch_gps_ns")[keep],
        _numpy(batch, "intensity")[keep],
        _numpy(batch, "classification")[keep],
        fates,
        {c: _numpy(batch, c)[keep] for c in EXTRA_COLUMNS if batch.column(c).null_count == 0},
    )


@dataclass(frozen=True)
class CloudFrame:
    """What the coordinates of a vendor's cloud are."""

    crs: str
    height: str
    geoid: str | None = None

    def to_map(self, xyz_m: Float64, frame: MapFrame) -> Float64:
        """Easting, northing, height (n, 3) in the survey's map, metres."""
        same_height = self.height == frame.height
        if (self.crs == frame.crs or (self.crs == "local" and frame.is_local)) and same_height:
            return xyz_m
        if self.height == "orthometric" and self.geoid is None:
            raise CrsError(
                f"the cloud has orthometric heights in {self.crs}, the map {frame.height} heights in {frame.crs}",
                expected="the geoid that the cloud's heights were made with",
                change="name it as geoid of the log, or choose the cloud's own CRS and height for the map",
            )
        own = MapFrame(
            crs=self.crs,
            height="orthometric" if self.height == "orthometric" else "ellipsoidal",
            geoid=Geoid(self.geoid) if self.geoid else None,
        )
        world = world_frame_of(self.crs)
        return frame.map_from_world(world, own.world_from_map(world, xyz_m))


def passes_of(epochs_gps_ns: Int64, passes: Sequence[LanePass]) -> npt.NDArray[np.uint16]:
    """Pass of each epoch, (n,), 0 where none: `passes` are those of one run."""
    out = np.zeros(epochs_gps_ns.size, dtype=np.uint16)
    for one in passes:
        out[(epochs_gps_ns >= one.start_gps_ns) & (epochs_gps_ns < one.end_gps_ns)] = one.pass_id
    return out


def _numpy(batch: pa.RecordBatch, column: str) -> npt.NDArray[Any]:
    values: npt.NDArray[Any] = batch.column(column).to_numpy(zero_copy_only=False)
    return values


def _lists(batch: pa.RecordBatch, column: str, size: int) -> npt.NDArray[Any]:
    """(n, size) view of a fixed-size list column."""
    flat: npt.NDArray[Any] = batch.column(column).flatten().to_numpy(zero_copy_only=False)
    return flat.reshape(batch.num_rows, size)
