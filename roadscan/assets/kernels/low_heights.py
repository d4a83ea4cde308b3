"""Robust low height of cells: the mean of the returns near the lowest one."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel


@kernel
def low_heights(cell, z_m, used, depth_m, count, mean_m, variance_m2):
    """Fill (cells,) `count`, `mean_m` and `variance_m2` of the returns that lie lowest in each cell.

    cell : (n,) number of each return's cell, −1 of none. z_m : (n,) heights (m). used : (n,) returns that are looked
    at; then those among them up to `depth_m` above their cell's mean. depth_m : returns up to this above the lowest of
    the cell count. Cells without a return keep 0 returns.
    """
    lowest = np.full(count.size, np.inf)
    for i in range(z_m.size):
        if cell[i] < 0:
            used[i] = False
        if used[i] and z_m[i] < lowest[cell[i]]:
            lowest[cell[i]] = z_m[i]
    for i in range(z_m.size):
        if used[i]:
            at = cell[i]
            above = z_m[i] - lowest[at]
            if above <= depth_m:
                count[at] += 1
                mean_m[at] += above
                variance_m2[at] += above * above
    for at in range(count.size):
        n = count[at]
        if n > 0:
            mean = mean_m[at] / n
            variance_m2[at] = max(variance_m2[at] / n - mean * mean, 0.0)
            mean_m[at] = lowest[at] + mean
    for i in range(z_m.size):
        used[i] = used[i] and z_m[i] <= mean_m[cell[i]] + depth_m
