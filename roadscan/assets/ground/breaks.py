"""Upper edges of steep breaks (crests of banks, terraces, quarry faces), which an opening takes for objects."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.bins import cells_of
from roadscan.assets.ground.grid import Grid
from roadscan.assets.ground.kernels.breaks import drops_on_both_sides, grow
from roadscan.assets.ground.surface import Place
from roadscan.compute.array_types import Float32

Bools = npt.NDArray[np.bool_]

_LINES: Final = 8
"""Lines through a cell: every 22.5 degrees."""
_NEIGHBOURS: Final = 16
"""Neighbours of a return, seen from above: two rings in a regular pattern."""
_LEAST: Final = 3
"""Neighbours on the ground that carry a return onto it: a wall's returns have one or two."""
_STEP_M: Final = 0.3
"""Height up to which neighbours go on as one surface (m): twice the noise of airborne returns of the year 2000."""


def with_crests(place: Place, grid: Grid, lowest_m: Float32, sure: Bools, drop_m: float) -> Bools:
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
