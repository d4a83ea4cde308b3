"""Holes of a gridded surface, filled up to a stated width.

A hole is a run of empty cells between two known ones, along a row or a column, of at most that width. It is filled as
the coarse model fills one (``surfaces/coarse.py``): by the straight line between the mean heights of the last three
known cells on each side. A cell that lies in such a run both ways gets the line of the shorter one, of two of the same
length the mean. Heights that were there stay as they are, and nothing goes beyond the border of what was measured.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

RIM: Final = 3
"""Known cells on each side that a line begins with."""


def cells_across(fill_m: float, cell_m: float) -> int:
    """Empty cells in the widest hole that is filled."""
    return math.floor(fill_m / cell_m + 1e-9)


def fill_holes(values: Float64, known: Bool, most: tuple[int, int]) -> tuple[Float64, Bool]:
    """Fill the holes of a grid.

    Parameters
    ----------
    values : (rows, columns), of what is known.
    known : (rows, columns), where it is.
    most : cells in the widest hole along a column (northwards), and along a row (eastwards).

    Returns
    -------
    The values with holes filled, and which cells were. A cell farther than the widest hole and its rim from the
    window's border has the same bits in every window.
    """
    along, steps = _lines(values, known, most[1])
    down, rises = (part.T for part in _lines(values.T, known.T, most[0]))
    filled = (steps > 0) | (rises > 0)
    one_way = np.where((rises == 0) | ((steps > 0) & (steps < rises)), along, down)
    both = np.where((steps > 0) & (steps == rises), 0.5 * (along + down), one_way)
    return np.where(filled, both, values), filled


def _lines(values: Float64, known: Bool, most: int) -> tuple[Float64, npt.NDArray[np.int32]]:
    """Values along the rows of holes, and the cells in the hole that a cell lies in; 0 in none."""
    line, width = np.zeros(values.shape), np.zeros(values.shape, np.int32)
    rows, columns = values.shape
    if most < 1 or columns < 3:
        return line, width
    inside = np.zeros((rows, columns + 2), np.int8)  # known beyond both ends, so that every run has two
    inside[:, 1:-1] = ~known
    row, edge = np.nonzero(np.diff(inside, axis=1))
    row, first, end = row[::2], edge[::2], edge[1::2]
    own = (first > 0) & (end < columns) & (end - first <= most)
    row, first, end = row[own], first[own], end[own]
    before, after = _rim(values, known, row, first - 1, -1), _rim(values, known, row, end, 1)
    count = end - first
    hole = np.repeat(np.arange(count.size), count)
    place = np.arange(hole.size) - np.repeat(np.cumsum(count) - count, count)
    share = (place + 1) / (count + 1)[hole]
    at = row[hole], first[hole] + place
    line[at] = before[hole] + share * (after - before)[hole]
    width[at] = count[hole]
    return line, width


def _rim(values: Float64, known: Bool, row: npt.NDArray[np.int64], column: npt.NDArray[np.int64], step: int) -> Float64:
    """Mean of the known cells from a column on, at most :data:`RIM` without a gap."""
    total, count = values[row, column], np.ones(row.size)
    goes_on = np.ones(row.size, bool)
    for k in range(1, RIM):
        there = column + k * step
        goes_on &= (there >= 0) & (there < values.shape[1])
        there = np.clip(there, 0, values.shape[1] - 1)
        goes_on &= known[row, there]
        total = total + np.where(goes_on, values[row, there], 0.0)
        count += goes_on
    return np.asarray(total / count)
