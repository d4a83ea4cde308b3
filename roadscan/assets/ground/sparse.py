"""Bare earth of sparse returns from the air: one in a square metre or fewer."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from roadscan.assets.bins import cells_of
from roadscan.assets.ground.surface import Found, Grid, Place, Surface, bare_cells, filled, grid_over, without_pits
from roadscan.assets.kernels.ground import cell_heights, drops_on_both_sides, grow
from roadscan.assets.kernels.low_returns import heights_above, lowest_returns
from roadscan.assets.scene import Box
from roadscan.compute.array_types import Bool, Float32
from roadscan.core.extras import cv2

_LINES: Final = 8
"""Lines through a cell: every 22.5 degrees."""
_NEIGHBOURS: Final = 16
"""Neighbours of a return, seen from above: two rings in a regular pattern."""
_LEAST: Final = 3
"""Neighbours on the ground that carry a return onto it: a wall's returns have one or two."""
_STEP_M: Final = 0.3
"""Height up to which neighbours go on as one surface (m): twice the noise of airborne returns of the year 2000."""


def with_crests(place: Place, grid: Grid, lowest_m: Float32, sure: Bool, drop_m: float) -> Bool:
    """Returns a mask (n,) of the returns reached from sure ground without a step, where no ground lies lower on both
    sides.

    An opening cuts the upper edge of a break, because no window fits beneath it. The edge goes on level with the ground
    above it; a roof does not, and a bridge, which does, has lower ground on both sides.

    Parameters
    ----------
    lowest_m : (rows, columns) lowest returns of the cells, whole.
    sure : (n,) returns that lie on the ground.
    drop_m : greatest drop on both sides (m), beyond the steepest terrain of the settings, within the largest object.
    """
    from scipy.spatial import cKDTree

    returns, settings = place.returns, place.settings
    found = sure.copy()
    if len(returns) <= _NEIGHBOURS:
        return found
    turn = np.pi / _LINES * np.arange(_LINES)
    drops = np.empty(grid.shape, np.float32)
    lines = np.column_stack([np.sin(turn), np.cos(turn)])
    drops_on_both_sides(
        lowest_m, lines, round(settings.largest_object_m / grid.cell_m), settings.steepest * grid.cell_m, drops
    )
    cell = cells_of(returns.x_m, returns.y_m, (grid.x_min_m, grid.y_min_m, grid.cell_m), grid.shape)
    may = (cell >= 0) & (drops.flat[np.maximum(cell, 0)] <= drop_m)
    places = np.column_stack([returns.x_m, returns.y_m])
    near = cKDTree(places).query(places, k=_NEIGHBOURS + 1)[1][:, 1:]
    grow(returns.height_m, np.ascontiguousarray(near, np.int64), may, _STEP_M, _LEAST, found)
    return found


CELL_M: Final = 1.0  # Edge of a cell (m).
_PIT_M: Final = 8.0
"""A lowest return farther below its surroundings (m) is noise: gaps in crowns are no deeper."""
_SMOOTH: Final = 0.7
"""Standard deviation (cells) of the Gaussian that smooths the ground before returns are compared with it."""
_TOLERANCE_M: Final = 0.5
"""Tolerance of returns about level ground (m) (Pingel, Clarke, McBride 2013, section 2.4, table 3)."""
_CLOSE: Final = 0.5
"""Share of the tolerance within which returns define the ground anew."""


class SparseRules(NamedTuple):
    """What `python -m benchmarks bare_earth` chose from the samples of the filter test."""

    tolerance_slope_m: float = 1.5
    """Tolerance of returns about the ground for each unit of its slope (m)."""
    drop_m: float = 0.8
    """Drop on both sides from which a crest is a bridge, a wall or a roof (m)."""


RULES: Final = SparseRules()


def sparse_ground(place: Place, rules: SparseRules = RULES) -> Found:
    """Returns a mask of returns near the surface of the cells that remain after opening, with the crests of breaks.

    The surface of lowest returns leans to the lowest place of each cell, so it is made anew from the returns that lie
    close to it.
    """
    returns = place.returns
    x, y, z = returns.x_m, returns.y_m, returns.height_m
    grid = grid_over(seen_part(place), CELL_M)
    lowest = np.full(grid.shape, np.inf, np.float32)
    lowest_returns(x, y, z, grid.origin, 1.0 / grid.cell_m, lowest)
    surface, known = without_pits(lowest, _PIT_M, grid)
    known &= bare_cells(surface, grid.cell_m, place.settings)
    first = near(place, smoothed(Surface(grid, filled(lowest, known, grid))), rules, _CLOSE)
    found = near(place, smoothed(remade(place, first)), rules, 1.0)
    sure = found.on_ground & (np.abs(found.above_m) <= _TOLERANCE_M)
    wider = with_crests(place, grid, surface, sure, rules.drop_m)
    return found._replace(on_ground=found.on_ground | wider)


def seen_part(place: Place) -> Box:
    """Returns the cells of the window from the first that has a return to the last, in both directions.

    Openings reflect the surface at its edges; where a window goes beyond the survey, these are the edges of the data.
    """
    window, returns = place.window, place.returns
    if not len(returns):
        return window
    ends = []
    for low, high, at in ((window.x_min_m, window.x_max_m, returns.x_m), (window.y_min_m, window.y_max_m, returns.y_m)):
        first, last = (math.floor((at.min() - low) / CELL_M), math.floor((at.max() - low) / CELL_M) + 1)
        ends.append((max(low + first * CELL_M, low), min(low + last * CELL_M, high)))
    (x_min, x_max), (y_min, y_max) = ends
    return Box(x_min, y_min, x_max, y_max)


def smoothed(surface: Surface) -> Surface:
    """Returns the surface through a Gaussian."""
    z = cv2.GaussianBlur(surface.height_m, (0, 0), _SMOOTH, borderType=cv2.BORDER_REPLICATE)
    return Surface(surface.grid, np.asarray(z))


def near(place: Place, base: Surface, rules: SparseRules, share: float) -> Found:
    """Returns a mask of returns near a surface: within a share of the tolerance."""
    x, y, z = place.returns.x_m, place.returns.y_m, place.returns.height_m
    grid = base.grid
    above, tolerance = np.empty(x.size, np.float32), np.empty(x.size, np.float32)
    heights_above(x, y, z, grid.origin, 1.0 / grid.cell_m, base.height_m, above)
    limit = -(_TOLERANCE_M + rules.tolerance_slope_m * base.slope()).astype(np.float32)
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
    return Surface(grid, filled((found.base.height_m + mean).astype(np.float32), seen, grid))
