"""Shape and size of a control target as the survey states them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
