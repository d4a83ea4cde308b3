"""Low returns by cells: the lowest, robust low heights, moments, and heights above a raster of ground."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel


@kernel
def lowest_returns(x, y, z, origin, per_m, out):
    """Compute the lowest height of each cell.

    Parameters
    ----------
    x, y, z : (n,) float64 (m).
    origin : (2,) float64, x and y of the grid's corner (m).
    per_m : cells a metre.
    out : (rows, columns) float32, holding inf; the lowest height of the returns in each cell.
    """
    rows, columns = out.shape
    for k in range(x.size):
        i, j = math.floor((y[k] - origin[1]) * per_m), math.floor((x[k] - origin[0]) * per_m)
        if 0 <= i < rows and 0 <= j < columns and z[k] < out[i, j]:
            out[i, j] = z[k]


@kernel
def counts(x, y, origin, per_m, out):
    """Count the returns in each cell, added to out (rows, columns) int32; other arguments as of `lowest_returns`."""
    rows, columns = out.shape
    for k in range(x.size):
        i, j = math.floor((y[k] - origin[1]) * per_m), math.floor((x[k] - origin[0]) * per_m)
        if 0 <= i < rows and 0 <= j < columns:
            out[i, j] += 1


@kernel
def low_heights(cell, z_m, used, depth_m, count, mean_m, variance_m2):
    """Fill (cells,) `count`, `mean_m` and `variance_m2` of the returns that lie lowest in each cell.

    cell : (n,) number of each return's cell, −1 of none. z_m : (n,) heights (m). used : (n,) returns that are looked
    at; then those among them up to `depth_m` above their cell's mean. depth_m : returns up to this above the lowest of
    the cell count. Cells without a return keep 0 returns.
    """
    lowest = np.full(count.size, np.inf)
    for i in range(z_m.size):
        if cell[i] < 0:
            used[i] = False
        if used[i] and z_m[i] < lowest[cell[i]]:
            lowest[cell[i]] = z_m[i]
    for i in range(z_m.size):
        if used[i]:
            at = cell[i]
            above = z_m[i] - lowest[at]
            if above <= depth_m:
                count[at] += 1
                mean_m[at] += above
                variance_m2[at] += above * above
    for at in range(count.size):
        n = count[at]
        if n > 0:
            mean = mean_m[at] / n
            variance_m2[at] = max(variance_m2[at] / n - mean * mean, 0.0)
            mean_m[at] = lowest[at] + mean
    for i in range(z_m.size):
        used[i] = used[i] and z_m[i] <= mean_m[cell[i]] + depth_m


@kernel
def low_moments(x, y, above, intensity, is_counted, limits, corner, cell_m, sums):
    """Add low returns to their cells: sums (rows, columns, 4) float64: n, Σh, Σh², Σ intensity.

    x, y : (n,) places (m); above : (n,) h, height above the ground (m); intensity : (n,); is_counted : (n,) bool;
    limits : (2,) least and greatest h that counts (m); corner : (x, y) of cell (0, 0).
    """
    rows, columns = sums.shape[:2]
    for i in range(x.size):
        h = above[i]
        if not is_counted[i] or not (limits[0] <= h <= limits[1]):
            continue
        a, b = (x[i] - corner[0]) / cell_m, (y[i] - corner[1]) / cell_m
        if not (a >= 0.0 and b >= 0.0 and a < columns and b < rows):
            continue
        r, c = int(b), int(a)
        sums[r, c, 0] += 1.0
        sums[r, c, 1] += h
        sums[r, c, 2] += h * h
        sums[r, c, 3] += intensity[i]


@inlined
def bilinear(z, u, v):
    """Height at column u and row v (cells, counted from the middle of the first), clamped to the raster z."""
    rows, columns = z.shape
    u, v = min(max(u, 0.0), columns - 1.0), min(max(v, 0.0), rows - 1.0)
    j, i = int(u), int(v)
    j2, i2 = min(j + 1, columns - 1), min(i + 1, rows - 1)
    fu, fv = u - j, v - i
    south = z[i, j] + fu * (z[i, j2] - z[i, j])
    north = z[i2, j] + fu * (z[i2, j2] - z[i2, j])
    return south + fv * (north - south)


@kernel
def heights_above(x, y, z, origin, per_m, ground, out):
    """Compute the height of each return above a raster of ground.

    Parameters
    ----------
    x, y, z : (n,) float64 (m).
    origin : (2,) float64, x and y of the raster's corner (m).
    per_m : cells a metre.
    ground : (rows, columns) float32, heights at the middles of cells; NaN where unknown.
    out : (n,) float32, NaN where the ground is unknown.
    """
    for k in range(x.size):
        u, v = (x[k] - origin[0]) * per_m - 0.5, (y[k] - origin[1]) * per_m - 0.5
        out[k] = z[k] - bilinear(ground, u, v)
