"""Finds profiles that repeat the one before in every reading: a scanner that is stuck, or a buffer sent again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.counted import counted
from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.core.witness import Witness
from roadscan.ingest.log_check import LogCheck
from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.store.writer import LogWriter

REPEATED_PROFILES: Final = Witness(
    "repeated_profiles",
    input="profiler",
    fault="The scanner is stuck, or sends a buffer again: the vehicle moves on, and the profile does not.",
    asks="the profile before: no two differ by nothing, since each reading has noise of its own",
    does="the profiles are used; their number and the time of the first are named",
    told=("findings",),
)

LEAST_REPEATS: Final = 3
"""Consecutive repeats from which they are no coincidence: a coarse scanner at a standstill repeats some."""
_SAMPLED: Final = 8
"""Readings of a profile that are compared first: most profiles differ in one of them."""


class RepeatedProfiles(LogCheck):
    """Counts repeated profiles of a log while it streams, in file order."""

    def __init__(self) -> None:
        self._last: npt.NDArray[np.generic] | None = None
        self._in_row = 0
        self._repeats = 0
        self._first_gps_ns = 0
        self._began_gps_ns = 0

    def take(self, rows: Rows, refused: Sequence[npt.NDArray[np.int64]]) -> None:
        """Take the next rows of the table `scans`."""
        if rows.table != "scans":
            return
        batch = rows.batch
        column = batch.column("range")
        if not batch.num_rows or not pa.types.is_fixed_size_list(column.type):
            return
        ranges = column.flatten().to_numpy(zero_copy_only=False).reshape(batch.num_rows, -1)
        epochs = batch.column("epoch_gps_ns").to_numpy(zero_copy_only=False)
        before = ranges[:1] if self._last is None else self._last[None]
        same = _equal_rows(np.concatenate([before, ranges[:-1]]), ranges)
        same[0] &= self._last is not None
        for row in np.flatnonzero(same | np.concatenate([[self._in_row > 0], same[:-1]])):
            self._count(bool(same[row]), int(epochs[row]))
        self._last = ranges[-1].copy()

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Report how many profiles repeat."""
        self._count(repeats=False, epoch_gps_ns=0)
        if not self._repeats:
            return
        text = (
            f"{counted(self._repeats, 'profile')} equal the one before, reading by reading, for the first time at "
            f"{iso_from_gps_ns(self._first_gps_ns)}: the scanner was stuck, or a buffer was sent again; they are used, "
            "and show the road where it was not measured"
        )
        writer.findings.append(REPEATED_PROFILES.finds("", text))

    def _count(self, repeats: bool, epoch_gps_ns: int) -> None:
        if repeats:
            self._began_gps_ns = self._began_gps_ns if self._in_row else epoch_gps_ns
            self._in_row += 1
            return
        if self._in_row >= LEAST_REPEATS:
            self._first_gps_ns = self._first_gps_ns or self._began_gps_ns
            self._repeats += self._in_row
        self._in_row = 0


def _equal_rows(before: npt.NDArray[np.generic], after: npt.NDArray[np.generic]) -> npt.NDArray[np.bool_]:
    """Return which rows (n,) of two arrays (n, k) are equal and not all of one value."""
    columns = np.linspace(0, after.shape[1] - 1, _SAMPLED).astype(int)
    same: npt.NDArray[np.bool_] = (before[:, columns] == after[:, columns]).all(axis=1)
    rows = np.flatnonzero(same)
    same[rows] = (before[rows] == after[rows]).all(axis=1) & (after[rows] != after[rows, :1]).any(axis=1)
    return same
