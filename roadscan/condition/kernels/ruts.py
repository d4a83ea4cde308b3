"""Depth of ruts in cross-sections: below a stretched wire, below a straightedge, and of standing water."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel


@inlined
def upper_hull(x, h, first, end, hull):
    """Find points of x[first:end], h[first:end] that a wire over them touches, ascending in hull; return the number."""
    count = 0
    for k in range(first, end):
        while count > 1:
            a, b = hull[count - 2], hull[count - 1]
            if (x[b] - x[a]) * (h[k] - h[a]) < (x[k] - x[a]) * (h[b] - h[a]):
                break
            count -= 1
        hull[count] = k
        count += 1
    return count


@kernel
def wire_places(x, h, out):
    """Find the places on which a wire over one cross-section rests, into out (m,) int64; return their number.

    x, h : (m,) float64, ascending offsets and heights, finite, m.
    """
    return upper_hull(x, h, 0, x.size, out)


@kernel
def gaps(x, h, hull, out):
    """Compute the depth of a cross-section below a wire, normal to it, into out (m,) float64 (m); contacts in hull.

    Returns how many contacts there are.
    """
    count = upper_hull(x, h, 0, x.size, hull)
    for e in range(count - 1):
        a, b = hull[e], hull[e + 1]
        slope = (h[b] - h[a]) / (x[b] - x[a])
        upright = 1.0 / math.sqrt(1.0 + slope * slope)
        for k in range(a, b + 1):
            out[k] = (h[a] + slope * (x[k] - x[a]) - h[k]) * upright
    return count


@kernel
def stretched_wire(x, h, out):
    """Compute ruts below a wire stretched over a cross-section from end to end, in its left and right half.

    Parameters
    ----------
    x : (m,) float64, ascending, m, 0 in the middle; h : (n, m) float64, heights, finite, m.
    out : (n, 2, 5) float64, out, of the left and the right half: greatest depth, normal to the wire (m); width over
        which the depth is more than a tenth of that (m); area between wire and road (m²); place of the greatest depth
        (m); and the variance of the depth for independent heights of variance 1.
    """
    m = x.size
    hull, gap = np.empty(m, np.int64), np.zeros(m)
    for i in range(len(h)):
        count = gaps(x, h[i], hull, gap)
        out[i] = 0.0
        for k in range(m - 1):
            half = 0 if x[k] + x[k + 1] < 0.0 else 1
            out[i, half, 2] += 0.5 * (gap[k] + gap[k + 1]) * (x[k + 1] - x[k])
        e = 0
        for k in range(m):
            while e < count - 2 and hull[e + 1] <= k:
                e += 1
            half = 0 if x[k] < 0.0 else 1
            if gap[k] > out[i, half, 0]:
                t = (x[k] - x[hull[e]]) / (x[hull[e + 1]] - x[hull[e]])
                out[i, half, 0] = gap[k]
                out[i, half, 1] = width(x, gap, k)
                out[i, half, 3] = x[k]
                out[i, half, 4] = 1.0 + t * t + (1.0 - t) * (1.0 - t)


@inlined
def width(x, gap, deepest):
    """Return the extent around a place over which the depth is above a tenth of that there (m); linear between."""
    first, last, tenth = deepest, deepest, 0.1 * gap[deepest]
    while first > 0 and gap[first - 1] > tenth:
        first -= 1
    while last < x.size - 1 and gap[last + 1] > tenth:
        last += 1
    begin, end = x[first], x[last]
    if first > 0:
        begin -= (x[first] - x[first - 1]) * (gap[first] - tenth) / (gap[first] - gap[first - 1])
    if last < x.size - 1:
        end += (x[last + 1] - x[last]) * (gap[last] - tenth) / (gap[last] - gap[last + 1])
    return end - begin


@kernel
def straightedge(x, h, length, out):
    """Compute the greatest depth below a straightedge anywhere across the road, in its left and right half.

    The edge rests on the two points on both sides of its middle that it touches; beyond the ends of the cross-section
    it is unsupported.

    Parameters
    ----------
    x : (m,) float64, ascending, m, 0 in the middle; h : (n, m) float64, heights, finite, m.
    length : float64, of the edge, m; out : (n, 2) float64, out: depth in the left and the right half, m.
    """
    m = x.size
    hull = np.empty(m, np.int64)
    for i in range(len(h)):
        out[i, 0], out[i, 1] = 0.0, 0.0
        first, end = 0, 0
        for middle in range(m):
            while x[first] < x[middle] - 0.5 * length - 1e-9:
                first += 1
            while end < m and x[end] <= x[middle] + 0.5 * length + 1e-9:
                end += 1
            count = upper_hull(x, h[i], first, end, hull)
            e = 0
            while e < count - 2 and hull[e + 1] < middle:
                e += 1
            if count < 2:
                continue
            a, b = hull[e], hull[e + 1]
            slope = (h[i, b] - h[i, a]) / (x[b] - x[a])
            upright = 1.0 / math.sqrt(1.0 + slope * slope)
            for k in range(a + 1, b):
                gap = (h[i, a] + slope * (x[k] - x[a]) - h[i, k]) * upright
                half = 0 if x[k] < 0.0 else 1
                out[i, half] = max(out[i, half], gap)


@kernel
def water(h, out):
    """Compute the depth of the water that stands in a cross-section before it runs off to a side.

    h : (n, m) float64, heights, finite, m; out : (n, m) float64, out, m.
    """
    m = h.shape[1]
    for i in range(len(h)):
        top = h[i, 0]
        for k in range(m):
            top = max(top, h[i, k])
            out[i, k] = top
        top = h[i, m - 1]
        for k in range(m - 1, -1, -1):
            top = max(top, h[i, k])
            out[i, k] = max(min(out[i, k], top) - h[i, k], 0.0)
