"""The axis of a shaft and its diameter, from returns on the side that sensors saw."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.cylinders import fit_cylinder

Float64 = npt.NDArray[np.float64]

SECTOR_DEG: Final = 8.0
"""Sight lines within a sector (degrees) count as of one direction."""


@dataclass(frozen=True)
class Axis:
    """A straight, nearly upright axis: x = x_m + slope_x · (height − height_m), y likewise."""

    x_m: float
    y_m: float
    height_m: float
    slope_x: float
    slope_y: float
    radius_m: float
    residual_m: float
    """Root mean square distance of the returns from the cylinder."""

    @property
    def lean_deg(self) -> float:
        """Returns the angle from the vertical (degrees)."""
        return math.degrees(math.atan(math.hypot(self.slope_x, self.slope_y)))

    def at(self, height_m: npt.ArrayLike) -> tuple[Float64, Float64]:
        """Returns x and y of the axis at heights (any shape)."""
        past = np.asarray(height_m, np.float64) - self.height_m
        return self.x_m + self.slope_x * past, self.y_m + self.slope_y * past


def fit_axis(xyh: Float64, sensor_xy: Float64, *, lean: bool = True) -> Axis:
    """Returns the cylinder through returns (n, 3), seen from (n, 2).

    Sight lines meet a cylinder evenly across its width, so the spread of the returns across their sight lines shows the
    radius, and the middle of that spread the axis across them; along them the axis lies where the returns are one
    radius away from it (Gauss–Newton, Huber weights). A circle fit alone shows neither for shafts as thin as the range
    noise.

    lean : the axis may lean; otherwise it is upright.
    """
    middle = float(np.median(xyh[:, 2]))
    sight = sensor_xy - xyh[:, :2]
    sight /= np.maximum(np.hypot(sight[:, 0], sight[:, 1]), 1e-9)[:, None]
    sector = np.floor(np.degrees(np.arctan2(sight[:, 1], sight[:, 0])) / SECTOR_DEG).astype(np.int64)
    order = np.argsort(sector, kind="stable")
    table = np.ascontiguousarray(np.column_stack([xyh[:, :2], xyh[:, 2] - middle, sight])[order])
    state = np.array([float(np.median(xyh[:, 0])), float(np.median(xyh[:, 1])), 0.0, 0.0, 0.03])
    residual, _ = fit_cylinder(table, sector[order], lean, state, np.empty((len(table), 4)))
    x, y, slope_x, slope_y, radius = map(float, state)
    return Axis(x, y, middle, slope_x, slope_y, radius, float(residual))
