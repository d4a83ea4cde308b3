"""Cell statistics in whole numbers: the result does not depend on the order of the points, to the bit."""

from __future__ import annotations

import math

import numpy as np

from roadscan.kernels.options import inlined, kernel

MAD_TO_SIGMA = 1.4826
OUTLIER_SIGMAS = 3.0


@kernel
def count_cells(x, y, cell_quanta, edge, counts):
    """Count points a cell.

    x, y : (n,) int32, quanta from the tile's corner; counts : (edge·edge,) int32, in/out, row-major from south.
    """
    for i in range(x.size):
        counts[(y[i] // cell_quanta) * edge + x[i] // cell_quanta] += 1


@inlined
def robust_mean(heights, floor_quanta):
    """Mean of the sorted heights within 3 · 1.4826 · MAD (at least `floor_quanta`) of their lower median."""
    n = heights.size
    median = heights[(n - 1) // 2]
    # The k-th smallest distance from the median: walk outwards from it on both sides.
    low = (n - 1) // 2
    high = low + 1
    deviation = 0
    for _ in range((n - 1) // 2 + 1):
        below = median - heights[low] if low >= 0 else np.int64(2**62)
        above = heights[high] - median if high < n else np.int64(2**62)
        if below <= above:
            deviation = below
            low -= 1
        else:
            deviation = above
            high += 1
    reach = max(OUTLIER_SIGMAS * MAD_TO_SIGMA * deviation, floor_quanta)
    total = 0
    used = 0
    for i in range(n):
        if abs(heights[i] - median) <= reach:
            total += heights[i] - median
            used += 1
    return median + total / used


@kernel
def cell_statistics(
    x, y, height, intensity, passes, cell_quanta, edge, floor_quanta, counts,
    column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
):  # fmt: skip
    """Statistics of all cells with a point, in order of row and column.

    Parameters
    ----------
    x, y, height : (n,) int32, quanta; intensity, passes : (n,) uint16.
    counts : (edge·edge,) int32 from :func:`count_cells`.
    column, row, count, mean, robust, low, high, deviation, bright : (c,) out; heights in quanta, float64.
    pass_offsets : (c + 1,) int32, out; pass_ids : (n,) uint16, out.

    Returns
    -------
    int, how many pass ids were written.
    """
    n = x.size
    starts = np.zeros(edge * edge + 1, np.int64)
    for k in range(edge * edge):
        starts[k + 1] = starts[k] + counts[k]
    fill = starts[:-1].copy()
    heights = np.empty(n, np.int64)
    lights = np.empty(n, np.uint16)
    sources = np.empty(n, np.uint16)
    for i in range(n):
        k = (y[i] // cell_quanta) * edge + x[i] // cell_quanta
        heights[fill[k]] = height[i]
        lights[fill[k]] = intensity[i]
        sources[fill[k]] = passes[i]
        fill[k] += 1
    cell = 0
    written = 0
    for k in range(edge * edge):
        if counts[k] == 0:
            continue
        a, b = starts[k], starts[k + 1]
        group = np.sort(heights[a:b])
        size = b - a
        total = 0
        squares = 0
        light = 0
        for i in range(size):
            above = group[i] - group[0]
            total += above
            squares += above * above
            light += np.int64(lights[a + i])
        column[cell] = k % edge
        row[cell] = k // edge
        count[cell] = size
        low[cell] = group[0]
        high[cell] = group[size - 1]
        mean[cell] = group[0] + total / size
        deviation[cell] = math.sqrt(max(squares / size - (total / size) * (total / size), 0.0))
        robust[cell] = robust_mean(group, floor_quanta)
        bright[cell] = light / size
        pass_offsets[cell] = written
        present = np.sort(sources[a:b])
        for i in range(size):
            if i == 0 or present[i] != present[i - 1]:
                pass_ids[written] = present[i]
                written += 1
        cell += 1
    pass_offsets[cell] = written
    return written
