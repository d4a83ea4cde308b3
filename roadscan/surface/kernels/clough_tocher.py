"""Control points of Clough–Tocher cubic triangles with cubic precision.

A triangle's patch is 19 heights, by corner k (edge k lies opposite corner k and runs from i = k + 1 to j = k + 2, both
modulo 3; c is the centroid; [·, ·, ·] is the polar form of the cubic that the point belongs to):

====  ==================  ==========================================
from  [·, ·, ·]           of
====  ==================  ==========================================
0     [k, k, k]           corner k
3     [i, i, j], [i, j, j]  edge k, at 3 + 2 k and 4 + 2 k
9     [k, k, c]           corner k
12    [i, j, c]           edge k
15    [k, c, c]           corner k
18    [c, c, c]
====  ==================  ==========================================

The theory stands in ``surfaces.clough_tocher``.

Evaluation of Clough–Tocher patches on a regular grid, triangle by triangle, without any search for a point.

The nodes of a triangle are collected row by row, then their heights are computed together (``simd.patch_heights``).
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import bare_inner, inlined, inner, kernel
from roadscan.compute.kernels.patch_heights import (
    AT_ONCE,
    BY_CORNER,
    BY_EDGE,
    CENTRE,
    CORNER,
    EDGE,
    INNER,
    POINTS,
    SCALE,
    heights_of_eight,
)

ALONG, ACROSS, SLOPE = 0, 1, 2  # Columns of `halves`: position along and across an edge, and slope across it.
THIN = 0.25
"""A triangle is thin relative to its neighbour if its corner is nearer to their edge by this factor."""
LEAST_SHARE = 0.05
"""Least weight of the slope across an edge's middle in a thin triangle's equation (1.5 above the middle, 0 at an end).
"""


@inlined
def third_of_slope(gradients, i, dx, dy):
    """Returns a third of the derivative at vertex i along (dx, dy): from a vertex to its control point (eq. 7-9)."""
    return (gradients[i, 0] * dx + gradients[i, 1] * dy) / 3.0


@kernel
def cross_slopes(x, y, z, gradients, triangles, halves):
    """Compute the slope across its edges that each triangle implies.

    Parameters
    ----------
    x, y, z : (m,) float64; gradients : (m, 2); triangles : (n, 3) int64.
    halves : (n, 3, 3) float64, out: of edge k, where the corner opposite lies along and across it (in lengths of the
        edge, from its first end to the left of it), and the slope across its middle as this corner sees it.
    """
    for t in range(triangles.shape[0]):
        for k in range(3):
            a, i, j = triangles[t, k], triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
            lo, hi = min(i, j), max(i, j)  # both triangles of an edge compute in the same direction
            ex, ey, ax, ay = x[hi] - x[lo], y[hi] - y[lo], x[a] - x[lo], y[a] - y[lo]
            square = ex * ex + ey * ey
            along, across = (ex * ax + ey * ay) / square, (ex * ay - ey * ax) / square
            z3 = z[hi] - z[lo]
            z1, z2 = third_of_slope(gradients, lo, ex, ey), z3 - third_of_slope(gradients, hi, ex, ey)
            seen = 2.0 * (z[a] - z[lo]) + third_of_slope(gradients, a, ex - 2.0 * ax, ey - 2.0 * ay)
            rest = 1.0 - along
            known = rest * rest * (z1) + 2.0 * rest * along * (z1 + z2) + along * along * (z2 + z3)
            ends = rest * third_of_slope(gradients, lo, -ey, ex) + along * third_of_slope(gradients, hi, -ey, ex)
            halves[t, k, ALONG], halves[t, k, ACROSS] = along, across
            halves[t, k, SLOPE] = (seen - known) / (2.0 * across) - ends


@inlined
def misfits(x, y, z, gradients, lo, hi, a):
    """Returns the position of corner a along and across an edge, and the misfit of its height and slopes to the edge.

    Returns
    -------
    along, across; then, of the cubic less its edge and its slopes across the ends of it: height over `across`, slope
    along over `across`, slope across (lengths of the edge).
    """
    ex, ey, ax, ay = x[hi] - x[lo], y[hi] - y[lo], x[a] - x[lo], y[a] - y[lo]
    square = ex * ex + ey * ey
    s, t = (ex * ax + ey * ay) / square, (ex * ay - ey * ax) / square
    r = 1.0 - s
    z3 = z[hi] - z[lo]
    z1, z2 = third_of_slope(gradients, lo, ex, ey), z3 - third_of_slope(gradients, hi, ex, ey)
    n0, n1 = third_of_slope(gradients, lo, -ey, ex), third_of_slope(gradients, hi, -ey, ex)
    edge = 3.0 * s * r * (r * z1 + s * z2) + s * s * s * z3
    rise = 3.0 * (r * r * z1 + 2.0 * s * r * (z2 - z1) + s * s * (z3 - z2))
    ends = 3.0 * (r * r * n0 + s * s * n1)
    height = (z[a] - z[lo] - edge) / t - ends
    along = (3.0 * third_of_slope(gradients, a, ex, ey) - rise) / t + 6.0 * (r * n0 - s * n1)
    return s, t, height, along, 3.0 * third_of_slope(gradients, a, -ey, ex) - ends


@inner
def slope_beside_thin(x, y, z, gradients, lo, hi, wide, thin, seen_wide, seen_thin):
    """Returns the slope across the middle of an edge beside a thin triangle, by least squares of two equations.

    The equations: the slope at the thin corner, and the rule of Foley & Opitz times the small distance of that
    corner (`seen_wide`, `seen_thin`: the slopes of :func:`cross_slopes`). Where the thin corner lies over an end of
    the edge it does not determine the middle, and the mean of the ends is taken.
    """
    s, t, height, along, across = misfits(x, y, z, gradients, lo, hi, wide)
    thin_s, thin_t, _, _, thin_across = misfits(x, y, z, gradients, lo, hi, thin)
    ratio = thin_t / t
    bulge, thin_bulge = 6.0 * s * (1.0 - s), 6.0 * thin_s * (1.0 - thin_s)
    share = thin_bulge + ratio * ((3.0 * ratio - 4.0) * bulge - 12.0 * (1.0 - 2.0 * s) * (thin_s - s))
    known = 2.0 * (3.0 * height - across + along * (thin_s - s)) + 3.0 * ratio * (across - 2.0 * height)
    near = 2.0 * thin_t
    square = share * share + (near * (1.0 - ratio)) ** 2
    if square < LEAST_SHARE * LEAST_SHARE:
        ex, ey = x[hi] - x[lo], y[hi] - y[lo]
        return 0.5 * (third_of_slope(gradients, lo, -ey, ex) + third_of_slope(gradients, hi, -ey, ex))
    total = share * (thin_across - ratio * known) + near * (1.0 - ratio) * near * (seen_thin - ratio * seen_wide)
    return total / square


@kernel
def control_points(x, y, z, gradients, triangles, opposite, halves, patches):
    """Compute the control points of each triangle.

    Parameters
    ----------
    x, y, z : (m,) float64; gradients : (m, 2); triangles, opposite : (n, 3) int64.
    halves : (n, 3, 3) float64, of :func:`cross_slopes`.
    patches : (n, POINTS) float64, out.
    """
    flat = halves.reshape(-1, 3)
    for t in range(triangles.shape[0]):
        patch = patches[t]
        inner, sides = 0.0, 0
        for k in range(3):
            i, j = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
            dx, dy = x[j] - x[i], y[j] - y[i]
            patch[CORNER + k] = z[triangles[t, k]]
            near, far = z[i] + third_of_slope(gradients, i, dx, dy), z[j] - third_of_slope(gradients, j, dx, dy)
            patch[EDGE + 2 * k], patch[EDGE + 2 * k + 1] = near, far
            other = opposite[t, k]
            if other >= 0:
                mine, theirs = halves[t, k, ACROSS], flat[other, ACROSS]
                a, b, lo, hi = triangles[t, k], triangles[other // 3, other % 3], min(i, j), max(i, j)
                mine_seen, theirs_seen = halves[t, k, SLOPE], flat[other, SLOPE]
                if abs(theirs) < THIN * abs(mine):
                    slope = slope_beside_thin(x, y, z, gradients, lo, hi, a, b, mine_seen, theirs_seen)
                elif abs(mine) < THIN * abs(theirs):
                    slope = slope_beside_thin(x, y, z, gradients, lo, hi, b, a, theirs_seen, mine_seen)
                else:
                    slope = (mine_seen * theirs - theirs_seen * mine) / (theirs - mine)
                along = halves[t, k, ALONG] if i < j else 1.0 - halves[t, k, ALONG]
                patch[BY_EDGE + k] = (1.0 - along) * near + along * far + mine * slope
                inner += patch[BY_EDGE + k]
                sides += 1
        if sides < 3:
            if sides == 0:  # quadratic precision
                for e in range(6):
                    inner += 0.25 * patch[EDGE + e]
                for k in range(3):
                    inner -= patch[k] / 6.0
            else:
                inner /= sides
            for k in range(3):
                if opposite[t, k] < 0:
                    patch[BY_EDGE + k] = inner
        split(patch)


@inlined
def split(patch):
    """Compute from the inner point of each edge the control points of three smoothly joined cubics (Clough–Tocher)."""
    centre = 0.0
    for k in range(3):
        near, far = patch[EDGE + 2 * k], patch[EDGE + 2 * k + 1]
        patch[BY_EDGE + k] = (near + far + patch[BY_EDGE + k]) / 3.0
        towards_next, towards_last = patch[EDGE + 2 * ((k + 2) % 3)], patch[EDGE + 2 * ((k + 1) % 3) + 1]
        patch[BY_CORNER + k] = (patch[k] + towards_next + towards_last) / 3.0
    for k in range(3):
        inner = (patch[BY_CORNER + k] + patch[BY_EDGE + (k + 1) % 3] + patch[BY_EDGE + (k + 2) % 3]) / 3.0
        patch[INNER + k] = inner
        centre += inner
    patch[CENTRE] = centre / 3.0


ROOM = 64
"""Nodes of a triangle that are collected before their heights are computed."""
SHORT = 4
"""Nodes that are collected at once: most rows of a triangle have fewer, and a loop over them would be mispredicted."""
MARGIN = 1e-6
"""Margin (cells) above the rounding error of an edge's crossing of a row: nodes within it are tested exactly."""


