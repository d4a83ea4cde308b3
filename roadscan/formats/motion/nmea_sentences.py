"""Finds NMEA 0183 sentences in text, checks them, and converts their fields to numbers.

A sentence starts at a ``$`` wherever it stands in a line, so that what a logger puts before it does
not matter, and ends with ``*`` and the exclusive or of the bytes between in two hexadecimal digits.
Everything here works on whole blocks of text; fields are parsed by Arrow, a kind of sentence at a time.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow.compute as pc

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.gpstime import NS_PER_S
from roadscan.ingest.reading.format import Reject
from roadscan.ingest.reading.gnss import NO_POSITION, QUALITIES, UNKNOWN_QUALITY
from roadscan.ingest.reading.records import Sieve, few_rejects
from roadscan.ingest.reading.text_table import Kind, TextBlock, TextLayout, parse_lines

Bytes = npt.NDArray[np.uint8]

DAY_NS: Final = 86_400 * NS_PER_S  # nanoseconds of a day
UNTIMED: Final = -1  # time of sentences that state none
UNDATED: Final = np.iinfo(np.int64).min
METRES_PER_S_IN_KNOT: Final = 1852 / 3600  # a knot is 1,852 m per hour

KINDS: Final = ("GGA", "RMC", "VTG", "ASHR", "HDT", "GST", "ZDA")
"""Sentences that are used, by the last letters of their address. Where two state one quantity of an epoch, the
first in this order is taken."""

VALUES: Final = (
    "latitude_deg", "longitude_deg", "altitude_m", "undulation_m", "quality", "satellites", "hdop", "age_s",
    "sigma_north_m", "sigma_east_m", "sigma_down_m", "covariance_ne_m2", "course_deg", "speed_m_per_s",
    "heading_deg", "roll_deg", "pitch_deg", "sigma_heading_deg", "sigma_roll_deg", "sigma_pitch_deg",
)  # fmt: skip
"""Values that sentences state; `quality` is an index of :data:`QUALITIES`."""

GGA_QUALITY: Final = {
    0: "none",
    1: "single",
    2: "dgps",
    3: "pps",
    4: "fixed",
    5: "float",
    6: "dead_reckoning",
    7: "manual",
    8: "simulated",
    9: "sbas",
}
"""Quality of GGA by its number; 9 is NovAtel's for SBAS."""

BINARY_SHARE: Final = 4
"""A stretch between two sentences is binary where at least one byte in this many is neither text nor blank."""

_ADDRESS: Final = re.compile(rb"\$(?:P[A-Z0-9]{2,6}|[A-Z]{2}[A-Z0-9]{3}),")
_IS_BINARY: Final[Bool] = np.isin(np.arange(256), [*range(32, 127), *b"\t\r\n"], invert=True)  # by byte value
_DOLLAR, _STAR, _COMMA, _FEED = (ord(c) for c in "$*,\n")
_HEX: Final[npt.NDArray[np.int16]] = np.full(256, -1, dtype=np.int16)  # digit of each letter, −1 for others
for _digit, _letters in enumerate(zip("0123456789ABCDEF", "0123456789abcdef", strict=True)):
    _HEX[[ord(letter) for letter in _letters]] = _digit


@dataclass(frozen=True)
class Sentences:
    """Sound sentences of a piece of a log, in its order."""

    lines: Int64
    """(n,) line numbers, from 0."""
    offsets: Int64
    """(n,) byte of the ``$``."""
    kinds: Int64
    """(n,) indices of :data:`KINDS`."""
    times_ns: Int64
    """(n,) UTC time of the day (ns), `UNTIMED` for kinds that state none; a leap second is at 86,400 s."""
    days: Int64
    """(n,) days since 1970-01-01, `UNDATED` where the sentence states no date."""
    values: Float64
    """(len(VALUES), n), NaN where the sentence does not state it."""

    @property
    def size(self) -> int:
        """Number of sentences."""
        return int(self.lines.size)

    def take(self, rows: Int64 | Bool) -> Sentences:
        """Return some of the sentences."""
        return Sentences(
            self.lines[rows],
            self.offsets[rows],
            self.kinds[rows],
            self.times_ns[rows],
            self.days[rows],
            self.values[:, rows],
        )

    @classmethod
    def joined(cls, parts: list[Sentences]) -> Sentences:
        """Return several pieces as one."""
        if not parts:
            empty = np.empty(0, dtype=np.int64)
            return cls(empty, empty, empty, empty, empty, np.empty((len(VALUES), 0)))
        return cls(
            np.concatenate([p.lines for p in parts]),
            np.concatenate([p.offsets for p in parts]),
            np.concatenate([p.kinds for p in parts]),
            np.concatenate([p.times_ns for p in parts]),
            np.concatenate([p.days for p in parts]),
            np.concatenate([p.values for p in parts], axis=1),
        )


