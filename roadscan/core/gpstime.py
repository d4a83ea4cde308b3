"""GPS time and the time systems that logs are written in.

Inside roadscan every epoch is ``epoch_gps_ns``: int64 nanoseconds of GPS time since
1980-01-06T00:00:00. All other systems exist only here, at the edge.
"""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import Missing, TimeSystemError

Int64 = npt.NDArray[np.int64]

NS_PER_S: Final = 1_000_000_000  # nanoseconds in a second
WEEK_S: Final = 604_800  # seconds in a week
WEEKS_A_ROLLOVER: Final = 1024  # the ten bits of the week number in the GPS signal overflow after so many weeks
GPS_EPOCH_UNIX_S: Final = 315_964_800
"""Unix seconds of 1980-01-06T00:00:00 UTC, the origin of GPS time."""
ADJUSTED_OFFSET_S: Final = 1_000_000_000
"""LAS 'adjusted standard GPS time' is GPS seconds minus 1e9 (ASPRS LAS 1.4 R15, 2.4)."""
TAI_MINUS_GPS_S: Final = 19  # constant offset (s): TAI is ahead of GPS time

_LEAP_DATES: Final = (
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01",
    "1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01",
    "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01",
)  # fmt: skip
"""Days whose midnight (UTC) was preceded by a leap second since 1980 (IERS Bulletin C)."""

_LEAP_UNIX_S: Final[Int64] = np.array(_LEAP_DATES, dtype="datetime64[s]").astype(np.int64)
_LEAP_GPS_S: Final[Int64] = _LEAP_UNIX_S - GPS_EPOCH_UNIX_S + np.arange(1, _LEAP_UNIX_S.size + 1)  # first seconds after

EARLIEST_GPS_NS: Final = 0  # 1980-01-06: GPS time starts here
LATEST_GPS_NS: Final = 3_155_760_000 * NS_PER_S  # 2080: later stamps are a wrong unit or system


class TimeSystem(StrEnum):
    """Time system of a log's stamps."""

    GPS = "gps"
    """Seconds of GPS time since 1980-01-06."""
    GPS_WEEK = "gps_week_seconds"
    """Seconds of the GPS week; the week comes from `week` or `date`."""
    GPS_ADJUSTED = "gps_adjusted"
    """GPS seconds minus 1e9 (LAS)."""
    UNIX_GPS = "unix_gps"
    """Seconds from 1970-01-01 counted on GPS time, no leap seconds (RTKLIB's GPST)."""
    UNIX_UTC = "unix_utc"
    """POSIX time: seconds from 1970-01-01 UTC, leap seconds not counted."""
    UNIX_TAI = "unix_tai"
    """Seconds from 1970-01-01 on TAI (PTP's scale)."""
    UTC_HOUR = "utc_hour"
    """Time past the full UTC hour (Velodyne); the hour comes from `date` and the log itself."""
    FREE = "free"
    """The sensor's counter; `offset_s` (measured) brings it to GPS seconds since 1980."""


UNIT_NS: Final[dict[str, int]] = {"s": NS_PER_S, "ms": 1_000_000, "us": 1_000, "ns": 1}  # ns in each unit of stamps


def leap_seconds_at_unix(unix_utc_s: npt.ArrayLike) -> Int64:
    """GPS − UTC in whole seconds at POSIX seconds `unix_utc_s` (any shape)."""
    return np.searchsorted(_LEAP_UNIX_S, np.asarray(unix_utc_s), side="right").astype(np.int64)


SCALES: Final = {TimeSystem.UNIX_GPS: "GPS time", TimeSystem.UNIX_TAI: "TAI"}
"""Names of the scales without leap seconds that stamps from 1970 may count."""


def ahead_of_utc_s(unix_utc_s: float) -> dict[TimeSystem, int]:
    """Return by how many seconds each of `SCALES` is ahead of UTC at POSIX seconds."""
    leap_s = int(leap_seconds_at_unix(int(unix_utc_s)))
    return {TimeSystem.UNIX_GPS: leap_s, TimeSystem.UNIX_TAI: leap_s + TAI_MINUS_GPS_S}


def leap_seconds_at_gps(gps_s: npt.ArrayLike) -> Int64:
    """GPS − UTC in whole seconds at GPS seconds `gps_s` (any shape)."""
    return np.searchsorted(_LEAP_GPS_S, np.asarray(gps_s), side="right").astype(np.int64)


def gps_ns_from_utc(moment: dt.datetime) -> int:
    """Epoch of a timezone-aware datetime, in GPS nanoseconds."""
    if moment.tzinfo is None:
        raise TimeSystemError(
            f"the time {moment.isoformat()} has no time zone",
            expected="a zone, such as a trailing Z for UTC",
            change="write it as 2026-05-04T09:30:00Z",
        )
    delta = moment - dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
    whole = delta.days * 86_400 + delta.seconds
    return (whole - GPS_EPOCH_UNIX_S + int(leap_seconds_at_unix(whole))) * NS_PER_S + delta.microseconds * 1_000


