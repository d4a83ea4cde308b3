"""Bare earth of a window: which returns lie on it, and its raster."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.filling import filled
from roadscan.assets.ground.grid import Grid, grid_over
from roadscan.assets.ground.morphological import bare_cells
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box, GroundModel
from roadscan.kernels.assets.heights import heights_above, heights_by_cell
from roadscan.kernels.assets.lowest import counts, lowest_returns
from roadscan.model.asset_ground import GroundSettings

Float32 = npt.NDArray[np.float32]

COARSE_CELL_M: Final = 1.0
FINE_CELL_M: Final = 0.5
DENSE_PER_M2: Final = 4
"""Median number of returns of the square metres that hold any, from which cells of half a metre are filled."""
_TOLERANCE: Final = 0.5
"""Of a return's height above the provisional ground, in cells; the more the steeper the ground is."""
_TOLERANCE_SLOPE: Final = 1.25
_BELOW: Final = 2.0
"""A return is noise that lies below the ground by this many times the tolerance."""


class BareEarth(NamedTuple):
    """What is known of the ground of a window."""

    model: GroundModel
    above_m: Float32
    """(n,) height of each return above bare earth (m), NaN where it is not known."""
    on_ground: npt.NDArray[np.bool_]
    """(n,) returns that lie on it."""
    below: npt.NDArray[np.bool_]
    """(n,) returns that lie below it: noise."""


def filter_cell_m(x_m: npt.NDArray[np.float64], y_m: npt.NDArray[np.float64], window: Box) -> float:
    """Edge of the cells in which lowest returns are sought (m), from the density of the data."""
    grid = grid_over(window, 1.0)
    found = np.zeros(grid.shape, np.int32)
    counts(x_m, y_m, grid.origin, 1.0, found)
    held = found[found > 0]
    return FINE_CELL_M if held.size and np.median(held) >= DENSE_PER_M2 else COARSE_CELL_M


def bare_earth(returns: Returns, window: Box, settings: GroundSettings) -> BareEarth:
    """Ground of the returns of a window."""
    x, y, z = returns.x_m, returns.y_m, returns.height_m
    grid = grid_over(window, filter_cell_m(x, y, window))
    lowest = np.full(grid.shape, np.inf, np.float32)
    lowest_returns(x, y, z, grid.origin, 1.0 / grid.cell_m, lowest)
    known = bare_cells(lowest, grid.cell_m, settings.steepest, settings.largest_object_m)
    provisional = filled(lowest, known)
    tolerance = tolerances(provisional, grid)
    above = np.empty(x.size, np.float32)
    heights_above(x, y, z, grid.origin, 1.0 / grid.cell_m, provisional, above)
    model = raster(returns, above, provisional, tolerance, (grid, window), settings)
    exact = np.empty(x.size, np.float32)
    heights_above(x, y, z, np.array([window.x_min_m, window.y_min_m]), 1.0 / settings.cell_m, model.height_m, exact)
    limit = tolerance[
        np.clip(((y - grid.y_min_m) / grid.cell_m).astype(np.int64), 0, grid.rows - 1),
        np.clip(((x - grid.x_min_m) / grid.cell_m).astype(np.int64), 0, grid.columns - 1),
    ]
    return BareEarth(model, exact, np.abs(exact) <= limit, exact < -_BELOW * limit)


def tolerances(ground: Float32, grid: Grid) -> Float32:
    """How far returns on the ground may lie from the provisional ground (rows, columns) (m)."""
    if min(ground.shape) < 2:
        return np.full(ground.shape, np.float32(_TOLERANCE * grid.cell_m))
    north, east = np.gradient(ground, grid.cell_m)
    return np.asarray(_TOLERANCE * grid.cell_m * (1.0 + 2.0 * _TOLERANCE_SLOPE * np.hypot(north, east)), np.float32)


def raster(
    returns: Returns,
    above: Float32,
    provisional: Float32,
    tolerance: Float32,
    place: tuple[Grid, Box],
    settings: GroundSettings,
) -> GroundModel:
    """Robust heights of ground in cells: the mean of those within the tolerance, then of those near that mean."""
    coarse, window = place
    grid = grid_over(window, settings.cell_m)
    x, y = grid.middles_m
    base, limit = sampled(provisional, coarse, x, y), sampled(tolerance, coarse, x, y)
    sums = np.zeros((3, *grid.shape))
    heights_by_cell(returns.x_m, returns.y_m, above, grid.origin, 1.0 / grid.cell_m, -limit, limit, sums)
    seen = sums[0] > 0
    mean = np.divide(sums[1], sums[0], out=np.zeros(grid.shape), where=seen)
    height = filled((base + mean).astype(np.float32), seen)
    away = cv2.distanceTransform((~seen).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    if not seen.any():
        height[:] = np.nan
    height[away * grid.cell_m > settings.reach_m] = np.nan
    return GroundModel(grid.x_min_m, grid.y_min_m, grid.cell_m, height, seen)


def sampled(z: Float32, grid: Grid, x_m: npt.NDArray[np.float64], y_m: npt.NDArray[np.float64]) -> Float32:
    """Raster z (of `grid`) bilinear at the columns x and rows y of another (rows, columns)."""
    u = np.clip((x_m - grid.x_min_m) / grid.cell_m - 0.5, 0, grid.columns - 1).astype(np.float32)
    v = np.clip((y_m - grid.y_min_m) / grid.cell_m - 0.5, 0, grid.rows - 1).astype(np.float32)
    return np.asarray(cv2.remap(z, *np.meshgrid(u, v), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
