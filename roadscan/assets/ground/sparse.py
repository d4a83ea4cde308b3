"""Bare earth of sparse returns from the air: one in a square metre or fewer."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.filling import filled
from roadscan.assets.ground.grid import grid_over
from roadscan.assets.ground.morphological import bare_cells
from roadscan.assets.ground.surface import Found, Place, Surface
from roadscan.assets.kernels.ground_cells import cell_heights
from roadscan.assets.kernels.heights import heights_above
from roadscan.assets.kernels.lowest import lowest_returns
from roadscan.core.extras import cv2

Float32 = npt.NDArray[np.float32]

CELL_M: Final = 1.0  # Edge of a cell (m).
_PIT_M: Final = 8.0
"""A lowest return farther below its surroundings (m) is noise: gaps in crowns are no deeper."""
_SMOOTH: Final = 0.7
"""Standard deviation (cells) of the Gaussian that smooths the ground before returns are compared with it."""
_TOLERANCE_M, _TOLERANCE_SLOPE = 0.5, 1.25
"""Tolerance of returns about the ground (m), and per slope (m) (section 2.4, table 3)."""
_CLOSE: Final = 0.5
"""Share of that tolerance within which returns define the ground anew."""


def sparse_ground(place: Place) -> Found:
    """Returns a mask of returns near the surface of the cells that remain after opening.

    The surface of lowest returns leans to the lowest place of each cell, so it is made anew from the returns that lie
    close to it.
    """
    returns = place.returns
    x, y, z = returns.x_m, returns.y_m, returns.height_m
    grid = grid_over(place.window, CELL_M)
    lowest = np.full(grid.shape, np.inf, np.float32)
    lowest_returns(x, y, z, grid.origin, 1.0 / grid.cell_m, lowest)
    known = bare_cells(lowest, grid.cell_m, _PIT_M, place.settings)
    first = near(place, smoothed(Surface(grid, filled(lowest, known))), _CLOSE)
    return near(place, smoothed(remade(place, first)), 1.0)


def smoothed(surface: Surface) -> Surface:
    """Returns the surface through a Gaussian."""
    z = cv2.GaussianBlur(surface.height_m, (0, 0), _SMOOTH, borderType=cv2.BORDER_REPLICATE)
    return Surface(surface.grid, np.asarray(z))


def near(place: Place, base: Surface, share: float) -> Found:
    """Returns a mask of returns near a surface: within a share of the tolerance."""
    x, y, z = place.returns.x_m, place.returns.y_m, place.returns.height_m
    grid = base.grid
    above, tolerance = np.empty(x.size, np.float32), np.empty(x.size, np.float32)
    heights_above(x, y, z, grid.origin, 1.0 / grid.cell_m, base.height_m, above)
    limit = -(_TOLERANCE_M + _TOLERANCE_SLOPE * base.slope())
    heights_above(x, y, np.zeros(x.size), grid.origin, 1.0 / grid.cell_m, limit, tolerance)
    return Found(base, above, np.abs(above) <= np.float32(share) * tolerance)


def remade(place: Place, found: Found) -> Surface:
    """Returns the surface through the mean heights of the returns that were found."""
    grid, x, y = found.base.grid, place.returns.x_m, place.returns.y_m
    sums, wide = np.zeros((*grid.shape, 3)), np.full(grid.shape, np.inf, np.float32)
    middle = np.zeros(grid.shape, np.float32)
    cell_heights(x, y, found.above_m, found.on_ground, grid.origin, 1.0 / grid.cell_m, middle, wide, sums)
    seen = sums[..., 0] > 0
    mean = np.divide(sums[..., 1], sums[..., 0], out=np.zeros(grid.shape), where=seen)
    return Surface(grid, filled((found.base.height_m + mean).astype(np.float32), seen))
