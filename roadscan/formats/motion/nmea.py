"""NMEA 0183: the text that GNSS receivers write."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Final, Literal

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.crs import Geoid
from roadscan.core.errors import ConfigError, CrsError, FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, Clock, leap_seconds_at_unix
from roadscan.core.strict import Strict
from roadscan.core.witness import Finding, Witness
from roadscan.formats.lidars.pcap import MAGICS, PCAPNG
from roadscan.formats.motion.nmea_sentences import (
    DAY_NS,
    KINDS,
    UNDATED,
    UNTIMED,
    VALUES,
    Sentences,
    find_sentences,
    is_address,
    kinds_of,
    parse_sentences,
)
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import NO_POSITION, GnssReader, RawSolutions, utc_clock
from roadscan.ingest.reading.poses import GeodeticPlacement, check_geographic
from roadscan.ingest.reading.records import EpochReader, Sieve, drop_failing, few_rejects, options_of
from roadscan.ingest.reading.text_table import SEARCHED_BYTES, head_of, line_blocks

LATE_NS: Final = 2 * NS_PER_S
"""Largest delay of an epoch's sentences relative to others."""
HELD_MAX: Final = 20_000
"""Sentences that wait for late ones; more in so short a time mean a clock that stands still."""
SNIFF_BYTES: Final = 1 << 14  # bytes from which the format is recognised
MIXED_SENTENCES: Final = 3
"""Known sentences with valid checksums that make a log with binary messages an NMEA log."""

SENTENCES_GO_BACK: Final = Witness(
    "nmea_time_goes_back",
    input="nmea",
    fault="The times of sentences go back: logs were appended to one another, or the receiver set its clock.",
    asks="the time of each sentence against the one before it, over 2 s",
    does="of sentences of one kind and epoch the first counts; other epochs are used, and the log is named",
    told=("rejects", "findings"),
)

_EPOCH_DAY: Final = dt.date(1970, 1, 1)  # origin of day counts
_UNKNOWN: Final = np.iinfo(np.int64).min


_UBX_SOLUTION: Final = b"\xb5\x62\x01\x07\x5c\x00"  # how a NAV-PVT of UBX begins
_PLACED: Final = re.compile(rb"GGA,[^,\r\n]*,\d")  # a GGA with a latitude
_BAGS: Final = (b"#ROS", b"\x89MCA", b"SQLi")  # first bytes of ROS bags


class NmeaOptions(Strict):
    """Settings of `nmea`."""

    altitude: Literal["above_geoid", "ellipsoidal"] = "above_geoid"
    """What GGA's altitude counts from: the geoid, as the standard has it, or the ellipsoid, as some receivers
    can be set to; the geoid separation is then not looked at."""
    untimed: Literal["before", "after"] = "before"
    """Whose time sentences without their own (VTG, HDT) have: that of the sentence before them, as most
    receivers write, or of the one after."""


