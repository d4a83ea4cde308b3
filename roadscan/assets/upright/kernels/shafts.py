"""Components of slices along a straight axis, and the widths of their slices."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel
from roadscan.compute.kernels.sorted_quantile import sorted_quantile

REACHES_M = (0.3, 0.2, 0.15)
"""Components this near to the axis (m) belong to it, round after round."""


@inlined
def _slope(t, v):
    """Returns the slope of v (n,) over t (n,), whose mean is 0."""
    mean, total, squares = v.mean(), 0.0, 0.0
    for k in range(t.size):
        total += t[k] * (v[k] - mean)
        squares += t[k] * t[k]
    return total / max(squares, 1e-9)


@inlined
def _distinct(level):
    """Returns how many numbers occur in level (n,)."""
    held = np.sort(level)
    found = 1 if held.size else 0
    for k in range(1, held.size):
        found += 1 if held[k] != held[k - 1] else 0
    return found


@kernel
def near_axis(x, y, level, seed, most_lean, kept):
    """Compute which components lie near the straight axis through most of them: kept (n,) bool.

    x, y : (n,) places (m); level : (n,) int64 number of the slice; seed : (2,) place of one (m); most_lean : greatest
    shift of the axis from slice to slice, in x and y each (m).
    """
    kept[:] = True
    ax, ay, bx, by = seed[0], seed[1], 0.0, 0.0
    for reach in REACHES_M:
        own = level[kept].astype(np.float64)
        if own.size == 0:
            return
        middle = own.mean()
        if _distinct(own) >= 4:
            bx = min(max(_slope(own - middle, x[kept]), -most_lean), most_lean)
            by = min(max(_slope(own - middle, y[kept]), -most_lean), most_lean)
        ax = np.median(x[kept] - bx * (own - middle))
        ay = np.median(y[kept] - by * (own - middle))
        for k in range(x.size):
            past = level[k] - middle
            kept[k] = math.hypot(x[k] - ax - bx * past, y[k] - ay - by * past) <= reach


@kernel
def longest_run(level, gap, least, kept):
    """Keep of the kept components (n,) those in the run of levels with the most; the lower run where equal.

    level : (n,) int64; gap : greatest step from a level to the next of a run; least : shorter runs keep none.
    """
    held = np.unique(level[kept])
    best, first, begin = 0, 0, 0
    for k in range(held.size + 1):
        if k == held.size or (k > 0 and held[k] - held[k - 1] > gap):
            if k - begin > best:
                best, first = k - begin, begin
            begin = k
    for i in range(level.size):
        kept[i] = kept[i] and best >= least and held[first] <= level[i] <= held[first + best - 1]


@kernel
def widths_of_levels(xyh, level, least, shares, widths):
    """Compute the diagonal of the box about the middle returns of each level: widths (levels,); unset of too few.

    xyh : (n, 3) returns (m); level : (n,) int64; least : number of returns; shares : (2,) of those below the box and
    below its end, along x and y each.
    """
    order = np.argsort(level, kind="mergesort")
    first = 0
    while first < order.size:
        end = first + 1
        while end < order.size and level[order[end]] == level[order[first]]:
            end += 1
        if end - first >= least:
            x, y = np.sort(xyh[order[first:end], 0]), np.sort(xyh[order[first:end], 1])
            across = sorted_quantile(x, shares[1]) - sorted_quantile(x, shares[0])
            widths[level[order[first]]] = math.hypot(
                across, sorted_quantile(y, shares[1]) - sorted_quantile(y, shares[0])
            )
        first = end


@kernel
def returns_about(counts, level, cell_m, reach_m):
    """Returns the number of returns in cells within reach of the middle one, in some slices.

    counts : (slices, rows, columns) returns of each cell; level : (n,) int64, slices, each as often as one likes.
    """
    _, rows, columns = counts.shape
    total, seen = 0, 0
    for k in level:
        if seen >> k & 1:
            continue
        seen |= 1 << k
        for r in range(rows):
            for c in range(columns):
                if math.hypot(c - columns // 2, r - rows // 2) * cell_m <= reach_m:
                    total += counts[k, r, c]
    return total
