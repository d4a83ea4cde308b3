"""Bare earth as planes, fitted to returns one after another.

Sairam, Nagarajan, Ornitz (2016), "Development of mobile mapping system for 3D road asset inventory", Sensors 16, 367,
section 3.3.2: RANSAC finds the plane of most returns, then that of most returns which the planes before left over, and
what no plane holds is no ground. What is added here: planes are those of squares of the map, they are not steep, and
returns high above the lowest ones around take no part.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.filling import filled
from roadscan.assets.ground.grid import Grid, grid_over
from roadscan.assets.ground.surface import Found, Place, Surface, is_dense
from roadscan.assets.kernels.heights import heights_above
from roadscan.assets.kernels.lowest import lowest_returns
from roadscan.assets.kernels.planes import planes
from roadscan.core.extras import cv2

_BLOCK_M: Final = 10.0
"""Planes are sought in squares of the map of this edge (m)."""
_CELL_M: Final = 0.5  # Edge of a cell of the lowest returns (m).
_ABOVE_LOWEST_M, _AROUND_M = 0.5, 1.5
"""Returns take part up to this height above the lowest one within this distance: roofs of cars do not (m, m)."""
_STEEPEST: Final = 0.5
"""Steepest slope of a plane (m/m)."""
_DENSE, _SPARSE = (0.06, 30), (0.3, 6)
"""Vertical reach of a plane (m) and least number of returns on it, in dense and in sparse data."""
_PLANES, _DRAWS, _JUDGES = 8, 120, 1500
"""Most planes of a square, draws of a plane, and returns that judge a draw."""


def plane_ground(place: Place) -> Found:
    """Returns a mask of returns on planes near the lowest returns around."""
    returns = place.returns
    x, y, z = returns.x_m, returns.y_m, returns.height_m
    grid = grid_over(place.window, _CELL_M)
    taking_part = np.flatnonzero(z - lowest_around(place, grid) <= _ABOVE_LOWEST_M)
    column = np.floor((returns.corner_m[0] + x[taking_part]) / _BLOCK_M).astype(np.int64)
    row = np.floor((returns.corner_m[1] + y[taking_part]) / _BLOCK_M).astype(np.int64)
    order = np.lexsort([taking_part, column, row])
    rows, row, column = taking_part[order], row[order], column[order]
    begins = np.flatnonzero(np.concatenate([[True], (np.diff(row) != 0) | (np.diff(column) != 0)]))
    found = np.zeros(rows.size, np.bool_)
    if rows.size:
        keys = (row[begins].astype(np.uint64) << np.uint64(40)) ^ (column[begins].astype(np.uint64) << np.uint64(16))
        middle = np.array([place.window.x_min_m, place.window.y_min_m])
        begin = np.append(begins, rows.size).astype(np.int64)
        reach_m, least = _DENSE if is_dense(place) else _SPARSE
        counts = np.array([_PLANES, _DRAWS, _JUDGES, least])
        planes(x[rows] - middle[0], y[rows] - middle[1], z[rows], begin, keys, reach_m, _STEEPEST, counts, found)
    on_ground = np.zeros(len(returns), np.bool_)
    on_ground[rows[found]] = True
    return above_planes(place, grid, on_ground)


def lowest_around(place: Place, grid: Grid) -> npt.NDArray[np.float32]:
    """Returns the lowest height (n,) near each return."""
    returns = place.returns
    lowest = np.full(grid.shape, np.inf, np.float32)
    lowest_returns(returns.x_m, returns.y_m, returns.height_m, grid.origin, 1.0 / grid.cell_m, lowest)
    side = 2 * round(_AROUND_M / grid.cell_m) + 1
    lowest = np.asarray(cv2.erode(lowest, np.ones((side, side), np.uint8)))
    row = np.clip(((returns.y_m - grid.y_min_m) / grid.cell_m).astype(np.int64), 0, grid.rows - 1)
    column = np.clip(((returns.x_m - grid.x_min_m) / grid.cell_m).astype(np.int64), 0, grid.columns - 1)
    return np.asarray(lowest[row, column])


def above_planes(place: Place, grid: Grid, on_ground: npt.NDArray[np.bool_]) -> Found:
    """Returns the surface through the lowest of the returns on planes, and heights above it."""
    returns = place.returns
    lowest = np.full(grid.shape, np.inf, np.float32)
    x, y, z = returns.x_m, returns.y_m, returns.height_m
    lowest_returns(x[on_ground], y[on_ground], z[on_ground], grid.origin, 1.0 / grid.cell_m, lowest)
    base = Surface(grid, filled(lowest, np.isfinite(lowest), grid.corner, grid.cell_m))
    above = np.empty(len(returns), np.float32)
    heights_above(x, y, z, grid.origin, 1.0 / grid.cell_m, base.height_m, above)
    return Found(base, above, on_ground)
