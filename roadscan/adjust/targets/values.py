"""Input and output of the search for targets: expected target, readings near it, and the find."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from roadscan.adjust.targets.shapes import Shape
from roadscan.compute.array_types import Float64, UInt8

Status = Literal["found", "missed", "doubled", "moved"]


@dataclass(frozen=True)
class TargetReadings:
    """n readings of one pass near one control point, georeferenced with its recorded poses; axes of the map."""

    easting_m: Float64
    """(n,)"""
    northing_m: Float64
    """(n,)"""
    height_m: Float64
    """(n,)"""
    intensity: npt.NDArray[np.generic]
    """(n,) any number type, brighter is more."""
    sigma_horizontal_m: float
    """1 σ of the pass's place on each horizontal axis (m): a common error of all readings."""

    @property
    def size(self) -> int:
        """Returns the number of readings."""
        return self.easting_m.size


@dataclass(frozen=True)
class ExpectedTarget:
    """A control target as the survey states it; axes of the map."""

    name: str
    easting_m: float
    northing_m: float
    height_m: float
    sigma_horizontal_m: float
    """1 σ of the stated place on each horizontal axis (m)."""
    shape: Shape


@dataclass(frozen=True)
class TargetPicture:
    """A small grey picture of a target's surroundings; its outline is drawn where it was found."""

    grey: UInt8
    """(rows, columns), row 0 in the north."""
    west_m: float
    """Easting of the left edge."""
    north_m: float
    """Northing of the upper edge."""
    cell_m: float
    """Edge of a pixel (m)."""


@dataclass(frozen=True)
class TargetFind:
    """The result for one target in one pass; of a missed one places and heights are NaN."""

    name: str
    status: Status
    why_not: str
    """"" where it was found; else a sentence."""
    easting_m: float
    """Centre, in the map, as the pass's recorded poses place it; of a doubled one the likelier."""
    northing_m: float
    height_m: float
    """Height of the road's surface at the centre."""
    covariance_m2: Float64
    """(2, 2) of easting and northing, without that of the poses."""
    sigma_height_m: float
    """1 σ, without that of the poses."""
    count: int
    """Number of readings from which the centre is computed."""
    contrast: float
    """Paint against road, in units of the intensity."""
    noise: float
    """1 σ of single readings about the shape, in units of the intensity."""
    score: float
    """0 to 1: least of the shares of paint, outline and clear road that the shape should have."""
    diameter_m: float
    """Size of the shape as it fits (diameter, or edge of the square)."""
    azimuth_rad: float
    """Direction of an edge of a chequered target, from north clockwise, modulo 180°: the first white quadrant lies
    between it and 90° more; 0 for a disc."""
    others_m: Float64
    """(k, 2) easting and northing of further places that look like the target."""
    picture: TargetPicture

    @property
    def found(self) -> bool:
        """Returns whether its place can enter an adjustment."""
        return self.status == "found"


@dataclass(frozen=True)
class HeightFind:
    """Height of the road's surface at a place, from the readings around it."""

    height_m: float
    """NaN where there is none."""
    sigma_m: float
    """1 σ, without that of the poses."""
    slope_east: float
    """Rise of the surface to the east (m/m)."""
    slope_north: float
    """Rise of the surface to the north (m/m)."""
    count: int
    """Readings within the radius."""
    used: float
    """Share of them that the surface uses."""
    why_not: str
    """"" where there is a height; else a sentence."""

    @property
    def found(self) -> bool:
        """Returns whether there is a height."""
        return not self.why_not
