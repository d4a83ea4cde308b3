"""Medians and means of seven cells in a line, and sums over small windows, each over a whole grid.

Every loop runs along a row of a grid with a margin, so that it needs no look at the borders. The order of operations
at a cell is the same whatever the grid around it.
"""

from __future__ import annotations

import numpy as np

from roadscan.kernels.options import inlined, kernel

CELLS = 7
"""Cells of a line, its middle among them."""


@inlined
def put_in_order(a, b):
    """The smaller, the larger."""
    return (a if a < b else b), (b if a < b else a)


@kernel
def median_row(a, b, c, d, e, f, g, absent, median, count):
    """Of each place of seven rows (n,) the median, and how many heights it is of.

    Those below `absent` count. A sorting network of 16 exchanges (Knuth 1998, The Art of Computer Programming 3,
    section 5.3.4) puts the others last. Of an even number the mean of the middle two; `absent` where there is none.
    """
    for j in range(median.size):
        v0, v1, v2, v3, v4, v5, v6 = a[j], b[j], c[j], d[j], e[j], f[j], g[j]
        n = (1.0 if v0 < absent else 0.0) + (1.0 if v6 < absent else 0.0)
        n += (1.0 if v1 < absent else 0.0) + (1.0 if v5 < absent else 0.0)
        n += (1.0 if v2 < absent else 0.0) + (1.0 if v4 < absent else 0.0)
        n += 1.0 if v3 < absent else 0.0
        v0, v6 = put_in_order(v0, v6)
        v2, v3 = put_in_order(v2, v3)
        v4, v5 = put_in_order(v4, v5)
        v0, v2 = put_in_order(v0, v2)
        v1, v4 = put_in_order(v1, v4)
        v3, v6 = put_in_order(v3, v6)
        v0, v1 = put_in_order(v0, v1)
        v2, v5 = put_in_order(v2, v5)
        v3, v4 = put_in_order(v3, v4)
        v1, v2 = put_in_order(v1, v2)
        v4, v6 = put_in_order(v4, v6)
        v2, v3 = put_in_order(v2, v3)
        v4, v5 = put_in_order(v4, v5)
        v1, v2 = put_in_order(v1, v2)
        v3, v4 = put_in_order(v3, v4)
        low = v3 if n > 6.5 else (v2 if n > 4.5 else (v1 if n > 2.5 else v0))
        high = v3 if n > 5.5 else (v2 if n > 3.5 else (v1 if n > 1.5 else v0))
        median[j] = 0.5 * (low + high)
        count[j] = n


@inlined
def row_of_line(values, margin, line, k, i, n):
    """The k-th cells of the lines through the n cells of row i."""
    first = margin + line[k, 1]
    return values[i + margin + line[k, 0], first : first + n]


@kernel
def line_medians(values, margin, line, absent, median, count):
    """Median of the seven cells of a line through each cell.

    Parameters
    ----------
    values : (rows + 2 margin, columns + 2 margin) float64; cells that hold nothing are `absent`, above all others.
    line : (7, 2) int64, rows and columns from the cell, none beyond `margin`.
    median, count : (rows, columns) float64, out; see :func:`median_row`.
    """
    rows, n = median.shape
    for i in range(rows):
        median_row(
            row_of_line(values, margin, line, 0, i, n),
            row_of_line(values, margin, line, 1, i, n),
            row_of_line(values, margin, line, 2, i, n),
            row_of_line(values, margin, line, 3, i, n),
            row_of_line(values, margin, line, 4, i, n),
            row_of_line(values, margin, line, 5, i, n),
            row_of_line(values, margin, line, 6, i, n),
            absent,
            median[i],
            count[i],
        )


@kernel
def mean_row(a, b, c, d, e, f, g, absent, mean):
    """Of each place of seven rows (n,) the mean of the middle one `d` and of the pairs about it; see `line_means`."""
    for j in range(mean.size):
        v = d[j] if d[j] < absent else 0.0
        far, mid, near = max(a[j], g[j]) < absent, max(b[j], f[j]) < absent, max(c[j], e[j]) < absent
        total = (a[j] - v) + (g[j] - v) if far else 0.0
        total += (b[j] - v) + (f[j] - v) if mid else 0.0
        total += (c[j] - v) + (e[j] - v) if near else 0.0
        n = 1.0 + ((2.0 if far else 0.0) + (2.0 if mid else 0.0) + (2.0 if near else 0.0))
        mean[j] = v + total / n if d[j] < absent else absent


@kernel
def line_means(values, margin, line, absent, mean):
    """Mean of the seven cells of a line through each cell; arguments as of :func:`line_medians`.

    A cell counts if its mirror image does, so that the mean of a slope is the slope's height at borders and holes as
    well. What holds nothing has no mean.
    """
    rows, n = mean.shape
    for i in range(rows):
        mean_row(
            row_of_line(values, margin, line, 0, i, n),
            row_of_line(values, margin, line, 1, i, n),
            row_of_line(values, margin, line, 2, i, n),
            row_of_line(values, margin, line, 3, i, n),
            row_of_line(values, margin, line, 4, i, n),
            row_of_line(values, margin, line, 5, i, n),
            row_of_line(values, margin, line, 6, i, n),
            absent,
            mean[i],
        )


@kernel
def judge_row(heights, ground, median, count, least, limit, absent, contrast, misfit):
    """How far medians along a line lie from the ground and from the heights; all (n,), see :func:`judge_lines`."""
    for j in range(misfit.size):
        there = heights[j] < absent
        away = abs(median[j] - ground[j]) * np.sqrt(count[j]) if there & (count[j] >= least) else 0.0
        contrast[j] = max(contrast[j], np.float32(away))
        off = abs(heights[j] - median[j]) if there else 0.0
        misfit[j] = np.float32(min(off, limit))


@kernel
def judge_lines(heights, ground, median, count, least, limit, absent, contrast, misfit):
    """Rate the medians along the lines of one direction.

    Parameters
    ----------
    heights, ground, median, count : (rows, columns) float64.
    least : medians of fewer heights show no contrast; limit : greatest misfit (m).
    contrast : (rows, columns) float32, in/out, the greatest |median − ground| · √count so far (m).
    misfit : (rows, columns) float32, out, |height − median|, 0 where nothing was measured.
    """
    for i in range(misfit.shape[0]):
        judge_row(heights[i], ground[i], median[i], count[i], least, limit, absent, contrast[i], misfit[i])


@kernel
def keep_better(cost, median, least_cost, best):
    """Keep the medians whose cost is less than the least so far; (n,) each, the last two in/out."""
    for j in range(cost.size):
        better = cost[j] < least_cost[j]
        least_cost[j] = cost[j] if better else least_cost[j]
        best[j] = median[j] if better else best[j]


@kernel
def add_row(values, total):
    """Add one row (n,) float32 to another."""
    for j in range(total.size):
        total[j] += values[j]


@kernel
def window_sums(values, half, across, total):
    """Sums over the (2 half + 1)² cells around each cell.

    Parameters
    ----------
    values : (rows + 2 half, columns + 2 half) float32.
    across : (rows + 2 half, columns) float32, zeros, scratch.
    total : (rows, columns) float32, zeros, out.
    """
    rows, n = total.shape
    for i in range(across.shape[0]):
        for k in range(2 * half + 1):
            add_row(values[i, k : k + n], across[i])
    for i in range(rows):
        for k in range(2 * half + 1):
            add_row(across[i + k], total[i])
