"""Lowest returns of the cells of a grid, and their number."""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import kernel


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