@dataclass(frozen=True)
class Found:
    """Sentences of a block of text with valid checksums."""

    starts: Int64
    """(n,) byte of the ``$``."""
    ends: Int64
    """(n,) byte of the ``*``."""
    faulty: list[tuple[int, str]]
    """Byte of each ``$`` whose sentence is damaged, and its fault."""


def find_sentences(data: bytes) -> Found:
    """Find and check all sentences of a block of whole lines."""
    letters = np.frombuffer(data, dtype=np.uint8)
    starts = np.flatnonzero(letters == _DOLLAR)
    ends = _next(np.flatnonzero((letters == _FEED) | (letters == _DOLLAR)), starts + 1, letters.size)
    stars = _next(np.flatnonzero(letters == _STAR), starts, letters.size)
    complete = (stars + 2 < ends) & (stars > starts + 1)
    faulty = [(int(s), "the sentence breaks off before its checksum") for s in starts[~complete]]
    starts, stars = starts[complete], stars[complete]
    if starts.size == 0:
        return Found(starts, stars, faulty)
    own = np.bitwise_xor.reduceat(letters, np.stack([starts + 1, stars], axis=-1).ravel())[::2]
    high, low = _HEX[letters[stars + 1]], _HEX[letters[stars + 2]]
    right = (high >= 0) & (low >= 0) & (high * 16 + low == own)
    faulty += [(int(s), "the sentence does not fit its checksum") for s in starts[~right]]
    return Found(starts[right], stars[right], faulty)


def _next(marks: Int64, positions: Int64, none: int) -> Int64:
    """Return the first of `marks` at or after each position, `none` where there is none."""
    return np.append(marks, none)[np.searchsorted(marks, positions)]


def is_address(data: bytes, dollar: int) -> bool:
    """Return True if the ``$`` at byte `dollar` opens a sentence, rather than being part of binary data."""
    return _ADDRESS.match(data, dollar) is not None


def kinds_of(data: bytes, starts: Int64, ends: Int64) -> Int64:
    """Return the index in :data:`KINDS` of each sentence, −1 for others."""
    letters = np.frombuffer(data, dtype=np.uint8)
    out = np.full(starts.size, -1, dtype=np.int64)
    long = np.flatnonzero(ends - starts > 7)
    at = starts[long, None] + np.arange(1, 8)
    address = letters[at]
    talks = (address[:, 0] != ord("P")) & (address[:, 5] == _COMMA)
    for number, kind in enumerate(KINDS):
        last = np.frombuffer(kind[-3:].encode(), dtype=np.uint8)
        fits = np.all(address[:, 2:5] == last, axis=1)
        if kind == "ASHR":  # proprietary; $PASHR,POS and the like are other messages under the same address
            timed = (address[:, 6] >= ord("0")) & (address[:, 6] <= ord("9"))
            proprietary = (address[:, 0] == ord("P")) & (address[:, 1] == ord("A")) & (address[:, 5] == _COMMA)
            out[long[fits & proprietary & timed]] = number
        else:
            out[long[fits & talks]] = number
    return out


