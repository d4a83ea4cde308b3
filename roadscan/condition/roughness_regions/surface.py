"""Robust surfaces of the road, relative to which heights are judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.compute.robust import scatter_about

_ROUNDS: Final = 12  # Iterations of a robust fit.
_TUKEY: Final = 4.685
"""Residuals beyond this many standard deviations have no weight (Tukey's biweight, 95 % efficient)."""
_LEAST_SPREAD_M: Final = 1e-4  # Least spread of residuals that is assumed.
_LOWEST_M: Final = 1.0
"""Edge of the squares whose low points show the road beside and below vehicles (m)."""
_LOW_SHARE: Final = 0.2  # Quantile of the low points of a square.


@dataclass(frozen=True, eq=False)
class RoadSurface:
    """A surface of the second degree over the plane."""

    middle_m: tuple[float, float, float]
    scale_m: float
    terms: Float64
    """(6,) of 1, x, y, x², x y, y², with x and y from the middle in units of the scale."""

    def residuals_m(self, x_m: Float64, y_m: Float64, height_m: Float64) -> Float64:
        """Return (n,) heights above the surface."""
        x, y = (x_m - self.middle_m[0]) / self.scale_m, (y_m - self.middle_m[1]) / self.scale_m
        above: Float64 = height_m - self.middle_m[2] - np.sum(_powers(x, y) * self.terms, axis=1)
        return above


def fit(x_m: Float64, y_m: Float64, height_m: Float64) -> RoadSurface | None:
    """Fit the surface of second degree through points (n,), by reweighted least squares (Tukey's biweight).

    None with fewer than twelve points, or points on a line.
    """
    if x_m.size < 12:
        return None
    middle = (float(np.median(x_m)), float(np.median(y_m)), float(np.median(height_m)))
    x, y, h = x_m - middle[0], y_m - middle[1], height_m - middle[2]
    scale = max(float(np.abs(x).max()), float(np.abs(y).max()), 1e-6)
    powers, weight = _powers(x / scale, y / scale), np.ones(x.size)
    terms = np.zeros(6)
    for _ in range(_ROUNDS):
        weighed = powers * weight[:, None]
        # Sums without BLAS, so that the bits do not depend on its number of threads.
        normal = np.array([[np.sum(weighed[:, a] * powers[:, b]) for b in range(6)] for a in range(6)])
        if np.linalg.matrix_rank(normal, tol=1e-9 * float(normal[0, 0])) < 6:
            return None
        terms = np.linalg.solve(normal, np.sum(weighed * h[:, None], axis=0))
        residual = h - np.sum(powers * terms, axis=1)
        spread = max(scatter_about(residual, 0.0), _LEAST_SPREAD_M)
        weight = np.square(np.maximum(1.0 - np.square(residual / (_TUKEY * spread)), 0.0))
    return RoadSurface(middle, scale, terms)


def road_below(x_m: Float64, y_m: Float64, height_m: Float64) -> RoadSurface | None:
    """Fit the road's surface of a section, with or without vehicles, through the low points of each square metre."""
    if not x_m.size:
        return None
    column, row = (np.floor(v / _LOWEST_M).astype(np.int64) for v in (x_m, y_m))
    square = (row - row.min()) * (int(np.ptp(column)) + 1) + column - column.min()
    order = np.lexsort((height_m, square))
    starts = np.flatnonzero(np.diff(square[order], prepend=square[order[0]] - 1))
    many = np.diff(starts, append=order.size)
    low = order[starts + (_LOW_SHARE * (many - 1)).astype(np.int64)]
    return fit(x_m[low], y_m[low], height_m[low])


def _powers(x: Float64, y: Float64) -> Float64:
    return np.column_stack([np.ones(x.size), x, y, x * x, x * y, y * y])
