"""Places map coordinates in a drawing of the report."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from roadscan.compute.array_types import Float64

COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
"""Colours that people with any colour vision can distinguish (Okabe and Ito 2008)."""
WIDTH: Final = 1000.0  # width of a drawing, in its units
_MARGIN: Final = 40.0  # margin of a drawing
_HIGHEST: Final = 900.0  # greatest height of a drawing
_LEAST_EXTENT_M: Final = 1.0  # least extent that is shown


@dataclass(frozen=True)
class MapPage:
    """A drawing of a piece of the map, north up, `WIDTH` wide."""

    low_m: Float64
    """(2,) easting and northing of the piece's south-western corner."""
    extent_m: Float64
    """Width and height of the piece (2,)."""
    scale: float
    """Units of the drawing per metre."""

    @classmethod
    def around(cls, places_m: Float64) -> Self:
        """Return a drawing that contains all places (n, 2) of the map."""
        low = places_m.min(axis=0)
        extent = np.maximum(places_m.max(axis=0) - low, _LEAST_EXTENT_M)
        scale = min((WIDTH - 2 * _MARGIN) / extent[0], (_HIGHEST - 2 * _MARGIN) / extent[1])
        return cls(low, extent, float(scale))

    @property
    def height(self) -> float:
        """Height of the drawing."""
        return float(self.extent_m[1] * self.scale + 2 * _MARGIN)

    @property
    def scale_bar(self) -> tuple[float, str]:
        """Return the length of a bar of 1, 10, 100 … metres, and its text."""
        bar_m = 10.0 ** math.floor(math.log10(max(float(self.extent_m.max()) / 4, 1.0)))
        return bar_m * self.scale, f"{bar_m / 1000:g} km" if bar_m >= 1000 else f"{bar_m:g} m"

    def on_page(self, places_m: Float64) -> Float64:
        """Return places (n, 2) of the drawing, downwards positive, of places (n, 2) of the map."""
        x = _MARGIN + (places_m[:, 0] - self.low_m[0]) * self.scale
        y = self.height - _MARGIN - (places_m[:, 1] - self.low_m[1]) * self.scale
        return np.stack([x, y], axis=-1)
