"""Reads time stamps in a column of text: numbers in the clock's unit, or calendar times (ISO 8601).

Calendar times with a zone are UTC; without one, the survey file has to say on which scale they are
written. Both are counted in nanoseconds from 1970 on that scale, and the clock does the rest.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, UNIT_NS, WEEKS_A_ROLLOVER, Clock, TimeSystem, leap_seconds_at_unix
from roadscan.core.witness import Witness
from roadscan.ingest.reading.columns import Found, Quantity, need_stamp_unit
from roadscan.ingest.reading.format import LogSource
from roadscan.ingest.reading.records import Sieve
from roadscan.ingest.reading.text_table import Kind, TextBlock, TextLayout, first_fields, is_number, stamp_kind

TIME: Final = Quantity(
    "time", "time",
    ("timestamp", "stamp", "datetime", "date_time", "gps_time", "utc_time", "unix_time", "gpst_unix", "utctime", "zeit",
     "gps_seconds", "gps_sow", "sow", "tow", "seconds_of_week"),
)  # fmt: skip
"""Column of time stamps by its common names."""
DATES: Final = ("date", "date_utc", "utc_date", "utcdate")
"""Names of a column with the date, where the column of stamps only has the time of day."""
_TIME_OF_DAY: Final = re.compile(r"T?\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d*)?)?(?:Z|[+-]\d{2}:?\d{2})?")
_OTHER_TIMES: Final = (
    (re.compile(r"^\s*\d{1,2}\.\d{1,2}\.\d{4}"), ": day, month and year stand as in German texts"),
    (re.compile(r"^\s*\d{1,2}/\d{1,2}/\d{4}"), ": whether day or month stands first is not said"),
    (re.compile(r"[AaPp]\.?[Mm]\.?\s*$"), ": hours of 12 with AM and PM are not read"),
    (re.compile(r"\d{2}:\d{2}:\d{2}:\d+"), ": the fraction of the second stands behind a colon"),
)
"""Messages about time formats that other programs write."""
_LEAP_SECOND: Final = re.compile(r"23:59:60")
_UNIT_STAMPS: Final = 50
"""Stamps from which a unit is proposed."""
_OF_OUR_TIME_S: Final = (4.75e8, 2.524e9)
"""Range of seconds since 1970 or 1980 that give a date between 1985 and 2060."""
_SLOWEST_STEP_NS: Final = 2 * NS_PER_S
"""Longest usual interval between a sensor's records (ns)."""
CALENDAR_SCALES: Final = (TimeSystem.UNIX_UTC, TimeSystem.UNIX_GPS, TimeSystem.UNIX_TAI)
"""Scales on which a calendar time without a zone can be written."""


SCALE_OF_TIMES: Final = Witness(
    "scale_of_calendar_times",
    "any text with calendar times",
    "Calendar times stand without a zone, or without a date.",
    "the first times of the file, the names of its columns and the stated clock",
    "nothing is assumed: the log is refused until its clock states the scale; times of day without a date are refused",
    ("error",),
)

WEEK_COLUMN: Final = Witness(
    "week_column",
    input="any text with seconds of the GPS week",
    fault="The clock in the survey file states another GPS week than the log.",
    asks="a column gps_week, gpsweek, week_number or week of the log, in its first row",
    does="the log is refused; the message names both weeks",
    told=("error",),
)
_WEEKS: Final = ("gps_week", "gpsweek", "gps_week_number", "week_number", "week")
"""Names of a column with the GPS week."""


