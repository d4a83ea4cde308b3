"""Sorting of returns by their cell, seen from above."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel


@inlined
def _cell(x, y, corner, cell_m, shape):
    """Returns the flat number of the cell of a place; -1 outside."""
    u, v = (x - corner[0]) / cell_m, (y - corner[1]) / cell_m
    if not (u >= 0.0 and v >= 0.0 and u < shape[1] and v < shape[0]):
        return -1
    return int(v) * shape[1] + int(u)


@kernel
def by_number(number, starts, order):
    """Sort items by their number, ascending in each: `order` (n,) int64, and the beginning of each number.

    number : (n,) integers from 0 on; items of a negative one are left out. starts : (numbers + 1,) int64, zeroed; last
    the end of all. order : room for all items.
    """
    for i in range(number.size):
        if number[i] >= 0:
            starts[number[i] + 1] += 1
    for k in range(1, starts.size):
        starts[k] += starts[k - 1]
    at = starts.copy()
    for i in range(number.size):
        if number[i] >= 0:
            order[at[number[i]]] = i
            at[number[i]] += 1


@kernel
def sort_groups(key, begins, order):
    """Compute the order (n,) int64 of items by their key (n,) int64 within each group, which begins (groups + 1,)."""
    for g in range(begins.size - 1):
        first, end = begins[g], begins[g + 1]
        own = np.argsort(key[first:end])
        for k in range(own.size):
            order[first + k] = first + own[k]


@kernel
def rows_within(x, y, box, rows):
    """Write the numbers of the places within a box, ascending, to `rows` (n,) int64; returns their count.

    x, y : (n,) whole numbers. box : (4,) least x and y, which belong to it, and those that it ends before.
    """
    found = 0
    for i in range(x.size):
        rows[found] = i
        found += 1 if box[0] <= x[i] < box[2] and box[1] <= y[i] < box[3] else 0
    return found


@kernel
def raster_cells(x, y, grid, shape, cell):
    """Compute the flat number of each place's cell of a raster: cell (n,) int32; −1 outside.

    x, y : (n,) places (m); grid : (x_min_m, y_min_m, cell_m); shape : (rows, columns).
    """
    for i in range(x.size):
        column, row = math.floor((x[i] - grid[0]) / grid[2]), math.floor((y[i] - grid[1]) / grid[2])
        inside = 0 <= row < shape[0] and 0 <= column < shape[1]
        cell[i] = row * shape[1] + column if inside else -1


@kernel
def count_buckets(x, y, counted, corner, cell_m, shape, starts):
    """Compute the beginning of each cell's returns, and last the end of all: starts (cells + 1,) int64, zeroed.

    x, y : (n,) places (m); counted : (n,) bool; corner : (x, y) of cell (0, 0); shape : (rows, columns).
    """
    for i in range(x.size):
        if counted[i]:
            cell = _cell(x[i], y[i], corner, cell_m, shape)
            if cell >= 0:
                starts[cell + 1] += 1
    for cell in range(1, starts.size):
        starts[cell] += starts[cell - 1]


@kernel
def fill_buckets(x, y, counted, corner, cell_m, shape, at, order):
    """Write the numbers of the returns (n,) int64 by cell, ascending in each; at : (cells + 1,) beginnings, used up."""
    for i in range(x.size):
        if counted[i]:
            cell = _cell(x[i], y[i], corner, cell_m, shape)
            if cell >= 0:
                order[at[cell]] = i
                at[cell] += 1
