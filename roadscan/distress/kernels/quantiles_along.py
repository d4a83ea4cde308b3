"""Running quantiles of the values of a line's cells."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inner, kernel
from roadscan.compute.kernels.arrays import sort_few

HALF_ALONG = 10
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
    near = np.empty((2 * HALF_ALONG + 1) ** 2)
    for n in range(row.size):
        i, j, count = row[n], column[n], 0
        for a in range(max(i - HALF_ALONG, 0), min(i + HALF_ALONG + 1, number.shape[0])):
            for b in range(max(j - HALF_ALONG, 0), min(j + HALF_ALONG + 1, number.shape[1])):
                k = number[a, b]
                if k >= 0 and not math.isnan(values[k]) and abs((b - j) * north[n] - (a - i) * east[n]) <= _HALF_ASIDE:
                    near[count] = values[k]
                    count += 1
        out[n] = quantile_of(near, count, level[n])
