"""Trajectories as Parquet or Arrow IPC (Feather) with the columns of ``trajectory_csv``."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError, CrsError, FormatError
from roadscan.core.strict import Strict
from roadscan.ingest.reading.column_table import ColumnTable, Lost, is_number, need_table, open_table
from roadscan.ingest.reading.columns import ColumnOption, Found, Quantity, find_columns, fits
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.poses import (
    North,
    Placement,
    PoseReader,
    RawPoses,
    check_rph,
    level_placement,
    ned_from_rph,
)
from roadscan.ingest.reading.records import Sieve, options_of
from roadscan.ingest.reading.stamps import EPOCH, TIME, StampColumn, TableStamps, need_type
from roadscan.ingest.reading.text_table import Kind, TextLayout, TextOptions, sniff_layout, text_blocks, text_layout
from roadscan.store.digest import UNREADABLE

GEODETIC: Final = (
    Quantity("longitude", "angle", ("lon", "lng")),
    Quantity("latitude", "angle", ("lat",)),
    Quantity("height", "length", ("altitude", "alt", "elevation", "h-ell", "ellipsoidal_height")),
)
GRID: Final = (
    Quantity("easting", "length"),
    Quantity("northing", "length"),
    Quantity("height", "length", ("altitude", "alt", "elevation", "h-ell", "ellipsoidal_height")),
)
LOCAL: Final = (
    Quantity("easting", "length", ("x",)),
    Quantity("northing", "length", ("y",)),
    Quantity("height", "length", ("z", "altitude", "alt")),
)
ATTITUDE: Final = (Quantity("roll", "angle"), Quantity("pitch", "angle"), Quantity("heading", "angle"))
SIGMAS: Final = (
    Quantity("sigma_north", "length", ("sigma_northing",), optional=True),
    Quantity("sigma_east", "length", ("sigma_easting",), optional=True),
    Quantity("sigma_down", "length", ("sigma_height", "sigma_up"), optional=True),
)
ANGLE_SIGMAS: Final = tuple(Quantity(f"sigma_{q.name}", "angle", optional=True) for q in ATTITUDE)


VELOCITIES: Final = (
    Quantity("velocity_north", "speed", ("vn", "v_north"), optional=True),
    Quantity("velocity_east", "speed", ("ve", "v_east"), optional=True),
    Quantity("velocity_down", "speed", ("vd", "v_down"), optional=True),
    Quantity("velocity_up", "speed", ("vu", "v_up"), optional=True),
)


def position_of(crs: str) -> tuple[Quantity, ...]:
    """Return the three quantities of a position in a CRS, two horizontal ones first."""
    if crs == LOCAL_WORLD:
        return LOCAL
    return GRID if crs_from_text(crs).is_projected else GEODETIC


def pose_quantities(crs: str) -> tuple[Quantity, ...]:
    """Return all quantities of a pose in a CRS except its time: position, attitude, their σ, and velocity."""
    return (*position_of(crs), *ATTITUDE, *SIGMAS, *ANGLE_SIGMAS, *VELOCITIES)


@dataclass(frozen=True)
class Records:
    """Places of a block's records in their log."""

    numbers: Int64
    """(n,) record numbers."""
    offsets: Int64
    """(n,) byte offsets, −1 where there are none."""
    stamps: npt.NDArray[np.generic]
    """(n,) time stamps."""


