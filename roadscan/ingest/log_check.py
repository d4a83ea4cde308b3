"""The interface of a check: it sees each chunk of rows while a log is read, and reports at the end."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import pyarrow as pa

from roadscan.compute.array_types import Int64
from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.store.writer import LogWriter

Refused: TypeAlias = tuple[Int64, str]
"""Rows of a chunk (by index) that are left out, with the reason."""


class LogCheck:
    """Checks the rows of one log; subclasses override what they need."""

    def refused(self, rows: Rows) -> Sequence[Refused]:
        """Return the rows of a chunk that are left out."""
        return ()

    def take(self, rows: Rows, refused: Sequence[Int64]) -> None:
        """Examine a chunk of which rows (by index) were `refused`, by this check or another."""

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Leave rows out of the finished tables, and add findings to `writer.findings`."""


@dataclass(frozen=True)
class Refuses(LogCheck):
    """A check that treats each chunk independently."""

    judge: Callable[[Rows], Sequence[Refused]]

    def refused(self, rows: Rows) -> Sequence[Refused]:
        """Return the rows of a chunk that are left out."""
        return self.judge(rows)


def epochs_in(rows: Rows, tables: Collection[str]) -> Int64 | None:
    """Return the epochs (n,), n > 0, of a chunk of one of these tables; None for others, and where one is not whole.

    The schema's rules for columns reject epochs that are not whole.
    """
    _, batch = rows.stored
    if rows.table not in tables or not batch.num_rows or "epoch_gps_ns" not in batch.schema.names:
        return None
    column = batch.column("epoch_gps_ns")
    return None if column.null_count or not pa.types.is_int64(column.type) else column.to_numpy()
