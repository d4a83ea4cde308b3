"""Medians and means of seven cells in a line, and sums over small windows, each over a whole grid.

Every loop runs along a row of a grid with a margin, so that it needs no border checks. The order of operations
at a cell is the same whatever the grid around it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, inner, kernel

CELLS = 7
"""Cells of a line, including its middle."""


@inlined
def put_in_order(a, b):
    """Returns the smaller, then the larger."""
    return (a if a < b else b), (b if a < b else a)


@inlined
def middle_two(v0, v1, v2, v3, v4, v5, v6, absent):
    """Returns the middle two of up to seven heights, and their number; of an odd number the median twice.

    Those below `absent` count. A sorting network of 16 exchanges (Knuth 1998, The Art of Computer Programming 3,
    section 5.3.4) puts the others last. `absent` where there is none.
    """
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
    return low, high, n


@inner
def median_row(a, b, c, d, e, f, g, absent, median, count, own):
    """Compute for each place of seven rows (n,) the median, the number of its heights, and the share of `d` in it.

    Of an even number the median is the mean of the middle two; `absent` where there is none.
    """
    for j in range(median.size):
        low, high, n = middle_two(a[j], b[j], c[j], d[j], e[j], f[j], g[j], absent)
        median[j] = 0.5 * (low + high)
        count[j] = n
        own[j] = np.float32((0.5 if d[j] == low else 0.0) + (0.5 if d[j] == high else 0.0))


@inlined
def or_mirrored(value, opposite, middle, absent):
    """Returns the value, or if absent, its extrapolation from the opposite and the middle one."""
    return value if value < absent else (2.0 * middle - opposite if opposite < absent else absent)


@inner
def mirrored_median_row(a, b, c, d, e, f, g, middle, absent, median):
    """Apply :func:`median_row`, with mirrored heights where one side has two heights fewer than the other.

    So the median at a border is not biased on a slope. Where heights miss here and there, none is mirrored: in a
    crack, a mirrored height would lie far below it.

    middle : (n,) float64, a height of the place itself or `absent`; see :func:`or_mirrored`.
    """
    for j in range(median.size):
        m = middle[j]
        before = (1 if a[j] < absent else 0) + (1 if b[j] < absent else 0) + (1 if c[j] < absent else 0)
        after = (1 if e[j] < absent else 0) + (1 if f[j] < absent else 0) + (1 if g[j] < absent else 0)
        mirror = (abs(before - after) > 1) & (m < absent)
        low, high, _ = middle_two(
            or_mirrored(a[j], g[j], m, absent) if mirror else a[j],
            or_mirrored(b[j], f[j], m, absent) if mirror else b[j],
            or_mirrored(c[j], e[j], m, absent) if mirror else c[j],
            d[j],
            or_mirrored(e[j], c[j], m, absent) if mirror else e[j],
            or_mirrored(f[j], b[j], m, absent) if mirror else f[j],
            or_mirrored(g[j], a[j], m, absent) if mirror else g[j],
            absent,
        )
        median[j] = 0.5 * (low + high)


@inlined
def row_of_line(values, margin, line, k, i, n):
    """Returns the k-th cells of the lines through the n cells of row i."""
    first = margin + line[k, 1]
    return values[i + margin + line[k, 0], first : first + n]


@inlined
def rows_of_line(values, margin, line, i, n):
    """Returns the seven cells of these lines, a row (n,) each."""
    return (
        row_of_line(values, margin, line, 0, i, n),
        row_of_line(values, margin, line, 1, i, n),
        row_of_line(values, margin, line, 2, i, n),
        row_of_line(values, margin, line, 3, i, n),
        row_of_line(values, margin, line, 4, i, n),
        row_of_line(values, margin, line, 5, i, n),
        row_of_line(values, margin, line, 6, i, n),
    )


@kernel
def line_medians(values, margin, line, absent, median, count, own):
    """Compute the median of the seven cells of a line through each cell.

    Parameters
    ----------
    values : (rows + 2 margin, columns + 2 margin) float64; empty cells are `absent`, above all others.
    line : (7, 2) int64, rows and columns from the cell, none beyond `margin`.
    median, count : (rows, columns) float64, out; own : the same, float32, out; see :func:`median_row`.
    """
    rows, n = median.shape
    for i in range(rows):
        median_row(
            *rows_of_line(values, margin, line, i, n),
            absent,
            median[i],
            count[i],
            own[i],
        )


@kernel
def mirrored_line_medians(values, margin, line, middle, absent, median):
    """Compute the same without bias at borders and holes of a slope; see :func:`mirrored_median_row`.

    middle : (rows, columns) float64, a height of the cell itself; the others as of :func:`line_medians`.
    """
    rows, n = median.shape
    for i in range(rows):
        mirrored_median_row(
            *rows_of_line(values, margin, line, i, n),
            middle[i],
            absent,
            median[i],
        )


@inner
def mean_row(a, b, c, d, e, f, g, absent, mean):
    """Compute for each place of seven rows (n,) the mean of the middle one `d` and of the pairs about it."""
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
    """Compute the mean of the seven cells of a line through each cell; arguments as of :func:`line_medians`.

    A cell counts if its mirror image does, so that the mean of a slope is the slope's height at borders and holes as
    well. Empty cells have no mean.
    """
    rows, n = mean.shape
    for i in range(rows):
        mean_row(
            *rows_of_line(values, margin, line, i, n),
            absent,
            mean[i],
        )


@inner
def judge_row(heights, ground, median, count, own, least, sigma, limit, absent, contrast, risk):
    """Compute the distance of medians along a line from ground and heights; all (n,), see :func:`judge_lines`."""
    for j in range(risk.size):
        there = heights[j] < absent
        away = abs(median[j] - ground[j]) * np.sqrt(count[j]) if there & (count[j] >= least) else 0.0
        contrast[j] = max(contrast[j], np.float32(away))
        off = min(abs(heights[j] - median[j]) / sigma, limit) if there else 0.0
        risk[j] = np.float32(off * off + 2.0 * own[j]) if there else np.float32(0.0)


@kernel
def judge_lines(heights, ground, median, count, own, least, sigma, limit, absent, contrast, risk):
    """Compute contrast and risk of the medians along the lines of one direction.

    Parameters
    ----------
    heights, ground, median, count : (rows, columns) float64; own : the same, float32.
    least : medians of fewer heights show no contrast; sigma : 1 σ of a height (m); limit : greatest misfit (σ).
    contrast : (rows, columns) float32, in/out, the greatest |median − ground| · √count so far (m).
    risk : (rows, columns) float32, out, misfit² + 2 · own in σ², 0 where nothing was measured: but for a constant, the
        squared error that is to be expected (Stein 1981, "Estimation of the mean of a multivariate normal
        distribution", Annals of Statistics 9, 1135–1151).
    """
    for i in range(risk.shape[0]):
        judge_row(heights[i], ground[i], median[i], count[i], own[i], least, sigma, limit, absent, contrast[i], risk[i])


@kernel
def keep_better(risk, median, own, direction, least_risk, best, best_own, best_direction):
    """Store the medians whose risk is less than the least so far; (n,) each, the last four in/out."""
    for j in range(risk.size):
        better = risk[j] < least_risk[j]
        least_risk[j] = risk[j] if better else least_risk[j]
        best[j] = median[j] if better else best[j]
        best_own[j] = own[j] if better else best_own[j]
        best_direction[j] = direction if better else best_direction[j]


@kernel
def add_row(values, total):
    """Add one row (n,) float32 to another."""
    for j in range(total.size):
        total[j] += values[j]


@kernel
def window_sums(values, half, across, total):
    """Compute sums over the (2 half + 1)² cells around each cell.

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


SUPPORTS = 6
"""Supports: median of seven along the line, means of 3 and 13 along it, paraboloids of 7 × 7 and 9 × 9, a strip."""


class CrackCells(NamedTuple):
    """Cells whose heights are fitted."""

    row: npt.NDArray[np.int64]
    """(n,) in the grid without margin."""
    column: npt.NDArray[np.int64]
    """(n,)"""
    middle_m: npt.NDArray[np.float64]
    """(n,) median height along the cell's line."""
    own_of_middle: npt.NDArray[np.floating]
    """(n,) share of the cell itself in that median."""
    direction: npt.NDArray[np.uint8]
    """(n,) of the line."""


class Shapes(NamedTuple):
    """Cells of the supports, as steps of (rows, columns) from the middle."""

    lines: npt.NDArray[np.int64]
    """(directions, 6, 2) one half of each line, from the nearest."""
    pairs: npt.NDArray[np.int64]
    """(40, 2) one cell of each pair of 9 × 9, the nearest squares first."""


@inlined
def along_line(heights, i, j, line, first, last, middle, absent, total, n):
    """Sum over the pairs `first` to `last` of a line, less the middle, and their number, added to those before."""
    for k in range(first, last):
        a, b = heights[i + line[k, 0], j + line[k, 1]], heights[i - line[k, 0], j - line[k, 1]]
        whole = max(a, b) < absent
        total += (a - middle) + (b - middle) if whole else 0.0
        n += 2.0 if whole else 0.0
    return total, n


@inlined
def with_pairs(heights, i, j, pairs, first, last, middle, absent, sums):
    """Sums of height less the middle, of that times squared distance, of cells, squared distances and their squares.

    Over the pairs `first` to `last`, added to the `sums` of those before, a tuple.
    """
    total, curved, n, r, rr = sums
    for k in range(first, last):
        down, right = pairs[k, 0], pairs[k, 1]
        a, b = heights[i + down, j + right], heights[i - down, j - right]
        squared = float(down * down + right * right)
        whole = max(a, b) < absent
        both = (a - middle) + (b - middle) if whole else 0.0
        weight = 2.0 if whole else 0.0
        total += both
        curved += both * squared
        n += weight
        r += weight * squared
        rr += weight * squared * squared
    return total, curved, n, r, rr


@kernel
def heights_by_support(heights, margin, cells, choice, shapes, absent, off, own):
    """Fit the heights around each cell over each support.

    A cell counts only together with its mirror image about the middle, so that a slope has no effect. Of a paraboloid
    only its height and the sum of its curvatures remain to be estimated. Where less than half of a support
    counts, the fit is the middle.

    Parameters
    ----------
    heights : (rows + 2 margin, columns + 2 margin) float64, `absent` where nothing was measured, without outliers.
    cells : CrackCells; shapes : Shapes.
    choice : share more in what lies along the line, because its direction was chosen by the same heights.
    off : (n, 6) float32, out but for the strip's, height less `middle`; own : the same, the share of the cell itself.
    """
    row, column, middle, own_of_middle, direction = cells
    lines, pairs = shapes
    for t in range(row.size):
        i, j, z, line = margin + row[t], margin + column[t], middle[t], lines[direction[t]]
        least = own_of_middle[t] + choice
        off[t, 0], own[t, 0] = 0.0, least
        total, n = along_line(heights, i, j, line, 0, 1, z, absent, heights[i, j] - z, 1.0)
        off[t, 1], own[t, 1] = total / n, 1.0 / n + (choice if n > 1.0 else 0.0)
        total, n = along_line(heights, i, j, line, 1, line.shape[0], z, absent, total, n)
        off[t, 2], own[t, 2] = (total / n, 1.0 / n + choice) if n > line.shape[0] else (0.0, least)
        sums = (heights[i, j] - z, 0.0, 1.0, 0.0, 0.0)
        first = 0
        for k in range(2):
            last = 24 + 16 * k
            sums = with_pairs(heights, i, j, pairs, first, last, z, absent, sums)
            total, curved, n, r, rr = sums
            first = last
            enough = n > last
            scale = n * rr - r * r if enough else 1.0
            off[t, 3 + k] = (rr * total - r * curved) / scale if enough else 0.0
            own[t, 3 + k] = rr / scale if enough else least


@kernel
def least_risk(row, column, number, height, off, own, sigma, limit, chosen):
    """Choose at each cell the support of least risk, summed over those of the 49 cells around that are cells as well.

    Risk is misfit² + 2 · own in σ², as of ``judge_lines``; for a linear fit Mallows' Cp (Mallows 1973, "Some comments
    on Cp", Technometrics 15, 661–675).

    Parameters
    ----------
    row, column : (n,) int64; number : (rows + 6, columns + 6) int32, which cell lies there, −1 for none, three cells
        more at each end.
    height : (n,) float64, less the middle (m); off, own : (n, 6) float32, `own` is overwritten.
    sigma : 1 σ of a height (m); limit : greatest misfit (σ).
    chosen : (n,) float32, out, of `off` that of the support chosen.
    """
    for t in range(row.size):
        for k in range(SUPPORTS):
            misfit = min(abs(height[t] - off[t, k]) / sigma, limit)
            own[t, k] = np.float32(misfit * misfit + 2.0 * own[t, k])
    risk = np.empty(SUPPORTS, np.float32)
    for t in range(row.size):
        risk[:] = 0.0
        for i in range(row[t], row[t] + 7):
            for j in range(column[t], column[t] + 7):
                near = number[i, j]
                if near >= 0:
                    for k in range(SUPPORTS):
                        risk[k] += own[near, k]
        best = 0
        for k in range(1, SUPPORTS):
            best = k if risk[k] < risk[best] else best
        chosen[t] = off[t, best]
