"""Finds the hour of Velodyne stamps: data packets count microseconds past a UTC hour that they do not name.

The first hour comes from a GPRMC sentence or from the survey file. From there on stamps are counted over
the ends of hours, whether they start again at 3,600 s or a little later (at 3,601 s with a leap second). A gap of
half an hour or more cannot be counted and is refused.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

import numpy as np

from roadscan.compute.array_types import Bool, Int64
from roadscan.core.errors import ConfigError, Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, Clock, TimeSystem, leap_seconds_at_unix
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.lidars.velodyne_packets import LATEST_STAMP_US
from roadscan.ingest.reading.format import LogSource

POSITION_BYTES: Final = 512  # bytes of a position packet
HOUR_S: Final = 3600  # seconds of an hour
HOUR_US: Final = HOUR_S * 1_000_000  # microseconds of an hour

_SHORTEST_GAP_S: Final = HOUR_S / 2  # with longer gaps, hours cannot be counted
_LARGEST_DISAGREEMENT_S: Final = 5.0  # largest difference of stamp and sentence
_LEAP_US: Final = 10_000_000
"""A stamp farther than this from both its neighbours is damage."""
_SOME_PACKETS: Final = 64  # packets whose median delay is taken


def unroll(stamps_us: Int64, previous_us: int | None) -> Int64:
    """Return stamps (n,) unrolled over the ends of hours: each within half an hour of the one before."""
    before = [] if previous_us is None else [previous_us]
    joined = np.concatenate([np.array(before, dtype=np.int64), stamps_us])
    hours = np.zeros(joined.size, dtype=np.int64)
    hours[1:] = -np.cumsum(np.rint(np.diff(joined) / HOUR_US)).astype(np.int64)
    return (joined + hours * HOUR_US)[len(before) :]


def leaps(stamps_us: Int64, previous_us: int | None) -> Bool:
    """Return which stamps (n,) leap out of their order and back: damage.

    The last stamp is taken as it is; the first of a log is judged by the two after it.
    """
    series = unroll(stamps_us, previous_us)
    if previous_us is not None:
        series = np.concatenate([[previous_us], series])
    far = np.abs(np.diff(series)) > _LEAP_US
    leaping = np.zeros(series.size, dtype=bool)
    leaping[1:-1] = far[:-1] & far[1:] & (np.abs(series[2:] - series[:-2]) <= _LEAP_US)
    if series.size > 2 and previous_us is None:
        leaping[0] = far[0] and not far[1]
    return leaping if previous_us is None else leaping[1:]


_DATED: Final = Missing("clock", {"system": "utc_hour", "date": dt.date(2026, 5, 4)})  # proposal for a clock


@dataclass(frozen=True)
class Fix:
    """A valid GPRMC sentence with the lidar's stamp of the same moment."""

    stamp_us: int
    unix_s: float

    @classmethod
    def of(cls, packet: Datagram) -> Fix | None:
        """Return the time in a position packet (µs at byte 198, sentence at 206), None where it has none."""
        if len(packet.payload) != POSITION_BYTES:
            return None
        stamp_us = int.from_bytes(packet.payload[198:202], "little")
        sentence = packet.payload[206:334].split(b"\0")[0].split(b"\r")[0].strip()
        unix_s = _unix_of_rmc(sentence.decode("ascii", errors="replace"))
        return None if unix_s is None or stamp_us > LATEST_STAMP_US else cls(stamp_us, unix_s)

    def hour_unix_s(self) -> int:
        """Return the start of the hour from which the stamp counts (POSIX s)."""
        return hour_near(self.unix_s, self.stamp_us / 1e6)


def _unix_of_rmc(sentence: str) -> float | None:
    """Return the POSIX seconds of a valid RMC sentence (NMEA 0183) with date and status A."""
    body, star, checksum = sentence.removeprefix("$").partition("*")
    fields = body.split(",")
    if not star or not sentence.startswith("$") or len(fields) < 10 or fields[0][2:] != "RMC" or fields[2] != "A":
        return None
    total = 0
    for byte in body.encode("ascii", errors="replace"):
        total ^= byte
    clock, date = fields[1], fields[9]
    try:
        if int(checksum[:2], 16) != total or len(date) != 6:
            return None
        moment = dt.datetime(
            2000 + int(date[4:6]), int(date[2:4]), int(date[0:2]), int(clock[0:2]), int(clock[2:4]), tzinfo=dt.UTC
        )
        seconds = float(clock[4:])
    except ValueError:
        return None
    return moment.timestamp() + seconds if 0.0 <= seconds <= 61.0 else None


