"""Shape and size of a control target as the survey states them, and the intensities around a stated place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from roadscan.adjust.settings import TargetSettings
from roadscan.compute.array_types import Float64, Int64, UInt8
from roadscan.compute.arrays import SIGMA_OF_MAD
from roadscan.core.errors import ConfigError


@dataclass(frozen=True)
class Disc:
    """A white disc, with a black centre or without."""

    diameter_m: float
    """Diameter of the disc (m)."""
    centre_m: float = 0.0
    """Diameter of the black centre (m); 0: it has none."""

    def __post_init__(self) -> None:
        if not 0.0 < self.diameter_m < 10.0 or not 0.0 <= self.centre_m <= 0.8 * self.diameter_m:
            raise ConfigError(
                f"a circular target of {self.diameter_m:g} m with a centre of {self.centre_m:g} m",
                expected="a diameter between 0 and 10 m, and a centre of at most 0.8 of it",
            )

    @property
    def half_m(self) -> float:
        """Returns the radius (m)."""
        return self.diameter_m / 2

    @property
    def reach_m(self) -> float:
        """Returns the farthest paint from the middle (m)."""
        return self.diameter_m / 2


@dataclass(frozen=True)
class Chequered:
    """A square of four equal squares, two of them white, that meet in the middle; it may be turned."""

    size_m: float
    """Edge of the whole square (m)."""
    quadrants: Literal[2, 4] = 4
    """Painted quadrants: 2, the others are bare road; 4, the others are black."""

    def __post_init__(self) -> None:
        if not 0.0 < self.size_m < 10.0 or self.quadrants not in (2, 4):
            raise ConfigError(
                f"a chequered target of {self.size_m:g} m with {self.quadrants} quadrants",
                expected="a size between 0 and 10 m, and 2 or 4 painted quadrants",
            )

    @property
    def half_m(self) -> float:
        """Returns the edge of a quadrant (m)."""
        return self.size_m / 2

    @property
    def reach_m(self) -> float:
        """Returns the farthest paint from the middle (m)."""
        return self.size_m / 2**0.5


@dataclass(frozen=True)
class SurveyedLine:
    """A point of a surveyed line: it binds across the line, and in height."""

    kind: Literal["paint", "kerb"]
    line: str
    """Name of the line."""
    azimuth_rad: float
    """Of the line, clockwise from grid north."""
    half_m: float = 0.5
    """The line is searched this far ahead and behind (m)."""

    @property
    def reach_m(self) -> float:
        """Returns the distance of the farthest part from the point (m)."""
        return self.half_m


Shape = Disc | Chequered
"""A target."""


@dataclass(frozen=True)
class Cells:
    """c cells with readings; coordinates are from a centre known to the caller (m)."""

    place_m: Float64
    """(c, 2) mean place of the readings, east and north."""
    value: Float64
    """(c,) mean intensity."""
    count: Int64
    """(c,) readings."""

    def within(self, centre_m: Float64, radius_m: float) -> Cells:
        """Returns the cells within a distance of a place."""
        near = np.hypot(*(self.place_m - centre_m).T) <= radius_m
        return Cells(self.place_m[near], self.value[near], self.count[near])


def cells_of(place_m: Float64, value: Float64, cell_m: float) -> Cells:
    """Returns means of readings (n, 2), (n,) in the cells of an even grid through the origin, by row and column."""
    if not value.size:
        return Cells(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    number = _numbers(place_m, cell_m)
    count = np.bincount(number)
    taken = np.flatnonzero(count)
    many = count[taken]
    sums = [np.bincount(number, weights)[taken] / many for weights in (place_m[:, 0], place_m[:, 1], value)]
    return Cells(np.stack(sums[:2], axis=-1), sums[2], many)


def _numbers(place_m: Float64, cell_m: float) -> Int64:
    """Returns the number (n,) of each reading's cell, by row and column."""
    column, row = (np.floor(axis / cell_m).astype(np.int64) for axis in place_m.T)
    numbers: Int64 = (row - row.min()) * (int(np.ptp(column)) + 1) + column - column.min()
    return numbers


def spacing_m(place_m: Float64, block_m: float) -> float:
    """Returns the mean distance between readings (n, 2) (m), from their number in non-empty blocks of a size.

    Blocks with less than a third of the median's readings lie at a border and do not count.
    """
    if not place_m.size:
        return float("inf")
    count = np.bincount(_numbers(place_m, block_m))
    count = count[count > 0]
    full = count[count >= np.median(count) / 3]
    return float(block_m / np.sqrt(full.mean()))


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
    weight: Float64 = field(default_factory=lambda: np.zeros(0))
    """(n,) of each of the readings in the surface, 0 of those that it does not use; empty where there is no height."""

    @property
    def found(self) -> bool:
        """Returns whether there is a height."""
        return not self.why_not