@dataclass(frozen=True)
class StampColumn:
    """The column of a text table with the log's stamps."""

    column: str
    kind: Kind
    clock: Clock
    """Clock of the numbers that :meth:`stamps` returns."""
    zoned: bool
    """Calendar times have a zone."""
    date: str | None = None
    """Column of the date, where `column` only has the time of day."""
    is_utc: bool = False
    """Calendar times are UTC: `clock` reads the numbers that :meth:`stamps` returns, including leap seconds."""

    @property
    def kinds(self) -> dict[str, Kind]:
        """Return the kind of each column from which the stamps are read."""
        return {self.column: self.kind} | ({} if self.date is None else {self.date: "text"})

    @classmethod
    def of(cls, source: LogSource, file: Path, layout: TextLayout, found: Found) -> Self:
        """Find how the stamps of `file` are written, and check the stated clock against that.

        Raises
        ------
        TimeSystemError
            if the clock is not stated, or fits neither the column's unit nor the way times are written.
        """
        clock = source.any_clock
        kind = stamp_kind(file, layout, found.column, "s" if clock is None else clock.unit)
        if kind != "text":
            clock = source.need_clock("gps", unit=first_unit(file, layout, found))
            need_stamp_unit(found, clock, file)
            _check_week(clock, layout, file)
            return cls(found.column, kind, clock, zoned=False)
        word = _first_word(file, layout, found.column)
        date = _date_column(word, found.column, layout, file)
        if date is not None:
            word = f"{_first_word(file, layout, date)}T{word}"
        zoned = parse_calendar([word], zoned=True) is not None
        named_utc = any("utc" in name.lower() for name in (found.column, date or ""))
        is_utc = zoned or (named_utc and clock is None)
        stated = source.clock if zoned else clock
        own = calendar_clock(stated, word, file, zoned=zoned, is_utc=is_utc)
        if own.system is TimeSystem.UNIX_UTC:
            return cls(found.column, kind, replace(own, system=TimeSystem.UNIX_GPS), zoned, date, is_utc=True)
        return cls(found.column, kind, own, zoned, date)

    def stamps(self, block: TextBlock, sieve: Sieve) -> npt.NDArray[np.generic]:
        """Return stamps (n,) of a block, float64 or int64, in `clock`'s unit; drop faulty ones from `sieve`."""
        if self.kind != "text":
            return block.stamps(self.column)
        words = block.text(self.column)
        if self.date is not None:
            words = [f"{date}T{time}" for date, time in zip(block.text(self.date), words, strict=True)]
        return (_leaping_ns if self.is_utc else calendar_ns)(words, sieve, zoned=self.zoned)


def _check_week(clock: Clock, layout: TextLayout, file: Path) -> None:
    """Refuse a clock whose week differs from the log's column of weeks, which may count modulo 1024."""
    column = next((name for name in layout.names if name.lower() in _WEEKS), None)
    if clock.system is not TimeSystem.GPS_WEEK or column is None or clock.week == 0:  # inspect assumes week 0
        return
    word, stated = _first_word(file, layout, column), clock.first_week()
    if is_number(word) and (float(word) - stated) % WEEKS_A_ROLLOVER:
        raise TimeSystemError(
            f"column '{column}' begins with week {word}, the log's clock says week {stated}",
            expected="one GPS week",
            change="correct week or date of the log's clock",
            file=file,
            missing=Missing("clock", {"system": "gps_week_seconds", "week": int(float(word))}),
        )


def first_unit(path: Path, layout: TextLayout, found: Found) -> str:
    """Return the likely unit of a text table's stamps: that of the column's name, else of :func:`likely_unit`."""
    if found.unit in UNIT_NS:
        return found.unit
    index = layout.names.index(found.column)
    words = [fields[index].strip() for fields in first_fields(path, layout, _UNIT_STAMPS)]
    return likely_unit(np.array([float(word) for word in words if is_number(word)]))


def likely_unit(stamps: Float64) -> str:
    """Return the unit in which stamps (n,) are present-day times or, for small counts, at least one in two seconds.

    It is good for a proposal alone.
    """
    if stamps.size == 0 or not np.isfinite(stamps).all():
        return "s"
    of_our_time = next(
        (unit for unit, ns in UNIT_NS.items() if _OF_OUR_TIME_S[0] < stamps[0] * ns / NS_PER_S < _OF_OUR_TIME_S[1]), ""
    )
    steps = np.abs(np.diff(stamps))
    steps = steps[steps > 0]
    if of_our_time or steps.size == 0:
        return of_our_time or "s"
    units = sorted(UNIT_NS, key=lambda unit: -UNIT_NS[unit])
    return next((unit for unit in units if np.median(steps) * UNIT_NS[unit] <= _SLOWEST_STEP_NS), units[-1])


def _first_word(path: Path, layout: TextLayout, column: str) -> str:
    index = layout.names.index(column)
    words = (fields[index].strip() for fields in first_fields(path, layout, 20))
    return next((word for word in words if word), "")


