"""Heights of single cells over several supports, and the support of least risk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, kernel

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
