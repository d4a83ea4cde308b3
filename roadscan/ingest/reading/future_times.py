"""Rejects rows with times in the future: their stamps are on another scale than the log says."""

from __future__ import annotations

import datetime as dt
import time
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.core.gpstime import (
    ADJUSTED_OFFSET_S,
    GPS_EPOCH_UNIX_S,
    NS_PER_S,
    TimeSystem,
    gps_ns_from_utc,
    iso_from_gps_ns,
)
from roadscan.core.witness import Witness
from roadscan.ingest.reading.format import LogHeader, LogSource, Rows

TIME_IN_FUTURE: Final = Witness(
    "time_in_future",
    input="any log with a stamp a row",
    fault="The stamps are on another scale than the log or its clock says, such as POSIX seconds under the bit of "
    "standard GPS time.",
    asks="the later of the log file's own date and this computer's, and a day",
    does="rows of a later time are left out; the reason names the scale on which they would not lie in the future",
    told=("rejects",),
)

_MARGIN_NS: Final = 86_400 * NS_PER_S
"""Tolerance (ns): clocks of two computers, or local times taken as UTC, differ by less."""
_ORIGIN_GPS_S: Final = {
    TimeSystem.UNIX_UTC: -GPS_EPOCH_UNIX_S,
    TimeSystem.GPS: 0,
    TimeSystem.GPS_ADJUSTED: ADJUSTED_OFFSET_S,
}
"""GPS seconds at which the count of each scale begins, to within some leap seconds."""
_EARLIEST_GPS_S: Final = 630_720_000
"""Start of 2000 (GPS s): there was no mobile mapping before."""


@dataclass
class FutureTimes:
    """Checks the epochs of one log against today's date."""

    latest_gps_ns: int
    system: TimeSystem | None
    """Assumed time system of the stamps, where one is known; a free clock has no date."""
    _reason: str = field(default="")

    @classmethod
    def of(cls, source: LogSource, header: LogHeader) -> FutureTimes:
        """Return the check of a log as the survey file describes it."""
        written_unix_s = source.path.stat().st_mtime if source.path.exists() else 0.0
        now = dt.datetime.fromtimestamp(max(time.time(), written_unix_s), dt.UTC)
        said = header.attributes.get("time_system") or (source.any_clock.system if source.any_clock else None)
        known = TimeSystem(said) if said in set(TimeSystem) else None
        return cls(gps_ns_from_utc(now) + _MARGIN_NS, known)

    def refused(self, rows: Rows) -> list[tuple[npt.NDArray[np.int64], str]]:
        """Return the rows of a chunk (by index) that lie in the future, with the reason."""
        _, batch = rows.stored
        if self.system is TimeSystem.FREE or not batch.num_rows or "epoch_gps_ns" not in batch.schema.names:
            return []
        column = batch.column("epoch_gps_ns")
        last = pc.max(column).as_py() if pa.types.is_int64(column.type) else None
        if last is None or last <= self.latest_gps_ns:
            return []
        late = np.flatnonzero(
            pc.fill_null(pc.greater(column, self.latest_gps_ns), False).to_numpy(zero_copy_only=False)
        )
        self._reason = self._reason or self._words(int(column[int(late[0])].as_py()))
        return [(late, self._reason)]

    def _words(self, epoch_gps_ns: int) -> str:
        text = f"the time lies in the future ({iso_from_gps_ns(epoch_gps_ns)[:19]}Z"
        if self.system not in _ORIGIN_GPS_S:
            return f"{text}): check the log's clock"
        counted_s = epoch_gps_ns // NS_PER_S - _ORIGIN_GPS_S[self.system]
        for system, origin_s in _ORIGIN_GPS_S.items():
            other_s = counted_s + origin_s
            if system is not self.system and _EARLIEST_GPS_S < other_s <= self.latest_gps_ns // NS_PER_S:
                there = iso_from_gps_ns(other_s * NS_PER_S)[:10]
                return (
                    f"{text} as '{self.system}'): as '{system}' it would be {there}; if it was driven then, state "
                    f'clock = {{ system = "{system}" }}'
                )
        return f"{text} as '{self.system}'): check the log's clock"
