"""What is wrong with control: points in another CRS or height datum, wrong ones, two that were swapped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.control.control import Sighting
from roadscan.compute.robust import scatter_about

Float64 = npt.NDArray[np.float64]

_NAMED: Final = 8
"""So many points are named; of more their number is told."""
_SIGMAS: Final = 4.0


@dataclass(frozen=True)
class WrongPoint:
    """A control point whose survey the others contradict."""

    name: str
    height_m: float
    """Surveyed minus what all others say; NaN where the height is right."""
    horizontal_m: float
    """Distance of the surveyed place from where all others say; NaN where the place is right."""
    sigma_m: float
    """1 σ of the height's difference."""
    surveyed_height_m: float
    sigmas: float = float("nan")
    """Length of the normalised residual; NaN where it is not known."""
    limit: float = float("nan")
    """That from which on a point is wrong."""
    alternatives: tuple[str, ...] = ()
    """Points that may be the wrong ones in its stead."""

    def told(self) -> str:
        """In words."""
        parts, what = [], []
        if np.isfinite(self.height_m):
            parts.append(f"its surveyed height lies {self.height_m * 1e3:+.1f} mm")
            what.append("height")
        if np.isfinite(self.horizontal_m):
            parts.append(f"its surveyed place lies {self.horizontal_m * 1e3:.1f} mm")
            what.append("place")
        text = f"{' and '.join(parts)} from what all other evidence says"
        if np.isfinite(self.sigmas):
            text += f" ({self.sigmas:.1f} σ, where {self.limit:.1f} σ are the limit)"
        if self.alternatives:
            names = listed(self.alternatives)
            return f"{text}; it or {names} is wrong, and nothing tells which of them: none of their {what[0]}s counts"
        return f"{text}; its {' and its '.join(what)} does not count"


def datum_fault(sightings: Sequence[Sighting], largest_m: float) -> str:
    """Why no point can be used: their heights are in another datum than the map's; "" where they fit.

    largest_m : a median difference up to this is a matter of the poses.
    """
    away = np.array([one.point.height_m - one.height_m for one in sightings if np.isfinite(one.height_m)])
    if away.size == 0 or abs(float(np.median(away))) <= largest_m:
        return ""
    middle = float(np.median(away))
    spread = scatter_about(away, middle)
    return (
        f"the control points lie {middle:+.3f} m from the road that was measured (median of {away.size} sightings, "
        f"spread {spread:.3f} m): they are in another height datum or CRS than their [[control]] states, or the "
        "trajectories are; none of them is used"
    )


def far_in_height(sightings: Sequence[Sighting], largest_m: float) -> dict[str, float]:
    """Points, by name, whose height differs from what most passes measured by more than that: surveyed minus measured
    (m).
    """
    found: dict[str, list[float]] = {}
    for one in sightings:
        if np.isfinite(one.height_m):
            found.setdefault(one.point.name, []).append(one.point.height_m - one.height_m)
    middle = {name: float(np.median(values)) for name, values in found.items()}
    return {name: away for name, away in middle.items() if abs(away) > largest_m}


def swapped(wrong: Sequence[WrongPoint]) -> list[tuple[str, str]]:
    """Pairs of wrong points whose heights would be right if they were exchanged."""
    found: list[tuple[str, str]] = []
    for k, one in enumerate(wrong):
        for other in wrong[k + 1 :]:
            apart = one.surveyed_height_m - other.surveyed_height_m
            left = np.array([one.height_m - apart, other.height_m + apart])
            limit = _SIGMAS * np.array([one.sigma_m, other.sigma_m])
            if np.isfinite(left).all() and (np.abs(left) < limit).all():
                found.append((one.name, other.name))
    return found


def listed(words: Sequence[str]) -> str:
    """Some of many, and how many more there are."""
    more = f" and {len(words) - _NAMED} more" if len(words) > _NAMED else ""
    return ", ".join(words[:_NAMED]) + more
