"""Crack response: depth of lines of cells below their flanks, in whole numbers, so that order does not matter.

A set of cells that respond is thinned to lines.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inner, kernel


@kernel
def add_row(total, row):
    """Compute total += row; both (n,) int32."""
    for j in range(total.size):
        total[j] += row[j]


@kernel
def line_sums(heights, line, out):
    """Sum the heights along a line through each cell.

    heights : (rows, columns) int32; line : (k, 2) int64, rows and columns from the cell, at most m away; out : (rows -
    2 m, columns - 2 m) int32, the cells that are m or more from the border.
    """
    rows, n = out.shape
    margin = (heights.shape[0] - rows) // 2
    for i in range(rows):
        own = out[i]
        own[:] = 0
        for k in range(line.shape[0]):
            first = margin + line[k, 1]
            add_row(own, heights[i + margin + line[k, 0], first : first + n])


@inner
def deepen_row(middle, left, right, far_left, far_right, most, code, depth, which):
    """Store the depth of the middle below its lower flank, and its code, where it is the deepest so far.

    A flank counts as high as it is on the straight line from three times as far to the middle, but at most `most` lower
    than it is. All arrays (n,) int32.
    """
    for j in range(depth.size):
        on_left = left[j] - min(max((far_left[j] - left[j]) >> 1, 0), most)
        on_right = right[j] - min(max((far_right[j] - right[j]) >> 1, 0), most)
        d = min(on_left, on_right) - middle[j]
        deeper = d > depth[j]
        depth[j] = d if deeper else depth[j]
        which[j] = code if deeper else which[j]


@inner
def bend_row(middle, left, right, bend):
    """Compute bend += |left + right - 2 middle|; all (n,) int32."""
    for j in range(bend.size):
        bend[j] += abs(left[j] + right[j] - 2 * middle[j])


@kernel
def deepen(sums, away, most, code, depth, which):
    """Apply :func:`deepen_row` to a grid.

    sums : (rows + 2 m, columns + 2 m) int32; away : (2, 2) int64, rows and columns to the right flank and three times
    as far, at most m; most, code : int32; depth, which : (rows, columns) int32.
    """
    rows, n = depth.shape
    margin = (sums.shape[0] - rows) // 2
    for i in range(rows):
        k = i + margin
        deepen_row(
            sums[k, margin : margin + n],
            sums[k - away[0, 0], margin - away[0, 1] : margin - away[0, 1] + n],
            sums[k + away[0, 0], margin + away[0, 1] : margin + away[0, 1] + n],
            sums[k - away[1, 0], margin - away[1, 1] : margin - away[1, 1] + n],
            sums[k + away[1, 0], margin + away[1, 1] : margin + away[1, 1] + n],
            most, code, depth[i], which[i],
        )  # fmt: skip


@kernel
def add_bend(sums, away, bend):
    """Apply :func:`bend_row` to a grid; arguments as for :func:`deepen`, bend : (rows, columns) int32."""
    rows, n = bend.shape
    margin = (sums.shape[0] - rows) // 2
    up, east = away[0], away[1]
    for i in range(rows):
        k = i + margin
        bend_row(
            sums[k, margin : margin + n],
            sums[k - up, margin - east : margin - east + n],
            sums[k + up, margin + east : margin + east + n],
            bend[i],
        )  # fmt: skip


@kernel
def fill_holes(heights, row, column, passes):
    """Fill holes from their border inwards, one ring of cells a pass, with the mean of the neighbours known before.

    heights : (rows, columns) float64, NaN in holes, changed; row, column : (n,) int64, the cells to fill, none at the
    grid's border.
    """
    left = row.size
    found = np.empty(left)
    for _ in range(passes):
        for k in range(left):
            total, count = 0.0, 0.0
            for i in range(row[k] - 1, row[k] + 2):
                for j in range(column[k] - 1, column[k] + 2):
                    z = heights[i, j]
                    known = not math.isnan(z)
                    total += z if known else 0.0
                    count += 1.0 if known else 0.0
            found[k] = total / count if count > 0.0 else np.nan
        kept = 0
        for k in range(left):
            if not math.isnan(found[k]):
                heights[row[k], column[k]] = found[k]
            else:
                row[kept], column[kept] = row[k], column[k]
                kept += 1
        left = kept


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
