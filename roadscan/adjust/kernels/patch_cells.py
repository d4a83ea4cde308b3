"""Readings near a place as cells in the axes of the road: robust heights, and their spread."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import kernel

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