def hour_near(unix_s: float, stamp_s: float) -> int:
    """Return the hour (POSIX s) for which `stamp_s` past it is nearest to `unix_s`."""
    return HOUR_S * round((unix_s - stamp_s) / HOUR_S)


@dataclass(frozen=True)
class Start:
    """Time information at the beginning of a capture."""

    stamp_us: int
    """Stamp of the first data packet on GPS time."""
    capture_ns: int
    """Its capture time by the recording computer's clock, POSIX ns."""
    fix: Fix | None
    """First valid sentence."""
    hours_to_fix: int
    """Hours from the first data packet's hour to that of the fix."""
    hours_on: int = 0
    """Hours from the hour of the capture's first data packet, if the clock steps in between."""


def first_hour_unix_s(source: LogSource, stated: Literal["capture"] | int | None, start: Start) -> int | None:
    """Return the start of the first data packet's hour (POSIX s); None for a free-running clock.

    Parameters
    ----------
    stated : `options.hour`.

    Raises
    ------
    TimeSystemError
        if nothing tells the hour, or if survey file, sentence and stamps disagree.
    """
    clock = source.clock
    if clock is not None and clock.system is TimeSystem.FREE:
        return None
    if clock is not None and clock.system is not TimeSystem.UTC_HOUR:
        raise TimeSystemError(
            f"clock.system is '{clock.system}', and Velodyne stamps count from the full UTC hour",
            expected="utc_hour, or free for a sensor without GPS",
            file=source.path,
            missing=_DATED,
        )
    date = clock.date if clock is not None else None
    hour = _stated_hour(source.path, stated, start, date)
    if start.fix is not None:
        return _heard_hour(source.path, start, None if stated == "capture" else hour, date)
    if hour is None:
        raise TimeSystemError(
            "the hour is not known: data packets count from the full hour, and the capture holds no valid GPRMC",
            expected="the UTC date and hour of the first data packet",
            change='add clock = { system = "utc_hour", date = 2026-05-04 } and options.hour = 9 '
            '(or options.hour = "capture" to trust the recording computer\'s clock)',
            file=source.path,
            missing=[[_DATED, Missing("options.hour", 9)]],
        )
    return hour


def _stated_hour(path: Path, stated: Literal["capture"] | int | None, start: Start, date: dt.date | None) -> int | None:
    """Return the hour that the survey file states."""
    if stated is None:
        return None
    if stated == "capture":
        hour = hour_near(start.capture_ns / NS_PER_S, start.stamp_us / 1e6)
        day = dt.datetime.fromtimestamp(hour, dt.UTC).date()
        if date is not None and day != date:
            raise TimeSystemError(
                f"the capture's clock says {day}, the log's clock {date}",
                expected="one date",
                change="state options.hour as a number, or correct the date",
                file=path,
            )
        return hour
    if not 0 <= stated <= 23:
        raise ConfigError(f"options.hour is {stated}", expected="0 to 23 (UTC)", file=path)
    if date is None:
        raise TimeSystemError(
            "options.hour is stated without a date",
            expected='clock = { system = "utc_hour", date = … }, the UTC date of the first data packet',
            file=path,
            missing=_DATED,
        )
    first = int(dt.datetime(date.year, date.month, date.day, stated, tzinfo=dt.UTC).timestamp())
    return first + HOUR_S * start.hours_on


def _heard_hour(path: Path, start: Start, stated: int | None, date: dt.date | None) -> int:
    """Return the hour of the sentence, checked against the lidar's stamp and the survey file."""
    if start.fix is None:
        raise TimeSystemError("the capture holds no valid GPRMC", file=path)
    heard = start.fix.hour_unix_s()
    apart_s = heard + start.fix.stamp_us / 1e6 - start.fix.unix_s
    if abs(apart_s) > _LARGEST_DISAGREEMENT_S:
        raise TimeSystemError(
            f"the lidar's stamps are {apart_s:+.1f} s off the GPRMC that it received",
            expected="a lidar locked to its receiver",
            change='state clock = { system = "free", offset_s = … } with a measured offset',
            file=path,
            missing=Missing("clock", {"system": "free", "offset_s": 0.0}),
        )
    first = heard - HOUR_S * start.hours_to_fix
    day = dt.datetime.fromtimestamp(first, dt.UTC).date()
    if (stated is not None and stated != first) or (date is not None and date != day):
        raise TimeSystemError(
            f"GPRMC puts the first data packet into the hour from {iso(first)}, the survey file says "
            + (f"{date}" if stated is None else iso(stated)),
            expected="one date and hour",
            change="correct date and options.hour, or leave them out",
            file=path,
        )
    return first


