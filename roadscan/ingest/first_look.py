"""Finds when logs were recorded before any is read completely, so that times that never meet show at once.

A small log is read completely. Of a large one, the first chunk is read, and what its format finds at its end directly
(`LogFormat.ending`). Where that end is not known, a log counts as one that lasts two days.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import pyarrow.compute as pc

from roadscan.core.errors import RoadscanError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.survey import Survey
from roadscan.ingest.overlap import DRIVEN, Fault, apart_logs
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Rows
from roadscan.store.logs import DataFile, LogRecord

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
        for one in _timed(log_format.read(source, header), whole):
            low, high = _span(one)
            first, last = (min(first, low), max(last, high)) if rows else (low, high)
            table, rows = one.table, rows + one.batch.num_rows
        if not rows:
            return None
        ends = whole
        for one in () if whole else _timed(log_format.ending(source, header), whole=True):
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


def _meet(a: tuple[int, int], b: tuple[int, int]) -> bool:
    return a[0] <= b[1] and b[0] <= a[1]


def _timed(items: Iterator[Item], whole: bool) -> Iterator[Rows]:
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
