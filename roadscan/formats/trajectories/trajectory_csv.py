"""Trajectories as text with named columns and units."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from roadscan.formats.trajectories.level_poses import (
    ATTITUDE,
    GEODETIC,
    GRID,
    LOCAL,
    Records,
    level_poses,
    pose_quantities,
)
from roadscan.ingest.reading.columns import ColumnOption, Found, Quantity, find_columns, fits
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.poses import North, Placement, PoseReader, level_placement
from roadscan.ingest.reading.records import Sieve, options_of
from roadscan.ingest.reading.stamps import TIME, StampColumn
from roadscan.ingest.reading.text_table import (
    Kind,
    TextLayout,
    TextOptions,
    sniff_layout,
    text_blocks,
    text_layout,
)


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
class _Plan:
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
        plan = _plan(source)
        columns = {quantity: found.column for quantity, found in plan.columns.items()}
        return LogHeader({"world_frame": plan.placement.world, "columns": columns})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a line that cannot be read is rejected."""
        plan = _plan(source)
        reader = PoseReader(source, plan.stamps.clock, plan.placement)
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            records = Records(block.records, block.offsets, plan.stamps.stamps(block, sieve))
            yield from reader.items(level_poses(records, plan.crs, plan.columns, block.number, sieve), sieve)


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, TrajectoryCsvOptions)
    placement = level_placement(source, options.heading)
    crs = source.need_crs()
    layout = text_layout(source.path, options)
    plain = {TIME.name: 1.0}  # the clock states its unit, or it is text
    columns = find_columns((TIME, *pose_quantities(crs)), layout.names, options.columns, source.path, plain)
    stamps = StampColumn.of(source, source.path, layout, columns["time"])
    kinds: dict[str, Kind] = {found.column: "number" for found in columns.values()}
    kinds |= stamps.kinds
    return _Plan(layout, columns, crs, kinds, stamps, placement)
