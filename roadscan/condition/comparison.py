"""Compares the condition in two surveys of a road: matches sections, and tests changes for significance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import numpy.typing as npt
import shapely

BESIDE_M: Final = 1.5
"""Largest distance between the middles of sections of one lane (m): half a narrow lane."""
LEAST_SHARE: Final = 0.9
"""Least common share of the lengths of sections that are compared."""
MOST_TURN_DEG: Final = 45.0
"""Largest angle between sections of one direction."""

Verdict: TypeAlias = Literal["larger", "smaller", "no change shown", "not judged"]
VERDICTS: Final[tuple[Verdict, ...]] = get_args(Verdict)


class Pair(NamedTuple):
    """A section of the later survey, and the matching one of the earlier survey."""

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
    """1 σ of it, from both surveys taken as independent; NaN where one states none."""
    p_value: float
    """Probability of so large a change, or a larger one, if nothing changed; NaN without σ."""
    verdict: Verdict


def matched_sections(earlier: npt.NDArray[Any], later: npt.NDArray[Any]) -> tuple[list[Pair], npt.NDArray[np.int64]]:
    """Return sections on the same piece of the same lane, and the rows of the later survey without a match.

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
    """Return the change of a quantity, and whether it exceeds the errors of both surveys, two-sided.

    `level` : a change whose probability without any change is below this is significant.
    """
    change, sigma = later - earlier, math.hypot(sigma_earlier, sigma_later)
    if not (math.isfinite(change) and sigma > 0.0):  # also for NaN
        return Change(change, math.nan, math.nan, "not judged")
    p_value = math.erfc(abs(change) / sigma / math.sqrt(2.0))
    if p_value >= level:
        return Change(change, sigma, p_value, "no change shown")
    return Change(change, sigma, p_value, "larger" if change > 0.0 else "smaller")


def _share(one: shapely.LineString, other: shapely.LineString) -> float:
    """Return the common length of two lines, divided by that of the longer; 0 for different directions."""
    if _turn_deg(one, other) > MOST_TURN_DEG:
        return 0.0
    beside = shapely.buffer(one, BESIDE_M, cap_style="flat")
    return float(shapely.length(shapely.intersection(other, beside)) / max(one.length, other.length))


def _turn_deg(one: shapely.LineString, other: shapely.LineString) -> float:
    chords = [np.subtract(line.coords[-1][:2], line.coords[0][:2]) for line in (one, other)]
    turn = math.atan2(*reversed(chords[0])) - math.atan2(*reversed(chords[1]))
    return abs(math.degrees(math.remainder(turn, 2.0 * math.pi)))
