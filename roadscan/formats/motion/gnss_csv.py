"""GNSS positions as text with named columns and units."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, Literal, get_args

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.crs import crs_from_text
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.formats.trajectories.trajectory_table import GEODETIC, GRID, LOCAL, SIGMAS, position_of
from roadscan.ingest.reading.columns import UNITS, ColumnOption, Found, Quantity, find_columns, fits, word_of
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import QUALITIES, UNKNOWN_QUALITY, GnssReader, RawSolutions, StatedQuality
from roadscan.ingest.reading.poses import Placement, level_placement
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of
from roadscan.ingest.reading.stamps import TIME, StampColumn
from roadscan.ingest.reading.text_table import (
    Kind,
    TextBlock,
    TextLayout,
    TextOptions,
    sniff_layout,
    text_blocks,
    text_layout,
)

_QUALITY: Final = Quantity("quality", "text", ("fix", "solution", "solution_status", "fix_type"), optional=True)
_COUNTS: Final = (
    Quantity("satellites", "count", ("sats", "num_sats", "satellites_used"), optional=True),
    Quantity("hdop", "count", optional=True),
)
_WORDS: Final = {name: name for name in QUALITIES} | {
    "fix": "fixed", "rtk fix": "fixed", "rtk fixed": "fixed", "rtk_fixed": "fixed", "rtk float": "float",
    "rtk_float": "float", "autonomous": "single", "spp": "single", "differential": "dgps", "no fix": "none",
}  # fmt: skip
"""Quality by the words of receivers' programs, lower case."""
_NOT_GNSS: Final = ("roll", "pitch", "yaw", "qw", "q_w", "r11", "angular", "gyro", "name", "point", "id")
"""Words of names that other formats read: attitudes, IMUs, control points."""
_PLAIN: Final = ("time", "longitude", "latitude", "easting", "northing", "height")


class GnssCsvOptions(TextOptions):
    """Settings of `gnss_csv`."""

    columns: dict[str, ColumnOption] = {}
    """Which column holds which quantity, where its name does not say so: time; longitude, latitude, height, or easting,
    northing, height; quality, satellites, hdop; sigma_north, sigma_east, sigma_down.
    For example { latitude = { name = "Lat", unit = "deg" } }."""
    height_unit: Literal["m", "ft", "ft_us"] | None = None
    """Unit of heights where neither the column's name nor the CRS says it (ft_us: US survey foot)."""
    quality: StatedQuality | None = None
    """Kind of the solutions, where no column says it: "single" for phones and portable receivers, "fixed" for RTK."""


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    layout: TextLayout
    columns: dict[str, Found]
    kinds: dict[str, Kind]
    stamps: StampColumn
    placement: Placement
    position: tuple[str, ...]
    quality: str


