"""Control points as text with named columns and units."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, Literal

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.crs import crs_from_text
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.formats.vectors.control import ControlFrame, ControlReader, RawControl, Role, need_role
from roadscan.ingest.reading.columns import (
    UNITS,
    ColumnOption,
    Found,
    Quantity,
    degrees_of,
    find_columns,
    fits,
    is_sexagesimal,
)
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.records import GRID_MAX_M, HEIGHT_MAX_M, HEIGHT_MIN_M, options_of
from roadscan.ingest.reading.text_table import (
    Kind,
    TextBlock,
    TextLayout,
    TextOptions,
    first_fields,
    sniff_layout,
    text_blocks,
    text_layout,
)

NAME: Final = Quantity(
    "name", "text",
    ("point", "id", "point_id", "punkt", "punktnummer", "point_name", "point_no", "pt", "pkt", "nr", "punto",
     "matricule"),
)  # fmt: skip
WORDS: Final = (
    Quantity("code", "text", ("description", "desc", "bemerkung"), optional=True),
    Quantity("role", "text", optional=True),
)  # fmt: skip
_EASTING: Final = Quantity("easting", "length", ("rechtswert", "ostwert", "east", "este", "est", "e", "grid_easting"))
_NORTHING: Final = Quantity(
    "northing", "length", ("hochwert", "nordwert", "north", "norte", "nord", "n", "grid_northing")
)
GEODETIC: Final = (Quantity("longitude", "angle", ("lon", "lng")), Quantity("latitude", "angle", ("lat",)))
GRID: Final = (_EASTING, _NORTHING)
LOCAL: Final = (
    Quantity("easting", "length", ("x", *_EASTING.also)), Quantity("northing", "length", ("y", *_NORTHING.also)),
)  # fmt: skip
HEIGHT: Final = Quantity(
    "height",
    "length",
    ("altitude", "elevation", "höhe", "hoehe", "elev", "alt", "cota", "z", "h"),
)
SIGMAS: Final = (
    Quantity("sigma_horizontal", "length", optional=True),
    Quantity("sigma_height", "length", ("sigma_vertical",), optional=True),
)
PNEZD: Final = ["point", "northing", "easting", "elevation_m", "description"]
PENZD: Final = ["point", "easting", "northing", "elevation_m", "description"]
"""Customary columns of surveyors' files without a line of names. The unit of heights is a proposal for the user."""
_EASTINGS_M: Final = (1e5, 1e6)
"""Eastings of UTM and most national grids; northings are outside, beyond 9 km from the equator."""
_LEAST_GRID_M: Final = 1e3  # smaller numbers are no grid coordinates
_NOT_CONTROL: Final = ("roll", "pitch", "heading", "qw", "r11", "gpstime", "timestamp")


class ControlCsvOptions(TextOptions):
    """Settings of `control_csv`."""

    later: ClassVar[frozenset[str]] = TextOptions.later | {"height_unit"}

    columns: dict[str, ColumnOption] = {}
    """Which column holds which quantity, where its name does not say so: name, code, role; longitude,
    latitude, or easting, northing; height; sigma_horizontal, sigma_height.
    For example { height = { name = "H", unit = "m" } }."""
    role: Role | None = None
    """Role of all points ("gcp" or "check") where the file has no column for it."""
    height_unit: Literal["m", "ft", "ft_us"] | None = None
    """Unit of heights where neither the column's name nor the CRS says it (ft_us: US survey foot)."""


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    layout: TextLayout
    columns: dict[str, Found]
    frame: ControlFrame
    role: str
    sexagesimal: frozenset[str]
    """Those of longitude and latitude that stand in degrees, minutes and seconds."""


