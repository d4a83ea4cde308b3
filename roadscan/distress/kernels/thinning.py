"""Thinning of a set of cells to lines, one layer a pass."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inner, kernel


@inner
def neighbour_bits(cells, i, j):
    """Returns the eight neighbours of a cell as bits: north is bit 0, then clockwise (rows grow to the south here)."""
    return (
        int(cells[i - 1, j])
        | int(cells[i - 1, j + 1]) << 1
        | int(cells[i, j + 1]) << 2
        | int(cells[i + 1, j + 1]) << 3
        | int(cells[i + 1, j]) << 4
        | int(cells[i + 1, j - 1]) << 5
        | int(cells[i, j - 1]) << 6
        | int(cells[i - 1, j - 1]) << 7
    )


@kernel
def thin(cells, row, column, deletable, passes):
    """Remove deletable cells, all at once in each half of a pass.

    Parameters
    ----------
    cells : (rows, columns) uint8, 1 in the set, changed; none at the grid's border.
    row, column : (n,) int64, the cells of the set.
    deletable : (2, 256) uint8, 1 where a cell with these neighbours goes, by half of the pass.
    passes : how many; a cell depends on others at most 2 `passes` away.
    """
    goes = np.empty(row.size, np.uint8)
    left = row.size
    for step in range(2 * passes):
        for k in range(left):
            goes[k] = deletable[step % 2, neighbour_bits(cells, row[k], column[k])]
        kept = 0
        for k in range(left):
            if goes[k]:
                cells[row[k], column[k]] = 0
            else:
                row[kept], column[kept] = row[k], column[k]
                kept += 1
        left = kept
