"""Logs whose profiles carry one stamp: their clock stood still, and all that they measured would lie on one line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from roadscan.core.errors import TimeSystemError
from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.overlap import Fault
from roadscan.store.logs import LogRecord

_STAMPED: Final = ("scans", "imu", "encoder", "gnss")
"""Tables of which each row has a time of its own. Returns of one sweep may share theirs."""


def one_stamp_logs(records: Sequence[LogRecord]) -> list[Fault]:
    """Logs of which each row has the stamp of its neighbours."""
    return [_fault(r, table) for r in records for table in _STAMPED if _share(r, table) == 1.0]


ONE_STAMP: Final = Witness(
    "one_stamp",
    input="any log with a stamp a row",
    fault="The clock that stamps the rows stands still: all that they measured lies on one line.",
    asks="the stamps of neighbouring rows",
    does="a log of one stamp fails; one of which more than checks.lost_share shares a stamp is named, and used",
    told=("error", "findings"),
)


def one_stamp_findings(records: Sequence[LogRecord], share: float) -> list[Finding]:
    """Logs of which more than a share of the rows, and not all, have the stamp of their neighbours."""
    return [
        ONE_STAMP.finds(
            r.path,
            f"{own:.0%} of its {table} carry the stamp of all others about them, and would lie on one line; see "
            "to what stamps them",
        )
        for r in records
        for table in _STAMPED
        if share < (own := _share(r, table)) < 1.0
    ]


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
    (first, _) = record.span(table) or (0, 0)
    reason = TimeSystemError(
        f"its {record.rows:,} {table} carry one stamp for many rows ({iso_from_gps_ns(first)} at first), so they "
        "would lie on one line",
        expected="a time of its own for each",
        change="see to what stamps them: a clock that stands still, or stamps that were rounded",
    )
    return Fault((record.key,), record.path, str(reason))
