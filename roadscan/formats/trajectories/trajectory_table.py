"""Trajectories as Parquet or Arrow IPC (Feather) with the columns of ``trajectory_csv``."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError, CrsError, FormatError
from roadscan.core.strict import Strict
from roadscan.formats.trajectories.level_poses import (
    ATTITUDE,
    GEODETIC,
    GRID,
    LOCAL,
    Records,
    level_poses,
    pose_quantities,
)
from roadscan.ingest.reading.column_table import ColumnTable, Lost, is_number, need_table, open_table
from roadscan.ingest.reading.columns import ColumnOption, Found, find_columns, fits
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.poses import North, Placement, PoseReader, level_placement
from roadscan.ingest.reading.records import Sieve, options_of
from roadscan.ingest.reading.stamps import TIME
from roadscan.ingest.reading.table_stamps import EPOCH, TableStamps, need_type
from roadscan.store.damage import UNREADABLE

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
