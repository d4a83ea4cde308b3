"""Shared parts of trajectories that offices' programs export as text: a preamble, names with units, a line a pose.

Each program's file names its columns and finds them in its preamble; angles, times, heights and σ are then read here.
Roll is positive with the right side down, pitch with the nose up, heading clockwise from north, all three rotated as
:func:`roadscan.ingest.reading.poses.ned_from_rph` has it. That is the convention of all these programs: of a frame
x right, y forward, z up, roll turns about y and pitch about x, right-handed, and azimuth about z, left-handed (NovAtel,
OEM7 documentation, log INSPVAS).
"""

from __future__ import annotations

import datetime as dt
import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Final, get_args

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import HeightKind, crs_from_text
from roadscan.core.errors import ConfigError, FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, WEEK_S, Clock, TimeSystem, gps_week_of_date
from roadscan.core.strict import Strict
from roadscan.ingest.reading.columns import UNITS
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import gps_clock, utc_clock
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
from roadscan.ingest.reading.stamps import calendar_ns
from roadscan.ingest.reading.text_table import (
    Kind,
    TextBlock,
    TextCoding,
    TextLayout,
    first_fields,
    head_of,
    is_number,
    text_blocks,
)

_UNIT_WORDS: Final = {
    "deg": ("angle", "deg"), "degrees": ("angle", "deg"), "°": ("angle", "deg"), "rad": ("angle", "rad"),
    "m": ("length", "m"), "meters": ("length", "m"), "metres": ("length", "m"),
    "sec": ("time", "s"), "s": ("time", "s"), "seconds": ("time", "s"),
    "m/s": ("speed", "m_per_s"), "m.s-1": ("speed", "m_per_s"), "meter/sec": ("speed", "m_per_s"),
}  # fmt: skip
"""Dimension and unit (see `UNITS`) of the words that programs write; feet are refused: which foot, none says."""
_SECONDS: Final = ("sec", "s", "seconds")  # units of a time that is no hh:mm:ss
_DMS: Final = re.compile(r"(\+/-)?\s*D[ -]M[ -]S", re.IGNORECASE)
_POSITION: Final = ("longitude", "latitude", "easting", "northing")
_ATTITUDE: Final = ("roll", "pitch", "heading")
_SIGMAS: Final = {f"sigma_{axis}": f"sigma_{axis}_m" for axis in ("north", "east", "down")} | {
    f"sigma_{angle}": f"sigma_{angle}_deg" for angle in _ATTITUDE
}
"""Column of the trajectory table for each σ."""
_DIMENSIONS: Final = (
    dict.fromkeys(("longitude", "latitude", *_ATTITUDE, *(f"sigma_{angle}" for angle in _ATTITUDE)), "angle")
    | dict.fromkeys(
        ("easting", "northing", "height_ellipsoidal", "height_orthometric", "sigma_north", "sigma_east", "sigma_down"),
        "length",
    )
    | dict.fromkeys(("velocity_north", "velocity_east", "velocity_up", "velocity_down"), "speed")
    | {"week_s": "time"}
)
"""Dimension of each quantity with a unit."""
_WEEKDAYS_FROM: Final = np.datetime64("1980-01-06", "D")
"""The day of GPS week 0 that is a Sunday, where seconds of the week begin."""
_DAY_S: Final = 86_400  # seconds in a day
_GPS_SINCE: Final = 1980  # first year of GPS time
_WIDEST: Final = 512
"""More columns than this are none."""


class OfficeOptions(Strict):
    """Settings of a trajectory that an office's program has exported."""

    heading: North | None = None
    """For a projected CRS: north that the heading is counted from, "true" or "grid". Programs export true north unless
    they are set to apply the convergence of meridians."""


@dataclass(frozen=True)
class Cell:
    """A column as its program names it."""

    name: str
    unit: str
    """As written, without brackets; "" for none."""


@dataclass(frozen=True)
class Preamble:
    """What stands above the first pose."""

    cells: Sequence[Cell]
    lines: int
    """Lines above the first pose."""
    delimiter: str
    said: Mapping[str, str] = field(default_factory=dict)
    """Statements of the preamble, in its words: they are shown, not used."""
    date: dt.date | None = None
    """Date of the drive, where the preamble states it: a proposal for the week of the clock."""
    sigma_scale: Mapping[str, float] = field(default_factory=dict)
    """σ as written, in stated σ of 1, by "length" and "angle"."""


