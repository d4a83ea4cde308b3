"""Returns of a lidar that lie farther away than any lidar of a road survey measures: values in another unit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.witness import Witness
from roadscan.ingest.log_check import LogCheck
from roadscan.ingest.reading.format import LogHeader, Rows
from roadscan.store.readings.packed_returns import PACKED, farthest_m
from roadscan.store.readings.returns import distances_m
from roadscan.store.writer import LogWriter

FAR_RETURNS: Final = Witness(
    "far_returns",
    input="lidar",
    fault="Returns are stated in another unit than metres, such as millimetres.",
    asks="the distance of each return from the sensor, against the reach of lidars on vehicles",
    does="the returns are used within range_max_m of the rig; their number and the farthest are named",
    told=("findings",),
)

FARTHEST_M: Final = 1_000.0
"""Lidars on vehicles measure to 300 m, few to 500 m; returns beyond this distance (m) are no measurements."""
_LEAST_SHARE: Final = 0.001
"""Share of such returns that is named: single ones are noise."""


class FarReturns(LogCheck):
    """Counts returns that are too far away while a log streams by."""

    def __init__(self) -> None:
        self._count = 0
        self._far = 0
        self._farthest_m = 0.0

    def take(self, rows: Rows, refused: Sequence[npt.NDArray[np.int64]]) -> None:
        """Take the next rows of the table `returns`."""
        table, stored = rows.stored
        if rows.table != "returns" or not stored.num_rows:
            return
        if table == PACKED and farthest_m(stored) <= FARTHEST_M:
            self._count += stored.num_rows
            return
        columns = [rows.batch.column(f"{axis}_sensor_m").to_numpy(zero_copy_only=False) for axis in "xyz"]
        if np.hypot.reduce([max(float(one.max()), -float(one.min())) for one in columns]) <= FARTHEST_M:
            self._count += rows.batch.num_rows
            return
        distance_m = np.nan_to_num(distances_m(rows.batch), nan=0.0, posinf=0.0)
        self._count += distance_m.size
        self._far += int((distance_m > FARTHEST_M).sum())
        self._farthest_m = max(self._farthest_m, float(distance_m.max()))

    def finish(self, writer: LogWriter, header: LogHeader) -> None:
        """Name what was counted."""
        if self._far > _LEAST_SHARE * self._count:
            text = (
                f"{self._far:,} of {self._count:,} returns lie more than {FARTHEST_M:,.0f} m from the sensor, the "
                f"farthest {self._farthest_m:,.0f} m: no lidar of a vehicle measures so far; check the unit"
            )
            writer.findings.append(FAR_RETURNS.finds("", text))
