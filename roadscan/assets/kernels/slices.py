"""Horizontal slices of the returns above the ground: occupied cells, and slices above one another."""

from __future__ import annotations

from roadscan.compute.kernel_options import kernel


@kernel
def fill_slices(x, y, above, corner, cell_m, slice_m, counts, cell_of):
    """Count returns into the cells of their slice, and write the flat number of each return's cell (-1: none).

    x, y : (n,) float64, places (m); above : (n,) float32, height above the ground (m), NaN where that is not known;
    corner : (x, y, height) of cell (0, 0, 0); counts : (slices, rows, columns) uint16, saturating; cell_of : (n,)
    int64.
    """
    slices, rows, columns = counts.shape
    for i in range(x.size):
        cell_of[i] = -1
        height = above[i] - corner[2]
        if not height >= 0.0:
            continue
        k = int(height / slice_m)
        u, v = (x[i] - corner[0]) / cell_m, (y[i] - corner[1]) / cell_m
        if k >= slices or u < 0.0 or v < 0.0 or u >= columns or v >= rows:
            continue
        r, c = int(v), int(u)
        if counts[k, r, c] < 65535:
            counts[k, r, c] += 1
        cell_of[i] = (k * rows + r) * columns + c


@kernel
def slices_above_one_another(row, column, level, reach, foot, masks, scores):
    """Write for each component the number of slices with a component within `reach` cells of its middle.

    It is 0 where none of the `foot` lowest slices does.
    row, column, level : (n,) int64 cell of the middle, and slice (0 … 62); masks : (rows, columns) int64, zeroed;
    scores : (n,) int64.
    """
    rows, columns = masks.shape
    for i in range(row.size):
        masks[row[i], column[i]] |= 1 << level[i]
    for i in range(row.size):
        mask = masks[row[i], column[i]]
        for r in range(max(row[i] - reach, 0), min(row[i] + reach + 1, rows)):
            for c in range(max(column[i] - reach, 0), min(column[i] + reach + 1, columns)):
                mask |= masks[r, c]
        ones = 0
        if mask & ((1 << foot) - 1) == 0:
            mask = 0
        while mask != 0:
            mask &= mask - 1
            ones += 1
        scores[i] = ones