@dataclass(frozen=True)
class _Column:
    """The words of a line that hold a quantity."""

    words: tuple[str, ...]
    """One, or three: degrees, minutes, seconds."""
    scale: float
    """Size of the unit (rad, m, s, m/s)."""
    name: str
    unit: str


@dataclass(frozen=True)
class Plan:
    """How a file is read."""

    layout: TextLayout
    columns: dict[str, _Column]
    kinds: dict[str, Kind]
    clock: Clock
    placement: Placement
    position: tuple[str, str, str]
    preamble: Preamble


class OfficeTrajectory(LogFormat):
    """A text of one program; its subclasses find the columns."""

    yields = ("trajectory",)
    options: ClassVar[type[Strict]] = OfficeOptions
    vocabulary: ClassVar[Mapping[str, str]]
    """Quantity by the program's name of its column, lower case. Quantities: `week`, `week_s`, `date`, `utc_date`,
    `utc_time`; the keys of `_DIMENSIONS`."""
    attitude: ClassVar[tuple[str, ...]] = ("roll", "pitch", "heading")
    """Quantities that a file needs beside time and position."""

    @abstractmethod
    def preamble(self, lines: Sequence[str]) -> Preamble | None:
        """Return the preamble in the file's first lines; None where they are not of this program."""

    def sniff(self, path: Path) -> bool:
        """True if the preamble is this program's and names attitudes."""
        found = self.preamble(_lines_of(path)[0]) if path.is_file() else None
        named = set() if found is None else {self.vocabulary.get(cell.name.lower()) for cell in found.cells}
        return found is not None and set(self.attitude) <= named

    def north(self, source: LogSource) -> North | None:
        """Return the north that headings are counted from, as stated."""
        return options_of(source, OfficeOptions).heading

    def header(self, source: LogSource) -> LogHeader:
        """Check columns, clock, CRS, heights and the heading's north."""
        plan = self.plan(source)
        columns = {quantity: column.name for quantity, column in plan.columns.items()}
        said = dict(plan.preamble.said)
        return LogHeader({"world_frame": plan.placement.world, "columns": columns} | ({"says": said} if said else {}))

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a line that cannot be read is rejected."""
        plan = self.plan(source)
        reader = PoseReader(source, plan.clock, plan.placement)
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            yield from reader.items(_poses(block, plan, sieve), sieve)

    def plan(self, source: LogSource) -> Plan:
        """Return how a file is read; raises as :meth:`header`."""
        lines, coding, offsets = _lines_of(source.path)
        preamble = self.preamble(lines)
        if preamble is None:
            raise FormatError(f"the preamble is not {self.title.split(':')[0]}", expected=self.title, file=source.path)
        names, columns = _columns(preamble, self.vocabulary, self.attitude, source.path)
        layout = TextLayout(names, preamble.delimiter, "", offsets[preamble.lines], coding=coding)
        _need_words(layout, lines[preamble.lines :], source.path)
        placement, position = _placement(source, columns, self.north(source))
        texts = {w for q in ("date", "utc_date", "utc_time") if q in columns for w in columns[q].words}
        wanted = [word for column in columns.values() for word in column.words]
        kinds: dict[str, Kind] = {word: "text" if word in texts else "number" for word in wanted}
        return Plan(layout, columns, kinds, _clock(source, columns, preamble, layout), placement, position, preamble)


# --- preambles ---------------------------------------------------------------------------------------


def aligned_units(names: str, units: str) -> list[Cell]:
    """Return the columns of a line of names, with the units that stand below them; a column may have none."""
    found = [(m.start(), m.end(), m[0].strip("()")) for m in re.finditer(r"\([^)]*\)|\S+", units)]
    columns = [(m.start(), m.end(), m[0]) for m in re.finditer(r"\S+", names)]
    if len(found) == len(columns):
        return [Cell(name, unit) for (*_, name), (*_, unit) in zip(columns, found, strict=True)]
    cells = []
    for start, end, name in columns:
        below = [unit for first, last, unit in found if first < end and last > start]
        cells.append(Cell(name, below[0] if len(below) == 1 else ""))
    return cells


def _lines_of(path: Path) -> tuple[list[str], TextCoding, list[int]]:
    """Return the first lines of a text, its coding, and the byte at which each line starts, and the last one ends."""
    head = head_of(path)
    coding = TextCoding.of(head)
    raw = coding.decoded(head).splitlines(keepends=True)
    offsets = [0, *np.cumsum([len(line) for line in raw], dtype=np.int64).tolist()]
    return [line.decode("utf-8", errors="replace").lstrip("\ufeff").rstrip("\r\n") for line in raw], coding, offsets


def _columns(
    preamble: Preamble, vocabulary: Mapping[str, str], attitude: Sequence[str], file: Path
) -> tuple[tuple[str, ...], dict[str, _Column]]:
    """Return a name for each word of a line, and the words of each quantity; the first column of a quantity counts."""
    names: list[str] = []
    found: dict[str, _Column] = {}
    for cell in preamble.cells[:_WIDEST]:
        parts = (" D", " M", " S") if _DMS.fullmatch(cell.unit) and preamble.delimiter == " " else ("",)
        words = []
        for part in parts:
            repeated = sum(name.split("#")[0] == cell.name + part for name in names)
            words.append(f"{cell.name}{part}" + (f"#{repeated + 1}" if repeated else ""))
        names += words
        quantity = vocabulary.get(cell.name.lower())
        if quantity is not None and quantity not in found:
            found[quantity] = _Column(tuple(words), _scale(quantity, cell, len(words), file), cell.name, cell.unit)
    absent = [name for name in attitude if name not in found]
    if absent:
        raise FormatError(f"no column holds the {absent[0]}", expected="roll, pitch and heading", file=file)
    return tuple(names), found


def _scale(quantity: str, cell: Cell, words: int, file: Path) -> float:
    """Return the size of a column's unit; 1 for quantities without one."""
    dimension = _DIMENSIONS.get(quantity)
    if dimension is None:
        return 1.0
    known, unit = ("angle", "deg") if words == 3 else _UNIT_WORDS.get(cell.unit.lower(), ("", ""))
    if known != dimension:
        raise FormatError(
            f"column '{cell.name}' is in '{cell.unit}'" if cell.unit else f"column '{cell.name}' states no unit",
            expected=" or ".join(word for word, (kind, _) in _UNIT_WORDS.items() if kind == dimension),
            change="export it in one of these",
            file=file,
        )
    return UNITS[dimension][unit]  # type: ignore[index]


