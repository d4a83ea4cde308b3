"""Returns sorted by the cell that they lie in, seen from above."""

from __future__ import annotations

from roadscan.kernels.options import inlined, kernel


@inlined
def _cell(x, y, corner, cell_m, shape):
    """Flat number of the cell of a place; -1 outside."""
    u, v = (x - corner[0]) / cell_m, (y - corner[1]) / cell_m
    if not (u >= 0.0 and v >= 0.0 and u < shape[1] and v < shape[0]):
        return -1
    return int(v) * shape[1] + int(u)


@kernel
def count_buckets(x, y, counted, corner, cell_m, shape, starts):
    """Where each cell's returns begin, and last where all end: starts (cells + 1,) int64, zeroed.

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
    """Numbers of the returns (n,) int64 by cell, ascending in each; at : (cells + 1,) where each begins, is used up."""
    for i in range(x.size):
        if counted[i]:
            cell = _cell(x[i], y[i], corner, cell_m, shape)
            if cell >= 0:
                order[at[cell]] = i
                at[cell] += 1
