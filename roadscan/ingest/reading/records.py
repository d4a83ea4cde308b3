"""Shared parts of all record readers: which records are sound, their epochs, and the names of point fields.

Nothing here knows a format. A :class:`Sieve` collects the faults of a block's records, an
:class:`EpochReader` brings a log's stamps to GPS time block by block.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self, TypeVar

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.errors import ConfigError, RoadscanError, TimeSystemError, nearest
from roadscan.core.gpstime import (
    EARLIEST_GPS_NS,
    LATEST_GPS_NS,
    NS_PER_S,
    UNIT_NS,
    WEEK_S,
    Clock,
    TimeSystem,
    unroll_week,
)
from roadscan.core.strict import Strict
from roadscan.ingest.reading.format import LogSource, Reject

LEAP_NS: Final = 10 * NS_PER_S
"""A stamp farther than this outside its two neighbours is damage, not a late record."""

_DAY_NS: Final = 86_400 * NS_PER_S  # nanoseconds in a day
_MOST_REJECTS: Final = 200  # rejects of a block that are listed singly


Options = TypeVar("Options", bound=Strict)


def options_of(source: LogSource, kind: type[Options]) -> Options:
    """Return the log's settings as the format's model; its defaults where none were given."""
    if isinstance(source.options, kind):
        return source.options
    return kind.parse(source.options.model_dump(), file=source.path)


class Sieve:
    """Tracks which records of a block are sound, and why the others are not."""

    def __init__(self, records: int) -> None:
        self.good: Bool = np.ones(records, dtype=bool)
        """(n,) True for the records that passed every test so far."""
        self._faults: list[tuple[Int64, str]] = []

    @property
    def kept(self) -> Int64 | slice:
        """Index of the sound records: a slice of the whole block where none is damaged, which avoids a copy."""
        return slice(None) if not self._faults else np.flatnonzero(self.good)

    def drop(self, bad: Bool, reason: str) -> None:
        """Drop the records of the mask `bad` (n,); the first reason given for a record is kept."""
        fresh = bad & self.good
        if fresh.any():
            self._faults.append((np.flatnonzero(fresh), reason))
            self.good &= ~bad

    def require(self, name: str, values: Float64, low: float, high: float, unit: str) -> None:
        """Drop records whose `values` (n,) are not finite or outside [low, high]."""
        if values.size and low <= values.min() and values.max() <= high:  # False with a NaN
            return
        finite = np.isfinite(values)
        self.drop(~finite, f"{name} is missing or not a number")
        self.drop(finite & ~((values >= low) & (values <= high)), f"{name} is outside {low:g} to {high:g} {unit}")

    def take_over(self, part: Sieve, rows: Int64) -> None:
        """Drop what `part`, a sieve of only this block's records `rows`, has dropped."""
        for faulty, reason in part._faults:
            bad = np.zeros(self.good.size, dtype=bool)
            bad[rows[faulty]] = True
            self.drop(bad, reason)

    def rejects(self, records: Int64, offsets: Int64) -> Iterator[Reject]:
        """Yield one :class:`Reject` for each run of adjacent records that were dropped for the same reason.

        Parameters
        ----------
        records, offsets : (n,) record numbers, and byte offsets (−1 without any), of the block.
        """
        for rows, reason in self._faults:
            for run in np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1):
                yield Reject(reason, int(records[run[0]]), int(offsets[run[0]]), run.size)


def few_rejects(rejects: Sequence[Reject]) -> list[Reject]:
    """Return the rejects of a batch; where there are too many runs of records, one for each reason."""
    if len(rejects) <= _MOST_REJECTS:
        return list(rejects)
    merged: dict[str, list[Reject]] = {}
    for reject in rejects:
        merged.setdefault(reject.reason, []).append(reject)
    return [
        Reject(
            f"{reason} (scattered from this record on)", same[0].record, same[0].offset, sum(r.records for r in same)
        )
        for reason, same in merged.items()
    ]


def isolate(attempt: Callable[[Int64], object], rows: Int64) -> list[tuple[int, RoadscanError]]:
    """Return the single rows on which `attempt` fails, found by bisection.

    Parameters
    ----------
    attempt : raises :class:`RoadscanError` if one of the rows it is given cannot be converted.
    rows : (m,) rows to try.

    Returns
    -------
    Failing row and its error, in order of `rows`; empty if all can be converted.
    """
    found: list[tuple[int, RoadscanError]] = []
    parts = [rows] if rows.size else []
    while parts:
        part = parts.pop()
        try:
            attempt(part)
        except RoadscanError as error:
            if part.size == 1:
                found.append((int(part[0]), error))
            else:
                middle = part.size // 2
                parts += [part[middle:], part[:middle]]
    return found


