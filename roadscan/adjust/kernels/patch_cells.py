"""Readings near a place as cells in the axes of the road, and moments of points about the plane of their group.

Two images of one place shifted against each other: their correlation, and their difference when aligned.

Pictures are arrays (rows, columns) with NaN where nothing was seen. A cell (r, c) of the first lies at (r + dr, c + dc)
of the second.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare, kernel
from roadscan.compute.kernels.arrays import catmull_rom, sampled

MOST = 32
"""Readings of a cell from which its height is computed; an even choice where there are more."""
QUARTILES_OF_SIGMA = 1.349
"""Distance of the quartiles of a normal distribution, in σ."""


class Frame(NamedTuple):
    """Axes of a place."""

    easting_m: float
    """Centre, map."""
    northing_m: float
    sine: float
    """Sine of the heading of the axis along, clockwise from grid north."""
    cosine: float


class Cells(NamedTuple):
    """Cells (along, across) of a patch, written by `fill_cells`."""

    height_m: npt.NDArray[np.float64]
    """Mean of the middle half of the heights; NaN in cells with too few."""
    spread_m: npt.NDArray[np.float64]
    """1 σ of one reading about it, from the quartiles."""
    used: npt.NDArray[np.int32]
    """Number of readings in the height."""
    intensity: npt.NDArray[np.float64]
    """Mean of the same readings; NaN as the height."""


@kernel
def local_axes(easting_m, northing_m, frame, along_m, across_m):
    """Write coordinates (n,) along and across (right positive) from the place."""
    for i in range(easting_m.size):
        e, n = easting_m[i] - frame.easting_m, northing_m[i] - frame.northing_m
        along_m[i] = e * frame.sine + n * frame.cosine
        across_m[i] = e * frame.cosine - n * frame.sine


@kernel
def cell_numbers(along_m, across_m, half_m, cell_m, edge, number, count):
    """Write the cell (n,) of each reading, row · edge + column, −1 outside, and add to the counts (edge · edge,)."""
    for i in range(along_m.size):
        r, c = math.floor((along_m[i] + half_m) / cell_m), math.floor((across_m[i] + half_m) / cell_m)
        number[i] = -1
        if 0 <= r < edge and 0 <= c < edge:
            number[i] = r * edge + c
            count[r * edge + c] += 1


@kernel
def fill_cells(number, height_m, intensity, count, least, cells):
    """Write height, spread and intensity of cells.

    Parameters
    ----------
    number : (n,) int32, cell of each reading, −1: none. height_m : (n,) float64. intensity : (n,) uint16.
    count : (c,) int64, readings of each cell. least : int, a cell with fewer has no height.
    cells : Cells, out, of arrays (c,).
    """
    size = count.size
    begin = np.zeros(size + 1, np.int64)
    for k in range(size):
        begin[k + 1] = begin[k] + min(count[k], MOST)
    held, light = np.empty(begin[size]), np.zeros(size)
    seen, kept = np.zeros(size, np.int64), np.zeros(size, np.int64)
    for i in range(number.size):
        k = number[i]
        if k < 0:
            continue
        # The readings whose share of the cell's passes a whole number: MOST of them, evenly.
        before = seen[k] * MOST // count[k]
        seen[k] += 1
        if (count[k] <= MOST or seen[k] * MOST // count[k] > before) and math.isfinite(height_m[i]):
            n = begin[k] + kept[k]
            while n > begin[k] and held[n - 1] > height_m[i]:
                held[n] = held[n - 1]
                n -= 1
            held[n] = height_m[i]
            light[k] += intensity[i]
            kept[k] += 1
    for k in range(size):
        n = kept[k]
        cells.used[k] = n
        if n < least or n == 0:
            cells.height_m[k], cells.spread_m[k], cells.intensity[k] = math.nan, math.nan, math.nan
            continue
        low, high = begin[k] + n // 4, begin[k] + n - n // 4
        total = 0.0
        for j in range(low, high):
            total += held[j]
        cells.height_m[k] = total / (high - low)
        cells.spread_m[k] = (held[high - 1] - held[low]) / QUARTILES_OF_SIGMA if n >= 4 else math.nan
        cells.intensity[k] = light[k] / n


class Splat(NamedTuple):
    """Sums of readings over the cells of an image, (rows, columns), in/out of `splat`."""

    mass: npt.NDArray[np.float64]
    """Sum of weights."""
    height: npt.NDArray[np.float64]
    """Sum of weight · height."""
    intensity: npt.NDArray[np.float64]


@kernel
def splat(along_m, across_m, height_m, intensity, number, road_m, deepest_m, level_m, cell_m, out):
    """Add readings to the four cells around each, by nearness; those far from the height of their cell are skipped.

    Parameters
    ----------
    along_m, across_m : (n,) float64, from the corner of the picture. height_m : (n,) float64. intensity : (n,) uint16.
    number : (n,) int32, cell of `road_m` of each reading. road_m : (c,) float64.
    deepest_m : float64, farther from its cell's height a reading is no road. level_m : float64, taken off all heights.
    cell_m : float64. out : Splat, in/out.
    """
    rows, columns = out.mass.shape
    for i in range(number.size):
        u, v = along_m[i] / cell_m - 0.5, across_m[i] / cell_m - 0.5
        if not (0.0 <= u < rows - 1.0 and 0.0 <= v < columns - 1.0):
            continue
        if not abs(height_m[i] - road_m[number[i]]) <= deepest_m:
            continue
        h, w = height_m[i] - level_m, float(intensity[i])
        r, c = int(u), int(v)
        for j in range(2):
            for k in range(2):
                part = (u - r if j else 1.0 - u + r) * (v - c if k else 1.0 - v + c)
                out.mass[r + j, c + k] += part
                out.height[r + j, c + k] += part * h
                out.intensity[r + j, c + k] += part * w


@bare
def add_moments(point_m, group, kept, count, total_m, squares_m2):
    """Add count, sum and second moments about the origin of the points of each group.

    Parameters
    ----------
    point_m : (n, 3), near the origin of their group, or digits are lost.
    group : (n,)
    kept : (n,) points that count.
    count : (g,) int64, changed in place.
    total_m : (g, 3), changed in place.
    squares_m2 : (g, 6) of xx, xy, xz, yy, yz, zz, changed in place.
    """
    for n in range(group.size):
        if not kept[n]:
            continue
        g = group[n]
        x, y, z = point_m[n, 0], point_m[n, 1], point_m[n, 2]
        count[g] += 1
        total_m[g, 0] += x
        total_m[g, 1] += y
        total_m[g, 2] += z
        squares_m2[g, 0] += x * x
        squares_m2[g, 1] += x * y
        squares_m2[g, 2] += x * z
        squares_m2[g, 3] += y * y
        squares_m2[g, 4] += y * z
        squares_m2[g, 5] += z * z


@bare
def leave_out_far(point_m, group, mean_m, normal, limit_m, kept):
    """Reject points that lie farther than a limit from the plane of their group.

    Parameters
    ----------
    mean_m, normal : (g, 3) of the plane of each group.
    limit_m : (g,); negative where no point of the group counts.
    kept : (n,) changed in place.
    """
    for n in range(group.size):
        if kept[n]:
            g = group[n]
            away = 0.0
            for a in range(3):
                away += (point_m[n, a] - mean_m[g, a]) * normal[g, a]
            kept[n] = abs(away) <= limit_m[g]


@kernel
def correlate(first, second, every, row, column, least, out):
    """Write normalised correlations of two images over a grid of shifts.

    Parameters
    ----------
    first, second : (rows, columns) float64. every : int, every so-manieth cell of a row and of a column of the first is
        used.
    row, column : (a,), (b,) int64, shifts in cells.
    least : int, shifts with fewer cells in common get NaN.
    out : (a, b) float64, out.
    """
    rows, columns = first.shape
    for a in range(row.size):
        for b in range(column.size):
            count, x, y, xx, yy, xy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for r in range(0, rows, every):
                s = r + row[a]
                if not 0 <= s < rows:
                    continue
                for c in range(
                    max(0, -column[b] + every - 1) // every * every, min(columns, columns - column[b]), every
                ):
                    v, w = first[r, c], second[s, c + column[b]]
                    if math.isfinite(v + w):
                        count += 1
                        x += v
                        y += w
                        xx += v * v
                        yy += w * w
                        xy += v * w
            out[a, b] = math.nan
            if count >= least:
                p, q = xx - x * x / count, yy - y * y / count
                if p > 0.0 and q > 0.0:
                    out[a, b] = (xy - x * y / count) / math.sqrt(p * q)


class Laid(NamedTuple):
    """Cell-by-cell figures of the second image aligned with the first, written by `lay_upon`."""

    left: npt.NDArray[np.float64]
    """(rows, columns) first − second; NaN where either was not seen."""
    first_slope: npt.NDArray[np.float64]
    """(rows, columns, 2) by column and by row, per cell."""
    second_slope: npt.NDArray[np.float64]


@kernel
def lay_upon(first, second, down, right, out):
    """Write differences and slopes of two images, the second moved back by (down, right) cells.

    Parameters
    ----------
    first, second : (rows, columns) float64. down, right : float64, shift of the second in rows and columns.
    out : Laid, out.
    """
    rows, columns = first.shape
    kr, kc = math.floor(down), math.floor(right)
    t, s = catmull_rom(down - kr), catmull_rom(right - kc)
    for r in range(rows):
        for c in range(columns):
            out.left[r, c] = math.nan
            inside = 1 <= r < rows - 1 and 1 <= c < columns - 1 and 1 <= r + kr < rows - 2 and 1 <= c + kc < columns - 2
            if not inside:
                continue
            there, across, along = sampled(second, r + kr, c + kc, s, t)
            out.left[r, c] = first[r, c] - there
            out.first_slope[r, c, 0] = 0.5 * (first[r, c + 1] - first[r, c - 1])
            out.first_slope[r, c, 1] = 0.5 * (first[r + 1, c] - first[r - 1, c])
            out.second_slope[r, c, 0] = across
            out.second_slope[r, c, 1] = along
            if not math.isfinite(out.first_slope[r, c, 0] + out.first_slope[r, c, 1]):
                out.left[r, c] = math.nan
