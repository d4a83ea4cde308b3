"""Two images of one place shifted against each other: their correlation, and their difference when aligned.

Pictures are arrays (rows, columns) with NaN where nothing was seen. A cell (r, c) of the first lies at (r + dr, c + dc)
of the second.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.calibrate.kernels.surface_patches import catmull_rom, sampled
from roadscan.compute.kernel_options import kernel


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