def _need_words(layout: TextLayout, lines: Sequence[str], file: Path) -> None:
    """Refuse a file whose lines do not have the columns that its preamble names."""
    whole = lines[:-1] if len(lines) > 1 else lines
    first = next((line for line in whole if line.strip()), "")
    count = len(first.split(None if layout.delimiter == " " else layout.delimiter))
    if not first_fields(file, layout):
        raise FormatError(
            f"the preamble names {len(layout.names)} columns, and the first pose has {count}"
            if first
            else "no pose follows the preamble",
            expected="a line a pose, one value a column",
            change="export columns that always have a value",
            file=file,
        )


# --- time, place, attitude -----------------------------------------------------------------------------


def _clock(source: LogSource, columns: Mapping[str, _Column], preamble: Preamble, layout: TextLayout) -> Clock:
    if "week_s" in columns and ("week" in columns or "date" in columns):
        word = (
            first_fields(source.path, layout)[0][layout.names.index(columns["week"].words[0])]
            if "week" in columns
            else ""
        )
        week = int(float(word)) if is_number(word) else None
        return gps_clock(source, f"column '{columns['week_s'].name}' counts", week)
    if _has_utc(columns):
        return utc_clock(source, f"column '{columns['utc_time'].name}' is UTC")
    if "week_s" in columns:
        return _weekly_clock(source, preamble.date)
    raise FormatError(
        "no columns tell the time: of UTC, a date and the time of day as hh:mm:ss are needed",
        expected="GPS week and seconds of it, or UTC date and time of day",
        change="export them",
        file=source.path,
    )


