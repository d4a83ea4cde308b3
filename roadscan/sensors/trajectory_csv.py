"""Trajectories as text with named columns and units."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.model.crs import LOCAL_WORLD, crs_from_text
from roadscan.model.errors import TimeSystemError
from roadscan.model.gpstime import Clock, TimeSystem
from roadscan.sensors.base import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.sensors.columns import ColumnOption, Found, Quantity, find_columns, fits, need_stamp_unit
from roadscan.sensors.poses import (
    North,
    Placement,
    PoseReader,
    RawPoses,
    check_rph,
    level_placement,
    ned_from_rph,
)
from roadscan.sensors.records import Sieve, options_of
from roadscan.sensors.text_table import (
    Kind,
    TextBlock,
    TextLayout,
    TextOptions,
    first_fields,
    sniff_layout,
    stamp_kind,
    text_blocks,
    text_layout,
)

Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]

TIME: Final = Quantity("time", "time", ("timestamp", "stamp", "gps_time", "utc_time", "unix_time"))
GEODETIC: Final = (
    Quantity("longitude", "angle", ("lon", "lng")),
    Quantity("latitude", "angle", ("lat",)),
    Quantity("height", "length", ("altitude",)),
)
GRID: Final = (
    Quantity("easting", "length"),
    Quantity("northing", "length"),
    Quantity("height", "length", ("altitude",)),
)
LOCAL: Final = (
    Quantity("easting", "length", ("x",)),
    Quantity("northing", "length", ("y",)),
    Quantity("height", "length", ("z", "altitude")),
)
ATTITUDE: Final = (Quantity("roll", "angle"), Quantity("pitch", "angle"), Quantity("heading", "angle"))
SIGMAS: Final = (
    Quantity("sigma_north", "length", ("sigma_northing",), optional=True),
    Quantity("sigma_east", "length", ("sigma_easting",), optional=True),
    Quantity("sigma_down", "length", ("sigma_height", "sigma_up"), optional=True),
)


class TrajectoryCsvOptions(TextOptions):
    """Settings of `trajectory_csv`."""

    columns: dict[str, ColumnOption] = {}
    """Which column holds which quantity, where its name does not say so: time; longitude, latitude,
    height, or easting, northing, height; roll, pitch, heading; sigma_north, sigma_east, sigma_down.
    For example { latitude = { name = "Lat", unit = "deg" } }."""
    heading: North | None = None
    """North that the heading is counted from, clockwise: "true" or "grid". Needed for a projected CRS;
    a geographic CRS has only true north, a local frame only its y axis ("grid")."""


@dataclass(frozen=True)
class _Plan:
    """How one file is read."""

    layout: TextLayout
    columns: dict[str, Found]
    horizontal: tuple[str, str]
    kinds: dict[str, Kind]
    clock: Clock
    placement: Placement
    zoned: bool
    """Calendar times carry a zone."""


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
    time = (
        "numbers: state clock.system and clock.unit; ISO 8601 text with a zone (…Z) is UTC, "
        "without one state unix_utc, unix_gps or unix_tai, the scale it is written in"
    )
    options = TrajectoryCsvOptions

    def sniff(self, path: Path) -> bool:
        """True if all columns of a trajectory are there with units in their names."""
        layout = sniff_layout(path)
        return layout is not None and any(
            fits((TIME, *position, *ATTITUDE), layout.names) for position in (GEODETIC, GRID, LOCAL)
        )

    def header(self, source: LogSource) -> LogHeader:
        """Find the columns and check clock, CRS and heading."""
        plan = _plan(source)
        columns = {quantity: found.column for quantity, found in plan.columns.items()}
        return LogHeader({"world_frame": plan.placement.world, "columns": columns})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a line that cannot be read is rejected."""
        plan = _plan(source)
        reader = PoseReader(source, plan.clock, plan.placement)
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            yield from reader.items(_raw(block, plan, sieve), sieve)


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, TrajectoryCsvOptions)
    placement = level_placement(source, options.heading)
    position = _position_of(source.need_crs())
    layout = text_layout(source.path, options)
    columns = find_columns((TIME, *position, *ATTITUDE, *SIGMAS), layout.names, options.columns, source.path)
    stamp = columns["time"]
    kinds: dict[str, Kind] = {found.column: "number" for found in columns.values()}
    kinds[stamp.column] = stamp_kind(source.path, layout, stamp.column)
    zoned = False
    if kinds[stamp.column] == "text":
        word = _first_word(source.path, layout, stamp.column)
        zoned = _parse_calendar([word], zoned=True) is not None
        clock = _clock_of_text(source, word, zoned=zoned)
    else:
        clock = source.need_clock('{ system = "gps", unit = "s" }')
        need_stamp_unit(stamp, clock, source.path)
    return _Plan(layout, columns, (position[0].name, position[1].name), kinds, clock, placement, zoned)


