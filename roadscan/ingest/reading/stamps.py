"""Reads time stamps in a column of text: numbers in the clock's unit, or calendar times (ISO 8601).

Calendar times with a zone are UTC; without one, the survey file has to say on which scale they are
written. Both are counted in nanoseconds from 1970 on that scale, and the clock does the rest.
"""

from __future__ import annotations

import datetime as dt
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError, FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import (
    ADJUSTED_OFFSET_S,
    EARLIEST_GPS_NS,
    GPS_EPOCH_UNIX_S,
    LATEST_GPS_NS,
    NS_PER_S,
    UNIT_NS,
    WEEKS_A_ROLLOVER,
    Clock,
    TimeSystem,
    gps_ns_from_utc,
    iso_from_gps_ns,
    leap_seconds_at_unix,
)
from roadscan.core.witness import Witness
from roadscan.ingest.reading.column_table import is_number as table_is_number
from roadscan.ingest.reading.columns import Found, Quantity, need_stamp_unit
from roadscan.ingest.reading.format import LogHeader, LogSource, Rows
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


EPOCH: Final = "epoch_gps_ns"
"""Column of GPS time (int64, ns since 1980-01-06): such a table needs no clock."""


@dataclass(frozen=True)
class TableStamps:
    """The column of a table with the log's stamps."""

    column: str
    clock: Clock
    """Clock of the numbers that :meth:`stamps` returns."""

    @classmethod
    def of(cls, source: LogSource, schema: pa.Schema, time: Found | None) -> Self:
        """Find how the stamps are written, and check the stated clock against that.

        Parameters
        ----------
        time : the column of stamps in the log's clock; None for a table with the column `epoch_gps_ns`.

        Raises
        ------
        ConfigError, FormatError, TimeSystemError
            if a clock is stated that is not needed, the column holds no stamps, or the clock is missing or another.
        """
        if time is None:
            refuse_clock(source)
            need_type(schema, EPOCH, pa.types.is_int64(schema.field(EPOCH).type), "int64", source)
            return cls(EPOCH, Clock(TimeSystem.GPS, unit="ns"))
        kind = schema.field(time.column).type
        if pa.types.is_timestamp(kind):
            shown = "2026-05-04T09:30:00" + ("Z" if kind.tz else "")
            stated = source.clock if kind.tz else source.any_clock
            return cls(time.column, calendar_clock(stated, shown, source.path, zoned=bool(kind.tz)))
        need_type(
            schema, time.column, table_is_number(kind), "numbers in the unit of the log's clock, or timestamps", source
        )
        clock = source.need_clock("gps", unit="s")
        need_stamp_unit(time, clock, source.path)
        return cls(time.column, clock)

    def stamps(self, batch: pa.RecordBatch, sieve: Sieve) -> npt.NDArray[np.generic]:
        """Return stamps (n,) of a batch, float64 or int64, in `clock`'s unit; missing ones are dropped from `sieve`."""
        return column_stamps(batch.column(self.column), sieve, is_epoch=self.column == EPOCH)


def column_stamps(stamps: pa.Array, sieve: Sieve, *, is_epoch: bool) -> npt.NDArray[np.generic]:
    """Return values (n,) of a column of stamps, 0 where missing; GPS epochs outside 1980–2080 are dropped."""
    sieve.drop(np.asarray(stamps.is_null()), "the time stamp is missing")
    if pa.types.is_timestamp(stamps.type):
        stamps = stamps.cast(pa.timestamp("ns", stamps.type.tz), safe=False).cast(pa.int64())
    values = np.asarray(stamps.fill_null(0).to_numpy(zero_copy_only=False))
    if values.dtype.kind in "iu":
        values = values.astype(np.int64, copy=False)
    if is_epoch:
        sieve.drop((values < EARLIEST_GPS_NS) | (values > LATEST_GPS_NS), f"{EPOCH} is outside 1980–2080")
    return values


