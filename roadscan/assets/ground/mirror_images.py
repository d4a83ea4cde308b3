"""Mirror images below the ground: what a scanner sees in the windows of cars and houses appears behind them."""

from __future__ import annotations

from typing import Final

import numpy as np

from roadscan.assets.ground.surface import Grid
from roadscan.assets.kernels.mirror_images import count_stopped, follow_lines, lowest_rows, rows_up_to
from roadscan.assets.scene import Returns
from roadscan.compute.array_types import Bool, Float32, Int64

_LEVEL_M, _LEVELS = 0.25, 32
"""Height of a place where something may stand (m), and how many there are above the lowest return of a cell: 8 m."""
_BELOW_M: Final = 0.3
"""A return is low that lies farther below the ground before a solid thing (m); nearer, it does not lift a road off."""
_STANDS_M: Final = 0.25
"""Places nearer to the ground (m) hold returns of the ground itself."""
_FROM_M, _SHORT_M = 20.0, 0.5
"""A sight line is followed from so far before its return (m), to so far before it: there it meets its own surface."""
_LEAST: Final = 20.0
"""Fewer returns do not show that a place is solid."""
_TIMES: Final = 19.0
"""A place is solid if this many times as many lines ended in it as passed it to low returns: a fence, a hedge or a
rail before a slope that falls lets more than a twentieth of them pass."""
_ROUNDS: Final = 8
"""Most rounds: without an image, the foot of what stands in its cell is higher. A street between two rows of parked
cars took six."""


def lowest_without_mirror_images(returns: Returns, grid: Grid, steepest: float) -> Float32:
    """Returns the height of the lowest return of each cell (rows, columns), inf where there is none.

    A pane mirrors a beam to somewhere else, and the return appears on the straight line behind the pane, as far away as
    the whole way is long: often below the ground. So it lies lower than the foot of a solid thing that stands on its
    sight line. No line reaches a real depression through what is solid.

    steepest : rise of the ground along a line (m/m).
    """
    x, y, z = returns.x_m, returns.y_m, returns.height_m
    end, start = (x, y, z), (returns.sensor_x_m, returns.sensor_y_m, returns.sensor_height_m)
    frame = grid.origin, 1.0 / grid.cell_m
    limits = np.array([_LEVEL_M, steepest, _BELOW_M, _STANDS_M, _FROM_M, _SHORT_M, _LEAST, _TIMES])
    image, rows = np.zeros(x.size, np.bool_), np.empty(x.size, np.int64)
    lowest, lowest_row = _lowest(returns, image, grid)
    bottom, stopped = lowest, np.zeros((*grid.shape, _LEVELS), np.int32)
    count_stopped(x, y, z, *frame, bottom, _LEVEL_M, stopped)
    for _ in range(_ROUNDS):
        passed, low = np.zeros_like(stopped), lowest_row[lowest_row >= 0]
        foot = np.full(low.size, -np.inf)
        follow_lines(low, end, start, *frame, bottom, lowest, limits, stopped, passed, False, foot)
        limit = np.full(grid.shape, -np.inf, np.float32)
        limit[lowest_row >= 0] = foot - _BELOW_M
        low = rows[: rows_up_to(x, y, z, *frame, limit, rows)]
        foot = np.full(low.size, -np.inf)
        for counting in (True, False):
            follow_lines(low, end, start, *frame, bottom, lowest, limits, stopped, passed, counting, foot)
        low = low[np.isfinite(foot)]
        if image[low].all():
            break
        image[low] = True
        lowest, lowest_row = _lowest(returns, image, grid)
    return lowest


def _lowest(returns: Returns, left_out: Bool, grid: Grid) -> tuple[Float32, Int64]:
    """Returns the height and the number (rows, columns) of the lowest return of each cell, inf and −1 of none."""
    lowest, row = np.full(grid.shape, np.inf, np.float32), np.full(grid.shape, -1)
    frame = grid.origin, 1.0 / grid.cell_m
    lowest_rows(returns.x_m, returns.y_m, returns.height_m, left_out, *frame, lowest, row)
    return lowest, row
