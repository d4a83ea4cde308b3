"""The ground around a block of cells, which a hole in it does not pull down."""

from __future__ import annotations

import math

import numpy as np

from roadscan.kernels.options import kernel


@kernel
def pair_means(heights, i, j, away, pair):
    """Means of opposite blocks around block (i, j) into `pair`; how many both have a height."""
    n = 0
    for k in range(away.shape[0]):
        a, b = away[k, 0], away[k, 1]
        rows = min(i - a, i + a) >= 0 and max(i - a, i + a) < heights.shape[0]
        if rows and min(j - b, j + b) >= 0 and max(j - b, j + b) < heights.shape[1]:
            mean = 0.5 * (heights[i + a, j + b] + heights[i - a, j - b])
            if not math.isnan(mean):
                pair[n] = mean
                n += 1
    return n


@kernel
def put_in_order(values, n):
    """Sort the first n of values (m,) float64, some dozens, in place."""
    for k in range(1, n):
        value = values[k]
        i = k
        while i > 0 and values[i - 1] > value:
            values[i] = values[i - 1]
            i -= 1
        values[i] = value


@kernel
def ground_of(heights, i, j, away, least, slack, pair, level, spread):
    """Ground at block (i, j), and the lowest of all sectors; NaN where no sector, or not each, has `least` pairs.

    level, spread : (sectors,) float64, working space; other arguments as of :func:`ground`.
    """
    closest, known = np.inf, 0
    for sector in range(away.shape[0]):
        level[sector], spread[sector] = np.inf, np.inf
        n = pair_means(heights, i, j, away[sector], pair)
        if n >= least:
            put_in_order(pair, n)
            level[sector] = pair[(6 * (n - 1)) // 10]
            spread[sector] = pair[(8 * (n - 1)) // 10] - pair[(3 * (n - 1)) // 10]
            closest = min(closest, spread[sector])
            known += 1
    lowest, agreed = np.inf, np.inf
    for sector in range(away.shape[0]):
        lowest = min(lowest, level[sector])
        if spread[sector] <= 2.0 * closest + slack:
            agreed = min(agreed, level[sector])
    return (agreed if known > 0 else np.nan), (lowest if known == away.shape[0] else np.nan)


@kernel
def ground(heights, away, least, slack, agreed, lowest):
    """Ground at each block that has a height.

    In each sector it is the 60 % quantile of the means of opposite blocks.

    Parameters
    ----------
    heights : (rows, columns) float64, NaN where none.
    away : (sectors, p, 2) int64, rows and columns to one block of each pair.
    least : fewest pairs of a sector; slack : by how much more than twice as much as the best's a sector's means may
        spread (80 % less 30 % quantile, m).
    agreed : (rows, columns) float64, out, the lowest of the sectors whose means agree about as well as those of the
        best; lowest : the lowest of all sectors. NaN where there is none.
    """
    pair, level, spread = np.empty(away.shape[1]), np.empty(away.shape[0]), np.empty(away.shape[0])
    for i in range(heights.shape[0]):
        for j in range(heights.shape[1]):
            agreed[i, j], lowest[i, j] = np.nan, np.nan
            if not math.isnan(heights[i, j]):
                agreed[i, j], lowest[i, j] = ground_of(heights, i, j, away, least, slack, pair, level, spread)
