"""What a check of a log is: it follows the rows while they are read, and is asked once they stand in the tables."""

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
"""Rows of a chunk (by index) that are left out, and why."""


class LogCheck:
    """Follows the rows of one log; each check overrides what it needs."""

    def refused(self, rows: Rows) -> Sequence[Refused]:
        """Rows of a chunk that are left out."""
        return ()

    def take(self, rows: Rows, refused: Sequence[Int64]) -> None:
        """Look at a chunk of which rows (by index) were `refused`, by this check or another."""

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Leave rows out of the finished tables, and say in `writer.findings` what is doubtful."""


@dataclass(frozen=True)
class Refuses(LogCheck):
    """A check that looks at each chunk by itself."""

    judge: Callable[[Rows], Sequence[Refused]]

    def refused(self, rows: Rows) -> Sequence[Refused]:
        """Rows of a chunk that are left out."""
        return self.judge(rows)