def parse_sentences(data: bytes, first_line: int, offset: int) -> tuple[Sentences, list[Reject], int]:
    """Return sound sentences of a block of whole lines, rejects of damaged ones, and its number of lines.

    Parameters
    ----------
    first_line, offset : line number and byte offset of the block in the log.
    """
    letters = np.frombuffer(data, dtype=np.uint8)
    feeds = np.flatnonzero(letters == _FEED)
    lines = feeds.size + (not data.endswith(b"\n"))
    found = find_sentences(data)
    rejects = [Reject(reason, int(np.searchsorted(feeds, start)), start) for start, reason in found.faulty]
    rejects += _lines_without(letters, feeds, lines)
    rejects = _stretches_as_one(data, found, rejects)
    rejects = [replace(r, record=first_line + r.record, offset=offset + r.offset) for r in rejects]
    kinds = kinds_of(data, found.starts, found.ends)
    commas = np.flatnonzero(letters == _COMMA)
    fields = np.searchsorted(commas, found.ends) - np.searchsorted(commas, found.starts)
    parts: list[Sentences] = []
    for kind, form in enumerate(_FORMS.values()):
        for count in np.unique(fields[kinds == kind]):
            chosen = np.flatnonzero((kinds == kind) & (fields == count))
            starts, ends = found.starts[chosen], found.ends[chosen]
            where = first_line + np.searchsorted(feeds, starts)
            part, damaged = form.parse(data, starts, ends, int(count))
            parts.append(_sentences(kind, part, where, offset + starts))
            rejects += [Reject(reason, int(where[row]), offset + int(starts[row])) for row, reason in damaged]
    joined = Sentences.joined(parts)
    rejects.sort(key=lambda r: r.offset)
    return joined.take(np.argsort(joined.offsets)), few_rejects(rejects), lines


def _stretches_as_one(data: bytes, found: Found, rejects: list[Reject]) -> list[Reject]:
    """Return one reject for each stretch of binary data between sentences; damaged sentences in it keep theirs."""
    if not rejects:
        return rejects
    letters = np.frombuffer(data, dtype=np.uint8)
    starts = np.concatenate([[0], found.ends + 3])
    ends = np.append(found.starts, letters.size)
    binary = np.concatenate([[0], np.cumsum(_IS_BINARY[letters])])
    count = binary[ends] - binary[np.minimum(starts, ends)]
    is_stretch = (count > 0) & (count * BINARY_SHARE >= ends - starts)
    kept: list[Reject] = []
    merged: dict[int, Reject] = {}
    line_behind: dict[int, int] = {}
    gaps = np.searchsorted(found.starts, [r.offset for r in rejects], side="right").tolist()
    for gap, reject in sorted(zip(gaps, rejects, strict=True), key=lambda pair: pair[1].offset):
        if not is_stretch[gap] or is_address(data, reject.offset):
            kept.append(reject)
            continue
        merged.setdefault(gap, reject)
        line_behind[gap] = max(line_behind.get(gap, 0), reject.record + reject.records)
    reason = "binary data between the sentences"
    return kept + [Reject(reason, r.record, r.offset, line_behind[gap] - r.record) for gap, r in merged.items()]


def _lines_without(letters: Bytes, feeds: Int64, lines: int) -> list[Reject]:
    """Return rejects of lines that are neither blank nor contain a sentence, one for each run of them."""
    if np.unique(np.searchsorted(feeds, np.flatnonzero(letters == _DOLLAR))).size == lines:
        return []
    starts = np.concatenate([[0], feeds + 1])[:lines]
    ends = np.append(feeds + 1, letters.size)[:lines]
    marks = np.concatenate([[0], np.cumsum(letters == _DOLLAR)])
    words = np.concatenate([[0], np.cumsum(letters > ord(" "))])
    empty = (marks[ends] == marks[starts]) & (words[ends] > words[starts])
    rows = np.flatnonzero(empty)
    if rows.size == 0:
        return []
    runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    reason = "there is no sentence ($…) in the line"
    return [Reject(reason, int(run[0]), int(starts[run[0]]), run.size) for run in runs]


def _sentences(kind: int, part: _Part, lines: Int64, offsets: Int64) -> Sentences:
    rows = part.rows
    values = np.full((len(VALUES), rows.size), np.nan)
    for name, column in part.values.items():
        values[VALUES.index(name)] = column
    return Sentences(
        lines[rows], offsets[rows], np.full(rows.size, kind, dtype=np.int64), part.times_ns, part.days, values
    )


# --- fields ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Part:
    """Sound sentences of one kind."""

    rows: Int64
    """(n,) their rows among the sentences given."""
    times_ns: Int64
    days: Int64
    values: dict[str, Float64]


