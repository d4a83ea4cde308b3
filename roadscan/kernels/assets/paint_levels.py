"""The brightness of the surface around each place, whatever is painted on it."""

from __future__ import annotations

import numpy as np

from roadscan.kernels.options import kernel

MOST_OF_A_CELL = 16
"""Readings of a cell that are looked at; of more, every so-manieth."""
FEWEST = 12
_LOW, _MIDDLE = 0.05, 0.35
_NORMAL_BETWEEN = 1.2595
"""Standard deviations between the quantiles 0.05 and 0.35 of a normal distribution."""


@kernel
def paint_levels(value, first, half, level, upper):
    """Median and upper bound of the unpainted surface around each cell of a raster.

    Up to half of a neighbourhood may be painted: what lies far above its lower third, in units of the spread below
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
