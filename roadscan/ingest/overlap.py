"""Finds logs that cannot contribute: those without a row, and those whose times never meet the poses of their run.

Both show in the records of ingested logs, before a reading is placed. What is said of clocks is a suggestion and is
never applied: which of two logs has the wrong clock, only who drove can know.

Finds when logs were recorded before any is read completely, so that times that never meet show at once.

A small log is read completely. Of a large one, the first chunk is read, and what its format finds at its end directly
(`LogFormat.ending`). Where that end is not known, a log counts as one that lasts two days.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self

import numpy as np
import pyarrow.compute as pc

from roadscan.core.counted import counted
from roadscan.core.errors import FormatError, RoadscanError, RunError, TimeSystemError
from roadscan.core.gpstime import (
    ADJUSTED_OFFSET_S,
    GPS_EPOCH_UNIX_S,
    NS_PER_S,
    TAI_MINUS_GPS_S,
    WEEK_S,
    WEEKS_A_ROLLOVER,
    TimeSystem,
    leap_seconds_at_gps,
    leap_seconds_at_unix,
    utc_from_gps_ns,
)
from roadscan.core.grid import of_run
from roadscan.core.survey import ClockConfig, Survey
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.clock_correction import ClockCorrection
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Rows
from roadscan.store.logs import NAVIGATION, DataFile, Fault, LogRecord

Span = tuple[int, int]
"""First and last epoch (GPS ns)."""
Clocks = Mapping[tuple[str, str], ClockCorrection]
"""Estimated corrections by run ('*' for all) and sensor."""

MEASURED: Final = ("scans", "returns", "images", "imu", "encoder", "gnss", "trajectory_accuracy")
"""Tables whose rows were measured while the vehicle drove. Clouds were georeferenced by another program."""
DRIVEN: Final = {"trajectory": "the poses", "gnss": "the GNSS positions"}
"""Tables that show when a run was driven, in words; the first that a run has is used."""
_MOST_HOURS: Final = 14
"""Largest offset of a time zone from UTC (h)."""
_REASONS: Final = 3  # reasons for rejects that are listed


class NothingPlacedError(RunError):
    """No log of readings is left that could be georeferenced."""

    @classmethod
    def of(cls, faults: Sequence[Fault]) -> Self:
        """Return the error with the reason of each log."""
        lines = [f"{one.path}: {one.reason}" for one in faults]
        listed = f" {lines[0]}" if len(lines) == 1 else "".join(f"\n  - {line}" for line in lines)
        return cls(f"no reading can be placed:{listed}")


def empty_logs(records: Sequence[LogRecord]) -> list[Fault]:
    """Return the logs without a single row."""
    return [Fault((r.key,), r.path, _empty(r)) for r in records if not r.rows and r.sensor != NAVIGATION]


def _empty(record: LogRecord) -> str:
    error = no_row(record.reject_reasons)
    return f"{error} (listed in the table `rejects`)" if record.rejected else str(error)


def no_row(reject_reasons: Mapping[str, int], file: Path | None = None) -> FormatError:
    """Return the error of a log that yields no row, with the number of its rejected records by reason."""
    rejected = sum(reject_reasons.values())
    if not rejected:
        return FormatError("the log holds no record", change="see what it holds with `roadscan inspect`", file=file)
    return FormatError(
        f"not one of its {rejected:,} records can be used: {_reasons(reject_reasons)}",
        change="correct its settings, or see what is wrong with it with `roadscan inspect`",
        file=file,
    )


def reject_words(record: LogRecord) -> str:
    """Return why records of a log were rejected, by count, and where all of them are listed."""
    return f"{_reasons(record.reject_reasons)} (listed in the table `rejects`)"


def _reasons(reject_reasons: Mapping[str, int]) -> str:
    most = sorted(reject_reasons.items(), key=lambda one: -one[1])
    words = [f"{count:,} × {reason}" for reason, count in most[:_REASONS]]
    more = len(most) - _REASONS
    return "; ".join(words) + (f"; and {more} more reasons" if more > 0 else "")


REJECTED_SHARE: Final = Witness(
    "rejected_share",
    input="any log",
    fault="Much of a log is damaged, or it is read as what it is not.",
    asks="the reader and the rules of the table's columns, record by record",
    does="rejected records are left out; where they are more than checks.lost_share of the log, the log is named",
    told=("rejects", "findings"),
)


def reject_findings(records: Sequence[LogRecord], share: float) -> list[Finding]:
    """Return findings for logs with rows of which more than a share of the records was rejected."""
    return [
        REJECTED_SHARE.finds(
            r.path, f"{r.rejected:,} records were rejected beside {r.rows:,} rows: {reject_words(r)}", r.rejected
        )
        for r in records
        if r.rows and r.rejected > share * (r.rows + r.rejected)
    ]


def can_be_placed(records: Sequence[LogRecord], faults: Sequence[Fault], tables: Sequence[str]) -> bool:
    """Return whether a faultless log with rows in one of `tables` is left, whose run has poses; clouds need none."""
    keys = {key for fault in faults for key in fault.keys}
    sound = [r for r in records if r.key not in keys]
    driven = {r.run for r in sound if r.tables.get("trajectory") or r.tables.get("gnss")}
    return any(r.tables.get(t) and (t == "cloud" or r.run in driven) for r in sound for t in tables)


def apart_logs(survey: Survey, records: Sequence[LogRecord], clocks: Clocks, *, estimated: bool) -> list[Fault]:
    """Return logs that do not overlap the poses of their run in time (its GNSS where it has none).

    Parameters
    ----------
    records : of the survey's logs, and of computed trajectories where there are any.
    clocks : corrections that hold for the ingested epochs.
    estimated : whether the clocks of ``[[clocks]]`` are estimated by now; logs of their sensors are left out before.
    """
    waiting = {s for e in survey.config.clocks for s in (e.sensor, *e.also)} if not estimated else set()
    found: list[Fault] = []
    for run in dict.fromkeys(r.run for r in records):
        own = [r for r in records if r.run == run]
        driven = _driven(own)
        if driven is None:
            continue
        measured = [r for r in own if r not in driven.records and r.sensor not in waiting]
        timed = [one for r in measured if (one := _timed(r, of_run(clocks, run, r.sensor))) is not None]
        apart = [one for one in timed if not any(_meet(one.span, span) for span in driven.spans)]
        found += [_fault(survey, run, group, driven) for group in _together(apart)]
    return found


@dataclass(frozen=True)
class _Timed:
    """A log, the table of its readings, and their time span."""

    record: LogRecord
    table: str
    span: Span


def _timed(record: LogRecord, clock: ClockCorrection | None) -> _Timed | None:
    for table in MEASURED:
        span = record.span(table)
        if span is not None:
            return _Timed(record, table, _on_time(span, clock))
    return None


def _together(logs: Sequence[_Timed]) -> list[list[_Timed]]:
    """Return groups of logs that overlap in time: a fault of one applies to all."""
    groups: list[list[_Timed]] = []
    last = 0
    for log in sorted(logs, key=lambda one: one.span):
        if groups and log.span[0] <= last:
            groups[-1].append(log)
        else:
            groups.append([log])
            last = log.span[1]
        last = max(last, log.span[1])
    return groups


def _union(spans: Sequence[Span]) -> Span:
    return min(first for first, _ in spans), max(last for _, last in spans)


@dataclass(frozen=True)
class _Driven:
    """When a run was driven, by its poses or its GNSS."""

    records: list[LogRecord]
    spans: list[Span]
    words: str

    @property
    def span(self) -> Span:
        """Return the span from first to last."""
        return _union(self.spans)


def _driven(records: Sequence[LogRecord]) -> _Driven | None:
    computed = [r for r in records if r.sensor == NAVIGATION]
    for table, words in DRIVEN.items():
        own = [r for r in (computed or records) if r.tables.get(table)]
        spans = [span for r in own for file in r.tables[table] for span in file.group_spans]
        if spans:
            return _Driven(own, spans, words)
    return None


def _on_time(span: Span, clock: ClockCorrection | None) -> Span:
    if clock is None:
        return span
    first, last = clock.applied(np.array(span, dtype=np.int64))
    return int(first), int(last)


def _meet(a: Span, b: Span) -> bool:
    return a[0] <= b[1] and b[0] <= a[1]


def _fault(survey: Survey, run: str, logs: Sequence[_Timed], driven: _Driven) -> Fault:
    """Return the fault of overlapping logs of a run that do not overlap the poses."""
    records = [one.record for one in logs]
    span = _union([one.span for one in logs])
    hints = list(_hints(survey, records, span, driven))
    if hints:
        change = f"they would meet with {', or with '.join(hints)}: change it if that is what is wrong"
    else:
        change = "check the clocks of both, and that the log belongs to this run"
    tables = " and ".join(dict.fromkeys(one.table for one in logs))
    reason = TimeSystemError(
        f"the {tables} last from {_words(span)}, {driven.words} of run '{run}' from {_words(driven.span)}: "
        "they do not overlap, so nothing can be placed",
        expected="times of one drive",
        change=change,
    )
    return Fault(tuple(r.key for r in records), ", ".join(r.path for r in records), str(reason))


def _words(span: Span) -> str:
    first, last = (utc_from_gps_ns(t).isoformat(sep=" ", timespec="seconds")[:19] for t in span)
    return f"{first} to {last} UTC"


# --- what would make them meet ----------------------------------------------------------------------


def _hints(survey: Survey, records: Sequence[LogRecord], span: Span, driven: _Driven) -> Iterator[str]:
    """Yield settings of the log's and the poses' clock that would make the times meet: at most one of each."""
    sides = [(r.run, r.path, driven.span, span) for r in driven.records if r.path][:1]
    sides += [(r.run, r.path, span, driven.span) for r in records]
    said: set[str] = set()
    for run, path, own, other in sides:
        clock = _stated_clock(survey, run, path)
        for shift_s, words in _changes(clock, own, other):
            if _would_meet((own[0] + shift_s * NS_PER_S, own[1] + shift_s * NS_PER_S), other):
                if words not in said:
                    yield f"{words} for {path}"
                said.add(words)
                break


def _stated_clock(survey: Survey, run: str, path: str) -> ClockConfig | None:
    for one in survey.config.runs:
        for log in one.logs:
            if one.id == run and str(log.path) == path:
                return log.clock
    return None


def _would_meet(span: Span, other: Span) -> bool:
    """Return whether half of the shorter span would lie within the other."""
    shorter = min(span[1] - span[0], other[1] - other[0])
    return min(span[1], other[1]) - max(span[0], other[0]) >= shorter / 2


def _changes(clock: ClockConfig | None, own: Span, other: Span) -> Iterator[tuple[int, str]]:
    """Yield alternative clocks: seconds added to the epochs, and the setting in words."""
    stated = 0.0 if clock is None else clock.offset_s
    first_s = own[0] // NS_PER_S
    missing_s = ((other[0] + other[1]) - (own[0] + own[1])) / 2 / NS_PER_S
    if clock is not None:
        yield from _other_systems(clock, first_s)
        yield from _other_week(clock, own, round(missing_s / WEEK_S))
    for shift_s, why in _slips(first_s, missing_s):
        yield shift_s, f"clock.offset_s = {stated + shift_s:.15g} ({why})"
    days = round(missing_s / 86_400)
    if clock is not None and clock.date is not None and days:
        date = utc_from_gps_ns(own[0] + days * 86_400 * NS_PER_S).date()
        yield days * 86_400, f"clock.date = {date.isoformat()} ({counted(abs(days), 'day')} {_sense(days)})"


def _other_systems(clock: ClockConfig, first_s: int) -> Iterator[tuple[int, str]]:
    if clock.system not in _COUNTS:
        return
    count_s = _count(clock.system, first_s)
    for system in _COUNTS:
        shift_s = _epoch_s(system, count_s) - first_s
        if shift_s:
            yield shift_s, f'clock.system = "{system}" in place of "{clock.system}" ({_amount(shift_s)})'


def _other_week(clock: ClockConfig, own: Span, weeks: int) -> Iterator[tuple[int, str]]:
    if clock.system is not TimeSystem.GPS_WEEK or not weeks:
        return
    why = f"{counted(abs(weeks), 'week')} {_sense(weeks)}"
    if abs(weeks) == WEEKS_A_ROLLOVER:
        why += ": a receiver that counts weeks modulo 1024"
    if clock.week is not None:
        yield weeks * WEEK_S, f"clock.week = {clock.week + weeks} ({why})"
    else:
        date = utc_from_gps_ns(own[0] + weeks * WEEK_S * NS_PER_S).date()
        yield weeks * WEEK_S, f"clock.date = {date.isoformat()} ({why})"


def _slips(first_s: int, missing_s: float) -> Iterator[tuple[int, str]]:
    """Yield common clock errors (s) of any time system."""
    leap_s = int(leap_seconds_at_gps(first_s))
    sign = 1 if missing_s > 0 else -1
    yield sign * leap_s, f"the {leap_s} leap seconds between UTC and GPS time"
    yield sign * WEEKS_A_ROLLOVER * WEEK_S, "1024 weeks: a receiver that counts weeks modulo 1024"
    for epoch_s in (GPS_EPOCH_UNIX_S, GPS_EPOCH_UNIX_S - leap_s):
        yield sign * epoch_s, "seconds counted from 1970 in place of 1980, or the other way round"
    hours = round(missing_s / 3600)
    if 0 < abs(hours) <= _MOST_HOURS:
        yield hours * 3600, f"{abs(hours)} h {_sense(hours)}: a local time?"


def _sense(amount: float) -> str:
    return "later" if amount > 0 else "earlier"


def _amount(shift_s: int) -> str:
    return f"{abs(shift_s):,} s {_sense(shift_s)}"


_COUNTS: Final = (
    TimeSystem.GPS, TimeSystem.UNIX_UTC, TimeSystem.UNIX_GPS, TimeSystem.UNIX_TAI, TimeSystem.GPS_ADJUSTED,
)  # fmt: skip
"""Systems that count seconds from a fixed instant."""


def _epoch_s(system: TimeSystem, count_s: int) -> int:
    """Return the GPS seconds of a count of seconds."""
    match system:
        case TimeSystem.GPS_ADJUSTED:
            return count_s + ADJUSTED_OFFSET_S
        case TimeSystem.UNIX_GPS:
            return count_s - GPS_EPOCH_UNIX_S
        case TimeSystem.UNIX_TAI:
            return count_s - GPS_EPOCH_UNIX_S - TAI_MINUS_GPS_S
        case TimeSystem.UNIX_UTC:
            return count_s - GPS_EPOCH_UNIX_S + int(leap_seconds_at_unix(count_s))
        case _:
            return count_s


def _count(system: TimeSystem, gps_s: int) -> int:
    """Return the count of seconds that a clock of a system shows at GPS seconds."""
    if system is TimeSystem.UNIX_UTC:
        return gps_s + GPS_EPOCH_UNIX_S - int(leap_seconds_at_gps(gps_s))
    return gps_s - _epoch_s(system, 0)


_WHOLE_BYTES: Final = 4 << 20
"""Logs up to this size are read to their end."""
_LONGEST_NS: Final = 2 * 86_400 * NS_PER_S
"""Assumed longest duration of a log (ns)."""
_LOOKED_AT: Final = ("scans", "returns", "imu", "encoder", "gnss", "trajectory")
"""Tables whose logs are looked at."""


@dataclass(frozen=True)
class LookedAt:
    """A partially read log, as a record of what is known of its rows."""

    record: LogRecord
    ends: bool
    """Whether its last epoch is known; if not, its span covers only its first rows."""

    @property
    def longest(self) -> tuple[int, int]:
        """Return the earliest and latest epoch (GPS ns) that it may have."""
        (table,) = self.record.tables
        first, last = self.record.span(table) or (0, 0)
        return (first, last) if self.ends else (first, max(last, first + _LONGEST_NS))


def look_at(run: str, sensor: str, log_format: LogFormat, source: LogSource, header: LogHeader) -> LookedAt | None:
    """Return when a log begins and ends; None where its first rows have no epochs, or cannot be read."""
    if not set(_LOOKED_AT) & set(log_format.yields):
        return None
    try:
        whole = sum(file.stat().st_size for file in log_format.files(source.path)) <= _WHOLE_BYTES
        table, rows, first, last = "", 0, 0, 0
        for one in _rows_with_epochs(log_format.read(source, header), whole):
            low, high = _span(one)
            first, last = (min(first, low), max(last, high)) if rows else (low, high)
            table, rows = one.table, rows + one.batch.num_rows
        if not rows:
            return None
        ends = whole
        for one in () if whole else _rows_with_epochs(log_format.ending(source, header), whole=True):
            last, ends = max(last, _span(one)[1]), True
    except (RoadscanError, OSError):  # other checks or the full read report it
        return None
    file = DataFile("", rows, 0, "", (rows,), ((first, last),))
    record = LogRecord(
        key_of_look(run, source.path),
        run,
        sensor,
        log_format.name,
        "",
        "",
        0,
        {table: (file,)},
        header.attributes,
        rows,
        0,
        {},
    )
    return LookedAt(record, ends)


def key_of_look(run: str, path: Path) -> str:
    """Return a substitute for the log's key, which would need its fingerprint."""
    return f"{run}/{path}"