def drop_failing(sieve: Sieve, attempt: Callable[[Int64], object]) -> RoadscanError | None:
    """Drop the sound records on which `attempt` fails; return the first error if none is left, else None."""
    tried = np.flatnonzero(sieve.good)
    failed = isolate(attempt, tried)
    if failed and len(failed) == tried.size:
        return failed[0][1]
    reasons: dict[str, list[int]] = {}
    for row, error in failed:
        reasons.setdefault(error.arrived, []).append(row)
    for reason, rows in reasons.items():
        bad = np.zeros(sieve.good.size, dtype=bool)
        bad[rows] = True
        sieve.drop(bad, reason)
    return None


class EpochReader:
    """Converts the stamps of one log to GPS time, block by block.

    A stamp that the clock refuses costs its record. If the clock refuses all stamps of the log's
    first block, it is the clock that is wrong: the error is raised, with file and record.

    Parameters
    ----------
    near_s : for seconds of the week, a stamp of another log (in the week that the clock states) to which
        the first stamp is nearer than half a week; without one, the log itself starts in that week.
    """

    def __init__(self, clock: Clock, file: Path, near_s: float | None = None) -> None:
        self._clock = clock
        self._file = file
        self._weekly = clock.system is TimeSystem.GPS_WEEK
        if self._weekly:
            clock.first_week()  # refuses a clock without a week before anything is read
            self._clock = replace(clock, unit="s")
        self._stamp_s = UNIT_NS[clock.unit] / NS_PER_S
        self._last_seconds = near_s
        self._last_epoch: int | None = None

    def epochs(self, stamps: npt.NDArray[np.generic], sieve: Sieve, records: Int64) -> Int64:
        """Return GPS time (ns, (n,)) of a block's stamps; 0 where the record is dropped.

        Parameters
        ----------
        stamps : (n,) float64 or int64, in the clock's unit and system.
        sieve : the block's; records with an impossible stamp are dropped from it.
        records : (n,) record numbers, for the message.

        Raises
        ------
        TimeSystemError
            if the clock fits no stamp of the log's first block.
        """
        if stamps.dtype.kind == "f":
            sieve.drop(~np.isfinite(stamps), "time stamp is missing or not a number")
        usable = self._unrolled(stamps, sieve, records) if self._weekly else stamps
        out = np.zeros(stamps.size, dtype=np.int64)
        try:
            out[sieve.kept] = self._clock.to_epoch_gps_ns(usable[sieve.kept])
        except TimeSystemError:
            failed = drop_failing(sieve, lambda rows: self._clock.to_epoch_gps_ns(usable[rows]))
            if failed is not None:
                self._give_up(failed, sieve, records)
            out[sieve.kept] = self._clock.to_epoch_gps_ns(usable[sieve.kept])
        self._drop_leaps(out, sieve)
        return out

    def _unrolled(self, stamps: npt.NDArray[np.generic], sieve: Sieve, records: Int64) -> Float64:
        """Return seconds of the first stamp's week, unrolled over a week's end."""
        with np.errstate(invalid="ignore", over="ignore"):  # a stamp that is not a number has already been dropped
            seconds = stamps.astype(np.float64) * self._stamp_s
            impossible = ~((seconds >= 0) & (seconds < 2 * WEEK_S))  # some programs count on past the week's end
        if impossible[sieve.good].all() and sieve.good.any():
            first = seconds[sieve.good][0]
            self._give_up(
                TimeSystemError(
                    f"stamp {first:.6g} s is not seconds of the GPS week",
                    expected=f"0 to {WEEK_S}",
                    change="check clock.system and clock.unit of this log",
                ),
                sieve,
                records,
            )
        sieve.drop(impossible, f"time stamp is outside the GPS week (0 to {WEEK_S} s)")
        good = sieve.kept
        if not sieve.good.any():
            return seconds
        growing = seconds[good]
        if np.ptp(growing) < WEEK_S / 2:  # no week ends inside the block: one shift applies to all of it
            growing = growing + (unroll_week(growing[:1], self._last_seconds)[0] - growing[0])
        else:
            growing = unroll_week(growing, self._last_seconds)
        self._last_seconds = float(growing[-1])
        seconds[good] = growing
        return seconds

    def _give_up(self, error: RoadscanError, sieve: Sieve, records: Int64) -> None:
        """Raise the error if the clock refuses all stamps of the log's first block; else drop the records."""
        if self._last_epoch is None:
            raise error.at(self._file, int(records[np.flatnonzero(sieve.good)[0]]))
        sieve.drop(sieve.good.copy(), error.arrived)

    def _drop_leaps(self, epochs: Int64, sieve: Sieve) -> None:
        """Drop single stamps that leap out of the log's order and back."""
        rows = np.flatnonzero(sieve.good)
        if rows.size == 0:
            return
        known = [] if self._last_epoch is None else [self._last_epoch]
        series = np.concatenate([np.array(known, dtype=np.int64), epochs[rows]])
        before, here, after = series[:-2], series[1:-1], series[2:]
        leap = (before <= after) & ((here < before - LEAP_NS) | (here > after + LEAP_NS))
        if leap.any():
            leaping = np.zeros(sieve.good.size, dtype=bool)
            leaping[rows[np.flatnonzero(leap) + 1 - len(known)]] = True
            sieve.drop(leaping, f"time stamp leaps out of the log's order by over {LEAP_NS // NS_PER_S} s and back")
            rows = np.flatnonzero(sieve.good)
        self._last_epoch = int(epochs[rows[-1]])


