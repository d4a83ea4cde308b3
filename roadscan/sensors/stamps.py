"""Time stamps in a column of text: numbers in the clock's unit, or calendar times (ISO 8601).

Calendar times with a zone are UTC; without one, the survey file has to say on which scale they are
written. Both are counted in nanoseconds from 1970 on that scale, and the clock does the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.model.errors import Missing, TimeSystemError
from roadscan.model.gpstime import Clock, TimeSystem
from roadscan.sensors.base import LogSource
from roadscan.sensors.columns import Found, Quantity, need_stamp_unit
from roadscan.sensors.records import Sieve
from roadscan.sensors.text_table import Kind, TextBlock, TextLayout, first_fields, stamp_kind

Int64 = npt.NDArray[np.int64]

TIME: Final = Quantity("time", "time", ("timestamp", "stamp", "gps_time", "utc_time", "unix_time", "gpst_unix"))
"""Column of time stamps by its common names."""
CALENDAR_SCALES: Final = (TimeSystem.UNIX_UTC, TimeSystem.UNIX_GPS, TimeSystem.UNIX_TAI)
"""Scales that a calendar time without a zone can be written in."""


@dataclass(frozen=True)
class StampColumn:
    """The column of a text table that holds the log's stamps."""

    column: str
    kind: Kind
    clock: Clock
    """Clock of the numbers that :meth:`stamps` gives."""
    zoned: bool
    """Calendar times carry a zone."""

    @classmethod
    def of(cls, source: LogSource, file: Path, layout: TextLayout, found: Found) -> Self:
        """See how the stamps of `file` are written, and hold the stated clock against that.

        Raises
        ------
        TimeSystemError
            if the clock is not stated, or fits neither the column's unit nor the way times are written.
        """
        clock = source.any_clock
        kind = stamp_kind(file, layout, found.column, "s" if clock is None else clock.unit)
        if kind != "text":
            clock = source.need_clock("gps", unit="s")
            need_stamp_unit(found, clock, file)
            return cls(found.column, kind, clock, zoned=False)
        word = _first_word(file, layout, found.column)
        zoned = parse_calendar([word], zoned=True) is not None
        stated = source.clock if zoned else clock
        return cls(found.column, kind, calendar_clock(stated, word, file, zoned=zoned), zoned)

    def stamps(self, block: TextBlock, sieve: Sieve) -> npt.NDArray[np.generic]:
        """Stamps (n,) of a block, float64 or int64, in the unit of `clock`; faulty ones are dropped from `sieve`."""
        if self.kind == "text":
            return calendar_ns(block.text(self.column), sieve, zoned=self.zoned)
        return block.stamps(self.column)


def _first_word(path: Path, layout: TextLayout, column: str) -> str:
    index = layout.names.index(column)
    words = (fields[index].strip() for fields in first_fields(path, layout, 20))
    return next((word for word in words if word), "")


def calendar_clock(clock: Clock | None, word: str, file: Path, *, zoned: bool) -> Clock:
    """Clock of calendar times such as `word`, counted in nanoseconds from 1970 on the scale they are written in.

    Raises
    ------
    TimeSystemError
        if `word` is no calendar time, has a zone and the clock is not UTC, or has no zone and the
        clock does not say the scale.
    """
    if zoned:
        if clock is not None and clock.system is not TimeSystem.UNIX_UTC:
            raise TimeSystemError(
                f"time '{word}' has a zone, so it is UTC, the clock says {clock.system}",
                expected='clock.system = "unix_utc", or no clock',
                file=file,
                missing=Missing("clock", {"system": "unix_utc"}),
            )
        return replace(clock or Clock(TimeSystem.UNIX_UTC), unit="ns")
    if parse_calendar([word], zoned=False) is None:
        raise TimeSystemError(
            f"time '{word[:40]}' is neither a number nor ISO 8601 text",
            expected="such as 2026-05-04T09:30:00.125Z",
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
    """Nanoseconds (n,) from 1970 of ISO 8601 times; a word that is none costs its record."""
    whole = parse_calendar(words, zoned=zoned)
    if whole is not None:
        return whole
    singles = [parse_calendar([word], zoned=zoned) for word in words]
    zone = "with" if zoned else "without"
    sieve.drop(np.array([one is None for one in singles]), f"time is not ISO 8601 text {zone} a zone, as the first is")
    return np.array([0 if one is None else one[0] for one in singles], dtype=np.int64)


def parse_calendar(words: Sequence[str], *, zoned: bool) -> Int64 | None:
    """Nanoseconds (n,) from 1970 of ISO 8601 times that all have a zone, or all have none; None where one is not so."""
    kind = pa.timestamp("ns", "UTC") if zoned else pa.timestamp("ns")
    try:
        return np.asarray(pc.cast(pa.array(words, pa.string()), kind).cast(pa.int64()), dtype=np.int64)
    except pa.ArrowInvalid:
        return None