@inlined
def edge_line(x, y, i, j):
    """Returns an edge as (x, y, dx, dy) from its lower end, turned so that the triangle lies where dx·Δy - dy·Δx ≥ 0.

    Both triangles of an edge get the same numbers but for the sign, so they agree exactly on which side a node lies.
    """
    if i < j:
        return x[i], y[i], x[j] - x[i], y[j] - y[i]
    return x[j], y[j], -(x[i] - x[j]), -(y[i] - y[j])


@inlined
def bound(line):
    """Returns dx / dy of an edge, and the offsets of its crossing of a row that make it a lower and an upper bound."""
    lean = line[2] / line[3] if line[3] != 0.0 else 0.0
    return lean, (0.0 if line[3] < 0.0 else -np.inf), (0.0 if line[3] > 0.0 else np.inf)


@inlined
def narrowed(line, bounds, up, low, high):
    """Returns a span of x on the row at height `up`, narrowed to the triangle's side of an edge."""
    meets = line[0] + bounds[0] * (up - line[1])
    return max(low, meets + bounds[1]), min(high, meets + bounds[2])


@bare_inner
def write_heights(edges, patches, patch, nodes, count, heights):
    """Write heights of a triangle at the collected nodes that an exact test finds within it.

    edges, patches, patch : as in ``heights_of_eight``; nodes : tuple of x, y : (ROOM + AT_ONCE,) float64 (m), places :
    (ROOM + AT_ONCE,) int64, of the first `count` nodes in `heights`, and scratch : as x.
    """
    x, y, places, found = nodes
    for first in range(np.uint64(0), np.uint64(count), np.uint64(AT_ONCE)):
        heights_of_eight(edges, patches, patch, x, y, found, first)
    for k in range(np.uint64(count)):
        place = np.uint64(places[k])
        heights[place] = heights[place] if np.isnan(found[k]) else found[k]