@dataclass(frozen=True)
class UnorderedStamps:
    """Converts stamps of points in no order of time to GPS time, relative to one of them."""

    clock: Clock
    anchor: float
    """A stamp near the log's start, in the clock's unit."""
    anchor_gps_ns: int

    @classmethod
    def of(cls, clock: Clock, sample: Float64, file: Path) -> Self:
        """Return a converter anchored at the median of `sample` (n,): finite stamps of the log's start.

        Raises
        ------
        TimeSystemError
            if the clock does not fit it.
        """
        if not sample.size:
            return cls(clock, 0.0, 0)
        anchor = np.sort(sample)[[sample.size // 2]]
        try:
            epoch = int(clock.to_epoch_gps_ns(anchor)[0])
        except TimeSystemError as error:
            raise error.at(file) from error
        return cls(clock, float(anchor[0]), epoch)

    def epochs(self, stamps: Float64, sieve: Sieve, name: str = "gps_time") -> Int64:
        """Return GPS time (ns, (n,)) of `stamps` (n,); records with an impossible one are dropped and get 0."""
        scale_ns = UNIT_NS[self.clock.unit]
        with np.errstate(invalid="ignore", over="ignore"):
            elapsed_ns = (stamps - self.anchor) * scale_ns
            # A day's margin: leap seconds and drift are left to the clock's exact rule. Seconds of the week have
            # no leap seconds, and those of week 0, which inspect assumes, may be of its first day.
            first_day_ns = 0 if self.clock.system is TimeSystem.GPS_WEEK and not self.clock.drift_ppm else _DAY_NS
            earliest = EARLIEST_GPS_NS - self.anchor_gps_ns + first_day_ns
            latest = LATEST_GPS_NS - self.anchor_gps_ns - _DAY_NS
            sieve.drop(~((elapsed_ns >= earliest) & (elapsed_ns <= latest)), f"{name} is no possible time")
        used = stamps
        if self.clock.system is TimeSystem.GPS_WEEK:
            seconds = stamps * (scale_ns / NS_PER_S)
            sieve.drop(~((seconds >= 0) & (seconds <= WEEK_S)), f"{name} is outside the GPS week")
            # Records are not in order of time: those beyond a week's end are the ones half a week away.
            weeks = np.rint((self.anchor - stamps) * scale_ns / NS_PER_S / WEEK_S)
            used = stamps + weeks * (WEEK_S * NS_PER_S / scale_ns)
        out = np.zeros(stamps.size, dtype=np.int64)
        out[sieve.kept] = self.clock.to_epoch_gps_ns(used[sieve.kept])
        return out


AXES: Final = ("x", "y", "z")
INTENSITIES: Final = ("intensity", "intensities", "reflectivity", "signal")
"""Names of a field with the intensity."""
LASERS: Final = ("ring", "channel", "line", "laser_id", "laser")
"""Names of a field with the laser's number."""


def field_named(
    stated: str | None, option: str, usual: tuple[str, ...], names: Collection[str], file: Path
) -> str | None:
    """Return a field's name, as stated or one of the usual ones; None where there is none.

    Raises
    ------
    ConfigError
        where the stated one is not there.
    """
    if stated is None:
        return next((name for name in usual if name in names), None)
    if stated not in names:
        raise ConfigError(
            f"options.{option} = '{stated}'{nearest(stated, names)}: the points have no such field",
            expected="one of: " + ", ".join(names),
            file=file,
        )
    return stated


NO_TEXT: Final = "\ufffd"
"""Replaces bytes that could not be decoded."""


HEIGHT_MIN_M: Final = -1_000.0  # lowest height that is no damage


HEIGHT_MAX_M: Final = 20_000.0
"""Greatest height that is no damage: survey vehicles are within these limits."""


GRID_MAX_M: Final = 2.1e7
"""Eastings and northings beyond half the Earth's girth are damage."""
