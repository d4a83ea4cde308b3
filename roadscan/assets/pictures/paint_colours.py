"""Colour of paint, white or yellow, from its pixels and those of the surface beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from roadscan.assets.pictures.reader import ColourReader
from roadscan.compute.array_types import Float64, UInt8
from roadscan.compute.robust import scatter_about

_LEAST_PLACES: Final = 5  # Least number of places of paint, and of surface.
_BRIGHTER: Final = 1.15
"""Paint no brighter than this multiple of the surface beside it is worn, or was missed."""
_BETWEEN: Final = 0.82
"""Blue over the mean of red and green, of paint relative to the surface: white paint is near 1, yellow below 0.65."""
_SPREAD: Final = 0.10  # Systematic 1 σ of that ratio.


class PaintReader(ColourReader):
    """A reader of the colour of paint; each kind chooses its places."""

    def read(self, own: UInt8, beside: UInt8) -> Mapping[str, Any]:
        """Columns colour and colour_probability."""
        return paint_colour(own, beside)


def paint_colour(own: UInt8, beside: UInt8) -> Mapping[str, Any]:
    """Columns `colour` and `colour_probability` from colours (n, 3) of paint and (m, 3) of the surface beside it.

    Asphalt and concrete are grey, so dividing by the surface's colour removes the light and the camera's white
    balance. Blue against red and green then distinguishes white from yellow, by the median over the places. There is no
    colour if fewer than five places are brighter than the surface, or if the picture has no colours.
    """
    if len(own) < _LEAST_PLACES or len(beside) < _LEAST_PLACES or _is_grey(own, beside):
        return {}
    surface = np.maximum(np.median(_linear(beside), axis=0), 1e-4)
    relative = _linear(own) / surface
    bright = relative[:, :2].mean(axis=1) >= _BRIGHTER
    if np.count_nonzero(bright) < _LEAST_PLACES:
        return {}
    blue = relative[bright, 2] / relative[bright, :2].mean(axis=1)
    middle = float(np.median(blue))
    sigma = np.hypot(_SPREAD, scatter_about(blue, middle) / np.sqrt(len(blue)))
    yellow = 1.0 / (1.0 + np.exp(2.0 * (middle - _BETWEEN) / sigma))
    name, share = ("yellow", yellow) if yellow > 0.5 else ("white", 1.0 - yellow)
    return {"colour": name, "colour_probability": float(share)}


def _linear(colours: UInt8) -> Float64:
    """Returns linear light (IEC 61966-2-1) of colours (n, 3)."""
    c = colours.astype(np.float64) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _is_grey(own: UInt8, beside: UInt8) -> bool:
    both = np.concatenate([own, beside])
    return bool((np.ptp(both, axis=1) <= 1).all())
