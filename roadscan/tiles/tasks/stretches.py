"""Divides tiles into stretches of road, each of which is a task: two kilometres, or less for many workers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.footprints.row_groups import GroupsByTile

_SQUARE_M = 100.0
"""Edge of the squares whose tiles stay in one task."""

_SQUARES = 29
"""Most squares of a task: two kilometres of road oblique to the grid, three along it."""

_SQUARES_A_TASK = 4
"""Least number of squares of a task; where there are few, squares are smaller than 100 m, to balance the tasks."""

_SHARES = (8, 4, 2, 1)
"""Tasks per worker where there are few squares: several, so that no worker waits long for the last one …"""

_MOST_READ = 1.15
"""… unless tasks would read more than this many times the row groups: a lidar sees far beyond a stretch."""

Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class DrivenTiles:
    """Every tile that readings may touch; arrays are (n,)."""

    column: npt.NDArray[np.int32]
    row: npt.NDArray[np.int32]
    readings: Int64
    """Approximate number of readings."""
    first_epoch_gps_ns: Int64
    groups: GroupsByTile
    """Row groups that may touch them."""


def cut_stretches(tiles: DrivenTiles, numbers: Int64, size_m: float, workers: int) -> list[Int64]:
    """Divide tiles (numbers into `tiles`, at least one) in driving order into stretches."""
    numbers = np.sort(numbers)
    edge = max(1, round(_SQUARE_M / size_m))
    square = _squares(tiles, numbers, edge)
    while edge > 1 and int(square.max()) < _SQUARES_A_TASK * _SHARES[0] * workers:
        edge //= 2
        square = _squares(tiles, numbers, edge)
    first = tiles.first_epoch_gps_ns[numbers]
    begun = np.full(int(square.max()) + 1, np.iinfo(np.int64).max)
    np.minimum.at(begun, square, first)
    order = np.argsort(begun, kind="stable")
    stretches: list[Int64] = []
    for share in _SHARES:
        stretch = np.empty(begun.size, np.int64)
        stretch[order] = _stretch_by_turn(_sums(tiles.readings[numbers], square)[order], share * workers)
        turn = np.lexsort((numbers, first, stretch[square]))
        stretches = np.split(numbers[turn], np.flatnonzero(np.diff(stretch[square][turn])) + 1)
        if begun.size >= _SQUARES * share * workers or _times_read(tiles.groups, stretches, numbers) <= _MOST_READ:
            break
    return stretches


def _squares(tiles: DrivenTiles, numbers: Int64, edge: int) -> npt.NDArray[np.intp]:
    """Return the number of the square of `edge` by `edge` tiles that contains each tile."""
    east, north = (part[numbers].astype(np.int64) // edge for part in (tiles.column, tiles.row))
    square: npt.NDArray[np.intp] = np.unique((north << 32) + east, return_inverse=True)[1]
    return square


def _stretch_by_turn(readings: Int64, parts: int) -> Int64:
    """Return the stretch of each square in driving order: of 29 squares, or `parts` of about as many readings each."""
    if readings.size >= _SQUARES * parts:
        return np.arange(readings.size, dtype=np.int64) // _SQUARES
    upto = np.cumsum(readings)
    stretch: Int64 = (upto - (readings + 1) // 2) * parts // max(int(upto[-1]), 1)
    return stretch


def _times_read(groups: GroupsByTile, stretches: list[Int64], numbers: Int64) -> float:
    """Return the ratio of the row groups that the stretches read to those that there are."""
    read = [int((runs.end - runs.begin).sum()) for runs in map(groups.runs, [numbers, *stretches])]
    return sum(read[1:]) / max(read[0], 1)


def _sums(values: Int64, place: npt.NDArray[np.intp]) -> Int64:
    sums = np.zeros(int(place.max()) + 1, np.int64)
    np.add.at(sums, place, values)
    return sums
