"""Faults of control: points in another CRS or height datum, wrong points, two that were swapped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.adjust.control.control import Sighting
from roadscan.compute.robust import scatter_about
from roadscan.core.counted import listed

NAMED: Final = 8
"""At most this many points are named; of the rest the number is reported."""
_SIGMAS: Final = 4.0  # Heights agree after an exchange within this many σ.


@dataclass(frozen=True)
class WrongPoint:
    """A control point whose survey the other evidence contradicts."""

    name: str
    height_m: float
    """Surveyed minus predicted height; NaN where the height is right."""
    horizontal_m: float
    """Distance of the surveyed place from the predicted one; NaN where the place is right."""
    sigma_m: float
    """1 σ of the height's difference."""
    surveyed_height_m: float
    sigmas: float = float("nan")
    """Length of the normalised residual; NaN where it is not known."""
    limit: float = float("nan")
    """Length of the normalised residual from which a point is wrong."""
    alternatives: tuple[str, ...] = ()
    """Points that may be wrong instead."""

    def told(self) -> str:
        """Returns the fault in words."""
        parts, what = [], []
        if np.isfinite(self.height_m):
            parts.append(f"its surveyed height lies {self.height_m * 1e3:+.1f} mm")
            what.append("height")
        if np.isfinite(self.horizontal_m):
            parts.append(f"its surveyed place lies {self.horizontal_m * 1e3:.1f} mm")
            what.append("place")
        if not what:  # all others together contradict it, but none of them alone says by how much
            parts, what = ["its survey lies elsewhere"], ["survey"]
        text = f"{' and '.join(parts)} from what all other evidence says"
        if np.isfinite(self.sigmas):
            text += f" ({self.sigmas:.1f} σ, where {self.limit:.1f} σ are the limit)"
        if self.alternatives:
            names = listed(self.alternatives, NAMED)
            return f"{text}; it or {names} is wrong, and nothing tells which of them: none of their {what[0]}s counts"
        return f"{text}; its {' and its '.join(what)} does not count"


def datum_fault(sightings: Sequence[Sighting], largest_m: float) -> str:
    """Returns why no point can be used: their heights are in another datum than the map's; "" where they fit.

    largest_m : a median difference up to this is attributed to the poses.
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


def far_in_height(
    sightings: Sequence[Sighting], largest_m: float, sigma_m: Sequence[float] | None = None
) -> dict[str, float]:
    """Returns points, by name, whose height differs by more than that from what most passes measured: surveyed minus
    (m).

    sigma_m : 1 σ of the recorded height at each sighting; in an outage a point may differ by four of them.
    """
    found: dict[str, list[float]] = {}
    allowed: dict[str, float] = {}
    for one, sigma in zip(sightings, sigma_m or [0.0] * len(sightings), strict=True):
        if np.isfinite(one.height_m):
            found.setdefault(one.point.name, []).append(one.point.height_m - one.height_m)
            allowed[one.point.name] = max(allowed.get(one.point.name, largest_m), _SIGMAS * sigma)
    middle = {name: float(np.median(values)) for name, values in found.items()}
    return {name: away for name, away in middle.items() if abs(away) > allowed[name]}


def swapped(wrong: Sequence[WrongPoint]) -> list[tuple[str, str]]:
    """Returns pairs of wrong points whose heights would be right if they were exchanged."""
    found: list[tuple[str, str]] = []
    for k, one in enumerate(wrong):
        for other in wrong[k + 1 :]:
            apart = one.surveyed_height_m - other.surveyed_height_m
            left = np.array([one.height_m - apart, other.height_m + apart])
            limit = _SIGMAS * np.array([one.sigma_m, other.sigma_m])
            if np.isfinite(left).all() and (np.abs(left) < limit).all():
                found.append((one.name, other.name))
    return found