class Nmea(LogFormat):
    """Sentences of any talker; those of one time become one row.

    GGA gives position, quality, satellites, hdop and age; RMC date, speed and course; VTG speed and
    course; GST σ of the position; ZDA the date; HDT the heading; PASHR (the form of $PASHR,hhmmss.sss,
    heading,T,roll,pitch,heave,σ,σ,σ,…) heading, roll and pitch with σ. Others are passed over. Velocity
    north and east come from speed and course; without a course (at rest) the speed alone is kept. Words
    before the ``$`` are passed over; a sentence without its right checksum is rejected, and so is a line
    without one. A record is a line. Binary messages of a receiver (UBX, RTCM) may stand between the
    sentences; where they look like damage, each stretch of them is one reject.

    GGA's altitude is above the geoid: the separation that the sentence states makes it ellipsoidal. A log
    without it needs height = "orthometric" and the geoid, or options.altitude = "ellipsoidal".

    Times of the day get their date from RMC (status A) and ZDA, and count on over midnight between them.
    Epochs whose sentences state no position with a height have quality 'none'. The datum is the receiver's or its
    corrections': state it as crs.
    """

    name = "nmea"
    title = "NMEA 0183 log: GGA, RMC, VTG, GST, ZDA, HDT, PASHR"
    yields = ("gnss",)
    suffixes: ClassVar[tuple[str, ...]] = (".nmea",)
    time = (
        "UTC by its nature; the date comes from RMC or ZDA. A log without either needs clock = "
        '{ system = "unix_utc", date = 2026-05-04 }, the UTC date of its first sentence'
    )
    options = NmeaOptions

    def sniff(self, path: Path) -> bool:
        """True if the first sentences are known, with right checksums for the most part; several in binary data.

        Where they state no position, and solutions of UBX stand between them, the log is one of UBX.
        """
        head = head_of(path, SNIFF_BYTES) if path.is_file() else b""
        if b"$" not in head or head[:4] in {*MAGICS, PCAPNG, *_BAGS}:  # they may hold the sentences of a receiver
            return False
        whole = head[: head.rfind(b"\n") + 1] or head
        found = find_sentences(whole)
        known = int((kinds_of(whole, found.starts, found.ends) >= 0).sum())
        if b"\x00" not in head and known and found.starts.size >= len(found.faulty):
            return True
        if _UBX_SOLUTION in head and not _PLACED.search(head):
            return False
        damaged = sum(is_address(whole, dollar) for dollar, _ in found.faulty)
        return known >= MIXED_SENTENCES and found.starts.size >= damaged

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights, and find the first date."""
        source.need_file()
        plan = _plan(source)
        return LogHeader({"world_frame": plan.placement.world, "date": _date_of(plan.first_day).isoformat()})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream epochs; damaged sentences, and such as have no time, are rejected."""
        plan = _plan(source)
        calendar = _Calendar(plan, source.path)
        epochs = _Epochs()
        solutions = _Solutions(source, plan)
        fixes = heights = 0
        for sentences in _sentences(source.path):
            if isinstance(sentences, Reject):
                yield sentences
                continue
            fixes += int(((sentences.kinds == KINDS.index("RMC")) & (sentences.days != UNDATED)).sum())
            heights += int((sentences.kinds == KINDS.index("GGA")).sum())
            yield from solutions.items(epochs, *calendar.timed(sentences))
        yield from solutions.items(epochs, *calendar.finish(), last=True)
        yield from calendar.findings()
        if fixes and not heights:
            raise FormatError(
                f"{fixes} RMC sentences state a position, and no GGA sentence its height",
                expected="GGA sentences: RMC alone places nothing",
                change="let the receiver write GGA too",
                file=source.path,
            )


def _sentences(path: Path, limit: int | None = None) -> Iterator[Sentences | Reject]:
    """Yield all sentences of a log, or of its first `limit` bytes, block by block."""
    line = 0
    for offset, data in line_blocks(path, limit=limit):
        if isinstance(data, Reject):
            yield replace(data, record=line, offset=offset)
            line += 1
            continue
        sentences, rejects, lines = parse_sentences(data, line, offset)
        yield from rejects
        yield sentences
        line += lines


# --- how one file is read --------------------------------------------------------------------------


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    options: NmeaOptions
    clock: Clock
    placement: GeodeticPlacement
    first_day: int
    """Days from 1970-01-01 to the date of the first sentence with a time."""


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, NmeaOptions)
    clock = utc_clock(source, "NMEA times are UTC")
    if options.altitude == "ellipsoidal" and source.any_height == "orthometric":
        raise ConfigError(
            'options.altitude = "ellipsoidal", and height = "orthometric"',
            expected="one kind of heights",
            file=source.path,
        )
    check_geographic(source.need_crs(), source.path)
    if source.geoid is not None:
        source.geoid.undulation_m([], [])  # reports at once where the grid is missing
    placement = GeodeticPlacement(source.need_crs(), "ellipsoidal", None, source.path)
    return _Plan(options, clock, placement, _first_day(source))


