"""Evaluation of Clough–Tocher patches on a regular grid, triangle by triangle, without any search for a point.

The nodes of a triangle are collected row by row, then their heights are computed together (``simd.patch_heights``).
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import bare_inner, inlined, kernel
from roadscan.compute.kernels.patch_heights import AT_ONCE, POINTS, SCALE, heights_of_eight

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
    wide_x[:columns] = node_x
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