def level_poses(
    records: Records, crs: str, columns: Mapping[str, Found], number: Callable[[str], Float64], sieve: Sieve
) -> RawPoses:
    """Return the poses of a block; a record with an impossible attitude is dropped from `sieve`.

    Parameters
    ----------
    columns : column of each quantity that the log has, by quantity.
    number : gives the values (n,) of a column, NaN where one is missing.
    """

    def quantity(name: str) -> Float64:
        found = columns[name]
        with np.errstate(over="ignore"):
            return number(found.column) * found.scale

    def velocity() -> Float64 | None:
        north, east, down, up = (quantity(q.name) if q.name in columns else None for q in VELOCITIES)
        down = -up if down is None and up is not None else down
        if north is None or east is None:
            return None
        return np.stack([north, east, np.full_like(north, np.nan) if down is None else down])

    roll, pitch, heading = (quantity(q.name) for q in ATTITUDE)
    check_rph(roll, pitch, heading, sieve)
    with np.errstate(invalid="ignore"):  # infinities of damaged records, dropped above
        attitude = ned_from_rph(roll, pitch, heading)
    return RawPoses(
        records=records.numbers,
        offsets=records.offsets,
        stamps=records.stamps,
        position=np.stack([quantity(q.name) for q in position_of(crs)]),
        attitude=attitude,
        sigmas={f"{q.name}_m": quantity(q.name) for q in SIGMAS if q.name in columns}
        | {f"{q.name}_deg": np.degrees(quantity(q.name)) for q in ANGLE_SIGMAS if q.name in columns},
        velocity=velocity(),
    )


FRAME_KEY: Final = "roadscan.trajectory"
"""Key of the schema metadata with the frame of the poses as JSON."""

BATCH_ROWS: Final = 65_536  # rows of a batch


class TrajectoryFrame(Strict):
    """Frame of a file's positions and headings, as its metadata states it."""

    crs: str | None = None
    """CRS of the positions, or "local"."""
    height: Literal["ellipsoidal", "orthometric"] | None = None
    """Kind of the heights."""
    heading: North | None = None
    """North that the heading is counted from."""


class TrajectoryTableOptions(Strict):
    """Settings of `trajectory_table`."""

    columns: dict[str, ColumnOption] = {}
    """Which column holds which quantity, where its name does not say so, as for `trajectory_csv`.
    For example { latitude = { name = "Lat", unit = "deg" } }."""
    heading: North | None = None
    """North that the heading is counted from, clockwise: "true" or "grid". Needed for a projected CRS, where the
    file does not state it."""


