"""Bare earth of dense returns of scanners on the road: several in each cell of a quarter of a metre."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.filling import filled
from roadscan.assets.ground.grid import Grid, grid_over
from roadscan.assets.ground.islands import without_islands
from roadscan.assets.ground.morphological import bare_cells, without_pits
from roadscan.assets.ground.surface import Found, Place, Surface
from roadscan.assets.ground.undersides import undersides
from roadscan.assets.kernels.ground_cells import on_ground, scatter
from roadscan.assets.kernels.lowest import lowest_returns
from roadscan.assets.statistics import Statistics
from roadscan.compute.array_types import Float32
from roadscan.core.extras import cv2

Bools = npt.NDArray[np.bool_]

LOWEST_CELL_M: Final = 0.5  # Edge of a cell of the lowest returns (m).
_PIT_M: Final = 0.5
"""A lowest return farther below its surroundings (m) is noise: a mirror image, seen in a car."""
_CELL_M: Final = 0.25  # Edge of a cell of the finer grid (m).
_NEAR_M, _CLOSE_M = (-0.25, 0.40), 0.20
"""Between these heights above the first estimate of the ground (m) show a cell's roughness, close ones its height."""
_ROUGH_M, _EVEN_M, _REACH_M = 0.03, 0.02, 0.03
"""Beyond the noise of the data: scatter from which a place is rough, up to which a cell is even, and how far a return
may lie from an even cell's height."""
_UPRIGHT: Final = 2.0
"""A cell that scatters by so many times the limit is rough whatever is around it: the foot of a hedge or a wall, of
which one face is seen. A kerb of 120 mm through the middle of a cell scatters by 60 mm."""
_NOISIEST_M: Final = 0.04
"""Noise of the data is no more than this (m)."""
_AROUND: Final = 5
"""A place is rough if most of the cells in a square of this many by as many are."""
_LEAST: Final = 3
"""Least number of returns of a cell for its scatter."""
_TOLERANCE_M, _TOLERANCE_SLOPE = 0.15, 0.35
"""Tolerance of returns in places that are not rough about the first estimate of the ground (m), and per slope (m)."""


class Cells(NamedTuple):
    """Arrays (rows, columns) of cells near the first estimate of the ground."""

    rough: Bools
    """True where most cells around scatter more than ground does: hedges, planted beds, walls."""
    even_m: Float32
    """Height of even cells above the first estimate of the ground; NaN for all others."""
    noise_m: float
    """Scatter of the evenest quarter of cells: noise of the data."""


def dense_ground(place: Place) -> Found:
    """Mask of the returns near the surface of the cells that remain after opening, where places are not rough, and
    those as high as an even cell beside.
    """
    returns = place.returns
    x, y, z = returns.x_m, returns.y_m, returns.height_m
    grid = grid_over(place.window, LOWEST_CELL_M)
    lowest = np.full(grid.shape, np.inf, np.float32)
    lowest_returns(x, y, z, grid.origin, 1.0 / grid.cell_m, lowest)
    surface, known = without_pits(lowest, _PIT_M, grid)
    known &= bare_cells(surface, grid.cell_m, place.settings)
    base = Surface(grid, filled(lowest, known, grid.corner, grid.cell_m))
    below = undersides(returns, grid, lowest, base.height_m) & known
    if below.any():
        base = Surface(grid, filled(lowest, known & ~below, grid.corner, grid.cell_m))
    fine, above = grid_over(place.window, _CELL_M), np.empty(x.size, np.float32)
    sums = np.zeros((*fine.shape, 5))
    limits = np.array([*_NEAR_M, _CLOSE_M])
    per_m = 1.0 / fine.cell_m
    scatter(x, y, z, grid.origin, 1.0 / grid.cell_m, base.height_m, per_m, limits, above, sums)
    cells = judged(sums, place.statistics)
    tolerance = tolerances(base, fine)
    found = np.empty(x.size, np.bool_)
    reach = _REACH_M + cells.noise_m
    on_ground(x, y, above, fine.origin, per_m, cells.rough, tolerance, cells.even_m, reach, found)
    return Found(base, above, without_islands(place, base, above, found, fine))


def judged(sums: npt.NDArray[np.float64], statistics: Statistics) -> Cells:
    """Returns rough and even cells, from their sums (rows, columns, 5) as `scatter` makes them."""
    count, total, squares, close, close_total = np.moveaxis(sums, -1, 0)
    several = count >= _LEAST
    mean = np.divide(total, count, out=np.zeros(count.shape), where=several)
    variance = np.divide(squares, count, out=np.zeros(count.shape), where=several) - mean * mean
    scattered = np.sqrt(np.maximum(variance, 0.0))
    noise = statistics.of("ground_noise_m", 0.25, lambda: scattered[several])
    noise = min(noise or 0.0, _NOISIEST_M)
    rough = around(several & (scattered > _ROUGH_M + noise)) * 2 > around(several)
    rough |= several & (scattered > _UPRIGHT * _ROUGH_M + noise)
    even = several & ~rough & (scattered <= _EVEN_M + noise) & (close > 0)
    height = np.full(count.shape, np.nan, np.float32)
    height[even] = close_total[even] / close[even]
    return Cells(rough, height, noise)


def around(cells: Bools) -> npt.NDArray[np.int64]:
    """Returns how many of the cells (rows, columns) about each one are True."""
    side = (_AROUND, _AROUND)
    counted = cv2.boxFilter(cells.view(np.uint8), cv2.CV_32S, side, None, (-1, -1), False, cv2.BORDER_CONSTANT)
    return np.asarray(counted, np.int64)


def tolerances(base: Surface, fine: Grid) -> Float32:
    """Returns the tolerance of ground returns about the first estimate, at each cell of the finer grid (m)."""
    slope = Surface(base.grid, base.slope()).at(fine)
    return np.asarray(_TOLERANCE_M + _TOLERANCE_SLOPE * slope, np.float32)