@dataclass(frozen=True)
class _Form:
    """Layout of one kind of sentence."""

    fields: tuple[str, ...]
    """Names of the fields after the address; a later edition may add more."""
    needed: int
    """Least number of fields."""
    texts: tuple[str, ...]
    """Fields of letters."""
    used: Callable[[_Fields], dict[str, Float64]]
    """Returns the values of sound sentences, and drops others."""

    def parse(self, data: bytes, starts: Int64, ends: Int64, count: int) -> tuple[_Part, list[tuple[int, str]]]:
        """Return values of sentences with `count` fields, and damaged rows with the reason."""
        if count < self.needed:
            reason = f"the sentence has {count} fields, expected {self.needed}"
            return _nothing(), [(row, reason) for row in range(starts.size)]
        names = (*self.fields[:count], *(f"_{i}" for i in range(count - len(self.fields))))
        layout = TextLayout(("_address", *names), ",", "", 0)
        kinds: dict[str, Kind] = {n: "text" if n in self.texts else "number" for n in names if n in self.fields}
        bodies = [data[a:b] for a, b in zip((starts + 1).tolist(), ends.tolist(), strict=True)]
        text = b"\n".join([*bodies, b""])
        text_ends = np.cumsum(ends - starts)  # each body is one shorter, and has its line feed
        rows = np.arange(starts.size, dtype=np.int64)
        damaged: list[tuple[int, str]] = []
        parts: list[_Part] = []
        for block in parse_lines(text, text_ends - (ends - starts), text_ends, layout, kinds, rows, rows):
            if isinstance(block, Reject):
                damaged.append((block.record, block.reason))
            else:
                parts.append(self._part(block, damaged))
        return (parts[0] if parts else _nothing()), damaged

    def _part(self, block: TextBlock, damaged: list[tuple[int, str]]) -> _Part:
        fields = _Fields(block, Sieve(block.records.size))
        with np.errstate(invalid="ignore", over="ignore"):  # damaged sentences, dropped
            values = self.used(fields)
        for name, column in values.items():
            fields.sieve.drop(np.isinf(column), f"{name} is not a finite number")
        for reject in fields.sieve.rejects(block.records, block.records):
            rows = np.flatnonzero((block.records >= reject.record) & (block.records < reject.record + reject.records))
            damaged += [(int(block.records[row]), reject.reason) for row in rows]
        good = np.flatnonzero(fields.sieve.good)
        return _Part(
            block.records[good],
            fields.times_ns[good],
            fields.days[good],
            {name: column[good] for name, column in values.items()},
        )


def _nothing() -> _Part:
    empty = np.empty(0, dtype=np.int64)
    return _Part(empty, empty, empty, {})


