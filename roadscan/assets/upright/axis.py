"""The axis of a shaft and its diameter, from returns on the side that sensors saw."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.cylinders import LEAST_RADIUS_M, MOST_RADIUS_M, fit_cylinder
from roadscan.assets.quantiles import median
from roadscan.compute.array_types import Float64

SECTOR_DEG: Final = 8.0
"""Sight lines within a sector (degrees) count as of one direction."""
_LEAST_SEEN: Final = 8
"""Fewer returns whose sensor's place is known show no width."""
_NOISE_M: Final = 0.02
"""Returns farther from the circle than this (m), the noise of many scanners, weigh less."""
_STIFF_M: Final = 0.05
"""A slope of 1 counts as so great a distance (m) of every return: what shows no lean stands upright."""


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
    noise; it is what remains where it is not known from where they were seen, as in clouds without a trajectory.

    sensor_xy : NaN where it is not known.
    lean : the axis may lean; otherwise it is upright.
    """
    seen = np.isfinite(sensor_xy[:, 0])
    if np.count_nonzero(seen) < _LEAST_SEEN:
        return _round_axis(xyh, lean)
    xyh, sensor_xy = xyh[seen], sensor_xy[seen]
    middle = median(xyh[:, 2])
    sight = sensor_xy - xyh[:, :2]
    sight /= np.maximum(np.hypot(sight[:, 0], sight[:, 1]), 1e-9)[:, None]
    sector = np.floor(np.degrees(np.arctan2(sight[:, 1], sight[:, 0])) / SECTOR_DEG).astype(np.int64)
    order = np.argsort(sector, kind="stable")
    table = np.ascontiguousarray(np.column_stack([xyh[:, :2], xyh[:, 2] - middle, sight])[order])
    state = np.array([median(xyh[:, 0]), median(xyh[:, 1]), 0.0, 0.0, 0.03])
    residual, _ = fit_cylinder(table, sector[order], lean, state, np.empty((len(table), 4)))
    x, y, slope_x, slope_y, radius = map(float, state)
    return Axis(x, y, middle, slope_x, slope_y, radius, float(residual))


def _round_axis(xyh: Float64, lean: bool) -> Axis:
    """Returns the cylinder that returns (n, 3) lie on: distances from it count by a soft L1 norm."""
    from scipy.optimize import least_squares

    middle = float(np.median(xyh[:, 2]))
    centre = np.median(xyh[:, :2], axis=0)
    past = xyh - [*centre, middle]

    def misses(state: Float64) -> Float64:
        x, y, slope_x, slope_y, radius = state
        away = np.hypot(past[:, 0] - x - slope_x * past[:, 2], past[:, 1] - y - slope_y * past[:, 2])
        return np.asarray(np.append(away - radius, math.sqrt(len(past)) * _STIFF_M * np.array([slope_x, slope_y])))

    most = np.array([1.0, 1.0, *[1.0 if lean else 1e-9] * 2, MOST_RADIUS_M])
    least = np.append(-most[:4], LEAST_RADIUS_M)
    spread = math.sqrt(past[:, :2].var(axis=0).sum())
    begin = [0.0, 0.0, 0.0, 0.0, min(max(spread, 2.0 * LEAST_RADIUS_M), 0.9 * MOST_RADIUS_M)]
    fit = least_squares(misses, begin, loss="soft_l1", f_scale=_NOISE_M, bounds=(least, most))
    x, y, slope_x, slope_y, radius = map(float, fit.x)
    return Axis(float(centre[0]) + x, float(centre[1]) + y, middle, slope_x, slope_y, radius,
                float(np.sqrt(np.mean(np.square(misses(fit.x)[:-2])))))  # fmt: skip
