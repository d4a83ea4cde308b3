"""Intensities of readings as means of small cells, around a stated place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Float64, Int64


@dataclass(frozen=True)
class Cells:
    """c cells with readings; coordinates are from a centre known to the caller (m)."""

    place_m: Float64
    """(c, 2) mean place of the readings, east and north."""
    value: Float64
    """(c,) mean intensity."""
    count: Int64
    """(c,) readings."""

    def within(self, centre_m: Float64, radius_m: float) -> Cells:
        """Returns the cells within a distance of a place."""
        near = np.hypot(*(self.place_m - centre_m).T) <= radius_m
        return Cells(self.place_m[near], self.value[near], self.count[near])


def cells_of(place_m: Float64, value: Float64, cell_m: float) -> Cells:
    """Returns means of readings (n, 2), (n,) in the cells of an even grid through the origin, by row and column."""
    if not value.size:
        return Cells(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    number = _numbers(place_m, cell_m)
    count = np.bincount(number)
    taken = np.flatnonzero(count)
    many = count[taken]
    sums = [np.bincount(number, weights)[taken] / many for weights in (place_m[:, 0], place_m[:, 1], value)]
    return Cells(np.stack(sums[:2], axis=-1), sums[2], many)


def _numbers(place_m: Float64, cell_m: float) -> Int64:
    """Returns the number (n,) of each reading's cell, by row and column."""
    column, row = (np.floor(axis / cell_m).astype(np.int64) for axis in place_m.T)
    numbers: Int64 = (row - row.min()) * (int(np.ptp(column)) + 1) + column - column.min()
    return numbers


def spacing_m(place_m: Float64, block_m: float) -> float:
    """Returns the mean distance between readings (n, 2) (m), from their number in non-empty blocks of a size.

    Blocks with less than a third of the median's readings lie at a border and do not count.
    """
    if not place_m.size:
        return float("inf")
    count = np.bincount(_numbers(place_m, block_m))
    count = count[count > 0]
    full = count[count >= np.median(count) / 3]
    return float(block_m / np.sqrt(full.mean()))