def iso(unix_s: float) -> str:
    """Return ``2026-05-04T09:00:00Z`` of POSIX seconds."""
    return dt.datetime.fromtimestamp(unix_s, dt.UTC).isoformat().replace("+00:00", "Z")


def _early_leaps_ns(first_hour_unix_s: int, stamps_us: Int64, unrolled_us: Int64) -> Int64:
    """Return the leap seconds (ns, (n,)) that POSIX time counts too early: an hour with one ends at 3,601 s."""
    hours_s = first_hour_unix_s + (unrolled_us - stamps_us) // 1_000_000
    within = leap_seconds_at_unix(first_hour_unix_s + unrolled_us // 1_000_000) - leap_seconds_at_unix(hours_s)
    return within * NS_PER_S


@dataclass
class Hours:
    """Converts the stamps of a capture to GPS time, chunk by chunk."""

    source: LogSource
    first_hour_unix_s: int | None
    """Start of the first data packet's hour; None for a free-running clock."""
    previous_us: int | None = None
    """Last stamp, unrolled from the first hour."""
    capture_set_s: float = 0.0
    """Total of forward corrections of the capture's clock (s)."""
    _capture_minus_stamp_s: float | None = None
    _has_sentences: bool = False
    _clock: Clock = field(init=False)

    def __post_init__(self) -> None:
        stated = self.source.clock or Clock(TimeSystem.UTC_HOUR)
        system = TimeSystem.FREE if self.first_hour_unix_s is None else TimeSystem.UNIX_UTC
        self._clock = dataclasses.replace(stated, system=system, unit="ns")

    def epochs(self, stamps_us: Int64, capture_ns: Int64) -> Int64:
        """Return GPS ns (n,) of stamps (n,), n > 0, in log order."""
        unrolled = unroll(stamps_us, self.previous_us)
        self.previous_us = int(unrolled[-1])
        self._watch_for_gap(unrolled, capture_ns)
        first_s = self.first_hour_unix_s or 0
        epochs = self._clock.to_epoch_gps_ns(first_s * NS_PER_S + unrolled * 1000)
        return epochs if self.first_hour_unix_s is None else epochs - _early_leaps_ns(first_s, stamps_us, unrolled)

    def resume(self, expected_us: int) -> None:
        """Continue with a later part of the capture, from `expected_us` on, counted from the first hour."""
        self.previous_us = expected_us
        self._capture_minus_stamp_s = None
        self.capture_set_s = 0.0

    def check(self, fix: Fix, record: int) -> None:
        """Compare the hour with a valid sentence in a position packet, whose record number is `record`."""
        if self.first_hour_unix_s is None or self.previous_us is None:
            return
        self._has_sentences = True
        unrolled_us = int(unroll(np.array([fix.stamp_us]), self.previous_us)[0])
        apart_s = self.first_hour_unix_s + unrolled_us / 1e6 - fix.unix_s
        if abs(apart_s) > _SHORTEST_GAP_S:
            raise TimeSystemError(
                f"GPRMC says {iso(fix.unix_s)}, the stamps counted from the first hour are {apart_s:+.0f} s off",
                expected="no gap of half an hour or more in the capture",
                change="split the capture at the gap",
                file=self.source.path,
                record=record,
            )

    def _watch_for_gap(self, unrolled_us: Int64, capture_ns: Int64) -> None:
        """Check for missing hours, which without sentences only the capture's clock shows."""
        apart_s = capture_ns / NS_PER_S - unrolled_us / 1e6
        if self._capture_minus_stamp_s is None:
            self._capture_minus_stamp_s = float(np.median(apart_s[:_SOME_PACKETS]))
        later_s = float(np.median(apart_s[-_SOME_PACKETS:])) - self.capture_set_s
        missing_s = later_s - self._capture_minus_stamp_s
        if abs(missing_s) > _SHORTEST_GAP_S and not self._has_sentences:
            raise TimeSystemError(
                f"by the capture's clock {missing_s:+.0f} s are missing from the stamps",
                expected="no gap of half an hour or more: stamps past the hour cannot tell how long it was",
                change="split the capture at the gap",
                file=self.source.path,
            )
