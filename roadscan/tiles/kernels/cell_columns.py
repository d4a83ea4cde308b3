"""The statistics of a tile's cells as columns, and those of a single cell with very many heights."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare, bare_inlined, bare_inner
from roadscan.compute.kernels.column_statistics import REACH
from roadscan.tiles.kernels.selection import BINS, bounds_of, smallest


class CellColumns(NamedTuple):
    """Columns for c cells with a reading, in order of row and column, of up to p passes each."""

    column: npt.NDArray[np.uint16]
    """(c,) in the tile."""
    row: npt.NDArray[np.uint16]
    """(c,)"""
    readings: npt.NDArray[np.uint32]
    """(c,)"""
    height_mean_m: npt.NDArray[np.float64]
    """(c,)"""
    height_robust_m: npt.NDArray[np.float64]
    """(c,) mean of the heights near the median."""
    height_min_m: npt.NDArray[np.float64]
    """(c,)"""
    height_max_m: npt.NDArray[np.float64]
    """(c,)"""
    height_std_m: npt.NDArray[np.float32]
    """(c,)"""
    intensity_mean: npt.NDArray[np.float32]
    """(c,)"""
    pass_offsets: npt.NDArray[np.int32]
    """(c + 1,) first pass of each cell, and the end."""
    pass_ids: npt.NDArray[np.uint16]
    """(c · p,) ids of each cell's passes, ascending."""


@bare_inlined
def write_statistics(out, lane, cell, columns):
    """Write a lane of `out`, see ``column_statistics.statistics_of``, as the statistics of a cell."""
    columns.height_mean_m[cell], columns.height_robust_m[cell] = out[0, lane], out[1, lane]
    columns.height_min_m[cell], columns.height_max_m[cell] = out[2, lane], out[3, lane]
    columns.height_std_m[cell], columns.intensity_mean[cell] = np.float32(out[4, lane]), np.float32(out[5, lane])


_MEAN, _ROBUST, _LOW, _HIGH, _DEVIATION, _BRIGHT = range(6)  # Rows of the statistics.


def select_arrays(most: int) -> tuple[Any, ...]:
    """Return the working arrays of `statistics_of_full`; `most`: heights that a cell may have."""
    return np.empty(most, np.int32), np.empty(BINS, np.int32), np.empty(most + 1, np.int32)


@bare
def differences(heights, base, out):
    """Write heights (n,) int32 relative to a base into out (≥ n,) int32."""
    for k in range(heights.size):
        out[k] = heights[k] - base


@bare
def distances(heights, middle, out):
    """Write distances of heights (n,) int32 from another into out (≥ n,) int32."""
    for k in range(heights.size):
        out[k] = abs(heights[k] - middle)


@bare_inner
def sums_of(heights, middle, reach):
    """Return sum and sum of squares of (n,) int32 less a middle, number within reach, and their sum."""
    total, squares, used, near = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for k in range(heights.size):
        d = np.int64(heights[k]) - middle
        inside = np.int64((d <= reach) & (d >= -reach))
        total += d
        squares += d * d
        used += inside
        near += d * inside
    return total, squares, used, near


@bare
def statistics_of_full(heights, light, floor, quantum_m, select, out, lane):
    """Write the statistics of one cell of n readings, as ``column_statistics.statistics_of``, into out[:, lane].

    heights : (n,) int32; light : int64, sum of intensities; select : work, see :func:`select_arrays`.
    """
    work, bins, found = select
    n, base = heights.size, heights[0]
    differences(heights, base, work)
    median = smallest(work[:n], (n - 1) // 2, bins, found)
    middle = np.int64(base) + median
    distances(heights, np.int32(middle), work)
    low, high = bounds_of(heights)
    reach = np.int64(math.floor(max(REACH * smallest(work[:n], (n - 1) // 2, bins, found), floor)))
    total, squares, used, near = sums_of(heights, middle, reach)
    average = total / n
    out[_MEAN, lane] = (middle + average) * quantum_m
    out[_ROBUST, lane] = (middle + near / used) * quantum_m
    out[_LOW, lane] = low * quantum_m
    out[_HIGH, lane] = high * quantum_m
    out[_DEVIATION, lane] = math.sqrt(max(squares / n - average * average, 0.0)) * quantum_m
    out[_BRIGHT, lane] = light / n
