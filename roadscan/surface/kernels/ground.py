"""Ground about a hole in a grid of blocks: its height in every direction, and its continuation from there.

Rays from a block are its profiles: heights above a plane of the ground's slope through the block.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inner, kernel

_SLOPES = 401
"""Number of classes of a slope …"""
_STEEPEST = 0.4
"""… between this slope downwards and upwards (m/m)."""
_FLAT_M, _FLAT = 0.005, 0.2
"""A rim is where the next two blocks are as high as these two, within this (m), or this share of the wall's rise."""
_SHARE = 0.25  # A rim may be lower than the surroundings of a hole by this share of the hole's depth …
_LEAST_M, _MOST_M = 0.004, 0.015
"""… within these limits (m)."""
_STEP_M = 0.015
"""Rays whose ground is higher by more than this (m) than the lower quartile end on other ground, such as that behind a
kerb."""
_APART = 4
"""Distance (blocks) of the blocks that show the slope beyond a rim."""
_STEEPEST_M = 0.02
"""Steepest slope beyond a rim (m a block)."""
_DAMPED = 8.0
"""Number of pairs of blocks with which a slope counts half."""


@inner
def slope_class(slope, steepest):
    """Returns the class of a slope, from 0 for -steepest up."""
    share = (slope + steepest) / (2.0 * steepest)
    return int(min(max(share, 0.0), 1.0) * (_SLOPES - 1) + 0.5)


@inner
def median_slope(counts, steepest):
    """Returns the median of slopes from the count of each class (401,); 0 of none."""
    n = 0
    for k in range(_SLOPES):
        n += counts[k]
    below = 0
    for k in range(_SLOPES):
        if n > 0 and 2 * (below + counts[k]) >= n:
            return (k + (0.5 * n - below) / counts[k] - 0.5) * (2.0 * steepest / (_SLOPES - 1)) - steepest
        below += counts[k]
    return 0.0


@inner
def slope_towards(heights, i, j, half, way, step_m, counts):
    """Returns the median slope (m/m) about block (i, j), from blocks `way` (rows, columns), `step_m`, apart.

    heights : (rows, columns) float64, NaN where none; half : reach in blocks to all sides, every third is used;
    way : (2,) int64; counts : (401,) int64, working space.
    """
    counts[:] = 0
    for a in range(i - half, i + half + 1 - way[0], 3):
        for b in range(j - half, j + half + 1 - way[1], 3):
            if a >= 0 and a + way[0] < heights.shape[0] and b >= 0 and b + way[1] < heights.shape[1]:
                rise = heights[a + way[0], b + way[1]] - heights[a, b]
                if not math.isnan(rise):
                    counts[slope_class(rise / step_m, _STEEPEST)] += 1
    return median_slope(counts, _STEEPEST)


@kernel
def slopes(heights, row, column, half, ways, step_m, out):
    """Compute :func:`slope_towards` for some ways at each of some blocks.

    row, column : (n,) int64; ways : (k, 2) int64; out : (n, k) float64.
    """
    counts = np.empty(_SLOPES, np.int64)
    for k in range(row.size):
        for m in range(ways.shape[0]):
            out[k, m] = slope_towards(heights, row[k], column[k], half, ways[m], step_m, counts)


@kernel
def profile(heights, i, j, away, north, east, out):
    """Compute heights along a ray from block (i, j), less those of a plane through it; NaN where there is none.

    away : (n, 2) int64, rows and columns from the block; north, east : the plane's rise a block; out : (n,) float64.
    """
    for k in range(away.shape[0]):
        a, b = i + away[k, 0], j + away[k, 1]
        if a >= 0 and a < heights.shape[0] and b >= 0 and b < heights.shape[1]:
            out[k] = heights[a, b] - (away[k, 0] * north + away[k, 1] * east)
        else:
            out[k] = np.nan


@kernel
def highest(along):
    """Highest mean of three blocks in a row (two are enough) of a profile (n,); -inf where there are none."""
    found = -np.inf
    for k in range(along.size - 2):
        total, count = 0.0, 0
        for m in range(k, k + 3):
            if not math.isnan(along[m]):
                total += along[m]
                count += 1
        if count >= 2:
            found = max(found, total / count)
    return found


@kernel
def steepest(along, start, level):
    """Returns the greatest rise over three blocks along a profile (n,) that begins at `start`, up to where it reaches
    `level`.
    """
    found, before = 0.0, start
    for k in range(2, along.size):
        if k > 2:
            before = along[k - 3]
        rise = along[k] - before
        found = rise if rise > found else found  # not where it is NaN
        if along[k - 2] >= level:
            return found
    return found


