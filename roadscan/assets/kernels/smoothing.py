"""Weighted and plain means of the surroundings of each cell of a raster, row by row in vector registers."""

from __future__ import annotations

from roadscan.compute.kernel_options import bare, bare_inlined


@bare_inlined
def scaled(value, factor, out):
    """Numbers times a factor."""
    for i in range(out.size):
        out[i] = value[i] * factor


@bare_inlined
def add_pairs(before, after, weight, out):
    """Add sums of two rows by a weight."""
    for i in range(out.size):
        out[i] += (before[i] + after[i]) * weight


@bare_inlined
def mirrored(at, size):
    """Returns the index of a row beyond the ends, which are mirrored."""
    at %= 2 * size
    return at if at < size else 2 * size - 1 - at


@bare
def convolve(value, weights, line, between, out):
    """Fill `out` (rows, columns) with sums of the surroundings by weight; the raster is mirrored at its edges.

    weights : (k + 1,) of the cell itself and of those up to k cells away, the same on both sides, and along rows and
    columns. line : (columns + 2 k,) and between : (rows, columns) are working space. Sums begin with the middle and go
    on from the farthest cells inwards.
    """
    rows, columns = value.shape
    most = weights.size - 1
    for row in range(rows):
        scaled(value[row], weights[0], between[row])
        for k in range(most, 0, -1):
            add_pairs(value[mirrored(row - k, rows)], value[mirrored(row + k, rows)], weights[k], between[row])
    for row in range(rows):
        for i in range(columns):
            line[most + i] = between[row, i]
        for i in range(most):
            line[i] = between[row, mirrored(i - most, columns)]
            line[most + columns + i] = between[row, mirrored(columns + i, columns)]
        scaled(line[most : most + columns], weights[0], out[row])
        for k in range(most, 0, -1):
            add_pairs(line[most - k : most - k + columns], line[most + k : most + k + columns], weights[k], out[row])


@bare_inlined
def add_row(value, total):
    """Add a row of numbers to another one."""
    for i in range(total.size):
        total[i] += value[i]


@bare_inlined
def moved(entering, leaving, total):
    """Advance sums of rows by one row."""
    for i in range(total.size):
        total[i] += entering[i] - leaving[i]


@bare_inlined
def divided(total, size, out):
    """Divide sums to means."""
    for i in range(out.size):
        out[i] = total[i] / size


@bare
def window_means(value, size, wanted, between, line, out):
    """Fill `out` (rows, columns) with the means of squares of `size` by `size` cells, zeros beyond the raster.

    wanted : (first, end) rows that are filled. The square reaches from size // 2 cells before a cell. between : (rows +
    2, columns), its last row zeros, and line : (columns + size,), zeros, are working space. Sums run along columns,
    then along rows.
    """
    rows, columns = value.shape
    before = size // 2
    after = size - before - 1
    total, nothing = between[rows], between[rows + 1]
    for i in range(columns):
        total[i] = 0.0
    for row in range(min(after + 1, rows)):
        add_row(value[row], total)
    if wanted[0] == 0:
        divided(total, float(size), between[0])
    for row in range(1, wanted[1]):
        entering = value[row + after] if row + after < rows else nothing
        leaving = value[row - before - 1] if row - before - 1 >= 0 else nothing
        moved(entering, leaving, total)
        if row >= wanted[0]:
            divided(total, float(size), between[row])
    for row in range(wanted[0], wanted[1]):
        for i in range(columns):
            line[before + i] = between[row, i]
        here = 0.0
        for i in range(size):
            here += line[i]
        out[row, 0] = here / float(size)
        for i in range(1, columns):
            here += line[i + size - 1] - line[i - 1]
            out[row, i] = here / float(size)
