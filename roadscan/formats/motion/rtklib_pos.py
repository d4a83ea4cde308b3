"""RTKLIB solutions (``.pos``)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Final, Literal, TypeAlias

import numpy as np
import pyarrow.compute as pc

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text, world_from_geodetic
from roadscan.core.errors import ConfigError, CrsError, FormatError, Missing, RoadscanError, TimeSystemError
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S, WEEK_S, Clock, TimeSystem
from roadscan.core.strict import Strict
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, height_in
from roadscan.ingest.reading.gnss import (
    QUALITIES,
    UNKNOWN_QUALITY,
    GnssReader,
    RawSolutions,
    geocentric_placement,
    ned_from_ecef,
    signed_square,
)
from roadscan.ingest.reading.poses import SIGMA_MAX_M, GeodeticPlacement, LevelPlacement, Placement, check_geographic
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of
from roadscan.ingest.reading.stamps import parse_calendar
from roadscan.ingest.reading.text_table import Kind, TextBlock, TextLayout, first_fields, head_of, text_blocks

Solution: TypeAlias = Literal["lat/lon/height", "x/y/z-ecef", "e/n/u-baseline"]

_TIME_SYSTEMS: Final = {
    "GPST": (TimeSystem.UNIX_GPS, 0),
    "UTC": (TimeSystem.UNIX_UTC, 0),
    "JST": (TimeSystem.UNIX_UTC, 9 * 3600),
}
"""Scale of the calendar by the header's word, and its lead over that scale (s)."""
_Q: Final = {1: "fixed", 2: "float", 3: "sbas", 4: "dgps", 5: "single", 6: "ppp", 7: "dead_reckoning"}  # column Q
_FIRST_COLUMNS: Final[dict[str, Solution]] = {
    "latitude(deg)": "lat/lon/height",
    "latitude(d'\")": "lat/lon/height",
    "x-ecef(m)": "x/y/z-ecef",
    "e-baseline(m)": "e/n/u-baseline",
}
_SEPARATORS: Final = ",;\t|"
_NAN: Final = float("nan")


class BasePosition(Strict):
    """Position of a base station, in the datum of the log's crs."""

    latitude_deg: float
    """Latitude (degrees)."""
    longitude_deg: float
    """Longitude (degrees)."""
    height_m: float
    """Ellipsoidal height (m)."""


class RtklibPosOptions(Strict):
    """Settings of `rtklib_pos`."""

    base: BasePosition | None = None
    """Base station that e/n/u-baselines start from, where the file's header does not name it ("ref pos")
    or another position of it is to be used."""