def _weekly_clock(source: LogSource, date: dt.date | None) -> Clock:
    """Return the clock of seconds of an unnamed week; an error where its week is not that of the preamble's date."""
    clock = source.need_clock("gps_week_seconds", **({} if date is None else {"date": date}))
    is_stated = clock.system is TimeSystem.GPS_WEEK and clock.week != 0  # inspect assumes week 0
    if date is not None and is_stated and clock.first_week() != gps_week_of_date(date):
        raise TimeSystemError(
            f"the preamble says {date.isoformat()}, of GPS week {gps_week_of_date(date)}, the clock says week "
            f"{clock.first_week()}",
            expected="one GPS week",
            file=source.path,
            missing=Missing("clock", {"system": "gps_week_seconds", "date": date}),
        )
    return clock


def _has_utc(columns: Mapping[str, _Column]) -> bool:
    return {"utc_date", "utc_time"} <= columns.keys() and columns["utc_time"].unit.lower() not in _SECONDS


def stamps_of(block: TextBlock, plan: Plan, sieve: Sieve) -> npt.NDArray[np.generic]:
    """Return stamps (n,) of a block for the plan's clock."""
    columns = plan.columns
    is_dated = "week" in columns or "date" in columns
    if not is_dated and _has_utc(columns):
        dates, times = _iso_dates(block, columns["utc_date"]), block.text(columns["utc_time"].words[0])
        return calendar_ns([f"{date}T{time}" for date, time in zip(dates, times, strict=True)], sieve, zoned=False)
    if not is_dated:
        return block.number(columns["week_s"].words[0])
    seconds = block.number(columns["week_s"].words[0])
    sieve.require(columns["week_s"].name, seconds, 0.0, float(WEEK_S), "s")
    if "week" in columns:
        weeks = block.number(columns["week"].words[0])
        sieve.require(columns["week"].name, weeks, 0.0, 8191.0, "weeks")
        return np.where(sieve.good, weeks, 0.0).astype(np.int64) * (WEEK_S * NS_PER_S) + _ns(seconds, sieve)
    return _dated(_iso_dates(block, columns["date"]), seconds, sieve)


def _dated(dates: Sequence[str], seconds: Float64, sieve: Sieve) -> Int64:
    """Return GPS time (ns, (n,)) of dates with seconds of the day, or of the week where they reach beyond a day."""
    sieve.drop(np.array([not date for date in dates], dtype=bool), "the date is none")
    days = np.array([date or "1980-01-06" for date in dates], "datetime64[D]") - _WEEKDAYS_FROM
    day = days.astype(np.int64)
    whole = np.where(sieve.good, seconds, 0.0) // _DAY_S
    sieve.drop((whole > 0) & (whole % 7 != day % 7), "the seconds of the week are of another day than the date")
    start: Int64 = (day - whole.astype(np.int64)) * (_DAY_S * NS_PER_S)
    return np.asarray(start + _ns(seconds, sieve), dtype=np.int64)


def _ns(seconds: Float64, sieve: Sieve) -> Int64:
    return np.asarray(np.rint(np.where(sieve.good, seconds, 0.0) * NS_PER_S), dtype=np.int64)


def _iso_dates(block: TextBlock, column: _Column) -> list[str]:
    """Return dates as ISO 8601, "" where one is none; their order is that of the unit (MDY, DMY), else year first."""
    order = "".join(letter for letter in "".join(dict.fromkeys(column.unit.upper())) if letter in "YMD")
    is_stated = sorted(order) == ["D", "M", "Y"]
    words = block.text(column.words[0])
    known = {word: _iso_date(word, order if is_stated else "YMD", is_stated=is_stated) for word in set(words)}
    return [known[word] for word in words]


def _iso_date(word: str, order: str, *, is_stated: bool) -> str:
    """Return a date as ISO 8601, "" for none. A year has four digits, or two where the order is stated.

    GPS time begins in 1980, so that two digits stand for one year of 1980 to 2079.
    """
    parts = re.split(r"[/.-]", word)
    if len(parts) != 3 or not all(part.isascii() and part.isdigit() and len(part) <= 4 for part in parts):
        return ""
    year, month, day = (int(parts[order.index(letter)]) for letter in "YMD")
    digits = len(parts[order.index("Y")])
    if digits == 2 and is_stated:
        year += 2000 if year < _GPS_SINCE % 100 else 1900
    elif digits != 4:
        return ""
    if year < _GPS_SINCE:
        return ""
    try:
        return dt.date(year, month, day).isoformat()
    except ValueError:
        return ""


