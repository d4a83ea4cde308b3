"""Cells whose lowest return was seen from below: the lower faces of bridges where no ground is in sight."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.bins import cells_of
from roadscan.assets.ground.grid import Grid
from roadscan.assets.returns import Returns
from roadscan.compute.array_types import Float32
from roadscan.core.extras import cv2

Bools = npt.NDArray[np.bool_]

_NEAR_LOWEST_M: Final = 0.15
"""Returns up to this above the lowest one of a cell (m) lie on the same surface."""
_MARGIN: Final = 0.05
"""Excess of the rise of a sight line over that of the surface (m/m) that shows that it comes from below."""
_SMOOTH: Final = (5, 5)
"""Cells over which the slope is computed."""
_AROUND: Final = np.ones((5, 5), np.uint8)  # Cells around an underside that count as one too.
_OVER_SENSOR_M: Final = 1.0
"""A structure is higher above the sensor than this (m); slopes, hedges and lower branches are left to other rules."""
_LEAST: Final = np.ones((3, 3), np.uint8)
"""Least extent of a face in both directions (cells)."""


def undersides(returns: Returns, grid: Grid, lowest_m: Float32, height_m: Float32) -> Bools:
    """Returns a mask (rows, columns) of the cells whose lowest returns were seen from below.

    A sight line that comes from above a surface falls against it: it rises less, along its way, than the surface does.

    Parameters
    ----------
    lowest_m : (rows, columns) lowest return of each cell; height_m : the same, whole between the known cells.
    """
    out = np.zeros(grid.shape, np.bool_)
    rows = np.flatnonzero(returns.height_m > returns.sensor_height_m + _OVER_SENSOR_M)
    cell = cells_of(returns.x_m[rows], returns.y_m[rows], (grid.x_min_m, grid.y_min_m, grid.cell_m), grid.shape)
    kept = cell >= 0
    kept[kept] = returns.height_m[rows[kept]] <= lowest_m.flat[cell[kept]] + _NEAR_LOWEST_M
    rows, (row, column) = rows[kept], np.unravel_index(cell[kept], grid.shape)
    if not rows.size or min(grid.shape) < 2:
        return out
    # slopes are smoothed, not heights: at the border these would be mirrored, and a bank look level
    north, east = (cv2.blur(g, _SMOOTH, borderType=cv2.BORDER_REPLICATE) for g in np.gradient(height_m, grid.cell_m))
    dx, dy = returns.x_m[rows] - returns.sensor_x_m[rows], returns.y_m[rows] - returns.sensor_y_m[rows]
    away = np.maximum(np.hypot(dx, dy), 0.1)
    rise = (returns.height_m[rows] - returns.sensor_height_m[rows]) / away
    excess = rise - (east[row, column] * dx + north[row, column] * dy) / away
    number, total = np.zeros(grid.shape), np.zeros(grid.shape)
    np.add.at(number, (row, column), 1.0)
    np.add.at(total, (row, column), excess)
    seen_below = ((number > 0) & (total > _MARGIN * number)).view(np.uint8)
    out = cv2.morphologyEx(seen_below, cv2.MORPH_OPEN, _LEAST) > 0
    # at the edge of a deck the surface falls to the ground beside it
    wider = cv2.dilate(out.view(np.uint8), _AROUND) > 0
    return np.asarray(out | (wider & (number > 0)))
