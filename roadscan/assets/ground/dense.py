"""Bare earth of dense returns of scanners on the road: several in each cell of a quarter of a metre."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.bins import cells_of
from roadscan.assets.ground.mirror_images import lowest_without_mirror_images
from roadscan.assets.ground.surface import Found, Grid, Place, Surface, bare_cells, filled, grid_over, without_pits
from roadscan.assets.kernels.ground import cell_heights, on_ground, scatter
from roadscan.assets.scene import Returns, Statistics
from roadscan.compute.array_types import Bool, Float32
from roadscan.core.extras import cv2

_LARGEST_M2: Final = 1.25
"""Larger patches (m²) are ground, such as a terrace."""
_RISE_M: Final = 0.3
"""A patch is an island where it lies farther from the height of the nearest larger one (m), and as much more as the
steepest slope makes on the way there. On sweeps 0–3 of the labelled street all patches beyond it are leaves, hedges and
parts of cars."""
_BESIDE: Final = np.ones((3, 3), np.uint8)
"""Cells with no more than two empty ones between them are one patch: rings of a lidar lie apart."""


def without_islands(place: Place, base: Surface, above_m: npt.NDArray[np.float32], found: Bool, grid: Grid) -> Bool:
    """Returns the mask (n,) of the returns on the ground without those on islands.

    Behind a hedge or a wall the ground is hidden, and the lowest that is seen there is no ground.

    base : the first estimate of the ground. above_m, found : (n,) heights above it, and which returns are ground.
    grid : of the cells in which patches are told.
    """
    x, y, per_m = place.returns.x_m, place.returns.y_m, 1.0 / grid.cell_m
    sums = np.zeros((*grid.shape, 3))
    cell_heights(x, y, above_m, found, grid.origin, per_m, np.zeros(grid.shape, np.float32),
                 np.full(grid.shape, np.inf, np.float32), sums)  # fmt: skip
    seen = sums[..., 0] > 0
    height = base.at(grid) + np.divide(sums[..., 1], sums[..., 0], out=np.zeros(grid.shape), where=seen)
    count, label = cv2.connectedComponents(cv2.dilate(seen.view(np.uint8), _BESIDE), connectivity=8)
    cells = np.bincount(label[seen], minlength=count)
    whole = seen & (cells * grid.cell_m**2 > _LARGEST_M2)[label]
    if not whole.any():
        return found
    away, near = cv2.distanceTransformWithLabels(
        (~whole).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    known = np.zeros(int(near.max()) + 1)
    known[near[whole]] = height[whole]
    small = seen & ~whole
    rise = np.bincount(label[small], (height - known[near])[small], count) / np.maximum(cells, 1)
    way = np.bincount(label[small], away[small], count) * grid.cell_m / np.maximum(cells, 1)
    island = small & (np.abs(rise) > _RISE_M + place.settings.steepest * way)[label]
    if not island.any():
        return found
    rows = np.flatnonzero(found)
    column, row = (np.floor((v[rows] - v0) * per_m).astype(np.int64) for v, v0 in zip((x, y), grid.origin, strict=True))
    inside = (column >= 0) & (row >= 0) & (column < grid.columns) & (row < grid.rows)
    out = found.copy()
    out[rows[inside][island[row[inside], column[inside]]]] = False
    return out


_NEAR_LOWEST_M: Final = 0.15
"""Returns up to this above the lowest one of a cell (m) lie on the same surface."""
_MARGIN: Final = 0.05
"""Excess of the rise of a sight line over that of the surface (m/m) that shows that it comes from below."""
_SMOOTH: Final = (5, 5)
"""Cells over which the slope is computed."""
_UNDERSIDE_AROUND: Final = np.ones((5, 5), np.uint8)  # Cells around an underside that count as one too.
_OVER_SENSOR_M: Final = 1.0
"""A structure is higher above the sensor than this (m); slopes, hedges and lower branches are left to other rules."""
_UNDERSIDE_LEAST: Final = np.ones((3, 3), np.uint8)
"""Least extent of a face in both directions (cells)."""


def undersides(returns: Returns, grid: Grid, lowest_m: Float32, height_m: Float32) -> Bool:
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
    out = cv2.morphologyEx(seen_below, cv2.MORPH_OPEN, _UNDERSIDE_LEAST) > 0
    # at the edge of a deck the surface falls to the ground beside it
    wider = cv2.dilate(out.view(np.uint8), _UNDERSIDE_AROUND) > 0
    return np.asarray(out | (wider & (number > 0)))


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
_AROUND_CELLS: Final = 5
"""A place is rough if most of the cells in a square of this many by as many are."""
_LEAST_RETURNS: Final = 3
"""Least number of returns of a cell for its scatter."""
_TOLERANCE_M, _TOLERANCE_SLOPE = 0.15, 0.35
"""Tolerance of returns in places that are not rough about the first estimate of the ground (m), and per slope (m)."""


class Cells(NamedTuple):
    """Arrays (rows, columns) of cells near the first estimate of the ground."""

    rough: Bool
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
    lowest = lowest_without_mirror_images(returns, grid, place.settings.steepest)
    surface, known = without_pits(lowest, _PIT_M, grid)
    known &= bare_cells(surface, grid.cell_m, place.settings)
    base = Surface(grid, filled(lowest, known, grid))
    below = undersides(returns, grid, lowest, base.height_m) & known
    if below.any():
        base = Surface(grid, filled(lowest, known & ~below, grid))
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
    several = count >= _LEAST_RETURNS
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


def around(cells: Bool) -> npt.NDArray[np.int64]:
    """Returns how many of the cells (rows, columns) about each one are True."""
    side = (_AROUND_CELLS, _AROUND_CELLS)
    counted = cv2.boxFilter(cells.view(np.uint8), cv2.CV_32S, side, None, (-1, -1), False, cv2.BORDER_CONSTANT)
    return np.asarray(counted, np.int64)


def tolerances(base: Surface, fine: Grid) -> Float32:
    """Returns the tolerance of ground returns about the first estimate, at each cell of the finer grid (m)."""
    slope = Surface(base.grid, base.slope()).at(fine)
    return np.asarray(_TOLERANCE_M + _TOLERANCE_SLOPE * slope, np.float32)
