"""Robust low height of cells: the mean of the returns that lie near the lowest one."""

from __future__ import annotations

import numpy as np

from roadscan.kernels.options import kernel


@kernel
def low_heights(x_m, y_m, z_m, grid, depth_m, count, mean_m, variance_m2):
    """Fill (rows, columns) `count`, `mean_m` and `variance_m2` of the returns that lie lowest in each cell.

    x_m, y_m, z_m : (n,) returns (m). grid : (x_min_m, y_min_m, cell_m). depth_m : returns up to this above the lowest
    of the cell count. Cells without a return keep 0 returns.
    """
    rows, columns = count.shape
    lowest = np.full((rows, columns), np.inf)
    for i in range(x_m.size):
        column, row = int(np.floor((x_m[i] - grid[0]) / grid[2])), int(np.floor((y_m[i] - grid[1]) / grid[2]))
        if 0 <= row < rows and 0 <= column < columns and z_m[i] < lowest[row, column]:
            lowest[row, column] = z_m[i]
    for i in range(x_m.size):
        column, row = int(np.floor((x_m[i] - grid[0]) / grid[2])), int(np.floor((y_m[i] - grid[1]) / grid[2]))
        if 0 <= row < rows and 0 <= column < columns:
            above = z_m[i] - lowest[row, column]
            if above <= depth_m:
                count[row, column] += 1
                mean_m[row, column] += above
                variance_m2[row, column] += above * above
    for row in range(rows):
        for column in range(columns):
            n = count[row, column]
            if n > 0:
                mean = mean_m[row, column] / n
                variance_m2[row, column] = max(variance_m2[row, column] / n - mean * mean, 0.0)
                mean_m[row, column] = lowest[row, column] + mean
