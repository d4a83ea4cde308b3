"""Counts of readings by outcome: each row group is reported by one of the tiles that it touches."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.grid import TileId
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.kernels.readings import KEPT, OUTSIDE
from roadscan.georeference.place import COUNTED_FATES, FATE_NAMES
from roadscan.store.logs import LogRecord, log_of
from roadscan.store.manifest import OutputRecord

_MOST_NOTED: Final = 10
"""Most logs that a finding names."""


class ReadingCounts:
    """Counts of readings by outcome for the row groups of a task, by reporting tile and by log."""

    def __init__(self) -> None:
        self._counts: dict[TileId, dict[str, npt.NDArray[np.int64]]] = defaultdict(
            lambda: defaultdict(lambda: np.zeros(COUNTED_FATES, np.int64))
        )

    def add(self, tile: TileId, file: str, fates: npt.NDArray[np.int64]) -> None:
        """Count (11,) readings of a log's file by outcome; readings outside the task's tiles count as kept."""
        self._counts[tile][log_of(file)] += fates

    def of(self, tile: TileId) -> dict[str, dict[str, int]]:
        """Return figures for the tile's record, by the key of the log."""
        return {log: _counts(fates) for log, fates in sorted(self._counts.get(tile, {}).items())}


def _counts(fates: npt.NDArray[np.int64]) -> dict[str, int]:
    counts = fates.copy()
    counts[KEPT] += counts[OUTSIDE]
    counts[OUTSIDE] = 0
    return {name: int(n) for name, n in zip(FATE_NAMES[:COUNTED_FATES], counts, strict=True) if n}


class LogCounts:
    """Sums of readings by outcome, by the key of their log.

    Footprints report clouds, which are read for them, and row groups that touch no tile. Tiles of older versions do not
    name the log; their readings have the key "".
    """

    def __init__(self, records: Iterable[OutputRecord] = ()) -> None:
        self._logs: dict[str, dict[str, int]] = defaultdict(lambda: dict.fromkeys(FATE_NAMES, 0))
        for record in records:
            self.add(record.unit, record.figures().get("fates", {}))

    def add(self, unit: str, figures: Mapping[str, Any]) -> None:
        """Add the counts that the record of a tile, or of the footprints of a data file, states."""
        is_by_log = isinstance(next(iter(figures.values()), {}), dict)
        for log, fates in figures.items() if is_by_log else ((log_of(unit), figures),):
            own = self._logs[log]
            for name, count in fates.items():
                own[name] += count

    def __add__(self, other: LogCounts) -> LogCounts:
        """Return the sums of both."""
        both = LogCounts()
        for one in (self, other):
            both.add("", one.by_log())
        return both

    def by_log(self) -> dict[str, dict[str, int]]:
        """Return the counts by log, without outcomes that no reading had."""
        logs = sorted(self._logs.items())
        return {log: {name: count for name, count in fates.items() if count} for log, fates in logs}

    def of_all(self) -> dict[str, int]:
        """Return the counts of all logs together."""
        totals = {name: sum(own[name] for own in self._logs.values()) for name in FATE_NAMES}
        return {name: count for name, count in totals.items() if count}


FATE_WORDS: Final = {
    "no_pose": "have no pose (the trajectory has a gap there, or navigation.max_gap_s is too short)",
    "range": "lie outside range_min_m and range_max_m of their sensor",
    "height": "lie outside the heights of [filters]",
    "no_return": "have no return",
    "outside_pass": "lie outside all passes",
    "centre_line": "lie off the centre lines of filters.centre_line",
}
"""Descriptions of the outcomes other than kept."""


def fate_words(fates: Mapping[str, int]) -> str:
    """Return descriptions and counts of readings that were not kept, the largest count first."""
    lost = sorted(((n, c) for n, c in fates.items() if c and n not in {"kept", "outside"}), key=lambda one: -one[1])
    return "; ".join(f"{count:,} {FATE_WORDS.get(name, f'are {name}')}" for name, count in lost)


NO_POSE: Final = Witness(
    "no_pose",
    input="lidar, profiler",
    fault="Readings were taken when the run has no pose: a gap, or a clock that is off.",
    asks="the trajectory at each reading's epoch",
    does="such a reading is left out and counted; where they are more than checks.lost_share, the log is named",
    told=("findings",),
)


def lost_findings(
    logs: Mapping[str, Mapping[str, int]], records: Iterable[LogRecord], share: float
) -> list[Finding]:  # fmt: skip
    """Return the logs of which more than a share of the readings has no pose.

    Parameters
    ----------
    logs : readings by fate, by the key of their log.
    records : of the logs.
    """
    found: list[Finding] = []
    for record in records:
        fates = logs.get(record.key, {})
        readings, lost = sum(fates.values()), fates.get("no_pose", 0)
        if readings and lost > share * readings:
            words = f"{lost:,} of {readings:,} readings ({lost / readings:.0%}) {FATE_WORDS['no_pose']}"
            found.append(NO_POSE.finds(record.path, words, lost))
    if more := found[_MOST_NOTED:]:
        words = "as many readings of each of these, too, have no pose"
        found[_MOST_NOTED:] = [NO_POSE.finds(f"{len(more):,} more logs", words, sum(one.left_out for one in more))]
    return found
