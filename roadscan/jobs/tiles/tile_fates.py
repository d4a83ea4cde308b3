"""What became of readings, told with the tiles: each row group's readings with one of the tiles that it touches."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.kernels.georeferencing.readings import KEPT, OUTSIDE
from roadscan.model.ids import TileId
from roadscan.points.place import COUNTED_FATES, FATE_NAMES
from roadscan.tables.manifest import OutputRecord


class Fates:
    """Readings by fate of the row groups of a task, by the tile that tells them."""

    def __init__(self) -> None:
        self._counts: dict[TileId, npt.NDArray[np.int64]] = defaultdict(lambda: np.zeros(COUNTED_FATES, np.int64))

    def add(self, tile: TileId, fates: npt.NDArray[np.int64]) -> None:
        """Count (11,) readings by fate; those that were placed outside the task's tiles are kept ones, too."""
        self._counts[tile] += fates

    def of(self, tile: TileId) -> dict[str, int]:
        """Figures for the tile's record."""
        if tile not in self._counts:
            return {}
        counts = self._counts[tile].copy()
        counts[KEPT] += counts[OUTSIDE]
        counts[OUTSIDE] = 0
        return {name: int(n) for name, n in zip(FATE_NAMES[:COUNTED_FATES], counts, strict=True) if n}


def told(records: Iterable[OutputRecord]) -> dict[str, int]:
    """Readings by fate over the records of tiles (and of the footprints of clouds, which are placed for these)."""
    totals = dict.fromkeys(FATE_NAMES, 0)
    for record in records:
        figures: dict[str, Any] = record.figures()
        for name, count in figures.get("fates", {}).items():
            totals[name] += count
    return {name: count for name, count in totals.items() if count}


FATE_WORDS: Final = {
    "no_pose": "have no pose (the trajectory has a gap there, or navigation.max_gap_s is too short)",
    "range": "lie outside range_min_m and range_max_m of their sensor",
    "height": "lie outside the heights of [filters]",
    "no_return": "have no return",
    "outside_pass": "lie outside all passes",
    "centre_line": "lie off the centre lines of filters.centre_line",
}
"""What became of readings that were not kept, in words."""


def fate_words(fates: Mapping[str, int]) -> str:
    """What became of readings that were not kept, the largest number first."""
    lost = sorted(((n, c) for n, c in fates.items() if c and n not in {"kept", "outside"}), key=lambda one: -one[1])
    return "; ".join(f"{count:,} {FATE_WORDS.get(name, f'are {name}')}" for name, count in lost)


def lost_notes(fates: Mapping[str, int], share: float) -> list[str]:
    """What to say where more than a share of the readings has no pose."""
    readings, lost = sum(fates.values()), fates.get("no_pose", 0)
    if not readings or lost <= share * readings:
        return []
    return [f"{lost:,} of {readings:,} readings ({lost / readings:.0%}) {FATE_WORDS['no_pose']}"]
