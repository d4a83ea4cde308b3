"""Computes statistics of a single cell with more heights than the tables for sixteen cells take."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inner
from roadscan.compute.kernels.column_statistics import REACH
from roadscan.tiles.kernels.selection import BINS, bounds_of, smallest

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
