"""Shapes of targets in their own plane, in half edges from the middle: how far a place is from their edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import erf

from roadscan.compute.array_types import Float64
from roadscan.pictures.settings import PictureTarget, TargetStyle

_FIELD: Final = 0.85
"""Part of a chequered target that is compared, in half edges: its outline belongs to what is around it."""


@dataclass(frozen=True)
class Shape:
    """The edges of a target."""

    style: TargetStyle
    radii: tuple[float, ...]
    """Radii of its circles in half edges, from the inside; none of a chequered one."""
    reach: float
    """How far from its middle it is compared, in half edges."""
    is_white: bool
    """Whether its middle is white; a chequered one has none."""

    @classmethod
    def of(cls, target: PictureTarget, style: TargetStyle) -> Shape:
        """Return the shape of a style."""
        if style == "ring":
            return cls(style, target.ring, 0.5 * (1.0 + target.ring[1]) if target.ring[1] < 1.0 else 1.0, True)
        if style == "disc":
            return cls(style, (target.centre, 1.0), 0.95, False)
        return cls(style, (), _FIELD, False)

    def contains(self, x: Float64, y: Float64) -> npt.NDArray[np.bool_]:
        """Return whether places belong to what is compared."""
        if self.style == "checker":
            return np.asarray(np.maximum(np.abs(x), np.abs(y)) <= self.reach)
        return np.asarray(np.hypot(x, y) <= self.reach)

    def white(self, x: Float64, y: Float64, per_px: tuple[Float64, Float64], blur_px: float) -> Float64:
        """Return how white (−1 … 1) places in half edges are, of a target whose picture is blurred by a Gaussian.

        per_px : change of x and of y in a pixel, at each place, of a chequered target; of a round one the first is the
            change of the distance from the middle.
        blur_px : its σ (pixels).
        """
        soft = np.sqrt(2.0) * blur_px
        if self.style == "checker":
            return np.asarray(erf(x / (soft * per_px[0])) * erf(-y / (soft * per_px[1])))
        away = np.hypot(x, y)
        value = np.full(np.shape(away), 1.0 if self.is_white else -1.0)
        for k, radius in enumerate(self.radii):
            sign = -1.0 if (k % 2 == 0) == self.is_white else 1.0
            value = value + sign * (1.0 + erf((away - radius) / (soft * per_px[0])))
        return np.asarray(value)