@inner
def level_about(heights, i, j, away, north, east, rise, along):
    """Returns the level about block (i, j): the lowest, over all rays, of the highest along the ray.

    -inf where a ray is empty, or as soon as one does not rise `rise` above the block.
    away : (rays, n, 2) int64; along : (n,) float64, working space; other arguments as of :func:`profile`.
    """
    level = np.inf
    for ray in range(away.shape[0]):
        profile(heights, i, j, away[ray], north, east, along)
        level = min(level, highest(along))
        if not level >= heights[i, j] + rise:
            return -np.inf
    return level


@kernel
def depths(heights, slope, away, least, wall, out):
    """Compute the depth of each block that lies `least` or more below all of its surroundings and has steep walls.

    Parameters
    ----------
    heights : (rows, columns) float64, NaN where none.
    slope : (rows, columns, 2) float64, rise of the ground a block, north and east.
    away : (rays, n, 2) int64, rows and columns from a block to those on rays from it, outwards.
    wall : rise over three blocks that most rays have somewhere (m).
    out : (rows, columns) float64, NaN where that is not so.
    """
    along = np.empty(away.shape[1])
    for i in range(heights.shape[0]):
        for j in range(heights.shape[1]):
            out[i, j] = np.nan
            north, east = slope[i, j, 0], slope[i, j, 1]
            level = level_about(heights, i, j, away, north, east, least, along)
            if level > -np.inf:
                steep = 0
                for ray in range(away.shape[0]):
                    profile(heights, i, j, away[ray], north, east, along)
                    steep += 1 if steepest(along, heights[i, j], level) >= wall else 0
                if 2 * steep > away.shape[0]:
                    out[i, j] = level - heights[i, j]


@kernel
def rim(along, level, slack):
    """Returns the first place of a profile (n,) that reaches `level` less `slack` and begins flat ground; -1: none."""
    wall = 0.0
    for k in range(along.size - 3):
        here, ahead = 0.5 * (along[k] + along[k + 1]), 0.5 * (along[k + 2] + along[k + 3])
        if here >= level - slack and abs(ahead - here) <= max(_FLAT_M, _FLAT * wall):
            return k
        wall = ahead - here if ahead - here > wall else wall  # not where it is NaN
    return -1


@inner
def slope_beyond(along, start, counts):
    """Returns the median rise over a block of a profile (n,) from place `start` on, damped where few blocks follow."""
    counts[:] = 0
    n = 0
    for k in range(start, along.size - _APART):
        rise = along[k + _APART] - along[k]
        if not math.isnan(rise):
            counts[slope_class(rise / _APART, _STEEPEST_M)] += 1
            n += 1
    return median_slope(counts, _STEEPEST_M) * (n / (n + _DAMPED))


@inner
def mean_below(height, weight, step):
    """Returns the weighted mean of heights (n,) no more than `step` above their lower quartile; NaN of none."""
    n = height.size
    low = np.inf
    for k in range(n):
        below = 0
        for m in range(n):
            below += 1 if height[m] <= height[k] else 0
        if 4 * below >= n:
            low = min(low, height[k])
    total, weights = 0.0, 0.0
    for k in range(n):
        if height[k] <= low + step:
            total += weight[k] * height[k]
            weights += weight[k]
    return total / weights if weights > 0.0 else np.nan


@kernel
def grounds(heights, slope, away, row, column, out):
    """Compute the ground at some blocks, extrapolated from the rim of the hole in which they lie.

    Each ray gives it from the height of the rim and the slope beyond; near rims count more.
    row, column : (n,) int64; out : (n,) float64, NaN where no rim is seen; other arguments as of :func:`depths`.
    """
    rays, steps = away.shape[0], away.shape[1]
    along = np.empty((rays, steps))
    height, weight = np.empty(rays), np.empty(rays)
    counts = np.empty(_SLOPES, np.int64)
    for b in range(row.size):
        i, j = row[b], column[b]
        lowest = np.inf
        for ray in range(rays):
            profile(heights, i, j, away[ray], slope[i, j, 0], slope[i, j, 1], along[ray])
            level = highest(along[ray])
            lowest = min(lowest, level if level > -np.inf else np.inf)
        slack = lowest - heights[i, j]
        slack = min(max(_SHARE * slack, _LEAST_M), _MOST_M) if not math.isnan(slack) else _LEAST_M
        n = 0
        for ray in range(rays):
            k = rim(along[ray], lowest, slack)
            if k >= 0:
                k += 2  # these two lie beyond the wall's top
                far = k + 1.5
                height[n] = 0.5 * (along[ray, k] + along[ray, k + 1]) - far * slope_beyond(along[ray], k, counts)
                weight[n] = 1.0 / (far * far)
                n += 1
        out[b] = mean_below(height[:n], weight[:n], _STEP_M)
