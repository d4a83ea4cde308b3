"""Brightness of the unpainted surface around each place, and the contrast of returns to it."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel
from roadscan.compute.kernels.arrays import sort

MOST_OF_A_CELL = 16
"""Readings of a cell that are used; of more, an even choice."""
FEWEST = 12  # Least number of readings in a neighbourhood.
_LOW, _MIDDLE = 0.05, 0.35  # Quantiles of the brightness that are compared.
_NORMAL_BETWEEN = 1.2595
"""Standard deviations between the quantiles 0.05 and 0.35 of a normal distribution."""


@kernel
def paint_levels(value, first, half, level, upper):
    """Compute median and upper bound of the unpainted surface around each cell of a raster.

    Up to half of a neighbourhood may be painted: values far above its lower third, in units of the spread below
    that, is left out first.

    Parameters
    ----------
    value : (n,) float64 brightness, in the order of cells; first : (rows · columns + 1,) int64, where each cell begins.
    half : cells on each side that the neighbourhood takes in.
    level, upper : (rows, columns) float64 out: median, and the quantile 84 % (1 σ above it where values are normal);
        NaN where the neighbourhood holds fewer than `FEWEST` readings or the cell itself none.
    """
    rows, columns = level.shape
    near = np.empty((2 * half + 1) ** 2 * MOST_OF_A_CELL)
    for i in range(rows):
        for j in range(columns):
            level[i, j] = upper[i, j] = np.nan
            own = i * columns + j
            if first[own] == first[own + 1]:
                continue
            count = 0
            for a in range(max(i - half, 0), min(i + half + 1, rows)):
                for b in range(max(j - half, 0), min(j + half + 1, columns)):
                    begin, end = first[a * columns + b], first[a * columns + b + 1]
                    step = max(1, -(-(end - begin) // MOST_OF_A_CELL))
                    for k in range(begin, end, step):
                        near[count] = value[k]
                        count += 1
            if count < FEWEST:
                continue
            found = np.sort(near[:count])
            middle, low = found[int(_MIDDLE * count)], found[int(_LOW * count)]
            most = middle + max(4.0 * (middle - low) / _NORMAL_BETWEEN, 0.25 * middle)
            kept = np.searchsorted(found, most, side="right")
            level[i, j] = found[kept // 2]
            upper[i, j] = found[int(0.84 * kept)]


@inlined
def _sampled(value, row, column, fu, fv):
    """Value between the middles of cells: row and column of the lower one, and the place's distance past it."""
    rows, columns = value.shape
    i, j = min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)
    north, east = min(max(row + 1, 0), rows - 1), min(max(column + 1, 0), columns - 1)
    u, v = 1.0 - fu, 1.0 - fv
    return (
        (value[i, j] * u * v + value[i, east] * u * (1.0 - v))
        + (value[north, j] * (1.0 - u) * v)
        + value[north, east] * (1.0 - u) * (1.0 - v)
    )


@kernel
def contrasts(x, y, intensity, grid, level, upper, bounds, contrast, noise):
    """Fill `contrast` (n,), intensity over that of the surface less 1, and `noise`, its 1 σ on a bare surface.

    x, y : (n,) places (m). grid : (x_min_m, y_min_m, cell_m) of both rasters. level, upper : (rows, columns) brightness
    of the surface, and what 84 % of its returns do not reach; linear between the middles of cells. bounds : (least and
    greatest contrast, least noise).
    """
    for k in range(x.size):
        u, v = (y[k] - grid[1]) / grid[2] - 0.5, (x[k] - grid[0]) / grid[2] - 0.5
        i, j = math.floor(u), math.floor(v)
        fu, fv = u - i, v - j
        here = _sampled(level, i, j, fu, fv)
        most = _sampled(upper, i, j, fu, fv)
        contrast[k] = min(max(intensity[k] / here - 1.0, bounds[0]), bounds[1])
        noise[k] = max(most / here - 1.0, bounds[2])


@kernel
def seen_on_ground(place, sensor, above, wanted, limits, box, rows):
    """Write the numbers of the ground returns whose beams were steep enough to `rows` (n,) int64; returns their count.

    place, sensor : three (n,) float64 arrays, x, y and height of the return and of the sensor (m); returns whose sensor
    is not known count as met steeply. above : (n,) float32 height above the ground (m). wanted : (n,) bool. limits :
    (greatest distance from the ground (m), least sine of the angle between beam and level). box : least x and y, which
    belong to it, and those that it ends before.
    """
    found = 0
    for i in range(wanted.size):
        if not (wanted[i] and abs(above[i]) <= limits[0]):
            continue
        x, y = place[0][i], place[1][i]
        if not (box[0] <= x < box[2] and box[1] <= y < box[3]):
            continue
        up, dx, dy = sensor[2][i] - place[2][i], x - sensor[0][i], y - sensor[1][i]
        if up < limits[1] * math.sqrt(dx * dx + dy * dy + up * up):
            continue
        rows[found] = i
        found += 1
    return found


@kernel
def scan_lines(rows, epoch, sensor, laser, step, out):
    """Compute the number of the scan line of some returns: out (k,) int64, what one laser saw within a step of time.

    rows : (k,) int64 numbers of returns; epoch : (n,) int64 and step, of one unit; sensor : (n,) uint8; laser : (n,)
    uint16.
    """
    begin, slot = np.int64(0), np.int64(0)
    for k in range(rows.size):
        at = epoch[rows[k]]
        if not 0 <= at - begin < step or k == 0:
            slot = at // step
            begin = slot * step
        out[k] = (slot << 24) + (np.int64(sensor[rows[k]]) << 16) + np.int64(laser[rows[k]])


@kernel
def paint_sums(cell, contrast, noise, height_m, sums):
    """Add returns to their cells: sums (cells, 5), number, contrast, noise², height (m), height².

    cell : (n,) number of each return's cell; contrast, noise, height_m : (n,).
    """
    for k in range(cell.size):
        at = cell[k]
        sums[at, 0] += 1.0
        sums[at, 1] += contrast[k]
        sums[at, 2] += noise[k] * noise[k]
        sums[at, 3] += height_m[k]
        sums[at, 4] += height_m[k] * height_m[k]


@kernel
def distinct_in_groups(starts, order, value, out):
    """Count the different values of each group: out (groups,) int64.

    starts : (groups + 1,) where the things of each group begin in `order`. value : (n,) int64 of each thing.
    """
    for group in range(out.size):
        own = value[order[starts[group] : starts[group + 1]]]
        sort(own)
        found = 0
        for k in range(own.size):
            found += 1 if k == 0 or own[k] != own[k - 1] else 0
        out[group] = found
