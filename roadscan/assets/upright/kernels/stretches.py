"""Returns about upright rectangles: on them, before them, behind them and above them."""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import kernel


@kernel
def count_about(x, y, height, index, grid, segments, limits, counts):
    """Count returns about upright rectangles; one whose edges are not known has none.

    Parameters
    ----------
    x, y : (k,) float64 places in the order of their cells. height : (k,) of each (m).
    index : (cells + 1,) int64, where each cell begins, row by row.
    grid : x and y of the raster's corner, edge of a cell (m), rows and columns.
    segments : (s, 7) float64: ends x, y and x, y of a rectangle seen from above, height of its lower and of its upper
        edge (m), 1 where the sensor is on the left of the way from the first end to the second, else −1.
    limits : greatest distance of what lies on a rectangle, and of what lies before and behind it; least and greatest
        height of what is above it (m).
    counts : (s, 5) float64, is added to: returns on it, before, behind and above it, and the sum of the distances of
        those on it (m).
    """
    rows, columns = int(grid[3]), int(grid[4])
    on_m, about_m, over_m, top_m = limits
    for s in range(segments.shape[0]):
        ax, ay, bx, by, low, high, side = segments[s]
        length = math.hypot(bx - ax, by - ay)
        if length == 0.0 or not high > low:
            continue
        ux, uy = (bx - ax) / length, (by - ay) / length
        first = max(math.floor((min(ax, bx) - about_m - grid[0]) / grid[2]), 0)
        last = min(math.floor((max(ax, bx) + about_m - grid[0]) / grid[2]), columns - 1)
        bottom = max(math.floor((min(ay, by) - about_m - grid[1]) / grid[2]), 0)
        top = min(math.floor((max(ay, by) + about_m - grid[1]) / grid[2]), rows - 1)
        for row in range(bottom, top + 1):
            if last < first:
                break
            for i in range(index[row * columns + first], index[row * columns + last + 1]):
                along = (x[i] - ax) * ux + (y[i] - ay) * uy
                if along < 0.0 or along >= length or height[i] < low:
                    continue
                beside = ux * (y[i] - ay) - uy * (x[i] - ax)
                off = abs(beside)
                if height[i] <= high:
                    if off <= on_m:
                        counts[s, 0] += 1.0
                        counts[s, 4] += off
                    elif off <= about_m:
                        counts[s, 1 if beside * side > 0.0 else 2] += 1.0
                elif off <= about_m and over_m <= height[i] - high <= top_m:
                    counts[s, 3] += 1.0
