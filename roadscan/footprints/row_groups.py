"""Index of row groups by tile: which groups a block of tiles needs, and which tile reports on their readings.

Row groups of all data files are numbered consecutively, with a gap after each file, so that a run of numbers is a run
of row groups of one file. A survey of a day has millions of them, so nothing here loops over row groups or tiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from roadscan.compute.array_types import Int32, Int64
from roadscan.footprints.footprints import FootprintRanges


@dataclass(frozen=True)
class Runs:
    """Runs of consecutive row groups that some tiles need, ascending; arrays are (n,)."""

    begin: Int64
    """Number of the first row group."""
    end: Int64
    """Number after the last."""
    source: Int64
    """Index of the data file."""
    slice: Int64
    """Index of that file among the files of the runs."""
    position: Int64
    """Number of row groups of the same file in earlier runs."""
    first_epoch_gps_ns: Int64
    last_epoch_gps_ns: Int64

    def places(self, begin: Int64, end: Int64) -> Int32:
        """Return (n, 3) slice, first position and end of ranges of row groups, each of which lies within a run."""
        run = np.searchsorted(self.begin, begin, side="right") - 1
        first = self.position[run] + begin - self.begin[run]
        return np.column_stack([self.slice[run], first, first + end - begin]).astype(np.int32)


class GroupsByTile:
    """Ranges of row groups by tile; tiles are numbered by row and column."""

    def __init__(self, footprints: FootprintRanges, order: Int64, starts: Int64) -> None:
        """`order` (n,) sorts the rows of the footprints by tile, then by file and time; `starts` (tiles + 1,)."""
        f = footprints
        counts = np.array([len(s.groups) for s in f.slices], dtype=np.int64)
        self._base = np.cumsum(counts + 1) - counts - 1
        self._source = f.slice_index[order].astype(np.int64)
        self._begin = self._base[self._source] + f.first_group[order]
        self._end = self._base[self._source] + f.last_group[order] + 1
        self._first_epoch = f.first_epoch_gps_ns[order]
        self._last_epoch = f.last_epoch_gps_ns[order]
        self._starts = starts

    def runs(self, tiles: Int64) -> Runs:
        """Return the runs that some tiles need together."""
        rows = expanded(self._starts[tiles], self._starts[tiles + 1])
        rows = rows[np.argsort(self._begin[rows], kind="stable")]
        begin, end = self._begin[rows], np.maximum.accumulate(self._end[rows])
        starts = np.flatnonzero(np.concatenate([np.ones(min(rows.size, 1), bool), begin[1:] > end[:-1]]))
        source = self._source[rows[starts]]
        size = end[np.append(starts[1:], rows.size) - 1] - begin[starts] if rows.size else np.zeros(0, np.int64)
        is_new = np.diff(source, prepend=-1) != 0
        number = np.cumsum(is_new) - 1
        before = np.cumsum(size) - size
        return Runs(
            begin=begin[starts],
            end=begin[starts] + size,
            source=source,
            slice=number,
            position=before - before[is_new][number],
            first_epoch_gps_ns=_reduced(np.minimum, self._first_epoch[rows], starts),
            last_epoch_gps_ns=_reduced(np.maximum, self._last_epoch[rows], starts),
        )

    def groups(self, runs: Runs, first: int, last: int) -> Sequence[int]:
        """Return the row groups of one data file, from run `first` to `last` − 1, numbered within their file."""
        base = self._base[runs.source[first]]
        begin, end = runs.begin[first:last] - base, runs.end[first:last] - base
        if begin.size == 1:
            return range(int(begin[0]), int(end[0]))
        return tuple(expanded(begin, end).tolist())

    def touched(self, runs: Runs, tiles: Int64) -> Int32:
        """Return (n, 4) index in `tiles`, slice, first position and end of the row groups that each tile needs."""
        rows = expanded(self._starts[tiles], self._starts[tiles + 1])
        place = np.repeat(np.arange(tiles.size), self._starts[tiles + 1] - self._starts[tiles])
        return np.column_stack([place, runs.places(self._begin[rows], self._end[rows])]).astype(np.int32)

    def owned(self, runs: Runs, tiles: Int64) -> Int32:
        """Return (n, 4) slice, first position, end and index in `tiles` of the groups that each tile reports on.

        That is the first by row and column of the tiles that a group touches.
        """
        begin, end, starts = self._owned
        rows = expanded(starts[tiles], starts[tiles + 1])
        place = np.repeat(np.arange(tiles.size), starts[tiles + 1] - starts[tiles])
        order = np.argsort(begin[rows], kind="stable")
        rows = rows[order]
        return np.column_stack([runs.places(begin[rows], end[rows]), place[order]]).astype(np.int32)

    @cached_property
    def _owned(self) -> tuple[Int64, Int64, Int64]:
        """Return first and end of the groups that each tile reports on, and where its ranges begin (tiles + 1,)."""
        tiles = self._starts.size - 1
        edges = np.sort(np.concatenate([self._begin, self._end]))
        edges = edges[np.diff(edges, prepend=-1) != 0]
        first, last = np.searchsorted(edges, self._begin), np.searchsorted(edges, self._end)
        owner = np.full(edges.size, tiles)
        tile = np.repeat(np.arange(tiles), np.diff(self._starts))
        painted = expanded(first[::-1], last[::-1])  # in reverse order, so that the first tile of a group stays
        owner[painted] = np.repeat(tile[::-1], (last - first)[::-1])
        begins = np.flatnonzero(np.diff(owner, prepend=-1))
        ends = np.append(edges[begins[1:]], 0)[: begins.size]  # the last range belongs to no tile
        order = np.argsort(owner[begins], kind="stable")
        order = order[owner[begins][order] < tiles]
        starts = np.searchsorted(owner[begins][order], np.arange(tiles + 1))
        return edges[begins][order], ends[order], starts


def expanded(begin: Int64, end: Int64) -> Int64:
    """Return all numbers of the ranges from `begin` (n,) to `end` (n,) − 1, one range after another."""
    counts = end - begin
    numbers: Int64 = np.arange(int(counts.sum())) + np.repeat(begin - (np.cumsum(counts) - counts), counts)
    return numbers


def _reduced(function: np.ufunc, values: Int64, starts: Int64) -> Int64:
    reduced: Int64 = function.reduceat(values, starts) if starts.size else values[:0]
    return reduced
