"""Finds rows with one stamp: their clock stood still, so all their measurements would be placed on one line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from roadscan.core.counted import counted
from roadscan.core.errors import TimeSystemError
from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.log_check import LogCheck, Refused, epochs_in
from roadscan.ingest.overlap import Fault
from roadscan.ingest.reading.format import Rows
from roadscan.store.logs import DataFile, LogRecord

STAMPED: Final = ("scans", "imu", "encoder", "gnss")
"""Tables in which each row has a time. Returns of one sweep may share theirs."""


ONE_STAMP: Final = Witness(
    "one_stamp",
    input="any log with a stamp a row",
    fault="The clock that stamps the rows stands still: all that they measured lies on one line.",
    asks="the stamps of neighbouring rows",
    does="rows after the first of a stretch of ten or more of one stamp are left out; a log of which that is more than "
    "half fails",
    told=("error", "rejects", "findings"),
)

VERSION: Final = 1
"""Raised when other rows are left out, so that logs with one stamp per row are read again."""
LEAST_ROWS: Final = 10
"""Consecutive rows with one stamp from which it is no rounding that a survey can use."""
STANDS: Final = "the clock stands: the row has the stamp of the rows before it"


class StandingClock(LogCheck):
    """Leaves out rows whose clock stood still, except the first of each run of equal stamps."""

    def __init__(self) -> None:
        self._before: dict[tuple[str, str], tuple[int, int]] = {}
        """Epoch of the last row of a table and file, and how many rows before it had that epoch."""

    def refused(self, rows: Rows) -> list[Refused]:
        """Return the rows of a chunk (by index) that are left out."""
        epochs = epochs_in(rows, STAMPED)
        if epochs is None:
            return []
        epoch, before = self._before.get((rows.table, rows.file), (int(epochs[0]), 0))
        starts = np.flatnonzero(np.diff(epochs, prepend=epoch - 1))  # the first row follows none
        lengths = np.diff(starts, append=epochs.size)
        carried = np.zeros(starts.size, np.int64)
        carried[0] = before if epochs[0] == epoch else 0
        stands = np.repeat(lengths + carried >= LEAST_ROWS, lengths)
        stands[starts[carried == 0]] = False
        self._before[rows.table, rows.file] = int(epochs[-1]), int(lengths[-1] + carried[-1])
        return [(np.flatnonzero(stands), STANDS)] if stands.any() else []


def one_stamp_logs(records: Sequence[LogRecord]) -> list[Fault]:
    """Return a fault for logs of which most rows have the stamp of their neighbours."""
    return [_fault(r, table) for r in records for table in STAMPED if r.tables.get(table) and _stands(r, table)]


def one_stamp_findings(records: Sequence[LogRecord]) -> list[Finding]:
    """Return findings for logs of which some rows were left out because their clock stood still."""
    return [
        ONE_STAMP.finds(
            r.path,
            f"{counted(left_out, 'row')} of {r.rows + left_out:,} carry the stamp of those before, and would lie "
            "on one line; they are left out: see to what stamps them",
            left_out,
        )
        for r in records
        if (left_out := r.reject_reasons.get(STANDS, 0))
    ]


def _stands(record: LogRecord, table: str) -> bool:
    """Return whether the clock stood for most left-out rows, or (in a first look) for all remaining ones."""
    return record.reject_reasons.get(STANDS, 0) > record.rows or _all_stand(record.tables.get(table, ()))


def _all_stand(files: Sequence[DataFile]) -> bool:
    """Return whether each row group of several rows has one stamp, and there is one; single rows are ignored."""
    groups = 0
    for file in files:
        several, (first, last) = np.array(file.group_rows) > 1, np.array(file.group_spans).T
        if (first != last)[several].any():
            return False
        groups += int(several.sum())
    return groups > 0


def _fault(record: LogRecord, table: str) -> Fault:
    (first, _), count = record.span(table) or (0, 0), record.rows + record.reject_reasons.get(STANDS, 0)
    reason = TimeSystemError(
        f"its {count:,} {table} carry one stamp for many rows ({iso_from_gps_ns(first)} at first), so they would lie "
        "on one line",
        expected="a time of its own for each",
        change="see to what stamps them: a clock that stands still, or stamps that were rounded",
    )
    return Fault((record.key,), record.path, str(reason))