class _Fields:
    """Fields of sentences of one kind, with their times and dates."""

    def __init__(self, block: TextBlock, sieve: Sieve) -> None:
        self._block = block
        self.sieve = sieve
        self.times_ns = np.full(block.records.size, UNTIMED, dtype=np.int64)
        self.days = np.full(block.records.size, UNDATED, dtype=np.int64)

    def number(self, name: str) -> Float64:
        """Return a field as numbers (n,), NaN where empty or absent."""
        if name in self._block.columns:
            return self._block.number(name)
        return np.full(self._block.records.size, np.nan)

    def among(self, name: str, *letters: str) -> list[Bool]:
        """Return for each of `letters` the mask (n,) of sentences with it; other letters are dropped."""
        if name not in self._block.columns:
            return [np.zeros(self._block.records.size, dtype=bool) for _ in letters]
        words = pc.utf8_upper(pc.utf8_trim_whitespace(self._block.columns[name]))
        *known, empty = (np.asarray(pc.equal(words, letter)) for letter in (*letters, ""))
        self.sieve.drop(~np.any([*known, empty], axis=0), f"{name} is not {' or '.join(letters)}")
        return known

    def require(self, name: str, values: Float64, low: float, high: float, unit: str) -> None:
        """Drop sentences with a value outside [low, high]; missing values pass."""
        outside = ~(np.isnan(values) | ((values >= low) & (values <= high)))
        self.sieve.drop(outside, f"{name} is outside {low:g} to {high:g} {unit}")

    def take_time(self) -> None:
        """Read the time of the day, hhmmss.sss; a sentence without one is dropped."""
        given = self.number("time")
        self.sieve.drop(np.isnan(given), "the sentence states no time")
        hour, minute, second = np.floor(given / 1e4), np.floor(given / 100) % 100, given % 100
        leap = (hour == 23) & (minute == 59)
        right = (given >= 0) & (hour < 24) & (minute < 60) & (second < np.where(leap, 61, 60))
        self.sieve.drop(~right, "time is not a time of the day (hhmmss)")
        ns = np.where(right, (hour * 3600 + minute * 60) * NS_PER_S + np.rint(second * NS_PER_S), 0)
        self.times_ns = ns.astype(np.int64)

    def take_date(self, day: Float64, month: Float64, year: Float64) -> None:
        """Read the date; a sentence with an impossible one is dropped, one without stays undated."""
        given = ~(np.isnan(day) | np.isnan(month) | np.isnan(year))
        possible = given & (month >= 1) & (month <= 12) & (day >= 1) & (day <= 31) & (year >= 1980) & (year < 2080)
        d, m, y = (np.where(possible, v, fill).astype(np.int64) for v, fill in ((day, 1), (month, 1), (year, 1980)))
        months = ((y - 1970) * 12 + m - 1).astype("datetime64[M]")
        days = months.astype("datetime64[D]") + (d - 1)
        possible &= days.astype("datetime64[M]") == months
        self.sieve.drop(given & ~possible, "there is no such date")
        self.days = np.where(possible, days.astype(np.int64), UNDATED)

    def signed(self, name: str, degrees: float, letters: tuple[str, str]) -> Float64:
        """Return latitude or longitude (degrees, (n,)) of dddmm.mmmm and a letter."""
        given = self.number(name)
        minutes = given % 100
        self.sieve.drop((given < 0) | (minutes >= 60), f"{name} is not degrees and minutes")
        out = np.floor(given / 100) + minutes / 60
        self.require(name, out, 0, degrees, "degrees")
        plus, minus = self.among(f"{name}_side", *letters)
        self.sieve.drop(~np.isnan(given) & ~plus & ~minus, f"{name} has no {letters[0]} or {letters[1]}")
        return np.where(minus, -out, out)


def _gga(f: _Fields) -> dict[str, Float64]:
    f.take_time()
    quality = f.number("quality")
    kinds = np.full(quality.size, UNKNOWN_QUALITY, dtype=np.int64)
    for number, name in GGA_QUALITY.items():
        kinds[quality == number] = QUALITIES.index(name)
    f.sieve.drop(kinds == UNKNOWN_QUALITY, "quality is not one of 0 to 9")
    latitude = f.signed("latitude", 90, ("N", "S"))
    longitude = f.signed("longitude", 180, ("E", "W"))
    altitude, undulation = f.number("altitude"), f.number("separation")
    for name, values in (("altitude", altitude), ("separation", undulation)):
        (metres,) = f.among(f"{name}_unit", "M")
        f.sieve.drop(~np.isnan(values) & ~metres, f"{name} has no unit M")
        f.require(name, values, -20_000, 20_000, "m")
    located = kinds != NO_POSITION
    f.sieve.drop(located & (np.isnan(latitude) | np.isnan(longitude)), "the sentence states a fix and no position")
    f.sieve.drop(located & np.isnan(altitude), "the sentence states a fix and no altitude")
    place = {"latitude_deg": latitude, "longitude_deg": longitude, "altitude_m": altitude, "undulation_m": undulation}
    return {name: np.where(located, values, np.nan) for name, values in place.items()} | {
        "quality": kinds.astype(np.float64),
        "satellites": f.number("satellites"),
        "hdop": np.where(located, f.number("hdop"), np.nan),  # 99.99 and the like without a fix
        "age_s": f.number("age"),
    }