@kernel
def evaluate(x, y, triangles, patches, node_x, node_y, cell_x, cell_y, heights):
    """Compute heights of the patches at the nodes of a grid.

    A node on an edge or a vertex belongs to the last of its triangles, in the order given.

    Parameters
    ----------
    x, y : (m,) float64 (m); triangles : (n, 3) int64; patches : (n, POINTS) float64.
    node_x, node_y : (c,), (r,) float64 (m), ascending, evenly spaced to rounding; differences to x and y exact.
    cell_x, cell_y : their spacing (m).
    heights : (r, c) float64, changed where a triangle lies.
    """
    columns, rows, per_x, per_y = node_x.size, node_y.size, 1.0 / cell_x, 1.0 / cell_y
    size = ROOM + AT_ONCE
    own_x, own_y, places, found = np.zeros(size), np.zeros(size), np.zeros(size, np.int64), np.zeros(size)
    edges, patches, heights = np.zeros(SCALE + 1), patches.reshape(-1), heights.reshape(-1)
    wide_x = np.zeros(columns + SHORT)
    for k in range(columns):
        wide_x[k] = node_x[k]
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        south, north = min(y[a], y[b], y[c]), max(y[a], y[b], y[c])
        west, east = min(x[a], x[b], x[c]), max(x[a], x[b], x[c])
        first = max(int(np.ceil((south - node_y[0]) * per_y - MARGIN)), 0)
        end = min(int(np.floor((north - node_y[0]) * per_y + MARGIN)) + 1, rows)
        if first >= end or east < node_x[0] - cell_x or west > node_x[columns - 1] + cell_x:
            continue
        line0, line1, line2 = edge_line(x, y, b, c), edge_line(x, y, c, a), edge_line(x, y, a, b)
        bounds0, bounds1, bounds2 = bound(line0), bound(line1), bound(line2)
        edges[0], edges[1], edges[2], edges[3] = line0
        edges[4], edges[5], edges[6], edges[7] = line1
        edges[8], edges[9], edges[10], edges[11] = line2
        edges[SCALE] = 1.0 / ((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))
        patch, count = np.uint64(t * POINTS), np.uint64(0)
        for row in range(first, end):
            up = node_y[row]
            low, high = narrowed(line0, bounds0, up, west, east)
            low, high = narrowed(line1, bounds1, up, low, high)
            low, high = narrowed(line2, bounds2, up, low, high)
            left = min(max(int(np.ceil((low - node_x[0]) * per_x - MARGIN)), 0), columns)
            right = min(int(np.floor((high - node_x[0]) * per_x + MARGIN)) + 1, columns)
            for start in range(left, max(right, left + 1), SHORT):
                for k in range(np.uint64(SHORT)):
                    own_x[count + k], own_y[count + k] = wide_x[np.uint64(start) + k], up
                    places[count + k] = row * columns + start + np.int64(k)
                count += np.uint64(min(max(right - start, 0), SHORT))
                if count >= np.uint64(ROOM):
                    write_heights(edges, patches, patch, (own_x, own_y, places, found), count, heights)
                    count = np.uint64(0)
        write_heights(edges, patches, patch, (own_x, own_y, places, found), count, heights)
