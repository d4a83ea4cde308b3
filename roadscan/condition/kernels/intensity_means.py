"""Mean intensities of the road at given places, from the cells in a window along a direction."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import kernel
from roadscan.condition.kernels.sampling import MOST_CELLS, Cells, gather


@kernel
def mean_intensities(table, places, half_along, half_across, out):
    """Compute mean intensities of the cells around places.

    Parameters
    ----------
    table : CellTable; places : (n, 4) float64, easting, northing (m), and the unit vector along the road.
    half_along, half_across : float64, half of a window's extents (m).
    out : (n,) float64, out: mean over the cells of the window that have an intensity; NaN without one.
    """
    room = np.empty((6, MOST_CELLS))
    found = Cells(room[0], room[1], room[2], room[3], room[4], room[5], np.empty(MOST_CELLS, np.int64))
    window = 4.0 * half_along * half_across / (table.cell[0] * table.cell[1])
    stride = max(math.ceil(math.sqrt(window / (0.9 * MOST_CELLS))), 1)
    for i in range(len(places)):
        count = gather(table, places[i], half_along, half_across, stride, found)
        total, lit = 0.0, 0.0
        for k in range(count):
            value = table.intensity[found.at[k]]
            if not np.isnan(value):
                total += value
                lit += 1.0
        out[i] = total / lit if lit > 0.0 else np.nan
