"""Clough–Tocher patches on a regular grid, triangle by triangle: no point is ever searched for."""

from __future__ import annotations

import numpy as np

from roadscan.kernels.clough_tocher import BY_CORNER, BY_EDGE, CENTRE, EDGE, INNER
from roadscan.kernels.options import inlined, kernel

ZERO, ONE, TWO = np.uint64(0), np.uint64(1), np.uint64(2)
FROM_CORNER, FROM_EDGE, FROM_INNER = np.uint64(BY_CORNER), np.uint64(BY_EDGE), np.uint64(INNER)
FIRST_EDGE, SECOND_EDGE = np.uint64(EDGE), np.uint64(EDGE + 1)
"""Unsigned: an index that could be negative costs a test."""
MARGIN = 1e-6
"""Of a cell: more than the rounding of where an edge meets a row. Nodes are then asked exactly."""


@inlined
def height(patch, l0, l1, l2):
    """Height of a patch at barycentric coordinates: from the cubic of the third that the smallest of them names."""
    least = min(l0, l1, l2)
    k = ZERO if l0 == least else (ONE if l1 == least else TWO)
    i, j = (ONE if k == ZERO else (TWO if k == ONE else ZERO)), (TWO if k == ZERO else (ZERO if k == ONE else ONE))
    u = (l1 if k == ZERO else (l2 if k == ONE else l0)) - least
    v = (l2 if k == ZERO else (l0 if k == ONE else l1)) - least
    w = 3.0 * least
    towards = 3.0 * (u * patch[FROM_INNER + i] + v * patch[FROM_INNER + j]) + w * patch[CENTRE]
    sides = u * u * patch[FROM_CORNER + i] + 2.0 * u * v * patch[FROM_EDGE + k] + v * v * patch[FROM_CORNER + j]
    near = u * u * (u * patch[i] + 3.0 * v * patch[FIRST_EDGE + k + k])
    far = v * v * (v * patch[j] + 3.0 * u * patch[SECOND_EDGE + k + k])
    return near + far + w * (3.0 * sides + w * towards)


@inlined
def edge_line(x, y, i, j):
    """An edge as (x, y, dx, dy) from its lower end, turned so that the triangle lies where dx·Δy - dy·Δx ≥ 0.

    Both triangles of an edge get the same numbers but for the sign, so they agree exactly on which side a node lies.
    """
    if i < j:
        return x[i], y[i], x[j] - x[i], y[j] - y[i]
    return x[j], y[j], -(x[i] - x[j]), -(y[i] - y[j])


@inlined
def bound(line):
    """How an edge bounds a row: dx / dy, and what is added to where it meets the row as a lower and an upper bound."""
    lean = line[2] / line[3] if line[3] != 0.0 else 0.0
    return lean, (0.0 if line[3] < 0.0 else -np.inf), (0.0 if line[3] > 0.0 else np.inf)


@inlined
def narrowed(line, bounds, up, low, high):
    """Narrow a span of x on the row at height `up` to the triangle's side of an edge."""
    meets = line[0] + bounds[0] * (up - line[1])
    return max(low, meets + bounds[1]), min(high, meets + bounds[2])


@kernel
def evaluate(x, y, triangles, patches, node_x, node_y, cell_x, cell_y, heights):
    """Heights of the patches at the nodes of a grid.

    A node on an edge or a vertex belongs to the last of its triangles, in the order given.

    Parameters
    ----------
    x, y : (m,) float64 (m); triangles : (n, 3) int64; patches : (n, POINTS) float64.
    node_x, node_y : (c,), (r,) float64 (m), ascending, evenly spaced to rounding; differences to x and y exact.
    cell_x, cell_y : their spacing (m).
    heights : (r, c) float64, changed where a triangle lies.
    """
    columns, rows, per_x, per_y = node_x.size, node_y.size, 1.0 / cell_x, 1.0 / cell_y
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
        scale = 1.0 / ((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))
        patch = patches[t]
        for row in range(first, end):
            up = node_y[row]
            low, high = narrowed(line0, bounds0, up, west, east)
            low, high = narrowed(line1, bounds1, up, low, high)
            low, high = narrowed(line2, bounds2, up, low, high)
            left = max(int(np.ceil((low - node_x[0]) * per_x - MARGIN)), 0)
            right = min(int(np.floor((high - node_x[0]) * per_x + MARGIN)) + 1, columns)
            across0, across1 = line0[2] * (up - line0[1]), line1[2] * (up - line1[1])
            across2 = line2[2] * (up - line2[1])
            for column in range(left, right):
                over = node_x[column]
                s0 = across0 - line0[3] * (over - line0[0])
                s1 = across1 - line1[3] * (over - line1[0])
                s2 = across2 - line2[3] * (over - line2[0])
                if s0 >= 0.0 and s1 >= 0.0 and s2 >= 0.0:
                    heights[row, column] = height(patch, s0 * scale, s1 * scale, s2 * scale)