def _date_column(word: str, column: str, layout: TextLayout, file: Path) -> str | None:
    """Return the column of the date for a time of day such as `word`; None where `word` includes a date.

    Raises
    ------
    FormatError
        if the file has no column of dates.
    """
    if not _TIME_OF_DAY.fullmatch(word):
        return None
    date = next((name for name in layout.names if name.lower() in DATES), None)
    if date is None:
        raise FormatError(
            f"column '{column}' holds times of day such as '{word}', and no column holds the date",
            expected="ISO 8601 text such as 2026-05-04T09:30:00.125Z, or a column 'date' such as 2026-05-04",
            change="export the log with its date",
            file=file,
        )
    return date


def calendar_clock(clock: Clock | None, word: str, file: Path, *, zoned: bool, is_utc: bool = False) -> Clock:
    """Return the clock of calendar times such as `word`, in nanoseconds from 1970 on the scale of the times.

    Parameters
    ----------
    is_utc : the names of the columns say that the times are UTC, and no clock is stated.

    Raises
    ------
    TimeSystemError
        if `word` has a zone and the clock is not UTC, or has no zone and the clock does not say the scale.
    FormatError
        if `word` is no calendar time.
    """
    if zoned or (is_utc and parse_calendar([word], zoned=False) is not None):
        if clock is not None and clock.system is not TimeSystem.UNIX_UTC:
            raise TimeSystemError(
                f"time '{word}' has a zone, so it is UTC, the clock says {clock.system}",
                expected='clock.system = "unix_utc", or no clock',
                file=file,
                missing=Missing("clock", {"system": "unix_utc"}),
            )
        return replace(clock or Clock(TimeSystem.UNIX_UTC), unit="ns")
    if parse_calendar([word], zoned=False) is None:
        why = next((why for pattern, why in _OTHER_TIMES if pattern.search(word)), "")
        raise FormatError(
            f"time '{word[:40]}' is neither a number nor ISO 8601 text{why}",
            expected="such as 2026-05-04T09:30:00.125Z",
            change="export times so, or as seconds",
            file=file,
        )
    if clock is None or clock.system not in CALENDAR_SCALES:
        raise TimeSystemError(
            f"time '{word}' has no zone",
            expected="clock.system = unix_utc, unix_gps or unix_tai: the scale it is written in",
            change='add clock = { system = "unix_utc" } if it is UTC',
            file=file,
            missing=Missing("clock", {"system": "unix_utc"}),
        )
    return replace(clock, unit="ns")


def calendar_ns(words: Sequence[str], sieve: Sieve, *, zoned: bool) -> Int64:
    """Return nanoseconds (n,) from 1970 of ISO 8601 times; a word that is none costs its record."""
    whole = parse_calendar(words, zoned=zoned)
    if whole is not None:
        return whole
    singles = [parse_calendar([word], zoned=zoned) for word in words]
    zone = "with" if zoned else "without"
    sieve.drop(np.array([one is None for one in singles]), f"time is not ISO 8601 text {zone} a zone, as the first is")
    return np.array([0 if one is None else one[0] for one in singles], dtype=np.int64)


def _leaping_ns(words: Sequence[str], sieve: Sieve, *, zoned: bool) -> Int64:
    """Return nanoseconds (n,) from 1970 on the GPS scale of UTC times; 23:59:60 is valid at leap seconds."""
    leaps = np.array([_LEAP_SECOND.search(word) is not None for word in words], dtype=np.int64)
    plain = [word.replace("23:59:60", "23:59:59") for word in words] if leaps.any() else words
    utc_ns = calendar_ns(plain, sieve, zoned=zoned)
    before, behind = (leap_seconds_at_unix(utc_ns // NS_PER_S + later) for later in (0, 1))
    sieve.drop((leaps > 0) & (before == behind), "time is 23:59:60 on a day without a leap second")
    return np.asarray(utc_ns + (before + leaps) * NS_PER_S, dtype=np.int64)


def parse_calendar(words: Sequence[str], *, zoned: bool) -> Int64 | None:
    """Return nanoseconds (n,) from 1970 of ISO 8601 times that all have, or all lack, a zone; None if one differs."""
    kind = pa.timestamp("ns", "UTC") if zoned else pa.timestamp("ns")
    try:
        text = pc.replace_substring(pa.array(words, pa.string()), ",", ".")  # ISO 8601 allows a decimal comma
        return np.asarray(pc.cast(text, kind).cast(pa.int64()), dtype=np.int64)
    except pa.ArrowInvalid:
        return None
