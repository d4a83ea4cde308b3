"""Gaps between the ends of cracks are bridged where two ends face one another.

A crack that is narrower than a cell is lost where it runs between two: less than half of either's readings lie in it.
Two free ends within `bridge_m` are joined by a straight piece without depth or width if both point at one another, to
30° and a cell and a half; the nearest are joined first, and each once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.distress.cracks import CrackPiece

_ASIDE: Final = math.tan(math.radians(30.0))  # Tangent of the most that an end may point past the other.
_ASIDE_CELLS: Final = 1.5  # Distance (cells) that is allowed aside on top of that angle.
_OPPOSITE: Final = -0.5
"""Greatest cosine of the angle between the directions out of two ends."""
_CHORD_M: Final = 0.1  # The direction of an end is that of a chord about this long (m).


def outwards(line_m: Float64) -> Float64:
    """Returns the unit vector (2,) that points out of a line (n, 2) at its end, along a chord of about 0.1 m."""
    along = np.cumsum(np.hypot(*np.diff(line_m[::-1], axis=0).T))
    back = line_m[-1] - line_m[-2 - min(int(np.searchsorted(along, _CHORD_M)), len(line_m) - 2)]
    size = float(np.hypot(*back))
    return np.asarray(back / size) if size > 0.0 else np.zeros(2)


def bridges_of(pieces: Sequence[CrackPiece], bridge_m: float, cell_m: float) -> list[CrackPiece]:
    """Returns pieces that join free ends of other pieces; the order of `pieces` does not matter."""
    from scipy.spatial import cKDTree

    met: dict[tuple[int, int], int] = {}
    for name in (name for one in pieces for name in (one.start, one.end)):
        met[name] = met.get(name, 0) + 1
    free = sorted(
        (name, tuple(line[-1].tolist()), tuple(outwards(line).tolist()))
        for one in pieces
        for name, line in ((one.start, one.line_m[::-1]), (one.end, one.line_m))
        if met[name] == 1
    )
    if len(free) < 2 or bridge_m <= 0.0:
        return []
    place, out = (np.array([end[k] for end in free], np.float64) for k in (1, 2))
    first, second = cKDTree(place).query_pairs(bridge_m, output_type="ndarray").T
    gap = place[second] - place[first]
    size = np.hypot(*gap.T)
    facing = (out[first] * out[second]).sum(axis=1) <= _OPPOSITE
    for here, way in ((out[first], gap), (out[second], -gap)):
        along, aside = (here * way).sum(axis=1), np.abs(here[:, 0] * way[:, 1] - here[:, 1] * way[:, 0])
        facing &= (along > 0.0) & (aside <= _ASIDE * along + _ASIDE_CELLS * cell_m)
    found: list[CrackPiece] = []
    taken: set[int] = set()
    for k in np.lexsort((second, first, size)).tolist():
        a, b = int(first[k]), int(second[k])
        if facing[k] and not {a, b} & taken:
            taken |= {a, b}
            length = float(size[k])
            found.append(CrackPiece(place[[a, b]], free[a][0], free[b][0], length, 0.0, 0.0, 0.0, 0.0, 0.0))
    return found