def never_meeting(survey: Survey, logs: Sequence[LookedAt]) -> list[Fault]:
    """Return the logs that cannot overlap the poses of their run, even if those of unknown end last longest."""
    return [
        fault
        for run in dict.fromkeys(one.record.run for one in logs)
        for fault in _never_meeting(survey, [one for one in logs if one.record.run == run])
    ]


def _never_meeting(survey: Survey, logs: Sequence[LookedAt]) -> list[Fault]:
    driven = next((own for table in DRIVEN if (own := [one for one in logs if table in one.record.tables])), [])
    apart = [one.record for one in logs if not any(_meet(one.longest, other.longest) for other in driven)]
    return apart_logs(survey, [*(one.record for one in driven), *apart], {}, estimated=False) if apart else []


def named(log: LookedAt, path: str) -> LookedAt:
    """Return the same with its path in the survey file."""
    return replace(log, record=replace(log.record, path=path))


def _rows_with_epochs(items: Iterator[Item], whole: bool) -> Iterator[Rows]:
    """Yield rows with epochs: all of them, or only the first."""
    try:
        for item in items:
            if isinstance(item, Rows) and item.table in _LOOKED_AT and item.batch.num_rows:
                yield item
                if not whole:
                    return
    finally:
        getattr(items, "close", lambda: None)()


def _span(rows: Rows) -> tuple[int, int]:
    ends = pc.min_max(rows.batch.column("epoch_gps_ns")).as_py()
    return int(ends["min"]), int(ends["max"])