def _rmc(f: _Fields) -> dict[str, Float64]:
    f.take_time()
    active, _ = f.among("status", "A", "V")
    date = np.where(active, f.number("date"), np.nan)  # a receiver without a fix may not know the date yet
    year = date % 100
    f.take_date(np.floor(date / 1e4), np.floor(date / 100) % 100, year + np.where(year < 80, 2000, 1900))
    speed, course = f.number("speed") * METRES_PER_S_IN_KNOT, f.number("course")
    return {"speed_m_per_s": np.where(active, speed, np.nan), "course_deg": np.where(active, course, np.nan)}


def _vtg(f: _Fields) -> dict[str, Float64]:
    course = f.number("course")
    (true,) = f.among("course_side", "T")
    (knots,) = f.among("knots_unit", "N")
    (kmh,) = f.among("kmh_unit", "K")
    f.sieve.drop(~np.isnan(course) & ~true, "course has no T: true north")
    invalid = f.among("mode", "N", "A", "D", "E", "F", "M", "P", "R", "S")[0]
    speed = np.where(knots, f.number("knots") * METRES_PER_S_IN_KNOT, np.nan)
    speed = np.where(np.isnan(speed) & kmh, f.number("kmh") / 3.6, speed)
    return {"course_deg": np.where(invalid, np.nan, course), "speed_m_per_s": np.where(invalid, np.nan, speed)}


def _gst(f: _Fields) -> dict[str, Float64]:
    f.take_time()
    angle = np.radians(f.number("orientation"))
    major, minor = f.number("major"), f.number("minor")
    for name, values in (("major", major), ("minor", minor)):
        f.require(f"the error ellipse's {name} axis", values, 0, 1e6, "m")
    return {
        "sigma_north_m": f.number("sigma_latitude"),
        "sigma_east_m": f.number("sigma_longitude"),
        "sigma_down_m": f.number("sigma_altitude"),
        "covariance_ne_m2": (major**2 - minor**2) * np.sin(angle) * np.cos(angle),
    }


def _zda(f: _Fields) -> dict[str, Float64]:
    f.take_time()
    f.take_date(f.number("day"), f.number("month"), f.number("year"))
    return {}


def _hdt(f: _Fields) -> dict[str, Float64]:
    heading = f.number("heading")
    (true,) = f.among("heading_side", "T")
    f.sieve.drop(~np.isnan(heading) & ~true, "heading has no T: true north")
    return {"heading_deg": heading}


def _ashr(f: _Fields) -> dict[str, Float64]:
    f.take_time()
    heading = _hdt(f)
    names = ("roll", "pitch", "sigma_roll", "sigma_pitch", "sigma_heading")
    return heading | {f"{name}_deg": f.number(name) for name in names}


_FORMS: Final[Mapping[str, _Form]] = {
    "GGA": _Form(
        (
            "time", "latitude", "latitude_side", "longitude", "longitude_side", "quality", "satellites", "hdop",
            "altitude", "altitude_unit", "separation", "separation_unit", "age", "station",
        ),
        12,
        ("latitude_side", "longitude_side", "altitude_unit", "separation_unit", "station"),
        _gga,
    ),
    "RMC": _Form(
        (
            "time", "status", "latitude", "latitude_side", "longitude", "longitude_side", "speed", "course", "date",
        ),
        9,
        ("status", "latitude", "latitude_side", "longitude", "longitude_side"),
        _rmc,
    ),
    "VTG": _Form(
        (
            "course", "course_side", "course_magnetic", "magnetic", "knots", "knots_unit", "kmh", "kmh_unit", "mode",
        ),
        8,
        ("course_side", "course_magnetic", "magnetic", "knots_unit", "kmh_unit", "mode"),
        _vtg,
    ),
    "ASHR": _Form(
        (
            "time", "heading", "heading_side", "roll", "pitch", "heave", "sigma_roll", "sigma_pitch", "sigma_heading",
        ),
        5,
        ("heading_side", "heave"),
        _ashr,
    ),
    "HDT": _Form(("heading", "heading_side"), 2, ("heading_side",), _hdt),
    "GST": _Form(
        (
            "time", "rms", "major", "minor", "orientation", "sigma_latitude", "sigma_longitude", "sigma_altitude",
        ),
        8,
        ("rms",),
        _gst,
    ),
    "ZDA": _Form(("time", "day", "month", "year"), 4, (), _zda),
}  # fmt: skip
"""Layout of the kinds, in the order of :data:`KINDS`."""