def _first_day(source: LogSource) -> int:
    """Return the date of the log's first sentence with a time, from its first date and the midnights before that."""
    stated = source.clock.date if source.clock is not None else None
    found = _first_dated_day(source.path)
    if found is None and stated is None and source.defaults.week is not None:
        stated = source.defaults.week.date
    if found is None and stated is None:
        raise TimeSystemError(
            "no sentence states a date",
            expected="RMC (status A) or ZDA, or the date in the log's clock",
            change='add clock = { system = "unix_utc", date = 2026-05-04 }, the UTC date of the first sentence',
            file=source.path,
            missing=Missing("clock", {"system": "unix_utc", "date": dt.date(2026, 5, 4)}),
        )
    if found is not None and stated is not None and _date_of(found) != stated:
        raise TimeSystemError(
            f"the log starts on {_date_of(found)}, the clock says {stated}",
            expected="one date",
            change="leave clock.date out",
            file=source.path,
        )
    return found if found is not None else (stated or _EPOCH_DAY).toordinal() - _EPOCH_DAY.toordinal()


def _first_dated_day(path: Path) -> int | None:
    head = (s for s in _sentences(path, SEARCHED_BYTES) if not isinstance(s, Reject))
    if not any((sentences.times_ns != UNTIMED).any() for sentences in head):
        return None  # whatever the file is, it need not be read to its end
    midnights = _Midnights()
    for sentences in _sentences(path):
        if isinstance(sentences, Reject):
            continue
        timed = np.flatnonzero(sentences.times_ns != UNTIMED)
        days = sentences.days[timed]
        passed = midnights.passed(sentences.times_ns[timed])
        dated = np.flatnonzero(days != UNDATED)
        if dated.size:
            return int(days[dated[0]] - passed[dated[0]])
    return None


def _date_of(day: int) -> dt.date:
    return dt.date.fromordinal(_EPOCH_DAY.toordinal() + day)


# --- time ------------------------------------------------------------------------------------------


