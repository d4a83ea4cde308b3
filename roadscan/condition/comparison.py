"""Change of the condition between two surveys of a road: the same sections, and what changed beyond chance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import numpy.typing as npt
import shapely

BESIDE_M: Final = 1.5
"""Sections are of one lane where their middles lie no farther apart than this (m): half a narrow lane."""
LEAST_SHARE: Final = 0.9
"""Sections are compared where they have this share of their length in common."""
MOST_TURN_DEG: Final = 45.0
"""Sections are of one direction where they turn from one another by less than this."""

Verdict: TypeAlias = Literal["larger", "smaller", "no change shown", "not judged"]
VERDICTS: Final[tuple[Verdict, ...]] = get_args(Verdict)


class Pair(NamedTuple):
    """A section of the later survey, and the one of the earlier survey that it is compared with."""

    later: int
    earlier: int
    share: float
    """Length in common, divided by that of the longer section."""


@dataclass(frozen=True)
class Change:
    """The change of a quantity."""

    change: float
    """Later minus earlier, in the quantity's unit."""
    sigma: float
    """1 σ of it: both surveys' own, taken as independent; NaN where one has none."""
    p_value: float
    """Probability of so large a change, or a larger one, where nothing changed; NaN without σ."""
    verdict: Verdict


def matched_sections(earlier: npt.NDArray[Any], later: npt.NDArray[Any]) -> tuple[list[Pair], npt.NDArray[np.int64]]:
    """Sections that lie on the same piece of the same lane, and rows of the later survey that have none.

    Parameters
    ----------
    earlier, later : (n,), (m,) shapely lines along the middle of each section's lane, in one map (m), in the direction
        of travel.
    """
    pairs: list[Pair] = []
    alone: list[int] = []
    tree = shapely.STRtree(earlier)
    for row, line in enumerate(later):
        near = tree.query(line, predicate="dwithin", distance=BESIDE_M) if len(earlier) else np.empty(0, np.int64)
        shares = [_share(earlier[k], line) for k in near.tolist()]
        best = int(np.argmax(shares)) if shares else -1
        if best >= 0 and shares[best] >= LEAST_SHARE:
            pairs.append(Pair(row, int(near[best]), shares[best]))
        else:
            alone.append(row)
    return pairs, np.array(alone, np.int64)


def change_of(earlier: float, later: float, sigma_earlier: float, sigma_later: float, level: float = 0.05) -> Change:
    """The change of a quantity and whether it is more than the errors of both surveys explain, two-sided.

    `level` : a change whose probability without any change is below this is told as one.
    """
    change, sigma = later - earlier, math.hypot(sigma_earlier, sigma_later)
    if not (math.isfinite(change) and sigma > 0.0):  # NaN compares as False
        return Change(change, math.nan, math.nan, "not judged")
    p_value = math.erfc(abs(change) / sigma / math.sqrt(2.0))
    if p_value >= level:
        return Change(change, sigma, p_value, "no change shown")
    return Change(change, sigma, p_value, "larger" if change > 0.0 else "smaller")


def _share(one: shapely.LineString, other: shapely.LineString) -> float:
    """Length that two lines have side by side, divided by that of the longer; 0 where they run in other directions."""
    if _turn_deg(one, other) > MOST_TURN_DEG:
        return 0.0
    beside = shapely.buffer(one, BESIDE_M, cap_style="flat")
    return float(shapely.length(shapely.intersection(other, beside)) / max(one.length, other.length))


def _turn_deg(one: shapely.LineString, other: shapely.LineString) -> float:
    chords = [np.subtract(line.coords[-1][:2], line.coords[0][:2]) for line in (one, other)]
    turn = math.atan2(*reversed(chords[0])) - math.atan2(*reversed(chords[1]))
    return abs(math.degrees(math.remainder(turn, 2.0 * math.pi)))
