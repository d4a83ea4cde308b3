"""Rows that carry one stamp: their clock stood still, and all that they measured would lie on one line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.core.counted import counted
from roadscan.core.errors import TimeSystemError
from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.log_check import LogCheck, Refused
from roadscan.ingest.overlap import Fault
from roadscan.ingest.reading.format import Rows
from roadscan.store.logs import LogRecord

STAMPED: Final = ("scans", "imu", "encoder", "gnss")
"""Tables of which each row has a time of its own. Returns of one sweep may share theirs."""


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
"""Raised when other rows are left out, so that logs with a stamp a row are read again."""
LEAST_ROWS: Final = 10
"""So many rows in a row with one stamp are no rounding of stamps that a survey can use."""
STANDS: Final = "the clock stands: the row has the stamp of the rows before it"


class StandingClock(LogCheck):
    """Leaves out rows whose clock stood still, but the first of each stretch."""

    def __init__(self) -> None:
        self._before: dict[tuple[str, str], tuple[int, int]] = {}
        """Epoch of the last row of a table and file, and how many rows before had it."""

    def refused(self, rows: Rows) -> list[Refused]:
        """Rows of a chunk (by index) that are left out."""
        if rows.table not in STAMPED or not rows.batch.num_rows or "epoch_gps_ns" not in rows.batch.schema.names:
            return []
        column = rows.batch.column("epoch_gps_ns")
        if column.null_count or not pa.types.is_int64(column.type):
            return []  # the rules of the table's columns refuse them
        epochs = column.to_numpy()
        epoch, before = self._before.get((rows.table, rows.file), (int(epochs[0]), 0))
        starts = np.flatnonzero(np.diff(epochs, prepend=epoch - 1))  # the first is one, whatever came before
        lengths = np.diff(starts, append=epochs.size)
        carried = np.zeros(starts.size, np.int64)
        carried[0] = before if epochs[0] == epoch else 0
        stands = np.repeat(lengths + carried >= LEAST_ROWS, lengths)
        stands[starts[carried == 0]] = False
        self._before[rows.table, rows.file] = int(epochs[-1]), int(lengths[-1] + carried[-1])
        return [(np.flatnonzero(stands), STANDS)] if stands.any() else []


def one_stamp_logs(records: Sequence[LogRecord]) -> list[Fault]:
    """Logs of which most rows have the stamp of their neighbours."""
    return [_fault(r, table) for r in records for table in STAMPED if r.tables.get(table) and _stands(r, table)]


def one_stamp_findings(records: Sequence[LogRecord]) -> list[Finding]:
    """Logs of which some rows are left out since their clock stood still."""
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
    """Whether the clock stood for most of the rows that were left out, or for all that are left (in a first look)."""
    return record.reject_reasons.get(STANDS, 0) > record.rows or _share(record, table) == 1.0


def _share(record: LogRecord, table: str) -> float:
    """Share of a table's rows that lie in row groups of one stamp; single rows are left out."""
    groups = [
        (rows, first == last)
        for file in record.tables.get(table, ())
        for rows, (first, last) in zip(file.group_rows, file.group_spans, strict=True)
        if rows > 1
    ]
    total = sum(rows for rows, _ in groups)
    return sum(rows for rows, is_one in groups if is_one) / total if total else 0.0


def _fault(record: LogRecord, table: str) -> Fault:
    (first, _), count = record.span(table) or (0, 0), record.rows + record.reject_reasons.get(STANDS, 0)
    reason = TimeSystemError(
        f"its {count:,} {table} carry one stamp for many rows ({iso_from_gps_ns(first)} at first), so they would lie "
        "on one line",
        expected="a time of its own for each",
        change="see to what stamps them: a clock that stands still, or stamps that were rounded",
    )
    return Fault((record.key,), record.path, str(reason))