def _placement(
    source: LogSource, columns: Mapping[str, _Column], north: North | None
) -> tuple[Placement, tuple[str, str, str]]:
    """Return the placement of the poses, and the three quantities of their position."""
    crs = source.need_crs()
    is_grid = crs != "local" and crs_from_text(crs).is_projected
    first, second = _POSITION[2:] if is_grid else _POSITION[:2]
    absent = [name for name in (first, second) if name not in columns]
    if absent:
        raise ConfigError(
            f"no column holds the {absent[0]}, which positions in '{crs}' need",
            expected="a projected CRS for easting and northing, a geographic one for latitude and longitude",
            file=source.path,
            missing=Missing("crs", None if is_grid else "EPSG:25832"),
        )
    kinds: list[HeightKind] = [kind for kind in get_args(HeightKind) if f"height_{kind}" in columns]
    if not kinds:
        raise FormatError("no column holds the height", expected="such as H-Ell or H-MSL", file=source.path)
    kind = next((kind for kind in kinds if kind == source.any_height), kinds[0])
    height = source.need_height(kind, f"the column '{columns[f'height_{kind}'].name}'")
    return level_placement(replace(source, height=height), north), (first, second, f"height_{kind}")


def _poses(block: TextBlock, plan: Plan, sieve: Sieve) -> RawPoses:
    def quantity(name: str) -> Float64:
        return _values(block, plan.columns[name], sieve)

    stamps = stamps_of(block, plan, sieve)
    roll, pitch, heading = (quantity(name) for name in _ATTITUDE)
    check_rph(roll, pitch, heading, sieve)
    with np.errstate(invalid="ignore"):  # infinities of damaged records, dropped above
        attitude = ned_from_rph(roll, pitch, heading)
    position, sigmas = position_of(block, plan, sieve)
    velocity = _velocity({name: quantity(name) for name in plan.columns if name.startswith("velocity_")})
    return RawPoses(block.records, block.offsets, stamps, position, attitude, sigmas, velocity)


def position_of(block: TextBlock, plan: Plan, sieve: Sieve) -> tuple[Float64, dict[str, Float64]]:
    """Return positions (3, n) in the units of the plan's placement, and σ (n,) by column of the trajectory table."""
    sigmas = {}
    for name, column in _SIGMAS.items():
        if name in plan.columns:
            sigma = _values(block, plan.columns[name], sieve)
            sigma = sigma / plan.preamble.sigma_scale.get(_DIMENSIONS[name], 1.0)
            sigmas[column] = np.degrees(sigma) if column.endswith("_deg") else sigma
    return np.stack([_values(block, plan.columns[name], sieve) for name in plan.position]), sigmas


def _velocity(parts: Mapping[str, Float64]) -> Float64 | None:
    """Return velocity north, east, down (3, n); None where the log states none."""
    if "velocity_north" not in parts or "velocity_east" not in parts:
        return None
    north, east = parts["velocity_north"], parts["velocity_east"]
    up = -parts["velocity_down"] if "velocity_down" in parts else parts.get("velocity_up", np.full_like(north, np.nan))
    return np.stack([north, east, -up])


def _values(block: TextBlock, column: _Column, sieve: Sieve) -> Float64:
    """Return a quantity (n,) in rad, m or m/s; records whose minutes or seconds of arc are none are dropped."""
    parts = [block.number(word) for word in column.words]
    with np.errstate(over="ignore", invalid="ignore"):
        if len(parts) == 1:
            return parts[0] * column.scale
        degrees, minutes, seconds = parts
        sound = (minutes >= 0) & (minutes < 60) & (seconds >= 0) & (seconds <= 60)  # 59.9999 may be written as 60
        sieve.drop(~sound, f"{column.name} is not degrees, minutes and seconds")
        return np.copysign(np.abs(degrees) + minutes / 60 + seconds / 3600, degrees) * column.scale
