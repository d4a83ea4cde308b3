"""Horizontal slices of the returns above the ground: occupied cells, and connected components of a slice."""

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
def label_slices(counts, cells, labels, boxes, stack):
    """Label the components of all slices, cells that touch, also at corners, within a slice; returns their number.

    cells : (m,) int64 flat numbers of the cells with returns, ascending; labels : (slices, rows, columns) int32,
    zeroed; gets the component's number from 1; boxes : (m, 5) int32, gets slice, first and last row, first and last
    column; stack : (m,) int64, working space.
    """
    _, rows, columns = counts.shape
    found, line, k, r = 0, 0, 0, 0
    for cell in cells:
        while cell - line >= columns:
            line += columns
            r += 1
            if r == rows:
                k, r = k + 1, 0
        c = cell - line
        if labels[k, r, c] != 0:
            continue
        found += 1
        labels[k, r, c] = found
        stack[0] = r << 32 | c
        waiting = 1
        south, north, west, east = r, r, c, c
        while waiting > 0:
            waiting -= 1
            at = stack[waiting]
            row, column = at >> 32, at & 0xFFFFFFFF
            south, north = min(south, row), max(north, row)
            west, east = min(west, column), max(east, column)
            for rr in range(max(row - 1, 0), min(row + 2, rows)):
                for cc in range(max(column - 1, 0), min(column + 2, columns)):
                    if counts[k, rr, cc] != 0 and labels[k, rr, cc] == 0:
                        labels[k, rr, cc] = found
                        stack[waiting] = rr << 32 | cc
                        waiting += 1
        boxes[found - 1, 0] = k
        boxes[found - 1, 1], boxes[found - 1, 2] = south, north
        boxes[found - 1, 3], boxes[found - 1, 4] = west, east
    return found


@kernel
def owners(x, y, cell, labels, number, owner, sums):
    """Fill `owner` (n,) int32, the component of each return, −1 of none, and add up those of each component.

    x, y : (n,) places (m); cell : (n,) as :func:`fill_slices` notes it; labels : (cells,) as :func:`label_slices` fills
    them; number : (labels + 1,) int32, component that a label stands for, −1 of none; sums : (components, 3) float64,
    added to: number, x and y.
    """
    for i in range(cell.size):
        owner[i] = number[labels[cell[i]]] if cell[i] >= 0 else -1
        if owner[i] >= 0:
            sums[owner[i], 0] += 1.0
            sums[owner[i], 1] += x[i]
            sums[owner[i], 2] += y[i]


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