class TrajectoryTable(LogFormat):
    """A row a pose: time, position, roll, pitch, heading, in columns whose names carry their units.

    The columns are those of `trajectory_csv`: ``latitude_deg``, ``longitude_deg``, ``height_m`` (or ``easting_m``,
    ``northing_m``), ``roll_deg``, ``pitch_deg``, ``heading_deg`` or the same in ``_rad``, and σ such as
    ``sigma_north_m``; others are ignored. Time is ``epoch_gps_ns`` (int64, GPS nanoseconds since 1980-01-06), or a
    column such as ``time_s`` in the clock that the survey file states; timestamps of Arrow with a zone are UTC.

    The file may state crs, height and heading itself, as JSON in its schema metadata under ``roadscan.trajectory``;
    files that `roadscan.arrays.write_trajectory` wrote do. What the survey file states has to agree with it.
    """

    name = "trajectory_table"
    title = "Trajectory as Parquet or Arrow IPC: the columns of trajectory_csv, also from NumPy and pandas"
    yields = ("trajectory",)
    time = (
        "column epoch_gps_ns is GPS time and needs no clock; numbers in another column: state clock.system and "
        "clock.unit; timestamps with a zone are UTC, without one state unix_utc, unix_gps or unix_tai"
    )
    options = TrajectoryTableOptions

    def sniff(self, path: Path) -> bool:
        """True if all columns of a trajectory are there with units in their names."""
        if not path.is_file():
            return False
        try:
            names = open_table(path).schema.names
        except (*UNREADABLE, FormatError):
            return False
        time = () if EPOCH in names else (TIME,)
        return any(fits((*time, *position, *ATTITUDE), names, (TIME.name,)) for position in (GEODETIC, GRID, LOCAL))

    def header(self, source: LogSource) -> LogHeader:
        """Find the columns and check clock, CRS and heading."""
        plan = _plan(source)
        columns = {quantity: found.column for quantity, found in plan.columns.items()}
        return LogHeader({"world_frame": plan.placement.world, "columns": columns})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a row that is no pose is rejected."""
        plan = _plan(source)
        reader = PoseReader(source, plan.stamps.clock, plan.placement)
        wanted = [plan.stamps.column, *(found.column for found in plan.columns.values())]
        for first, part in plan.table.parts(BATCH_ROWS, wanted):
            if isinstance(part, Lost):
                yield Reject(part.reason, first, records=max(part.records, 1))
                continue
            sieve = Sieve(part.num_rows)
            rows = first + np.arange(part.num_rows, dtype=np.int64)
            records = Records(rows, np.full(part.num_rows, -1, dtype=np.int64), plan.stamps.stamps(part, sieve))
            yield from reader.items(level_poses(records, plan.crs, plan.columns, _Numbers(part), sieve), sieve)


@dataclass(frozen=True)
class _Numbers:
    """Columns of a batch as float64, NaN where a value is missing."""

    batch: pa.RecordBatch

    def __call__(self, column: str) -> npt.NDArray[np.float64]:
        values = self.batch.column(column).cast(pa.float64(), safe=False)
        return np.asarray(values.to_numpy(zero_copy_only=False), dtype=np.float64)


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    table: ColumnTable
    columns: dict[str, Found]
    """Column of each quantity except the time."""
    crs: str
    stamps: TableStamps
    placement: Placement


def _plan(source: LogSource) -> _Plan:
    source.need_file()
    options = options_of(source, TrajectoryTableOptions)
    table = need_table(source.path)
    own = _frame(table.schema, source.path)
    stated = _agreed(source, own)
    crs = stated.need_crs()
    placement = level_placement(stated, _heading(options.heading, own, source.path))
    names = tuple(table.schema.names)
    time = () if EPOCH in names and "time" not in options.columns else (TIME,)
    plain = {TIME.name: 1.0}  # the clock states its unit, or timestamps have their own
    columns = find_columns((*time, *pose_quantities(crs)), names, options.columns, source.path, plain)
    found = columns.pop(TIME.name, None)
    for one in columns.values():
        need_type(table.schema, one.column, is_number(table.schema.field(one.column).type), "numbers", source)
    return _Plan(table, columns, crs, TableStamps.of(source, table.schema, found), placement)


def _frame(schema: pa.Schema, file: Path) -> TrajectoryFrame:
    text = (schema.metadata or {}).get(FRAME_KEY.encode())
    if text is None:
        return TrajectoryFrame()
    try:
        values = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"schema metadata '{FRAME_KEY}' is not JSON: {error}", file=file) from error
    if not isinstance(values, dict):
        raise ConfigError(f"schema metadata '{FRAME_KEY}' is not a JSON object", file=file)
    return TrajectoryFrame.parse(values, file=file)


def _agreed(source: LogSource, own: TrajectoryFrame) -> LogSource:
    """Return the log as file and survey file together state it."""
    if own.crs is not None and source.crs is not None and not _is_same(own.crs, source.crs):
        raise CrsError(
            f"the survey file says the positions are in {source.crs}, the file says {own.crs[:80]}",
            expected="one CRS",
            change="leave crs out of the survey file, or correct the one that is wrong",
            file=source.path,
        )
    height = source.height
    if own.height is not None:
        height = source.need_height(own.height, f"the file's metadata '{FRAME_KEY}'")
    return dataclasses.replace(source, crs=own.crs if source.crs is None else source.crs, height=height)


def _is_same(one: str, other: str) -> bool:
    if LOCAL_WORLD in (one, other):
        return one == other
    return one == other or crs_from_text(one).equals(crs_from_text(other))


def _heading(stated: North | None, own: TrajectoryFrame, file: Path) -> North | None:
    if stated is not None and own.heading is not None and stated != own.heading:
        raise ConfigError(
            f'options.heading = "{stated}", the file says "{own.heading}"', expected="one north", file=file
        )
    return stated or own.heading


class TrajectoryCsvOptions(TextOptions):
    """Settings of `trajectory_csv`."""

    columns: dict[str, ColumnOption] = {}
    """Which column holds which quantity, where its name does not say so: time; longitude, latitude,
    height, or easting, northing, height; roll, pitch, heading; sigma_north, sigma_east, sigma_down;
    sigma_roll, sigma_pitch, sigma_heading; velocity_north, velocity_east, velocity_down or velocity_up.
    For example { latitude = { name = "Lat", unit = "deg" } }."""
    heading: North | None = None
    """North that the heading is counted from, clockwise: "true" or "grid". Needed for a projected CRS;
    a geographic CRS has only true north, a local frame only its y axis ("grid")."""


@dataclass(frozen=True)
class _CsvPlan:
    """How a file is read."""

    layout: TextLayout
    columns: dict[str, Found]
    crs: str
    kinds: dict[str, Kind]
    stamps: StampColumn
    placement: Placement


class TrajectoryCsv(LogFormat):
    """A line a pose: time, position, roll, pitch, heading, in columns whose names carry their units.

    Columns such as ``time_s``, ``latitude_deg``, ``longitude_deg``, ``height_m`` (or ``easting_m``,
    ``northing_m``), ``roll_deg``, ``pitch_deg``, ``heading_deg`` are found by themselves, any others
    through `columns`. Time is a number in the stated clock's unit, or ISO 8601 text. Roll is
    positive with the right side down, pitch with the nose up, heading clockwise from north. Exports
    of a vendor's program with a preamble and blanks between the columns are read with `skip_lines`,
    ``delimiter = " "`` and `columns`.
    """

    name = "trajectory_csv"
    title = "Trajectory as CSV: time, position, roll, pitch and heading in named columns with units"
    yields = ("trajectory",)
    column_sets: ClassVar[tuple[tuple[Quantity, ...], ...]] = tuple(
        (TIME, *position, *ATTITUDE) for position in (GEODETIC, GRID, LOCAL)
    )
    time = (
        "numbers: state clock.system and clock.unit; ISO 8601 text with a zone (…Z) is UTC, "
        "without one state unix_utc, unix_gps or unix_tai, the scale it is written in"
    )
    options = TrajectoryCsvOptions

    def sniff(self, path: Path) -> bool:
        """True if all columns of a trajectory are there with units in their names."""
        layout = sniff_layout(path)
        return layout is not None and any(
            fits((TIME, *position, *ATTITUDE), layout.names, (TIME.name,)) for position in (GEODETIC, GRID, LOCAL)
        )

    def header(self, source: LogSource) -> LogHeader:
        """Find the columns and check clock, CRS and heading."""
        plan = _csv_plan(source)
        columns = {quantity: found.column for quantity, found in plan.columns.items()}
        return LogHeader({"world_frame": plan.placement.world, "columns": columns})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a line that cannot be read is rejected."""
        plan = _csv_plan(source)
        reader = PoseReader(source, plan.stamps.clock, plan.placement)
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            records = Records(block.records, block.offsets, plan.stamps.stamps(block, sieve))
            yield from reader.items(level_poses(records, plan.crs, plan.columns, block.number, sieve), sieve)


def _csv_plan(source: LogSource) -> _CsvPlan:
    options = options_of(source, TrajectoryCsvOptions)
    placement = level_placement(source, options.heading)
    crs = source.need_crs()
    layout = text_layout(source.path, options)
    plain = {TIME.name: 1.0}  # the clock states its unit, or it is text
    columns = find_columns((TIME, *pose_quantities(crs)), layout.names, options.columns, source.path, plain)
    stamps = StampColumn.of(source, source.path, layout, columns["time"])
    kinds: dict[str, Kind] = {found.column: "number" for found in columns.values()}
    kinds |= stamps.kinds
    return _CsvPlan(layout, columns, crs, kinds, stamps, placement)