def leap_second_steps() -> list[tuple[int, int]]:
    """Return the first GPS second with each number of leap seconds, and that number, in ascending order."""
    return [(int(first), count) for count, first in enumerate(_LEAP_GPS_S, 1)]


def utc_from_gps_ns(epoch_gps_ns: int) -> dt.datetime:
    """UTC datetime (microseconds) of a GPS epoch."""
    whole, rest = divmod(int(epoch_gps_ns), NS_PER_S)
    unix = whole + GPS_EPOCH_UNIX_S - int(leap_seconds_at_gps(whole))
    return dt.datetime(1970, 1, 1, tzinfo=dt.UTC) + dt.timedelta(seconds=unix, microseconds=rest // 1_000)


def iso_from_gps_ns(epoch_gps_ns: int) -> str:
    """``2026-05-04T09:30:00.123456Z`` for a GPS epoch."""
    return utc_from_gps_ns(epoch_gps_ns).isoformat().replace("+00:00", "Z")


def now_utc(timespec: str = "seconds") -> str:
    """Return the current instant (UTC) as ISO 8601, to the second or as `datetime.isoformat` knows `timespec`."""
    return dt.datetime.now(dt.UTC).isoformat(timespec=timespec).replace("+00:00", "Z")


def gps_week_of_date(date: dt.date) -> int:
    """GPS week that a calendar day (UTC) lies in."""
    return (date - dt.date(1980, 1, 6)).days // 7


def check_week(week: int) -> None:
    """Refuse a GPS week as the ten bits of the signal show it: they start again every 1024 weeks (IS-GPS-200, 20.3.3).

    Raises
    ------
    ValueError
        if the week lies before 22 August 1999, when the first rollover was.
    """
    if week < WEEKS_A_ROLLOVER:
        days = [dt.date(1980, 1, 6) + dt.timedelta(weeks=week + k * WEEKS_A_ROLLOVER) for k in range(3)]
        later = " or ".join(f"{week + k * WEEKS_A_ROLLOVER} (from {days[k]})" for k in (1, 2))
        raise ValueError(
            f"week {week} began on {days[0]}; a receiver that counts weeks modulo 1024 means {later}: "
            "state the full week, or the date of the log in its place"
        )


@dataclass(frozen=True)
class Clock:
    """Converts a log's stamps to GPS time.

    gps = scale(stamp) + offset_s + drift_ppm · 1e-6 · (stamp − reference_s)

    where ``scale`` is the time system's rule and every quantity is in seconds.
    """

    system: TimeSystem
    unit: str = "s"
    """Unit of numeric stamps: s, ms, us or ns."""
    week: int | None = None
    """GPS week of the first stamp, for `gps_week_seconds`."""
    date: dt.date | None = None
    """UTC date of the first stamp, for `gps_week_seconds` and `utc_hour`."""
    offset_s: float = 0.0
    """Measured correction added to every stamp (s)."""
    drift_ppm: float = 0.0
    """Measured rate error of the clock (parts per million), from `reference_s` on."""
    reference_s: float = 0.0
    """Stamp (in seconds of the log's count) at which `offset_s` was measured."""

    def first_week(self) -> int:
        """GPS week of the first stamp, from `week` or `date`."""
        if self.week is not None:
            return self.week
        if self.date is not None:
            return gps_week_of_date(self.date)
        raise TimeSystemError(
            "stamps are seconds of the GPS week, and the week is not known",
            expected="the GPS week or the date of the log",
            change="add week = 2405 or date = 2026-02-11 to the log's clock",
            missing=Missing("clock", {"system": "gps_week_seconds", "week": 2405}),
        )

    def to_epoch_gps_ns(self, stamps: npt.NDArray[np.generic]) -> Int64:
        """Convert stamps to GPS nanoseconds.

        Parameters
        ----------
        stamps : (n,) float64 or integer, in `unit` of `system`; for `gps_week_seconds` the
            seconds of the week in which the log starts (unroll a week's end with
            :func:`unroll_week` first).

        Raises
        ------
        TimeSystemError
            when the result lies outside 1980–2080: the unit or the system is wrong.
        """
        scale_ns = UNIT_NS[self.unit]
        ns = self._nanoseconds(stamps)
        if self.drift_ppm:
            elapsed_ns = (ns - round(self.reference_s * NS_PER_S)).astype(np.float64)
            drift_ns = np.rint(elapsed_ns * (self.drift_ppm * 1e-6)).astype(np.int64)
        else:
            drift_ns = np.zeros(1, dtype=np.int64)
        epochs = self._scale(ns) + drift_ns + round(self.offset_s * NS_PER_S)
        if epochs.size and (int(epochs.min()) < EARLIEST_GPS_NS or int(epochs.max()) > LATEST_GPS_NS):
            bad = epochs[(epochs < EARLIEST_GPS_NS) | (epochs > LATEST_GPS_NS)]
            at = int(np.flatnonzero(epochs == bad[0])[0])
            self._refuse(int(ns[at]) // scale_ns if np.issubdtype(stamps.dtype, np.integer) else float(stamps[at]))
        return epochs

    def counted_ns(self, stamps: npt.NDArray[np.generic]) -> tuple[Int64, Int64]:
        """Return stamps (n,) in nanoseconds of the log's count, and the GPS time (ns) that the time system alone gives.

        Neither offset nor drift is applied, and a free-running clock may show any time.
        """
        ns = self._nanoseconds(stamps)
        return ns, self._scale(ns)

    def _nanoseconds(self, stamps: npt.NDArray[np.generic]) -> Int64:
        scale_ns = UNIT_NS[self.unit]
        if np.issubdtype(stamps.dtype, np.integer):
            integral = stamps.astype(np.int64)
            limit = np.iinfo(np.int64).max // scale_ns
            if integral.size and (integral.max() > limit or integral.min() < -limit):
                self._refuse(int(integral[np.argmax(np.abs(integral))]))
            return integral * scale_ns
        floating = stamps.astype(np.float64)
        if floating.size and not np.all(np.isfinite(floating)):
            raise TimeSystemError("a time stamp is not a number", expected="finite stamps")
        whole = np.floor(floating)
        worst = float(np.max(np.abs(whole))) if floating.size else 0.0
        if worst * scale_ns > 9e18:
            self._refuse(worst)
        fraction: Int64 = np.rint((floating - whole) * scale_ns).astype(np.int64)
        return whole.astype(np.int64) * scale_ns + fraction

    def _scale(self, ns: Int64) -> Int64:
        match self.system:
            case TimeSystem.GPS | TimeSystem.FREE:
                return ns
            case TimeSystem.GPS_WEEK:
                return ns + self.first_week() * WEEK_S * NS_PER_S
            case TimeSystem.GPS_ADJUSTED:
                return ns + ADJUSTED_OFFSET_S * NS_PER_S
            case TimeSystem.UNIX_GPS:
                return ns - GPS_EPOCH_UNIX_S * NS_PER_S
            case TimeSystem.UNIX_TAI:
                return ns - (GPS_EPOCH_UNIX_S + TAI_MINUS_GPS_S) * NS_PER_S
            case TimeSystem.UNIX_UTC:
                leap = leap_seconds_at_unix(ns // NS_PER_S)
                return ns + (leap - GPS_EPOCH_UNIX_S) * NS_PER_S
            case TimeSystem.UTC_HOUR:
                raise TimeSystemError(
                    "stamps count from the full hour, and the hour is not resolved",
                    expected="a reader that resolves the hour from the date and the log's position packets",
                    change="state date (and hour) in the log's clock",
                )

    def _refuse(self, stamp: float) -> None:
        shown = str(stamp) if isinstance(stamp, int) else f"{stamp:.0f}"
        # Name the unit that would have fitted the stamp, instead of guessing it.
        fits = [unit for unit, scale in UNIT_NS.items() if unit != self.unit and self._plausible(stamp, scale)]
        hint = f"as '{fits[0]}' it would fit: set clock.unit = \"{fits[0]}\" if that is so" if fits else ""
        clock = {"system": str(self.system), "unit": fits[0]} if fits else None
        raise TimeSystemError(
            f"stamp {shown} read as {self.unit} of '{self.system}' falls outside 1980–2080",
            expected="a stamp inside that span",
            change=hint or "check clock.system, clock.unit and clock.offset_s of this log",
            missing=Missing("clock", clock),
        )

    def _plausible(self, stamp: float, scale_ns: int) -> bool:
        origin_s = {
            TimeSystem.GPS_ADJUSTED: ADJUSTED_OFFSET_S,
            TimeSystem.UNIX_GPS: -GPS_EPOCH_UNIX_S,
            TimeSystem.UNIX_TAI: -GPS_EPOCH_UNIX_S,
            TimeSystem.UNIX_UTC: -GPS_EPOCH_UNIX_S,
        }.get(self.system, 0)
        gps_s = stamp * scale_ns / NS_PER_S + origin_s
        return 315_360_000 < gps_s < LATEST_GPS_NS / NS_PER_S  # 1990–2080


def unroll_week(seconds_of_week: npt.NDArray[np.float64], previous: float | None = None) -> npt.NDArray[np.float64]:
    """Make seconds of the week grow over a week's end.

    Parameters
    ----------
    seconds_of_week : (n,) float64, in log order.
    previous : the last unrolled value of the preceding chunk, if any.

    A fall of more than half a week is taken as a new week (log order is nearly time order).
    """
    before = [] if previous is None else [previous]
    unwrapped = np.unwrap(np.concatenate([before, seconds_of_week]), period=WEEK_S)[len(before) :]
    weeks: npt.NDArray[np.float64] = np.rint((unwrapped - seconds_of_week) / WEEK_S)
    return seconds_of_week + weeks * WEEK_S
