"""Shape and size of a control target as the survey states them, and the intensities around a stated place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from roadscan.compute.array_types import Float64, Int64
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
