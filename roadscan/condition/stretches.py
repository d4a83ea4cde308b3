"""Stretches of a road where a quantity stays above a limit: localised roughness, bumps under a straightedge."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.compute.flags import runs_of


class Stretch(NamedTuple):
    """A stretch where a quantity stays above a limit."""

    from_m: float
    """Station of its first sample (m)."""
    to_m: float
    """Station of its last sample (m)."""
    peak_m: float
    """Station of the greatest value (m)."""
    peak: float
    """The greatest value, in the unit of the quantity."""


def stretches_above(x_m: Float64, values: Float64, limit: float) -> list[Stretch]:
    """Return stretches where values (n,) at stations (n,) are above a limit, in order; NaN is not above it."""
    found = []
    for first, behind in runs_of(values > limit).tolist():
        peak = first + int(np.argmax(values[first:behind]))
        found.append(Stretch(float(x_m[first]), float(x_m[behind - 1]), float(x_m[peak]), float(values[peak])))
    return found