class GnssCsv(LogFormat):
    """A line a position: time, longitude and latitude or easting and northing, height; quality and σ where present.

    Columns are found by names that carry the unit (``latitude_deg``, ``Height (m)``); those called just latitude,
    longitude, easting or northing are in the unit of the stated CRS. Time is a number in the stated clock's unit, or
    ISO 8601 text, or a date and a time of day. A column quality has words such as fixed, float, single; without one,
    `options.quality` states the kind of all. A table with roll, pitch and heading is a trajectory (`trajectory_csv`).
    """

    name = "gnss_csv"
    title = "GNSS positions as CSV: time, position, quality and σ in named columns with units"
    yields = ("gnss",)
    column_sets: ClassVar[tuple[tuple[Quantity, ...], ...]] = tuple((TIME, *p) for p in (GEODETIC, GRID))
    time = (
        "numbers: state clock.system and clock.unit; ISO 8601 text with a zone (…Z) is UTC, "
        "without one state unix_utc, unix_gps or unix_tai, the scale it is written in"
    )
    options = GnssCsvOptions

    def sniff(self, path: Path) -> bool:
        """True if there are times and positions, and neither attitude nor names of points."""
        layout = sniff_layout(path)
        if layout is None:
            return False
        words = [word_of(name) for name in layout.names]
        if any(other in word if len(other) > 2 else other == word for word in words for other in _NOT_GNSS):
            return False
        return any(fits((TIME, *position), layout.names, _PLAIN) for position in (GEODETIC, GRID))

    def header(self, source: LogSource) -> LogHeader:
        """Find the columns and check clock, CRS and the kind of the solutions."""
        plan = _plan(source)
        columns = {quantity: found.column for quantity, found in plan.columns.items()}
        return LogHeader({"world_frame": plan.placement.world, "columns": columns})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream positions; a line that cannot be read is rejected."""
        plan = _plan(source)
        reader = GnssReader(source, plan.placement)
        epochs = EpochReader(plan.stamps.clock, source.path)
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            stamps = epochs.epochs(plan.stamps.stamps(block, sieve), sieve, block.records)
            yield from reader.items(_solutions(block, plan, stamps, sieve), sieve)


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, GnssCsvOptions)
    crs = source.need_crs()
    is_grid = crs != "local" and crs_from_text(crs).is_projected
    placement = level_placement(source, "grid" if is_grid else None)  # the attitude of positions is none
    layout = text_layout(source.path, options)
    position = LOCAL if crs == "local" else position_of(crs)
    units = {TIME.name: 1.0}  # the clock states its unit, or it is text
    if crs != "local":
        axes = [float(axis.unit_conversion_factor) for axis in crs_from_text(crs).axis_info]
        units |= dict(zip([q.name for q in position], [axes[0], axes[0], *axes[2:]], strict=False))
    if options.height_unit is not None:
        units["height"] = UNITS["length"][options.height_unit]
    quantities = (TIME, *position, _QUALITY, *_COUNTS, *SIGMAS)
    height = [position[2]]
    is_plain = not fits(height, layout.names) and fits(height, layout.names, _PLAIN)
    if is_plain and "height" not in {**units, **options.columns}:
        raise FormatError(
            "neither the name of the heights' column nor the CRS says their unit",
            file=source.path,
            missing=Missing("options.height_unit", choices=("m", "ft", "ft_us")),
        )
    columns = find_columns(quantities, layout.names, options.columns, source.path, units)
    if "quality" not in columns and options.quality is None:
        raise ConfigError(
            "no column says what kind of solution the positions are",
            expected='options.quality: "single" for phones and portable receivers, "fixed" for RTK',
            file=source.path,
            missing=Missing("options.quality", choices=get_args(StatedQuality)),
        )
    stamps = StampColumn.of(source, source.path, layout, columns["time"])
    kinds: dict[str, Kind] = {
        found.column: "text" if name == "quality" else "number" for name, found in columns.items()
    }
    kinds |= stamps.kinds
    return _Plan(layout, columns, kinds, stamps, placement, tuple(q.name for q in position), options.quality or "")


def _solutions(block: TextBlock, plan: _Plan, epochs: npt.NDArray[np.int64], sieve: Sieve) -> RawSolutions:
    def quantity(name: str) -> Float64:
        found = plan.columns[name]
        with np.errstate(over="ignore"):
            return block.number(found.column) * found.scale

    if "quality" in plan.columns:
        codes = {word: QUALITIES.index(name) for word, name in _WORDS.items()}
        words = block.text(plan.columns["quality"].column)
        quality = np.array([codes.get(word.strip().lower(), UNKNOWN_QUALITY) for word in words], dtype=np.int64)
        sieve.drop(quality == UNKNOWN_QUALITY, "the kind of the solution is unknown")
    else:
        quality = np.full(block.records.size, QUALITIES.index(plan.quality), dtype=np.int64)
    columns = {q.name: quantity(q.name) for q in _COUNTS if q.name in plan.columns}
    columns |= {f"{q.name}_m": quantity(q.name) for q in SIGMAS if q.name in plan.columns}
    position = np.stack([quantity(name) for name in plan.position])
    return RawSolutions(block.records, block.offsets, epochs, position, quality, columns)
