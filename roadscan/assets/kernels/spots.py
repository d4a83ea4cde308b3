"""The returns around a place, and those of them that belong to the spot in the middle."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.compute.kernels.arrays import sort, sorted_quantile

LANES = 8  # Returns of a cell whose neighbours are sought together.


@kernel
def grow_spot(x, y, value, buckets, grid, place, limits, shares):
    """Returns rows (k,) int64 of the returns near a place, ascending, and a mask (k,) of those that make its spot.

    The value of a return becomes the mean over its neighbours, so that noise makes no holes. A return belongs to the
    spot where that is nearer to the value of the square than to that of what lies beside it, and where it hangs
    together with the square.

    Parameters
    ----------
    x, y, value : (n,) places (m) and values of returns.
    buckets : beginnings (cells + 1,) and rows of the returns of each cell, ascending.
    grid : corner of the cells (x, y) and their edge (m), rows, columns.
    place : x, y of the middle of the square, half its side (m).
    limits : radius around the place, of neighbours, gap beside the square, how far a spot reaches beyond it (m), and
        the fewest returns of a square.
    shares : quantiles that tell the value of the square, and of what lies beside it.
    """
    radius, smooth, gap, grows, fewest = limits
    near = _near(x, y, buckets, grid, place, radius)
    size = near.size
    inside, away = np.zeros(size, np.bool_), np.empty(size)
    cores, besides = 0, 0
    for k in range(size):
        away[k] = max(abs(x[near[k]] - place[0]), abs(y[near[k]] - place[1]))
        cores += 1 if away[k] <= place[2] else 0
        besides += 1 if away[k] >= place[2] + gap else 0
    if cores < fewest or besides == 0:
        return near, inside
    starts, order, cell = _in_cells(x, y, near, place, radius, smooth)
    side = round(math.sqrt(starts.size - 1))
    u, v, w = np.empty(size + LANES), np.empty(size + LANES), np.empty(size)
    for n in range(size):
        u[n], v[n], w[n] = x[near[order[n]]], y[near[order[n]]], value[near[order[n]]]
    mean, total, number = np.empty(size), np.empty(LANES), np.empty(LANES)
    for c in range(side + 1, starts.size - side - 2):
        for n in range(starts[c], starts[c + 1], LANES):
            total[:], number[:] = 0.0, 0.0
            east, north = u[n : n + LANES], v[n : n + LANES]
            for row in range(-side, side + 1, side):
                for m in range(starts[c + row - 1], starts[c + row + 2]):
                    _add_near(east, north, u[m], v[m], w[m], smooth * smooth, total, number)
            for k in range(n, min(n + LANES, starts[c + 1])):
                mean[order[k]] = total[k - n] / number[k - n]
    core, beside = np.sort(mean[away <= place[2]]), np.sort(mean[away >= place[2] + gap])
    half = (sorted_quantile(core, shares[0]) + sorted_quantile(beside, shares[1])) / 2.0
    stack, top = np.empty(size, np.int64), 0
    free = np.empty(size, np.bool_)
    for n in range(size):
        k = order[n]
        free[n] = mean[k] >= half and away[k] <= place[2] + grows
        if free[n] and away[k] <= place[2]:
            inside[k], free[n], stack[top] = True, False, n
            top += 1
    while top:
        top -= 1
        n = stack[top]
        k = order[n]
        for row in range(cell[k] // side - 1, cell[k] // side + 2):
            first = row * side + cell[k] % side
            for m in range(starts[first - 1], starts[first + 2]):
                if free[m] and (u[m] - u[n]) ** 2 + (v[m] - v[n]) ** 2 <= smooth * smooth:
                    inside[order[m]], free[m], stack[top] = True, False, m
                    top += 1
    return near, inside


@inlined
def _add_near(x, y, east, north, value, reach, total, number):
    """Add a value to those of some places that lie within reach (m²) of it."""
    for i in range(LANES):
        close = (x[i] - east) ** 2 + (y[i] - north) ** 2 <= reach
        total[i] += value if close else 0.0
        number[i] += 1.0 if close else 0.0


@inner
def _near(x, y, buckets, grid, place, radius):
    """Returns rows (k,) of the returns within a radius of a place, ascending."""
    starts, order = buckets
    west, south, edge, rows, columns = grid
    first = max(0, int((place[1] - radius - south) / edge)), max(0, int((place[0] - radius - west) / edge))
    last = (
        min(rows - 1, int((place[1] + radius - south) / edge)),
        min(columns - 1, int((place[0] + radius - west) / edge)),
    )
    most = 0
    for row in range(first[0], last[0] + 1):
        most += starts[row * columns + last[1] + 1] - starts[row * columns + first[1]]
    near, count = np.empty(most, np.int64), 0
    for row in range(first[0], last[0] + 1):
        for m in range(starts[row * columns + first[1]], starts[row * columns + last[1] + 1]):
            u, v = x[order[m]] - place[0], y[order[m]] - place[1]
            if u * u + v * v <= radius * radius:
                near[count] = order[m]
                count += 1
    sort(near[:count])
    return near[:count]


@inner
def _in_cells(x, y, near, place, radius, edge):
    """Returns beginnings of cells of a square raster with a free rim, the returns by cell, and the cell of each."""
    side = 2 * int(radius / edge + 1.0) + 3
    starts, order = np.zeros(side * side + 1, np.int64), np.empty(near.size, np.int64)
    cell = np.empty(near.size, np.int64)
    for k in range(near.size):
        row = int((y[near[k]] - place[1]) / edge + side / 2.0)
        cell[k] = row * side + int((x[near[k]] - place[0]) / edge + side / 2.0)
        starts[cell[k] + 1] += 1
    for k in range(side * side):
        starts[k + 1] += starts[k]
    at = starts.copy()
    for k in range(near.size):
        order[at[cell[k]]] = k
        at[cell[k]] += 1
    return starts, order, cell
