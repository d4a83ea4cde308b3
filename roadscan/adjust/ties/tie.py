"""One tie: the difference of two traverses along one direction at one place, and why it does not count, if so."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from roadscan.adjust.patches import PassReadings
from roadscan.compute.array_types import Float64

HEIGHT: Final = "height_tie"
SHIFT: Final = "shift_tie"
PLANE: Final = "plane_tie"

LASERS: Final = 256
"""Lasers of a sensor are numbered by bytes."""

COUNTS: Final = ""
FEW_CELLS: Final = "too few cells in common"
TOO_FAR: Final = "farther apart than the bound"
TWO_SURFACES: Final = "too few cells agree"
SCATTERED: Final = "cells scatter"
STEEP: Final = "too steep"
SAME_PASS: Final = "heads of one pass"


@dataclass(frozen=True)
class End:
    """One end of a tie: a point of the road and the pose that saw it."""

    readings: PassReadings
    pose: int
    """Row of the pose."""
    point_m: Float64
    """(3,) easting, northing, height as the recorded pose places it."""
    laser: float = math.nan
    """Laser that saw it; NaN of a sensor that has none."""


@dataclass(frozen=True)
class Tie:
    """A measurement along one direction: the second end minus the first."""

    kind: str
    ends: tuple[End, End]
    direction_level: Float64
    """(3,) unit vector, north, east, down."""
    value_m: float
    sigma_m: float
    count: int
    """Number of cells or returns used."""
    correlation: float
    """Correlation of the two images; NaN where none was compared."""
    why_not: str = COUNTS
    """Empty if it counts."""
    group: int = 0
    """Ties of one group of a place stand or fall together."""

    @property
    def counts(self) -> bool:
        """Returns whether the adjustment uses it."""
        return self.why_not == COUNTS