class ControlCsv(LogFormat):
    """A line a point: name, code, role, longitude and latitude or easting and northing, height, σ.

    Columns are found by names that carry the unit (``easting_m``, ``height_m``, ``latitude_deg``).
    Columns called just easting, northing, longitude or latitude are in the unit of the stated CRS;
    so is a height, where the CRS has a height axis or is a local frame. Longitude and latitude may also stand in
    degrees, minutes and seconds (52°31'09.37"N, 52 31 09.37). The words of surveyors are known, too:
    point, elevation and description; Punkt, Rechtswert, Hochwert and Höhe. Where no line names the columns (PNEZD:
    point, northing, easting, elevation, description), options.names states their order.
    """

    name = "control_csv"
    title = "Ground control and check points as CSV (name, code, role, position, height, σ)"
    yields = ("control_points",)
    column_sets: ClassVar[tuple[tuple[Quantity, ...], ...]] = ((NAME, *GEODETIC, HEIGHT), (NAME, *GRID, HEIGHT))
    time = "holds no time"
    options = ControlCsvOptions

    def sniff(self, path: Path) -> bool:
        """True if there are names and positions, and neither attitude nor time."""
        layout = sniff_layout(path)
        if layout is not None and _nameless(layout.names) is not None:
            return True
        if layout is None or any(stem in name.lower() for name in layout.names for stem in _NOT_CONTROL):
            return False
        plain = ("longitude", "latitude", "easting", "northing", "height")
        return any(fits((NAME, *position, HEIGHT), layout.names, plain) for position in (GEODETIC, GRID))

    def header(self, source: LogSource) -> LogHeader:
        """Find the columns and check CRS, heights and roles."""
        plan = _plan(source)
        columns = {quantity: found.column for quantity, found in plan.columns.items()}
        return LogHeader({"crs": plan.frame.crs, "height": plan.frame.height, "columns": columns})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream points; a line without a name, position or height is rejected."""
        plan = _plan(source)
        reader = ControlReader(plan.frame)
        words = {"name", "code", "role", *plan.sexagesimal}
        kinds: dict[str, Kind] = {
            found.column: "text" if quantity in words else "number" for quantity, found in plan.columns.items()
        }
        for block in text_blocks(source.path, plan.layout, kinds):
            if isinstance(block, Reject):
                yield block
                continue
            yield from reader.items(_raw(block, plan))
        yield from reader.findings()


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, ControlCsvOptions)
    frame = ControlFrame.of(source)
    position = {"local": (*LOCAL, HEIGHT), "projected": (*GRID, HEIGHT), "geographic": (*GEODETIC, HEIGHT)}
    layout = text_layout(source.path, options)
    if options.names is None and (proposed := _nameless(layout.names)) is not None:
        orders = [order[: len(layout.names)] for order in (PNEZD, PENZD)]
        raise FormatError(
            f"no line names the columns; the first is {', '.join(layout.names)}",
            expected="point, northing, easting, elevation and description, or easting first",
            change="state the order, and the unit of heights (elevation_m or elevation_ft), in options.names",
            file=source.path,
            missing=Missing("options.names", proposed or None, tuple(orders)),
        )
    quantities, units = (NAME, *WORDS, *position[frame.kind], *SIGMAS), units_of(frame)
    stated = None if options.height_unit is None else UNITS["length"][options.height_unit]
    if stated is not None and units.setdefault("height", stated) != stated:
        raise _other_unit(options.height_unit, f"the CRS '{frame.crs}'", source.path)
    height = position[frame.kind][2]
    is_plain = not fits([height], layout.names) and fits([height], layout.names, (height.name,))
    if is_plain and "height" not in units and "height" not in options.columns:
        raise FormatError(
            "neither the name of the heights' column nor the CRS says their unit",
            file=source.path,
            missing=Missing("options.height_unit", choices=("m", "ft", "ft_us")),
        )
    columns = find_columns(quantities, layout.names, options.columns, source.path, units)
    if stated is not None and columns["height"].scale != stated:
        raise _other_unit(options.height_unit, f"column '{columns['height'].column}'", source.path)
    need_role("role" in columns, options.role, source.path)
    return _Plan(layout, columns, frame, options.role or "", _sexagesimal(source.path, layout, columns))


def _other_unit(stated: str | None, by: str, file: Path) -> ConfigError:
    return ConfigError(
        f'options.height_unit = "{stated}", and {by} says another unit of heights',
        expected="one unit",
        change="leave options.height_unit out",
        file=file,
    )


def _sexagesimal(file: Path, layout: TextLayout, columns: dict[str, Found]) -> frozenset[str]:
    """Return which of longitude and latitude stand in degrees, minutes and seconds, by the first points."""
    lines = first_fields(file, layout, 5)
    found = {}
    for name in ("longitude", "latitude"):
        words = [fields[layout.names.index(columns[name].column)] for fields in lines] if name in columns else []
        found[name] = any(is_sexagesimal(word) for word in words)
    return frozenset(name for name, is_found in found.items() if is_found)


def _nameless(first: Sequence[str]) -> list[str] | None:
    """Return column names of a surveyors' file whose first line is a point; [] where their order is unclear.

    None of any other file. A point is a name, two lengths of a grid, a height, and words or nothing.
    """
    if not 4 <= len(first) <= 5 or _number(first[0].strip()) % 1.0 > 0.0:
        return None
    one, other, height = (_number(word) for word in first[1:4])
    is_grid = all(_LEAST_GRID_M < abs(value) < GRID_MAX_M for value in (one, other))
    is_described = len(first) == 5 and any(letter.isalpha() for letter in first[4]) and math.isnan(_number(first[4]))
    if not is_grid or not HEIGHT_MIN_M < height < HEIGHT_MAX_M or not is_described:
        return None
    low, high = _EASTINGS_M
    if abs(one) > high and low <= abs(other) < high:
        return PNEZD[: len(first)]
    return PENZD[: len(first)] if abs(other) > high and low <= abs(one) < high else []


def _number(word: str) -> float:
    """Return a number as written, NaN for other words."""
    try:
        return float(word)
    except ValueError:
        return math.nan


def units_of(frame: ControlFrame) -> dict[str, float]:
    """Return the size (rad, m) of the units that the CRS itself fixes, by quantity."""
    if frame.kind == "local":
        return {"easting": 1.0, "northing": 1.0, "height": 1.0}
    axes = crs_from_text(frame.crs).axis_info
    names = ("easting", "northing") if frame.kind == "projected" else ("longitude", "latitude")
    units = dict.fromkeys(names, float(axes[0].unit_conversion_factor))
    if len(axes) == 3:
        units["height"] = float(axes[2].unit_conversion_factor)
    return units


def _raw(block: TextBlock, plan: _Plan) -> RawControl:
    def number(name: str) -> Float64:
        if name not in plan.columns:
            return np.full(block.records.size, np.nan)
        found = plan.columns[name]
        if name in plan.sexagesimal:
            return np.radians(degrees_of(block.text(found.column), "latitude" if name == "latitude" else "longitude"))
        with np.errstate(over="ignore"):
            return block.number(found.column) * found.scale

    def words(name: str, otherwise: str) -> list[str]:
        if name not in plan.columns:
            return [otherwise] * block.records.size
        return [word or otherwise for word in block.text(plan.columns[name].column)]

    if plan.frame.kind == "geographic":
        horizontal = [number(name) * (180 / math.pi) for name in ("longitude", "latitude")]
    else:
        horizontal = [number(name) for name in ("easting", "northing")]
    return RawControl(
        records=block.records,
        offsets=block.offsets,
        names=words("name", ""),
        roles=words("role", plan.role),
        codes=[word or None for word in words("code", "")],
        coordinates=np.stack([*horizontal, number("height")]),
        sigma_horizontal_m=number("sigma_horizontal"),
        sigma_height_m=number("sigma_height"),
    )