class RtklibPos(LogFormat):
    """Text with header lines after ``%``; the last one names time system and columns.

    Positions are latitude, longitude (degrees, or degrees minutes seconds) and height, geocentric
    x, y, z, or a baseline east, north, up from the base station. Times are a date and time of day, or
    GPS week and seconds. All of RTKLIB's separators are read, and files packed with gzip, bzip2 or xz.
    Q becomes `quality`; sdne, sdeu, sdun are signed square roots of covariances and become
    covariances. Errors of geocentric solutions are turned into the local level.

    Where the header says WGS84, that is RTKLIB's word for the frame of the base station's coordinates
    (or of the orbits, without a base): state its datum as crs. Heights are ellipsoidal or geodetic as
    the header says; geodetic ones need height = "orthometric" and the geoid that RTKLIB used. A
    header without that line leaves it to `height`. With crs = "local", baselines are taken as x, y, z.
    Records behind a second header that says otherwise than the first are rejected.
    """

    name = "rtklib_pos"
    title = "RTKLIB solution (.pos): GNSS positions, with σ, velocity and ambiguity ratio where written"
    yields = ("gnss",)
    version = 2
    suffixes: ClassVar[tuple[str, ...]] = (".pos",)
    time = "the header says GPST, UTC or JST; a clock need not be stated, save for its measured offset"
    options = RtklibPosOptions

    def sniff(self, path: Path) -> bool:
        """True if a header line names the columns of a solution."""
        return path.is_file() and _column_line(head_of(path)) is not None

    def header(self, source: LogSource) -> LogHeader:
        """Read the header and check clock, CRS, heights and base station against it."""
        plan = _plan(source)
        return LogHeader(
            {"world_frame": plan.placement.world, "solution": plan.header.solution, "time": plan.header.time}
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream solutions; a line that cannot be read is rejected."""
        plan = _plan(source)
        epochs = EpochReader(plan.clock, source.path)
        reader = GnssReader(source, plan.placement)
        for block in text_blocks(source.path, plan.layout, plan.kinds, _LaterHeaders(plan.header)):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            stamps = plan.stamps(block, sieve)
            raw = RawSolutions(
                records=block.records,
                offsets=block.offsets,
                epochs=epochs.epochs(stamps, sieve, block.records),
                position=plan.position(block, sieve),
                quality=_quality(block, sieve),
                columns={},
            )
            yield from reader.items(replace(raw, columns=plan.columns(block, raw.position, sieve)), sieve)


# --- header ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Header:
    """Content of the header lines."""

    time: str
    """GPST, UTC or JST."""
    solution: Solution
    columns: tuple[str, ...]
    """Names after the time, without their units."""
    sexagesimal: bool
    """Latitude and longitude are degrees, minutes, seconds in separate fields."""
    separator: str
    datum: str
    height: str
    """"ellipsoidal", "geodetic" or "" where it is not said."""
    base: tuple[float, ...]
    """Words of the base station's position, as many as there are."""


@dataclass
class _LaterHeaders:
    """Headers of solutions that were appended to the first; the lines of each are judged one by one."""

    first: _Header
    other: str = (
        "a second header stands before it, which differs from the first in time system, columns, datum, kind of height "
        "or base station"
    )
    _same: dict[str, bool] = field(default_factory=dict)
    """Whether the last header agrees, by the subject of its lines."""

    def row(self, fields: Sequence[str]) -> bool | None:
        """Return None: rows are never headers, which are comments."""
        return None

    def comment(self, line: str) -> bool | None:
        """Return whether rows after this line match the first header; None for a line that says nothing about it."""
        said = _said_of_position(line)
        if any(name in line for name in _FIRST_COLUMNS):
            self._same["columns"] = self._has_columns(line)
        elif said:
            self._same["position"] = said == (self.first.datum, self.first.height)
        elif re.match(r"%\s*ref pos\s*:", line):
            base = _base_words(line.encode(), self.first.separator)
            self._same["base"] = base == self.first.base or self.first.solution != "e/n/u-baseline"
        else:
            return None
        return all(self._same.values())

    def _has_columns(self, line: str) -> bool:
        try:
            later = _columns_of(line, None)
        except RoadscanError:
            return False
        return replace(later, datum=self.first.datum, height=self.first.height, base=self.first.base) == self.first


def _said_of_position(text: str) -> tuple[str, str] | None:
    """Return the datum and kind of height that a header line states."""
    said = re.search(r"lat/lon/height=(\w+)/(\w+)", text)
    return (said[1], said[2]) if said else None


def _header(path: Path) -> _Header:
    head = head_of(path)
    line = _column_line(head)
    if line is None:
        raise FormatError(
            "no header line names the columns of a solution",
            expected="such as '%  GPST  latitude(deg) longitude(deg) height(m) Q ns …'",
            change="let RTKLIB write its header (out-outhead = on)",
            file=path,
        )
    header = _columns_of(line, path)
    own = "\n".join(_own_header_lines(head, line))
    datum, height = _said_of_position(own) or ("", "")
    return replace(header, datum=datum, height=height, base=_base_words(own.encode(), header.separator))


def _columns_of(line: str, path: Path | None) -> _Header:
    """Return the header's content from the line of column names."""
    first = next(name for name in _FIRST_COLUMNS if name in line)
    behind = line[line.index(first) + len(first) :][:1]
    separator = behind if behind and behind in _SEPARATORS else " "
    words = line.lstrip("% ").replace(separator, " ").split()
    if words[0] not in _TIME_SYSTEMS:
        raise TimeSystemError(
            f"the header says the time system '{words[0][:20]}'", expected="GPST, UTC or JST", file=path
        )
    columns = tuple(re.sub(r"\(.*\)$", "", word) for word in words[1:])
    if len(set(columns)) < len(columns):
        raise FormatError("two columns of the header have one name", expected="each column once", file=path)
    return _Header(
        time=words[0],
        solution=_FIRST_COLUMNS[first],
        columns=columns,
        sexagesimal="d'" in first,
        separator=separator,
        datum="",
        height="",
        base=(),
    )


def _header_lines(head: bytes) -> Iterator[str]:
    for raw in head.splitlines():
        if raw.startswith(b"%"):
            yield raw.decode("utf-8", errors="replace")


def _own_header_lines(head: bytes, columns: str) -> Iterator[str]:
    """Yield header lines above the first record: those of appended files do not apply to it."""
    is_behind = False
    for line in head.decode("utf-8", errors="replace").splitlines():
        is_behind |= line == columns
        if line.startswith("%"):
            yield line
        elif is_behind and line.strip():
            return


def _column_line(head: bytes) -> str | None:
    """Return the header line with the column names, None where there is none."""
    return next((line for line in _header_lines(head) if any(name in line for name in _FIRST_COLUMNS)), None)


def _base_words(head: bytes, separator: str) -> tuple[float, ...]:
    line = next((line for line in _header_lines(head) if re.match(r"%\s*ref pos\s*:", line)), "")
    words = line.partition(":")[2].replace(separator, " ").split()
    try:
        return tuple(float(word) for word in words)
    except ValueError:
        return ()


# --- how one file is read --------------------------------------------------------------------------


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    header: _Header
    layout: TextLayout
    kinds: dict[str, Kind]
    clock: Clock
    placement: Placement
    base_world_m: Float64 | None
    """(3,) base station, for baselines that become geocentric."""

    def stamps(self, block: TextBlock, sieve: Sieve) -> Int64:
        """Return nanoseconds (n,) from 1970 on the clock's scale; faulty stamps are dropped."""
        ahead_ns = _TIME_SYSTEMS[self.header.time][1] * NS_PER_S
        if "tow" in self.kinds:
            return _of_week(block.number("week"), block.number("tow"), sieve) - ahead_ns
        if "date" in self.kinds:
            times = pc.binary_join_element_wise(block.columns["date"], block.columns["time"], "T")
        else:
            times = pc.replace_substring_regex(pc.utf8_trim_whitespace(block.columns["datetime"]), r"\s+", "T")
        return _of_calendar(pc.replace_substring(times, "/", "-").to_pylist(), sieve) - ahead_ns

    def position(self, block: TextBlock, sieve: Sieve) -> Float64:
        """Return positions (3, n) in the units of the placement."""
        if self.header.solution == "x/y/z-ecef":
            return np.stack([block.number(f"{a}-ecef") for a in "xyz"])
        if self.header.solution == "e/n/u-baseline":
            enu = np.stack([block.number(f"{a}-baseline") for a in "enu"])
            if self.base_world_m is None:
                return enu
            ned = np.stack([enu[1], enu[0], -enu[2]])
            with np.errstate(invalid="ignore", over="ignore"):  # damaged records are dropped when they are placed
                return np.asarray(self.base_world_m[:, None] + self._ned_from_base().T @ ned)
        if self.header.sexagesimal:
            latitude, longitude = (_sexagesimal(block, name, sieve) for name in ("latitude", "longitude"))
        else:
            latitude, longitude = block.number("latitude"), block.number("longitude")
        return np.stack([np.radians(longitude), np.radians(latitude), block.number("height")])

    def _ned_from_base(self) -> Float64:
        """Return (3, 3) north-east-down from geocentric axes at the base station."""
        base = self.base_world_m
        return np.eye(3) if base is None else ned_from_ecef(self.placement.world, base[:, None])[0]

    def columns(self, block: TextBlock, position: Float64, sieve: Sieve) -> dict[str, Float64]:
        """Return further columns of `gnss`, (n,)."""
        names = set(self.kinds)
        found: dict[str, Float64] = {}
        for ours, theirs in (("satellites", "ns"), ("age_s", "age"), ("ratio", "ratio")):
            if theirs in names:
                found[ours] = block.number(theirs)
        if self.header.solution == "x/y/z-ecef":
            return found | _geocentric_columns(block, names, self.placement.world, position, sieve)
        return found | _level_columns(block, names, sieve)


def _plan(source: LogSource) -> _Plan:
    header = _header(source.path)
    layout, kinds = _layout(source.path, header)
    placement, base = _placement(source, header)
    return _Plan(header, layout, kinds, _clock(source, header), placement, base)


def _layout(path: Path, header: _Header) -> tuple[TextLayout, dict[str, Kind]]:
    """Return names and kinds of a line's fields, verified with the first lines."""
    fields = [part for name in header.columns for part in _parts(name, header)]
    day: dict[str, Kind] = {"date": "text", "time": "text"} if header.separator == " " else {"datetime": "text"}
    week: dict[str, Kind] = {"week": "number", "tow": "number"}
    missing = [name for name in _needed(header) if name not in header.columns]
    if missing:
        raise FormatError(f"the header names no column '{missing[0]}'", expected=", ".join(_needed(header)), file=path)
    for times in (week, day):
        layout = TextLayout((*times, *fields), header.separator, "%", 0)
        lines = first_fields(path, layout, 20)
        calendar = any("/" in line[0] for line in lines)
        if lines and calendar == (times is day):
            wanted = [name for name in fields if not _unused(name)]
            return layout, {**times, **dict.fromkeys(wanted, "number")}
    raise FormatError(
        f"no line has the {len(fields)} fields that the header names behind the time",
        expected="lines of time, " + ", ".join(fields),
        file=path,
    )


def _needed(header: _Header) -> tuple[str, ...]:
    position = {
        "lat/lon/height": ("latitude", "longitude", "height"),
        "x/y/z-ecef": ("x-ecef", "y-ecef", "z-ecef"),
        "e/n/u-baseline": ("e-baseline", "n-baseline", "u-baseline"),
    }
    return (*position[header.solution], "Q")


def _parts(name: str, header: _Header) -> list[str]:
    """Return the fields of a column: three for an angle in degrees, minutes and seconds."""
    if header.sexagesimal and name in ("latitude", "longitude"):
        return [f"{name}_{part}" for part in ("degrees", "minutes", "seconds")]
    return [name]


def _unused(name: str) -> bool:
    known = r"(latitude|longitude)(_\w+)?|height|[xyz]-ecef|[enu]-baseline|Q|ns|age|ratio|sdv?[a-z]{1,2}|v[neuxyz]"
    return re.fullmatch(known, name) is None


def _clock(source: LogSource, header: _Header) -> Clock:
    system = _TIME_SYSTEMS[header.time][0]
    stated = source.clock
    if stated is not None and stated.system is not system:
        raise TimeSystemError(
            f"the file's times are {header.time}, the clock says {stated.system}",
            expected=f'clock.system = "{system}", or no clock',
            file=source.path,
            missing=Missing("clock", {"system": str(system)}),
        )
    return replace(stated or Clock(system), unit="ns")


def _placement(source: LogSource, header: _Header) -> tuple[Placement, Float64 | None]:
    """Return the placement of positions, and the base station (3,) of baselines that become geocentric."""
    if header.solution == "lat/lon/height":
        return _geodetic_placement(source, header), None
    if header.solution == "x/y/z-ecef":
        return geocentric_placement(source), None
    if source.need_crs() == LOCAL_WORLD:
        return LevelPlacement(), None
    placement = geocentric_placement(source)
    return placement, world_from_geodetic(placement.world, _base(source, header)[None, :])[0]


def _geodetic_placement(source: LogSource, header: _Header) -> GeodeticPlacement:
    crs = source.need_crs()
    check_geographic(crs, source.path)
    geodetic = crs_from_text(crs).geodetic_crs
    if header.datum == "Tokyo" and (geodetic is None or "tokyo" not in str(geodetic.datum).lower()):
        raise CrsError(f"the header says the datum Tokyo, the crs is '{crs}'", expected='"EPSG:4301"', file=source.path)
    if header.height == "geodetic" and (source.any_height != "orthometric" or source.geoid is None):
        raise CrsError(
            "the header says geodetic heights, which RTKLIB counts from its geoid model",
            expected='height = "orthometric" and geoid, the grid of that model',
            change="add both to this log, or let RTKLIB write ellipsoidal heights (out-height = ellipsoidal)",
            file=source.path,
            missing=[[Missing("height", "orthometric"), Missing("geoid")]],
        )
    if header.height == "geodetic":
        return GeodeticPlacement(crs, "orthometric", source.geoid, source.path)
    if header.height == "ellipsoidal":
        height = source.need_height("ellipsoidal", "the log's header")
    else:
        height = height_in(source, crs)
    return GeodeticPlacement(crs, height, source.geoid, source.path)


def _base(source: LogSource, header: _Header) -> Float64:
    """Return longitude, latitude (degrees), ellipsoidal height (m) of the base station."""
    stated = options_of(source, RtklibPosOptions).base
    if stated is not None:
        return np.array([stated.longitude_deg, stated.latitude_deg, stated.height_m])
    if len(header.base) == 3 and np.all(np.isfinite(header.base)):
        return np.array([header.base[1], header.base[0], header.base[2]])
    raise ConfigError(
        "the log holds baselines, and its header does not say where the base station stands",
        expected="options.base = { latitude_deg = …, longitude_deg = …, height_m = … }",
        change='add it, or take the baselines as a local frame: crs = "local"',
        file=source.path,
        missing=[Missing("options.base"), Missing("crs", "local")],
    )


# --- fields ----------------------------------------------------------------------------------------


def _of_week(week: Float64, seconds: Float64, sieve: Sieve) -> Int64:
    sieve.require("week", week, 0, 10_000, "weeks")
    sieve.require("seconds of the week", seconds, 0, WEEK_S, "s")
    sieve.drop(week != np.floor(week), "week is not a whole number")
    weeks = np.where(sieve.good, week, 0).astype(np.int64)
    rest_ns = np.rint(np.where(sieve.good, seconds, 0) * NS_PER_S).astype(np.int64)
    return np.asarray((weeks * WEEK_S + GPS_EPOCH_UNIX_S) * NS_PER_S + rest_ns)


def _of_calendar(words: list[str], sieve: Sieve) -> Int64:
    whole = parse_calendar(words, zoned=False)
    if whole is not None:
        return whole
    singles = [parse_calendar([word], zoned=False) for word in words]
    sieve.drop(np.array([one is None for one in singles]), "time is not of the form yyyy/mm/dd hh:mm:ss.sss")
    return np.array([0 if one is None else one[0] for one in singles], dtype=np.int64)


def _sexagesimal(block: TextBlock, name: str, sieve: Sieve) -> Float64:
    """Return degrees (n,); the sign of the degrees applies to all parts, including minus zero."""
    degrees, minutes, seconds = (block.number(f"{name}_{part}") for part in ("degrees", "minutes", "seconds"))
    sieve.require(f"{name}'s minutes", minutes, 0, 60, "minutes")
    sieve.require(f"{name}'s seconds", seconds, 0, 60, "seconds")
    return np.asarray(np.copysign(np.abs(degrees) + minutes / 60 + seconds / 3600, degrees))


def _quality(block: TextBlock, sieve: Sieve) -> Int64:
    given = block.number("Q")
    out = np.full(given.size, UNKNOWN_QUALITY, dtype=np.int64)
    for q, name in _Q.items():
        out[given == q] = QUALITIES.index(name)
    sieve.drop(out == UNKNOWN_QUALITY, f"Q is not one of {', '.join(map(str, _Q))}")
    return out


def _roots(block: TextBlock, columns: Mapping[str, str], sieve: Sieve) -> dict[str, Float64]:
    """Return signed square roots of variances and covariances (n,) by their quantity."""
    found = {key: block.number(name) for key, name in columns.items()}
    for key, values in found.items():
        with np.errstate(invalid="ignore"):
            sieve.drop(np.abs(values) > SIGMA_MAX_M, f"{columns[key]} is beyond {SIGMA_MAX_M:g}")
        found[key] = np.where(sieve.good, values, _NAN)  # a damaged value must not overflow when squared
    return found


def _pick(names: set[str], **wanted: tuple[str, ...]) -> dict[str, str]:
    """Return the first of each quantity's names that the file has."""
    found = {key: next((one for one in known if one in names), None) for key, known in wanted.items()}
    return {key: name for key, name in found.items() if name is not None}


def _level_columns(block: TextBlock, names: set[str], sieve: Sieve) -> dict[str, Float64]:
    """Return σ, covariances and velocity that are east, north, up in the file."""
    # RTKLIB names the last column of degrees-minutes-seconds files sdue, although it contains un.
    last = ("sdun", "sdnu", "sdue") if "sdeu" in names else ("sdun", "sdnu")
    columns = _pick(names, n=("sdn",), e=("sde",), u=("sdu",), ne=("sdne", "sden"), eu=("sdeu", "sdue"), un=last)
    columns |= _pick(names, vn=("sdvn",), ve=("sdve",), vu=("sdvu",))
    roots = _roots(block, columns, sieve)
    out: dict[str, Float64] = {}
    for key, axis in (("n", "north"), ("e", "east"), ("u", "down")):
        if key in roots:
            out[f"sigma_{axis}_m"] = roots[key]
        if f"v{key}" in roots:
            out[f"sigma_velocity_{axis}_m_per_s"] = roots[f"v{key}"]
        if f"v{key}" in names:
            velocity = block.number(f"v{key}")
            out[f"velocity_{axis}_m_per_s"] = -velocity if key == "u" else velocity
    for key, ours, sign in (("ne", "ne", 1.0), ("un", "nd", -1.0), ("eu", "ed", -1.0)):
        if key in roots:
            out[f"covariance_{ours}_m2"] = signed_square(sign * roots[key])
    return out


def _geocentric_columns(
    block: TextBlock, names: set[str], world: str, position: Float64, sieve: Sieve
) -> dict[str, Float64]:
    """Return σ, covariances and velocity that are geocentric in the file, rotated into the local level."""
    sieve.require("distance from the Earth's centre", _length(position), 6.2e6, 6.5e6, "m")
    rotation = ned_from_ecef(world, np.where(sieve.good, position, np.array([[6.4e6], [0.0], [0.0]])))
    out: dict[str, Float64] = {}
    if (matrix := _covariance(block, names, "sd", sieve)) is not None:
        level = rotation @ matrix @ rotation.transpose(0, 2, 1)
        for i, axis in enumerate(("north", "east", "down")):
            out[f"sigma_{axis}_m"] = _root(level[:, i, i])
        for (i, j), key in (((0, 1), "ne"), ((0, 2), "nd"), ((1, 2), "ed")):
            out[f"covariance_{key}_m2"] = level[:, i, j]
    if {"vx", "vy", "vz"} <= names:
        velocity = np.stack([block.number(f"v{a}") for a in "xyz"], axis=-1)
        with np.errstate(invalid="ignore", over="ignore"):
            level_velocity = (rotation @ velocity[:, :, None])[:, :, 0]
        for i, axis in enumerate(("north", "east", "down")):
            out[f"velocity_{axis}_m_per_s"] = level_velocity[:, i]
    if (matrix := _covariance(block, names, "sdv", sieve)) is not None:
        level = rotation @ matrix @ rotation.transpose(0, 2, 1)
        for i, axis in enumerate(("north", "east", "down")):
            out[f"sigma_velocity_{axis}_m_per_s"] = _root(level[:, i, i])
    return out


def _covariance(block: TextBlock, names: set[str], prefix: str, sieve: Sieve) -> Float64 | None:
    """Return (n, 3, 3) covariance matrices of the columns sdx … sdzx, None where one is missing."""
    keys = ("x", "y", "z", "xy", "yz", "zx")
    if not {prefix + key for key in keys} <= names:
        return None
    roots = _roots(block, {key: prefix + key for key in keys}, sieve)
    xx, yy, zz, xy, yz, zx = (signed_square(roots[key]) for key in keys)
    return np.stack([np.stack(row, axis=-1) for row in ((xx, xy, zx), (xy, yy, yz), (zx, yz, zz))], axis=-2)


def _root(variance: Float64) -> Float64:
    """Return the square root; rounding in the file may leave a variance just below zero."""
    return np.sqrt(np.maximum(variance, 0.0))


def _length(vectors: Float64) -> Float64:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.sum(vectors * vectors, axis=0)))
