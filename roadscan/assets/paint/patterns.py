"""The pattern of a line: where it is solid, and where dashed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64

_LONGEST_DASH_M: Final = 8.0  # Longest dash (m).
_WORN_GAP_M: Final = 2.0
"""Longest gap (m) over which a solid line continues."""
_SOLID_SHARE: Final = 0.8
"""Painted share from which dashes are a worn solid line."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Paint without a gap."""

    line: Float64
    """(n, 3) centre line in the map: easting, northing, height."""
    pieces: tuple[int, ...]
    seen: tuple[bool, bool]
    """Whether bare ground was seen beyond its ends."""
    length_m: float
    width_m: float

    def turned(self) -> Stretch:
        """Returns the same in the other direction."""
        return Stretch(self.line[::-1], self.pieces[::-1], self.seen[::-1], self.length_m, self.width_m)


def patterned(chain: Sequence[Stretch]) -> list[tuple[str | None, list[Stretch]]]:
    """Returns stretches in sequence, split where the pattern changes; None where no pattern is known."""
    groups: list[list[list[Stretch]]] = []
    for bundle in _over_hidden_gaps(chain):
        if groups and _goes_on(groups[-1][-1], bundle):
            groups[-1].append(bundle)
        else:
            groups.append([bundle])
    return [(_kind(group), [s for bundle in group for s in bundle]) for group in groups]


def _over_hidden_gaps(chain: Sequence[Stretch]) -> list[list[Stretch]]:
    """Join stretches between which no bare ground was seen: something hid the line."""
    out = [[chain[0]]]
    for before, after in pairwise(chain):
        if before.seen[1] and after.seen[0]:
            out.append([after])
        else:
            out[-1].append(after)
    return out


def _goes_on(before: list[Stretch], after: list[Stretch]) -> bool:
    short = _reach(before) < _LONGEST_DASH_M, _reach(after) < _LONGEST_DASH_M
    gap = float(np.hypot(*(after[0].line[0, :2] - before[-1].line[-1, :2])))
    return all(short) or (not any(short) and gap <= _WORN_GAP_M)


def _reach(bundle: list[Stretch]) -> float:
    return float(np.hypot(*(bundle[-1].line[-1, :2] - bundle[0].line[0, :2])))


def _kind(group: list[list[Stretch]]) -> str | None:
    if _reach(group[0]) >= _LONGEST_DASH_M:
        return "solid"
    painted = sum(s.length_m for bundle in group for s in bundle)
    whole = float(np.hypot(*(group[-1][-1].line[-1, :2] - group[0][0].line[0, :2])))
    if len(group) == 1:
        return "dashed" if group[0][0].seen[0] and group[0][-1].seen[1] else None
    return "solid" if painted >= _SOLID_SHARE * whole else "dashed"
