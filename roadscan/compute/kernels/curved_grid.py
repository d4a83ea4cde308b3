"""Sums of points in the cells of a curved grid: a reference line with mitred sides, cells of equal steps.

Sums are made of whole numbers, so they are the same to the bit whatever the order of the points.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel

MOST_JUMPS = 200
"""Most steps of the search for a point's place; a point not found by then lies outside the line's reach."""


@kernel
def thin_path(path, least_m, kept):
    """Mark the positions of a path that lie at least `least_m` from the one marked before.

    path : (k, 2) float64, m; kept : (k,) bool, out.
    """
    last = 0
    for k in range(len(path)):
        far = math.hypot(path[k, 0] - path[last, 0], path[k, 1] - path[last, 1]) >= least_m
        kept[k] = k == 0 or far
        if kept[k]:
            last = k


@inlined
def ahead(x, y, k, vertices, left):
    """Return how far a position lies beyond the side of vertex k, along the line there (m)."""
    length = math.hypot(left[k, 0], left[k, 1])
    return ((x - vertices[k, 0]) * left[k, 1] - (y - vertices[k, 1]) * left[k, 0]) / length


@inlined
def place(x, y, hint, vertices, left, step):
    """Return a position's step of the line, the fraction along it and the offset to the left (m); −1 if none."""
    last = len(vertices) - 2
    k = min(max(hint, 0), last)
    for _ in range(MOST_JUMPS):
        begin = ahead(x, y, k, vertices, left)
        end = ahead(x, y, k + 1, vertices, left)
        if begin < 0.0:
            jump = min(-1, int(begin / step))
        elif end >= 0.0:
            jump = max(1, int(end / step))
        else:
            t = begin / (begin - end)
            ax = vertices[k, 0] + t * (vertices[k + 1, 0] - vertices[k, 0])
            ay = vertices[k, 1] + t * (vertices[k + 1, 1] - vertices[k, 1])
            dx = vertices[k + 1, 0] - vertices[k, 0]
            dy = vertices[k + 1, 1] - vertices[k, 1]
            v = ((y - ay) * dx - (x - ax) * dy) / math.hypot(dx, dy)
            return k, t, v
        if (k == 0 and jump < 0) or (k == last and jump > 0):
            # The first and last cell extend half a cell beyond the first and last vertex.
            t = begin / step if jump < 0 else 1.0 + end / step
            at = k if jump < 0 else k + 1
            length = math.hypot(left[at, 0], left[at, 1])
            v = ((x - vertices[at, 0]) * left[at, 0] + (y - vertices[at, 1]) * left[at, 1]) / length
            return k, t, v
        k = min(max(k + jump, 0), last)
    return -1, 0.0, 0.0


@kernel
def accumulate_curved(x, y, height, hints, vertices, left, step, v_first, v_step, sums, counts):
    """Add points to the cells of the nearest grid nodes.

    Parameters
    ----------
    x, y : (n,) float64, m; height : (n,) int32, quanta.
    hints : (n,) int64, a step of the line near each point.
    vertices, left : (nu, 2) float64, the line and its mitred normals, m.
    step : float64, from vertex to vertex; v_first, v_step : float64, columns of the grid, left positive, m.
    sums : (nu, nv) int64, in/out, quanta; counts : (nu, nv) int32, in/out.

    Returns
    -------
    int, how many points lie in no cell.
    """
    nu, nv = counts.shape
    outside = 0
    for i in range(x.size):
        k, t, v = place(x[i], y[i], hints[i], vertices, left, step)
        row = k + math.floor(t + 0.5)
        column = math.floor((v - v_first) / v_step + 0.5)
        if k < 0 or row < 0 or row >= nu or column < 0 or column >= nv:
            outside += 1
            continue
        sums[row, column] += np.int64(height[i])
        counts[row, column] += 1
    return outside
