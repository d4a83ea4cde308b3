"""Readings near a place as cells in the axes of the road: heights that outliers do not move, and their spread."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.kernels.options import kernel

MOST = 32
"""Readings of a cell that its height comes from; an even choice where there are more."""
QUARTILES_OF_SIGMA = 1.349
"""Distance of the quartiles of a normal distribution, in σ."""


class Frame(NamedTuple):
    """Square of cells around a place."""

    easting_m: float
    """Centre, map."""
    northing_m: float
    sine: float
    """Of the heading of the axis along, clockwise from grid north."""
    cosine: float
    half_m: float
    """Half the edge."""
    cell_m: float


class Cells(NamedTuple):
    """Cells (along, across) of a patch, written by `fill_cells`."""

    height_m: npt.NDArray[np.float64]
    """Mean of the middle half of the heights; NaN in cells with too few."""
    spread_m: npt.NDArray[np.float64]
    """1 σ of one reading about it, from the quartiles."""
    used: npt.NDArray[np.int32]
    """Readings that the height comes from."""
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