def refuse_clock(source: LogSource) -> None:
    """Raise :class:`ConfigError` where a clock is stated for a table of GPS epochs."""
    if source.clock is not None:
        raise ConfigError(
            f"a clock is stated, and the column '{EPOCH}' is GPS time already",
            expected="no clock, or the stamps in a column 'time'",
            file=source.path,
        )


def need_type(schema: pa.Schema, column: str, fits: bool, expected: str, source: LogSource) -> None:
    """Raise :class:`FormatError` unless a column's type `fits`."""
    if not fits:
        raise FormatError(f"column '{column}' is {schema.field(column).type}", expected=expected, file=source.path)


TIME_IN_FUTURE: Final = Witness(
    "time_in_future",
    input="any log with a stamp a row",
    fault="The stamps are on another scale than the log or its clock says, such as POSIX seconds under the bit of "
    "standard GPS time.",
    asks="the later of the log file's own date and this computer's, and a day",
    does="rows of a later time are left out; the reason names the scale on which they would not lie in the future",
    told=("rejects",),
)

_MARGIN_NS: Final = 86_400 * NS_PER_S
"""Tolerance (ns): clocks of two computers, or local times taken as UTC, differ by less."""
_ORIGIN_GPS_S: Final = {
    TimeSystem.UNIX_UTC: -GPS_EPOCH_UNIX_S,
    TimeSystem.GPS: 0,
    TimeSystem.GPS_ADJUSTED: ADJUSTED_OFFSET_S,
}
"""GPS seconds at which the count of each scale begins, to within some leap seconds."""
_EARLIEST_GPS_S: Final = 630_720_000
"""Start of 2000 (GPS s): there was no mobile mapping before."""


@dataclass
class FutureTimes:
    """Checks the epochs of one log against today's date."""

    latest_gps_ns: int
    system: TimeSystem | None
    """Assumed time system of the stamps, where one is known; a free clock has no date."""
    _reason: str = field(default="")

    @classmethod
    def of(cls, source: LogSource, header: LogHeader) -> FutureTimes:
        """Return the check of a log as the survey file describes it."""
        written_unix_s = source.path.stat().st_mtime if source.path.exists() else 0.0
        now = dt.datetime.fromtimestamp(max(time.time(), written_unix_s), dt.UTC)
        said = header.attributes.get("time_system") or (source.any_clock.system if source.any_clock else None)
        known = TimeSystem(said) if said in set(TimeSystem) else None
        return cls(gps_ns_from_utc(now) + _MARGIN_NS, known)

    def refused(self, rows: Rows) -> list[tuple[npt.NDArray[np.int64], str]]:
        """Return the rows of a chunk (by index) that lie in the future, with the reason."""
        _, batch = rows.stored
        if self.system is TimeSystem.FREE or not batch.num_rows or "epoch_gps_ns" not in batch.schema.names:
            return []
        column = batch.column("epoch_gps_ns")
        last = pc.max(column).as_py() if pa.types.is_int64(column.type) else None
        if last is None or last <= self.latest_gps_ns:
            return []
        late = np.flatnonzero(
            pc.fill_null(pc.greater(column, self.latest_gps_ns), False).to_numpy(zero_copy_only=False)
        )
        self._reason = self._reason or self._words(int(column[int(late[0])].as_py()))
        return [(late, self._reason)]

    def _words(self, epoch_gps_ns: int) -> str:
        text = f"the time lies in the future ({iso_from_gps_ns(epoch_gps_ns)[:19]}Z"
        if self.system not in _ORIGIN_GPS_S:
            return f"{text}): check the log's clock"
        counted_s = epoch_gps_ns // NS_PER_S - _ORIGIN_GPS_S[self.system]
        for system, origin_s in _ORIGIN_GPS_S.items():
            other_s = counted_s + origin_s
            if system is not self.system and _EARLIEST_GPS_S < other_s <= self.latest_gps_ns // NS_PER_S:
                there = iso_from_gps_ns(other_s * NS_PER_S)[:10]
                return (
                    f"{text} as '{self.system}'): as '{system}' it would be {there}; if it was driven then, state "
                    f'clock = {{ system = "{system}" }}'
                )
        return f"{text} as '{self.system}'): check the log's clock"