class _Midnights:
    """Counts the midnights between times of the day."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._count = 0

    def passed(self, times_ns: Int64) -> Int64:
        """Return midnights (n,) since the log's first time; a step of over half a day is one, forwards or back."""
        if times_ns.size == 0:
            return times_ns
        before = times_ns[0] if self._last_ns is None else self._last_ns
        steps = np.diff(times_ns, prepend=before)
        count = self._count + np.cumsum((steps < -DAY_NS // 2).astype(np.int64) - (steps > DAY_NS // 2))
        self._last_ns, self._count = int(times_ns[-1]), int(count[-1])
        return count


class _Calendar:
    """Adds dates to times of the day, and converts sentences' times to GPS time."""

    def __init__(self, plan: _Plan, file: Path) -> None:
        self._epochs = EpochReader(plan.clock, file)
        self._after = plan.options.untimed == "after"
        self._midnights = _Midnights()
        self._first_day = plan.first_day
        self._last_epoch = _UNKNOWN
        self._waiting = Sentences.joined([])
        self._last_ns: int | None = None
        self._back: list[tuple[int, int]] = []
        """Size of each step back in time (ns), with its line."""

    def timed(self, sentences: Sentences) -> tuple[Sentences, Int64, list[Reject]]:
        """Return sentences with their GPS epochs (n,), and those without one as rejects."""
        before = self._waiting.size
        sentences = Sentences.joined([self._waiting, sentences])
        rows = np.flatnonzero(sentences.times_ns != UNTIMED)
        sieve = Sieve(rows.size)
        own = self._own_epochs(sentences.take(rows), sieve)
        untimed = np.flatnonzero(sentences.times_ns == UNTIMED)
        lent, waiting = self._lent_epochs(own, rows, untimed)
        waiting &= untimed >= before  # none waits for a whole block
        self._waiting = sentences.take(untimed[waiting])
        epochs = np.full(sentences.size, _UNKNOWN, dtype=np.int64)
        epochs[rows], epochs[untimed] = own, lent
        rejects = _single(sieve, sentences.take(rows))
        homeless = sentences.take(untimed[(lent == _UNKNOWN) & ~waiting])
        rejects += _rejects(homeless, np.arange(homeless.size), "the sentence has no time, and none to share")
        good = epochs != _UNKNOWN
        return sentences.take(good), epochs[good], rejects

    def finish(self) -> tuple[Sentences, Int64, list[Reject]]:
        """Return sentences that no time followed."""
        left, self._waiting = self._waiting, Sentences.joined([])
        rejects = _rejects(left, np.arange(left.size), "the sentence has no time, and none follows to share")
        return Sentences.joined([]), np.empty(0, dtype=np.int64), rejects

    def _own_epochs(self, timed: Sentences, sieve: Sieve) -> Int64:
        """Return GPS epochs (n,) of sentences that state a time; undefined where dropped."""
        if timed.size == 0:
            return np.empty(0, dtype=np.int64)
        passed = self._midnights.passed(timed.times_ns)
        days = self._days(timed, passed, sieve) + passed
        leap = timed.times_ns >= DAY_NS  # 23:59:60 has no separate POSIX time
        unix_ns = days * DAY_NS + timed.times_ns - np.where(leap, NS_PER_S, 0)
        second = unix_ns // NS_PER_S
        real = leap_seconds_at_unix(second + 1) > leap_seconds_at_unix(second)
        sieve.drop(leap & ~real, "time is 23:59:60 on a day without a leap second")
        epochs = self._epochs.epochs(unix_ns, sieve, timed.lines) + np.where(leap, NS_PER_S, 0)
        good = np.flatnonzero(sieve.good)
        if good.size:
            own = epochs[good]
            steps = np.diff(own, prepend=own[0] if self._last_ns is None else self._last_ns)
            far = np.flatnonzero(steps < -LATE_NS)
            self._back += [(-int(steps[k]), int(timed.lines[good[k]])) for k in far]
            self._last_ns = int(own[-1])
        return np.where(sieve.good, epochs, _UNKNOWN)

    def findings(self) -> Iterator[Finding]:
        """Yield a finding if the times of the log go back."""
        if self._back:
            farthest_ns, line = max(self._back)
            yield SENTENCES_GO_BACK.finds(
                "",
                f"the times of its sentences go back {len(self._back):,} times, by {farthest_ns / NS_PER_S:.1f} s at "
                f"the most (line {line + 1:,}): logs were appended to one another, or the receiver's clock was set; of "
                "sentences of one epoch the first counts, and all other epochs are used",
            )

    def _days(self, timed: Sentences, passed: Int64, sieve: Sieve) -> Int64:
        """Return the date (n,) of the log's first time by each sentence's epoch, or by the last date before it."""
        run = _epoch_runs(timed)
        dated = np.flatnonzero(timed.days != UNDATED)[::-1]  # the first of an epoch counts
        of_run = np.full(run[-1] + 1, UNDATED, dtype=np.int64)
        of_run[run[dated]] = timed.days[dated] - passed[dated]
        known = np.flatnonzero(of_run != UNDATED)
        runs = np.arange(of_run.size)
        before = np.concatenate([[self._first_day], of_run[known]])[np.searchsorted(known, runs, side="right")]
        after = np.append(of_run[known], before[-1])[np.searchsorted(known, runs)]
        sieve.drop((before != after)[run], "its date is not known: the dates before and after it do not follow")
        self._first_day = int(before[-1])
        return np.asarray(before[run])

    def _lent_epochs(self, own: Int64, rows: Int64, untimed: Int64) -> tuple[Int64, Bool]:
        """Return epochs (m,) for sentences without a time, and which of them wait for the next block."""
        if self._after:
            at = np.searchsorted(rows, untimed)
            return np.append(own, _UNKNOWN)[at], at == rows.size
        at = np.searchsorted(rows, untimed)
        lent = np.concatenate([[self._last_epoch], own])[at]
        self._last_epoch = int(own[-1]) if own.size else self._last_epoch
        return lent, np.zeros(untimed.size, dtype=bool)


def _epoch_runs(timed: Sentences) -> Int64:
    """Return the number (n,) of each sentence's epoch: sentences of one time of the day, and of one date.

    Where one kind states two dates at the same time of the day, a day or more is missing from the log; its
    epochs then begin where the kind that came first comes again.
    """
    new = np.diff(timed.times_ns, prepend=-1) != 0
    run = np.cumsum(new) - 1
    dated = np.flatnonzero(timed.days != UNDATED)
    dated = dated[np.lexsort((dated, timed.kinds[dated], run[dated]))]
    same = (np.diff(run[dated]) == 0) & (np.diff(timed.kinds[dated]) == 0)
    split = run[dated[1:]][same & (np.diff(timed.days[dated]) != 0)]
    again = np.isin(run, split) & (timed.kinds == timed.kinds[new][run])
    return np.asarray(np.cumsum(new | again) - 1)


def _single(sieve: Sieve, sentences: Sentences) -> list[Reject]:
    """Return a reject for each dropped sentence: their lines are not adjacent."""
    index = np.arange(sentences.size, dtype=np.int64)
    out: list[Reject] = []
    for reject in sieve.rejects(index, index):
        out += _rejects(sentences, index[reject.record : reject.record + reject.records], reject.reason)
    return out


def _rejects(sentences: Sentences, rows: Int64, reason: str) -> list[Reject]:
    return [Reject(reason, int(sentences.lines[row]), int(sentences.offsets[row])) for row in rows]


# --- epochs ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Merged:
    """Epochs merged from their sentences."""

    lines: Int64
    offsets: Int64
    epochs: Int64
    values: Float64
    """(len(VALUES), n)."""

    def value(self, name: str) -> Float64:
        """Return a value (n,) by its name in :data:`VALUES`."""
        return np.asarray(self.values[VALUES.index(name)])


class _Epochs:
    """Merges the sentences of each epoch, even if they come late or in another block."""

    def __init__(self) -> None:
        self._held = Sentences.joined([])
        self._held_epochs = np.empty(0, dtype=np.int64)

    def merged(self, sentences: Sentences, epochs: Int64, *, last: bool) -> tuple[_Merged, list[Reject]]:
        """Return the complete epochs, and second sentences of one kind as rejects."""
        sentences = Sentences.joined([self._held, sentences])
        epochs = np.concatenate([self._held_epochs, epochs])
        open_ = np.zeros(epochs.size, dtype=bool)
        if not last and epochs.size:
            open_ = np.abs(epochs - epochs[-1]) <= LATE_NS
            open_ &= open_.sum() <= HELD_MAX
        self._held, self._held_epochs = sentences.take(open_), epochs[open_]
        return _merge(sentences.take(~open_), epochs[~open_])


def _merge(sentences: Sentences, epochs: Int64) -> tuple[_Merged, list[Reject]]:
    order = np.lexsort((sentences.offsets, sentences.kinds, epochs))
    sentences, epochs = sentences.take(order), epochs[order]
    new = np.diff(epochs, prepend=epochs[0] - 1 if epochs.size else 0) != 0
    twice = ~new & (np.diff(sentences.kinds, prepend=-1) == 0)
    group = np.cumsum(new) - 1
    values = np.full((len(VALUES), int(new.sum())), np.nan)
    for stated, out in zip(sentences.values, values, strict=True):
        rows = np.flatnonzero(~np.isnan(stated) & ~twice)[::-1]  # the first kind counts
        out[group[rows]] = stated[rows]
    rejects: list[Reject] = []
    for kind, name in enumerate(KINDS):
        rows = np.flatnonzero(twice & (sentences.kinds == kind))
        rejects += _rejects(sentences, rows, f"a second {name} sentence of one epoch: the first stands")
    return _Merged(sentences.lines[new], sentences.offsets[new], epochs[new], values), rejects


# --- rows ------------------------------------------------------------------------------------------


class _Solutions:
    """Converts epochs to rows of `gnss`."""

    def __init__(self, source: LogSource, plan: _Plan) -> None:
        self._source = source
        self._ellipsoidal = plan.options.altitude == "ellipsoidal"
        self._reader = GnssReader(source, plan.placement)
        self._any_height = False

    def items(
        self, epochs: _Epochs, sentences: Sentences, times: Int64, rejects: list[Reject], *, last: bool = False
    ) -> Iterator[Item]:
        """Yield rows of the complete epochs, and rejects."""
        merged, more = epochs.merged(sentences, times, last=last)
        yield from few_rejects(rejects + more)
        if merged.epochs.size == 0:
            return
        sieve = Sieve(merged.epochs.size)
        quality = np.nan_to_num(merged.value("quality"), nan=NO_POSITION).astype(np.int64)
        height = self._ellipsoidal_height(merged, quality != NO_POSITION, sieve)
        horizontal = np.radians([merged.value("longitude_deg"), merged.value("latitude_deg")])
        position = np.stack([*horizontal, height])
        yield from self._reader.items(
            RawSolutions(merged.lines, merged.offsets, merged.epochs, position, quality, _columns(merged)), sieve
        )

    def _ellipsoidal_height(self, merged: _Merged, located: Bool, sieve: Sieve) -> Float64:
        """Return ellipsoidal heights (n,); epochs whose height has no known zero are dropped."""
        altitude = merged.value("altitude_m")
        if self._ellipsoidal:
            return altitude
        height = altitude + merged.value("undulation_m")
        unknown = located & np.isnan(height)
        geoid = self._source.geoid if self._source.any_height == "orthometric" else None
        if geoid is not None:
            rows = self._covered(geoid, unknown, merged, located, sieve)
            height[rows] = altitude[rows] + geoid.undulation_m(*_degrees(merged, rows))
        elif unknown.any():
            self._without_zero(unknown, merged, located, sieve)
        self._any_height |= bool(np.isfinite(height[located]).any())
        return height

    def _covered(self, geoid: Geoid, wanted: Bool, merged: _Merged, located: Bool, sieve: Sieve) -> Int64:
        """Return those of the `wanted` epochs that the geoid's grid covers; the others are dropped."""
        rows = np.flatnonzero(wanted)
        part = Sieve(rows.size)
        failed = drop_failing(part, lambda some: geoid.undulation_m(*_degrees(merged, rows[some])))
        if failed is not None:
            if not self._any_height and rows.size == located.sum():
                raise failed
            part.drop(part.good.copy(), failed.arrived)
        sieve.take_over(part, rows)
        return rows[part.good]

    def _without_zero(self, unknown: Bool, merged: _Merged, located: Bool, sieve: Sieve) -> None:
        """Drop epochs without a geoid separation; raise an error for the log if no epoch has one."""
        if not self._any_height and unknown.sum() == located.sum():
            raise CrsError(
                "GGA states no geoid separation, so what its altitude counts from is not known",
                expected='height = "orthometric" and geoid, the grid of the receiver\'s geoid',
                change='add both to this log, or options.altitude = "ellipsoidal" if the receiver was set so',
                file=self._source.path,
                record=int(merged.lines[unknown][0]),
                missing=[
                    [Missing("height", "orthometric"), Missing("geoid")],
                    Missing("options.altitude", "ellipsoidal"),
                ],
            )
        sieve.drop(unknown, "the altitude comes without a geoid separation")


def _degrees(merged: _Merged, rows: Int64) -> tuple[Float64, Float64]:
    """Return longitudes and latitudes (degrees) of some epochs."""
    return merged.value("longitude_deg")[rows], merged.value("latitude_deg")[rows]


def _columns(merged: _Merged) -> dict[str, Float64]:
    """Return columns of `gnss` other than epoch, position and quality."""
    computed = ("latitude_deg", "longitude_deg", "altitude_m", "quality")
    columns = {name: merged.value(name) for name in VALUES if name not in computed}
    speed, course = columns["speed_m_per_s"], np.radians(columns["course_deg"])
    still = speed == 0  # a receiver at rest states no course
    with np.errstate(invalid="ignore"):
        columns["velocity_north_m_per_s"] = np.where(still, 0.0, speed * np.cos(course))
        columns["velocity_east_m_per_s"] = np.where(still, 0.0, speed * np.sin(course))
    return columns
