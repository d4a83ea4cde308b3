"""The interface of a check: it sees each chunk of rows while a log is read, and reports at the end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.store.writer import LogWriter

Int64 = npt.NDArray[np.int64]
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