_LEAST_COUNT = 12  # With fewer readings there is no height.
_CURVED_COUNT = 60  # From this many readings on, the surface has terms of second degree.
_CUT = 4.685
"""Constant of Tukey's biweight: 95 % efficiency for normal residuals."""
_ROUNDS = 30  # Rounds of re-weighting.
_BLOCKS = 6
"""Blocks along an edge: residuals within a block are taken as correlated."""
_LEAST_USED = 0.5  # A surface must use at least this share of the readings.
_LEAST_SCALE_M = 1e-6  # Least scale of the residuals (m), against division by zero.


def height_at(readings: TargetReadings, easting_m: float, northing_m: float, settings: TargetSettings) -> HeightFind:
    """Returns the surface's height at a place of the map, and its σ, from the readings within `height_radius_m`.

    The surface is a plane, with the three terms of second degree where there are readings enough: a rut bends by a
    millimetre over 0.3 m. It minimises Tukey's biweight of the residuals, begun from their least absolute sum. Its
    covariance is the sandwich of Huber (1967) with sums of blocks, so that texture and noise that neighbours share
    count as shared.
    Without readings on opposite sides of the place, a height is not given: it would be extrapolated.
    """
    place = np.stack([readings.easting_m - easting_m, readings.northing_m - northing_m], axis=-1)
    near = (np.hypot(*place.T) <= settings.height_radius_m) & np.isfinite(readings.height_m)
    place, height = place[near] / settings.height_radius_m, readings.height_m[near]
    if height.size < _LEAST_COUNT:
        return _none(height.size, f"{height.size} readings within {settings.height_radius_m:g} m")
    if not _surrounds(place):
        return _none(height.size, "the readings lie to one side of it")
    design: Float64 = np.column_stack([np.ones(height.size), place])
    if height.size >= _CURVED_COUNT:
        design = np.column_stack([design, place**2, place[:, 0] * place[:, 1]])
    level = float(np.median(height))
    plane, weight = _robust_plane(design, height - level)
    used = float((weight > 0.0).mean())
    if used < _LEAST_USED:
        return _none(height.size, f"only {used:.0%} of the readings lie on one surface")
    left = height - level - design @ plane
    sigma = float(np.hypot(np.sqrt(_variance(design, left, weight, place)), settings.sigma_plane_m))
    rise = plane[1:3] / settings.height_radius_m
    shares = np.zeros(near.size)
    shares[near] = weight
    return HeightFind(level + float(plane[0]), sigma, float(rise[0]), float(rise[1]), height.size, used, "", shares)


def _none(count: int, why_not: str) -> HeightFind:
    nan = float("nan")
    return HeightFind(nan, nan, nan, nan, count, 0.0, why_not)


def _surrounds(place: Float64) -> bool:
    """Returns whether every half plane through the origin, narrowed by 10°, contains a reading."""
    azimuth = np.sort(np.arctan2(place[:, 1], place[:, 0]))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
    return bool(gaps.max() < np.radians(190.0))


def _robust_plane(design: Float64, height: Float64) -> tuple[Float64, Float64]:
    """Coefficients (c,) of the columns of the design, and weights (n,) by iteratively re-weighted least squares."""
    weight: Float64 = np.ones(height.size)
    plane: Float64 = np.zeros(design.shape[1])
    for turn in range(_ROUNDS):
        before = plane
        weighted = design * weight[:, None]
        plane = np.asarray(np.linalg.lstsq(weighted.T @ design, weighted.T @ height, rcond=None)[0], np.float64)
        left: Float64 = np.abs(height - design @ plane)
        scale = max(SIGMA_OF_MAD * float(np.median(left)), _LEAST_SCALE_M)
        if turn < _ROUNDS // 3:
            weight = 1.0 / np.maximum(left, 0.1 * scale)
        else:
            weight = np.maximum(1.0 - (left / (_CUT * scale)) ** 2, 0.0) ** 2
            if np.abs(plane - before).max() < 1e-7:
                break
    return plane, weight


def _variance(design: Float64, left: Float64, weight: Float64, place: Float64) -> float:
    """Returns the variance of the surface's height in the middle."""
    block = np.clip(((place + 1.0) / 2.0 * _BLOCKS).astype(np.int64), 0, _BLOCKS - 1)
    number = block[:, 0] * _BLOCKS + block[:, 1]
    scores = design * (weight * left)[:, None]
    summed = np.stack([np.bincount(number, column, _BLOCKS**2) for column in scores.T], axis=-1)
    groups = np.unique(number).size
    root = np.sqrt(weight)
    slope = root * (5.0 * root - 4.0)  # derivative of the biweight's influence
    bread = np.linalg.pinv((design * slope[:, None]).T @ design)
    meat = summed.T @ summed * groups / max(groups - design.shape[1], 1)
    return float((bread @ meat @ bread)[0, 0])
