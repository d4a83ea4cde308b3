"""Cross-sections of a valley in a grid of heights, from all cells around it, with bins finer than a cell.

Running quantiles of the values of its cells.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inner, kernel
from roadscan.compute.kernels.arrays import sort_few

HALF_ALONG = 4.5
"""A cross-section is the mean over this many cells along the valley, to either side."""
BINS = 2
"""Number of bins per cell."""


@inner
def fill_bins(heights, i, j, north, east, reach, total, count):
    """Sum and count the cells around (i, j) by their distance to the right of a line through its middle.

    heights : (rows, columns) float64, NaN where none; north, east : unit vector of the line in rows and columns;
    reach : cells to either side; total, count : (2 BINS reach + 1,) float64, out. Returns what all heights were
    lowered by.
    """
    total[:] = 0.0
    count[:] = 0.0
    far = math.ceil(math.hypot(HALF_ALONG, reach))
    base = 0.0 if math.isnan(heights[i, j]) else heights[i, j]
    middle = BINS * reach
    for a in range(max(i - far, 0), min(i + far + 1, heights.shape[0])):
        for b in range(max(j - far, 0), min(j + far + 1, heights.shape[1])):
            along = (a - i) * north + (b - j) * east
            right = (b - j) * north - (a - i) * east
            k = math.floor(right * BINS + 0.5) + middle
            z = heights[a, b]
            if abs(along) <= HALF_ALONG and 0 <= k < total.size and not math.isnan(z):
                total[k] += z - base
                count[k] += 1.0
    return base


@inner
def mean_between(total, count, first, end):
    """Returns mean height and mean position of the bins from `first` to `end`; NaN where they are empty."""
    height, place, n = 0.0, 0.0, 0.0
    for k in range(max(first, 0), min(end, total.size)):
        height += total[k]
        place += k * count[k]
        n += count[k]
    return (height / n, place / n) if n > 0.0 else (np.nan, np.nan)


@kernel
def depths(total, count, flank, depth):
    """Compute the depth of each bin below the straight line between both flanks; empty inner bins are interpolated.

    flank : bins from the middle to where the flanks begin; depth : (bins,) float64, out. Returns the height of that
    line in the middle and that of the lower flank; NaN where a flank or the valley is empty.
    """
    middle = total.size // 2
    wide = max(flank // 2, 2 * BINS)
    left, left_at = mean_between(total, count, middle - flank - wide, middle - flank + 1)
    right, right_at = mean_between(total, count, middle + flank, middle + flank + wide + 1)
    if math.isnan(left) or math.isnan(right):
        return np.nan, np.nan
    slope = (right - left) / (right_at - left_at)
    last, any_bin = -1, False
    for k in range(total.size):
        if count[k] > 0.0:
            depth[k] = left + slope * (k - left_at) - total[k] / count[k]
            for empty in range(last + 1, k):
                share = (empty - last) / (k - last)
                depth[empty] = depth[k] if last < 0 else depth[last] + share * (depth[k] - depth[last])
            last, any_bin = k, any_bin or abs(k - middle) < flank
    for empty in range(last + 1, total.size):
        depth[empty] = depth[last]
    return (left + slope * (middle - left_at), min(left, right)) if any_bin else (np.nan, np.nan)


@inner
def half_way(depth, peak, step, half):
    """Returns the distance in bins from `peak` to where the depth falls to `half`, stepping by `step`, interpolated."""
    k = peak
    while 0 < k < depth.size - 1 and depth[k + step] > half:
        k += step
    if not 0 < k < depth.size - 1:
        return abs(k - peak) * 1.0
    return abs(k - peak) + (depth[k] - half) / (depth[k] - depth[k + step])


@kernel
def cross_sections(heights, row, column, north, east, flank, reach, out):
    """Compute depth, width and middle of a valley at each of its cells.

    Parameters
    ----------
    heights : (rows, columns) float64 (m), NaN where there is none.
    row, column : (n,) int64 cells; north, east : (n,) float64, unit vector along the valley, in rows and columns.
    flank : (n,) int64, where its flanks begin (cells); reach : most cells to either side.
    out : (n, 5) float64: depth below the line between both flanks (m), width at half that depth and how far the middle
        lies to the right (cells), depth below the lower flank (m), height of that line at the cell (m). NaN where it
        is not known.
    """
    size = 2 * BINS * reach + 1
    total, count, depth = np.empty(size), np.empty(size), np.empty(size)
    for n in range(row.size):
        out[n] = np.nan
        base = fill_bins(heights, row[n], column[n], north[n], east[n], reach, total, count)
        begin = BINS * flank[n]
        ground, lower = depths(total, count, begin, depth)
        if math.isnan(ground):
            continue
        out[n, 4] = base + ground
        middle = BINS * reach
        peak, deepest = middle, -np.inf
        for k in range(middle - begin // 2 - 1, middle + begin // 2 + 1):
            here = 0.5 * (depth[k] + depth[k + 1])
            if here > deepest:
                peak, deepest = k, here
        peak = peak if depth[peak] > depth[peak + 1] else peak + 1
        if deepest <= 0.0:
            continue
        left, right = half_way(depth, peak, -1, 0.5 * deepest), half_way(depth, peak, 1, 0.5 * deepest)
        out[n, 0] = deepest
        out[n, 1] = (left + right) / BINS
        out[n, 2] = (peak - middle + 0.5 * (right - left)) / BINS
        out[n, 3] = deepest - (ground - lower)


CELLS_ALONG = 10
"""The window reaches this many cells to either side, in rows and in columns."""
_HALF_ASIDE = 2.5
"""The window is this many cells wide to either side: it keeps bends of its line and takes in no other line."""


@inner
def quantile_of(values, count, level):
    """Returns a quantile of the first `count` values, interpolated between two; it reorders them. NaN of none."""
    sort_few(values[:count])
    if count == 0:
        return np.nan
    place = level * (count - 1)
    k = min(int(place), max(count - 2, 0))
    return values[k] + (place - k) * (values[min(k + 1, count - 1)] - values[k])


@kernel
def quantiles_along(number, row, column, north, east, values, level, out):
    """Compute for each cell of a line the quantile of the values of the line's cells around it.

    Parameters
    ----------
    number : (rows, columns) int32, index of the cells of lines in the other arrays, -1 elsewhere.
    row, column : (n,) int64 cells; north, east : (n,) float64, unit vector along the line, in rows and columns.
    values : (n,) float64, NaN where there is none; level : (n,) float64, which quantile, 0 to 1.
    out : (n,) float64, NaN where there is none around.
    """
    near = np.empty((2 * CELLS_ALONG + 1) ** 2)
    for n in range(row.size):
        i, j, count = row[n], column[n], 0
        for a in range(max(i - CELLS_ALONG, 0), min(i + CELLS_ALONG + 1, number.shape[0])):
            for b in range(max(j - CELLS_ALONG, 0), min(j + CELLS_ALONG + 1, number.shape[1])):
                k = number[a, b]
                if k >= 0 and not math.isnan(values[k]) and abs((b - j) * north[n] - (a - i) * east[n]) <= _HALF_ASIDE:
                    near[count] = values[k]
                    count += 1
        out[n] = quantile_of(near, count, level[n])
