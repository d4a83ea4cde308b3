"""Filling of holes in a gridded surface, up to a stated width.

A hole is a run of empty cells between two known ones, along a row or a column, of at most that width. It is filled as
the coarse model fills one (``surface/coarse.py``): by the straight line between the mean heights of the last three
known cells on each side. A cell that lies in such a run both ways gets the line of the shorter one, of two of the same
length the mean. Heights that were there stay as they are, and nothing goes beyond the border of what was measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64

RIM: Final = 3
"""Known cells on each side to which a line is fitted."""


def cells_across(fill_m: float, cell_m: float) -> int:
    """Returns the number of empty cells in the widest hole that is filled."""
    return math.floor(fill_m / cell_m + 1e-9)


@dataclass(frozen=True)
class Holes:
    """The filled cells: (n,) places in the flat grid, by the runs in which they lie."""

    shape: tuple[int, int]
    rows: _Runs
    columns: _Runs

    @classmethod
    def of(cls, known: Bool, most: tuple[int, int]) -> Holes:
        """Returns the holes of a grid.

        Parameters
        ----------
        known : (rows, columns), True where the grid has a height.
        most : cells in the widest hole along a column (northwards), and along a row (eastwards).
        """
        rows, columns = known.shape
        return cls((rows, columns), _Runs.of(known, most[1], columns, 1), _Runs.of(known.T, most[0], 1, columns))

    def filled(self) -> Bool:
        """Returns a mask (rows, columns) of the cells in a hole."""
        found = np.zeros(self.shape, bool)
        for runs in (self.rows, self.columns):
            found.flat[runs.cell] = True
        return found

    def fill(self, values: Float64) -> Float64:
        """Returns values (rows, columns) with the holes filled.

        A cell farther than the widest hole and its rim from the window's border has the same bits in every window.
        """
        found = values.copy()
        flat, width = found.reshape(-1), np.zeros(values.size, np.int32)
        across, down = self.rows.line(values.reshape(-1)), self.columns.line(values.reshape(-1))
        flat[self.rows.cell], width[self.rows.cell] = across, self.rows.width
        before = width[self.columns.cell]
        with_row = flat[self.columns.cell]
        mean = np.where(before == self.columns.width, 0.5 * (with_row + down), down)
        wider = (before > 0) & (before < self.columns.width)
        flat[self.columns.cell] = np.where(wider, with_row, mean)
        return found


@dataclass(frozen=True)
class _Runs:
    """Runs of empty cells along lines of the grid; places are those in the flat grid."""

    first: Int64
    """(k,) place of the known cell before each run; `last` the one after it."""
    last: Int64
    beside: Int64
    """(k,) number of known cells before the run without a gap, as its rim uses them; `beyond` those after it."""
    beyond: Int64
    step: int
    """Step in the flat grid from cell to cell of a line."""
    cell: Int64
    """(n,) cells of all runs, and the run of each."""
    run: Int64
    share: Float64
    """(n,) relative position of each cell between the rims, 0 to 1."""

    @property
    def width(self) -> Int64:
        """Returns (n,) the number of cells in the run of each cell."""
        width: Int64 = ((self.last - self.first) // self.step - 1)[self.run]
        return width

    @classmethod
    def of(cls, known: Bool, most: int, line_step: int, step: int) -> _Runs:
        """Returns the runs along the rows of `known`, whose cells lie `line_step` and `step` apart in the flat grid."""
        lines, cells = known.shape
        flat = np.zeros((lines, cells + 1), bool)  # a gap after each line
        flat[:, :-1] = known
        flat = flat.reshape(-1)
        edge = np.flatnonzero(flat[1:] != flat[:-1])
        edge = edge[int(flat.size > 0 and not flat[0]) :]  # from the end of a known run on
        end, begin = edge[0:-1:2], edge[1::2] + 1
        own = (begin - end - 1 <= most) & (end // (cells + 1) == begin // (cells + 1))
        beside, beyond = (_known_from(flat, at, away) for at, away in ((end[own], -1), (begin[own], 1)))
        first, last = (at // (cells + 1) * line_step + at % (cells + 1) * step for at in (end[own], begin[own]))
        size = begin[own] - end[own] - 1
        run = np.repeat(np.arange(size.size), size)
        place = np.arange(run.size) - np.repeat(np.cumsum(size) - size, size) + 1
        return cls(first, last, beside, beyond, step, first[run] + place * step, run, place / (size + 1)[run])

    def line(self, values: Float64) -> Float64:
        """Returns (n,) the straight line between the means of both rims, from a flat grid of values."""
        before = _rim(values, self.first, self.beside, -self.step)
        after = _rim(values, self.last, self.beyond, self.step)
        found: Float64 = before[self.run] + self.share * (after - before)[self.run]
        return found


def _known_from(flat: Bool, at: Int64, away: int) -> Int64:
    """Returns (k,) the number of known cells from a place on without a gap, at most :data:`RIM`."""
    count, goes_on = np.ones(at.size, np.int64), np.ones(at.size, bool)
    for k in range(1, RIM):
        there = at + away * k
        goes_on &= flat[np.clip(there, 0, flat.size - 1)] & (there >= 0)
        count += goes_on
    return count


def _rim(values: Float64, at: Int64, count: Int64, step: int) -> Float64:
    total = values[at]
    for k in range(1, RIM):
        inside = count > k
        total = total + np.where(inside, values[np.where(inside, at + k * step, at)], 0.0)
    return np.asarray(total / count)