def _position_of(crs: str) -> tuple[Quantity, ...]:
    if crs == LOCAL_WORLD:
        return LOCAL
    return GRID if crs_from_text(crs).is_projected else GEODETIC


def _raw(block: TextBlock, plan: _Plan, sieve: Sieve) -> RawPoses:
    def quantity(name: str) -> Float64:
        found = plan.columns[name]
        with np.errstate(over="ignore"):
            return block.number(found.column) * found.scale

    roll, pitch, heading = quantity("roll"), quantity("pitch"), quantity("heading")
    check_rph(roll, pitch, heading, sieve)
    with np.errstate(invalid="ignore"):  # infinities of damaged records, dropped above
        attitude = ned_from_rph(roll, pitch, heading)
    stamp = plan.columns["time"].column
    if plan.kinds[stamp] == "text":
        stamps: npt.NDArray[np.generic] = _calendar_ns(block.text(stamp), sieve, zoned=plan.zoned)
    else:
        stamps = block.stamps(stamp)
    return RawPoses(
        records=block.records,
        offsets=block.offsets,
        stamps=stamps,
        position=np.stack([quantity(name) for name in (*plan.horizontal, "height")]),
        attitude=attitude,
        sigma_ned_m={f"{q.name}_m": quantity(q.name) for q in SIGMAS if q.name in plan.columns},
    )


# --- time as text -----------------------------------------------------------------------------------


def _first_word(path: Path, layout: TextLayout, column: str) -> str:
    index = layout.names.index(column)
    words = (fields[index].strip() for fields in first_fields(path, layout, 20))
    return next((word for word in words if word), "")


def _clock_of_text(source: LogSource, word: str, *, zoned: bool) -> Clock:
    """Clock of calendar times, counted in nanoseconds from 1970 on the scale they are written in."""
    clock = source.clock
    if zoned:
        if clock is not None and clock.system is not TimeSystem.UNIX_UTC:
            raise TimeSystemError(
                f"time '{word}' has a zone, so it is UTC, the clock says {clock.system}",
                expected='clock.system = "unix_utc", or no clock',
                file=source.path,
            )
        return replace(clock or Clock(TimeSystem.UNIX_UTC), unit="ns")
    if _parse_calendar([word], zoned=False) is None:
        raise TimeSystemError(
            f"time '{word[:40]}' is neither a number nor ISO 8601 text",
            expected="such as 2026-05-04T09:30:00.125Z",
            file=source.path,
        )
    scales = (TimeSystem.UNIX_UTC, TimeSystem.UNIX_GPS, TimeSystem.UNIX_TAI)
    if clock is None or clock.system not in scales:
        raise TimeSystemError(
            f"time '{word}' has no zone",
            expected="clock.system = unix_utc, unix_gps or unix_tai: the scale it is written in",
            change='add clock = { system = "unix_utc" } if it is UTC',
            file=source.path,
        )
    return replace(clock, unit="ns")


def _calendar_ns(words: list[str], sieve: Sieve, *, zoned: bool) -> Int64:
    """Nanoseconds (n,) from 1970 of ISO 8601 times; a word that is none costs its record."""
    whole = _parse_calendar(words, zoned=zoned)
    if whole is not None:
        return whole
    singles = [_parse_calendar([word], zoned=zoned) for word in words]
    zone = "with" if zoned else "without"
    sieve.drop(np.array([one is None for one in singles]), f"time is not ISO 8601 text {zone} a zone, as the first is")
    return np.array([0 if one is None else one[0] for one in singles], dtype=np.int64)


def _parse_calendar(words: list[str], *, zoned: bool) -> Int64 | None:
    kind = pa.timestamp("ns", "UTC") if zoned else pa.timestamp("ns")
    try:
        return np.asarray(pc.cast(pa.array(words, pa.string()), kind).cast(pa.int64()), dtype=np.int64)
    except pa.ArrowInvalid:
        return None
