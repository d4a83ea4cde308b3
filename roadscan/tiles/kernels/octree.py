"""Cuts the points of a cube into nodes of an octree: a node has one point a voxel, its children have the others."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, kernel

BITS = 30
"""Positions along an edge of the cube are counted in 2⁻³⁰ of it."""

SPAN_BITS = 7
"""A node has 2⁷ voxels along an edge."""

NODE_COLUMNS = 6
"""Columns of a node: level, place along x, y and z, first position of its points, their number."""


class Steps(NamedTuple):
    """Positions of n points in 2^-BITS of the cube's edge, from its corner (:func:`parts_of_edge`)."""

    x: npt.NDArray[np.int32]
    y: npt.NDArray[np.int32]
    z: npt.NDArray[np.int32]


class Shape(NamedTuple):
    """Parameters of the octree."""

    top: int
    """Level of the cell that contains all given points; nodes above it are shared with other cells."""
    leaf_points: int
    """A node from `top` downward with at most this many points is not cut."""


class Tables(NamedTuple):
    """Working memory; `best` is -1 throughout before and after."""

    best: npt.NDArray[np.int32]
    """(2^21,) position of the point nearest to the centre of each voxel."""
    distance: npt.NDArray[np.int64]
    """(2^21,) square of twice the distance to that point (parts²)."""
    moved: npt.NDArray[np.int32]
    """(n,) order of the points of a node during sorting."""


@kernel
def parts_of_edge(values, corner, edge):
    """Return stored coordinates (n,) as parts of a cube's edge, rounded down.

    Parameters
    ----------
    values : (n,) int32, `corner` to `corner` + `edge`, which is below 2³⁰.
    """
    parts = np.empty(values.size, np.int32)
    for at in range(values.size):
        part = ((np.int64(values[at]) - corner) << BITS) // edge
        parts[at] = min(part, (1 << BITS) - 1)
    return parts


@inlined
def _voxel(steps, point, shift, bits):
    """Return a point's voxel of 2^shift parts among 2^bits an edge, and its distance² from the centre, times 4."""
    size, mask = np.int64(1) << shift, (np.int64(1) << bits) - 1
    number, square = np.int64(0), np.int64(0)
    for place in (np.int64(steps.x[point]), np.int64(steps.y[point]), np.int64(steps.z[point])):
        off = 2 * (place & (size - 1)) + 1 - size
        number = (number << bits) | ((place >> shift) & mask)
        square += off * off
    return number, square


@inlined
def _choose(steps, order, first, end, shift, bits, tables):
    """Find the point nearest to the centre of each voxel, of equally near ones the first."""
    for at in range(first, end):
        point = order[at]
        voxel, square = _voxel(steps, point, shift, bits)
        known = tables.best[voxel]
        if known < 0 or square < tables.distance[voxel]:
            tables.best[voxel] = point
            tables.distance[voxel] = square


@inlined
def _chosen_first(steps, order, first, end, shift, bits, tables):
    """Put the chosen points before the others, both in their former order; return where the others begin."""
    chosen, others = first, 0
    for at in range(first, end):
        point = order[at]
        voxel, _ = _voxel(steps, point, shift, bits)
        if tables.best[voxel] == point:
            order[chosen] = point
            chosen += 1
        else:
            tables.moved[others] = point
            others += 1
    for at in range(others):
        order[chosen + at] = tables.moved[at]
    for at in range(first, chosen):
        voxel, _ = _voxel(steps, order[at], shift, bits)
        tables.best[voxel] = -1
    return chosen


@inlined
def _octant(steps, point, shift):
    """Return the octant 0 to 7 of a point: sum of 1, 2 and 4 for the upper half along x, y and z."""
    x, y, z = (steps.x[point] >> shift) & 1, (steps.y[point] >> shift) & 1, (steps.z[point] >> shift) & 1
    return x + 2 * y + 4 * z


@kernel
def cut_cell(steps, order, first, end, shape, tables, nodes):
    """Cut the points of one cell into nodes of the octree; return the number of nodes.

    Above the level `top` the cell adds one point a voxel to each node that it is a part of. From there downward a node
    with more than `leaf_points` keeps the point nearest to the centre of each of its voxels and hands on the others.

    Parameters
    ----------
    steps : Steps of all points; those of the cell differ in the bits below BITS - `top` alone.
    order : (m,) out: positions first to end - 1, numbers of the cell's points, become the order of the nodes.
    nodes : (k, 6) out: a row a node (NODE_COLUMNS); room for `top` + 1 + 8 · BITS for each begun `leaf_points`.
    """
    top, leaf_points = shape.top, shape.leaf_points
    if end <= first:
        return 0
    lead = order[first]
    column, row, layer = steps.x[lead], steps.y[lead], steps.z[lead]
    found = 0
    for level in range(top):
        shift = BITS - level - SPAN_BITS
        if shift < 0 or end <= first:
            break
        _choose(steps, order, first, end, shift, SPAN_BITS - top + level, tables)
        start = _chosen_first(steps, order, first, end, shift, SPAN_BITS - top + level, tables)
        up = BITS - level
        nodes[found, 0], nodes[found, 1] = level, column >> up
        nodes[found, 2], nodes[found, 3] = row >> up, layer >> up
        nodes[found, 4], nodes[found, 5] = first, start - first
        found += 1
        first = start
    waiting = np.empty((8 * (BITS + 2), 3), np.int64)
    waiting[0, 0], waiting[0, 1], waiting[0, 2] = top, first, end
    left = 1 if end > first else 0
    count = np.zeros(9, np.int64)
    while left > 0:
        left -= 1
        level, first, end = waiting[left, 0], waiting[left, 1], waiting[left, 2]
        shift = BITS - level - SPAN_BITS
        start = end
        if end - first > leaf_points and shift > 0:
            _choose(steps, order, first, end, shift, SPAN_BITS, tables)
            start = _chosen_first(steps, order, first, end, shift, SPAN_BITS, tables)
        up, lead = BITS - level, order[first]
        nodes[found, 0], nodes[found, 1] = level, steps.x[lead] >> up
        nodes[found, 2], nodes[found, 3] = steps.y[lead] >> up, steps.z[lead] >> up
        nodes[found, 4], nodes[found, 5] = first, start - first
        found += 1
        if start == end:
            continue
        count[:] = 0
        for at in range(start, end):
            count[1 + _octant(steps, order[at], up - 1)] += 1
        for octant in range(8):
            count[octant + 1] += count[octant]
        for octant in range(7, -1, -1):
            if count[octant + 1] > count[octant]:
                waiting[left, 0] = level + 1
                waiting[left, 1], waiting[left, 2] = start + count[octant], start + count[octant + 1]
                left += 1
        for at in range(start, end):
            octant = _octant(steps, order[at], up - 1)
            tables.moved[count[octant]] = order[at]
            count[octant] += 1
        for at in range(start, end):
            order[at] = tables.moved[at - start]
    return found
