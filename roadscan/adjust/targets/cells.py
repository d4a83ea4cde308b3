"""Intensities of readings as means of small cells, around a stated place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Cells:
    """c cells that hold readings; places count from a middle that the caller knows (m)."""

    place_m: Float64
    """(c, 2) mean place of the readings, east and north."""
    value: Float64
    """(c,) mean intensity."""
    count: Int64
    """(c,) readings."""

    def within(self, centre_m: Float64, radius_m: float) -> Cells:
        """The cells within a distance of a place."""
        near = np.hypot(*(self.place_m - centre_m).T) <= radius_m
        return Cells(self.place_m[near], self.value[near], self.count[near])


def cells_of(place_m: Float64, value: Float64, cell_m: float) -> Cells:
    """Means of readings (n, 2), (n,) in the cells of an even grid through the origin, by row and column."""
    index = np.floor(place_m / cell_m).astype(np.int64)
    if not index.size:
        return Cells(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    low = index.min(axis=0)
    columns = int(np.ptp(index[:, 0])) + 1
    number = (index[:, 1] - low[1]) * columns + index[:, 0] - low[0]
    count = np.bincount(number)
    taken = np.flatnonzero(count)
    many = count[taken]
    sums = [np.bincount(number, weights)[taken] / many for weights in (place_m[:, 0], place_m[:, 1], value)]
    return Cells(np.stack(sums[:2], axis=-1), sums[2], many)


def spacing_m(place_m: Float64, block_m: float) -> float:
    """Mean distance (m) between readings (n, 2) where there are any, from their number in blocks of a size.

    Blocks with less than a third of the median's readings lie at a border and do not count.
    """
    _, count = np.unique(np.floor(place_m / block_m).astype(np.int64), axis=0, return_counts=True)
    if not count.size:
        return float("inf")
    full = count[count >= np.median(count) / 3]
    return float(block_m / np.sqrt(full.mean()))
