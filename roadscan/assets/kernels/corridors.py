"""Cells along the path of a vehicle."""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import kernel


@kernel
def mark_corridor(x, y, reach_m, corner, cell_m, inside):
    """Mark the cells whose middle lies within reach of a line: inside (rows, columns) bool.

    x, y : (p,) points of the line, in their order (m); corner : (x, y) of cell (0, 0). Points farther apart than 5 m
    are not joined: the vehicle left the window between them.
    """
    rows, columns = inside.shape
    for i in range(x.size):
        j = (
            i + 1
            if i + 1 < x.size and math.hypot(x[min(i + 1, x.size - 1)] - x[i], y[min(i + 1, x.size - 1)] - y[i]) <= 5.0
            else i
        )
        west, east = min(x[i], x[j]) - reach_m - corner[0], max(x[i], x[j]) + reach_m - corner[0]
        south, north = min(y[i], y[j]) - reach_m - corner[1], max(y[i], y[j]) + reach_m - corner[1]
        wx, wy = x[j] - x[i], y[j] - y[i]
        square = wx * wx + wy * wy
        for r in range(max(int(south / cell_m), 0), min(int(north / cell_m) + 1, rows)):
            for c in range(max(int(west / cell_m), 0), min(int(east / cell_m) + 1, columns)):
                px, py = corner[0] + (c + 0.5) * cell_m - x[i], corner[1] + (r + 0.5) * cell_m - y[i]
                share = min(max((px * wx + py * wy) / square, 0.0), 1.0) if square > 0.0 else 0.0
                if math.hypot(px - share * wx, py - share * wy) <= reach_m:
                    inside[r, c] = True


@kernel
def mark_strip(x, y, rows, middle, axes, box, marked):
    """Mark the returns of a rectangle seen from above: `marked` (n,) bool at their numbers.

    x, y : (k,) places (m) and rows : (k,) numbers of returns. middle : (2,) where axes (2, 2) begin, unit vectors. box
    : (4,) least and greatest place along the first axis, then along the second (m).
    """
    for i in range(x.size):
        dx, dy = x[i] - middle[0], y[i] - middle[1]
        along = dx * axes[0, 0] + dy * axes[0, 1]
        if box[0] <= along <= box[1]:
            across = dx * axes[1, 0] + dy * axes[1, 1]
            if box[2] <= across <= box[3]:
                marked[rows[i]] = True
