"""Writes a kilometre sheet of points as one COPC file, sorting points by square on disk.

Memory holds the points of one block of tiles, of the cells of one column of the octree, and of the nodes above the
cells, which are one point a voxel.

An octree over the points of a cloud, in which each node samples its cube in ever finer voxels.

A point stands in one node: the coarsest in which it lies nearest to the centre of its voxel among all points that no
coarser node took (the additive sampling of Schütz, *Potree*, 2016, and of COPC 1.0).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int32
from roadscan.core.errors import StoreError
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.core.grid import TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.store.codecs.copc import CopcWriter, Key
from roadscan.tiles.kernels.octree import (
    BITS,
    NODE_COLUMNS,
    SPAN_BITS,
    Shape,
    Steps,
    Tables,
    cut_cell,
    parts_of_edge,
)
from roadscan.tiles.products.las import SCALE_M, Lattice, layout_of, picked, records_of, without_colours

_SQUARE_M: Final = 16.0
"""Approximate edge of the squares into which larger tiles are divided."""
_BATCH_POINTS: Final = 1_000_000
"""Points of the nodes that are compressed in parallel."""

Records = npt.NDArray[np.void]


@dataclass(frozen=True)
class _Square:
    """Points of a map square in the scratch file."""

    tile: TileId
    part: int
    at: int
    """Index of its first record."""
    count: int
    low: tuple[int, int]
    high: tuple[int, int]
    """Least and greatest stored x and y."""


class PointSpool:
    """Points of a sheet on disk, square by square."""

    def __init__(self, path: Path, lattice: Lattice) -> None:
        self._lattice, self._path = lattice, path
        self._kind = layout_of(lattice.map, coloured=True).records
        self._squares: list[_Square] = []
        self.low = np.full(3, np.iinfo(np.int32).max, np.int64)
        """Least stored coordinates."""
        self.high = np.full(3, np.iinfo(np.int32).min, np.int64)
        """Greatest stored coordinates."""
        self.count = 0
        self.coloured = False
        """True where any point has a colour."""
        self.first_epoch_gps_ns = np.iinfo(np.int64).max

    def fill(self, tiles: Iterable[TilePoints]) -> None:
        """Add the points of tiles, each tile once and in any order."""
        with self._path.open("wb") as stream:
            for points in tiles:
                self._take(points, stream)
        self._squares.sort(key=lambda s: (s.tile.row, s.tile.column, s.part))

    def _take(self, points: TilePoints, stream: BinaryIO) -> None:
        records = records_of(points, self._lattice)
        self.coloured = self.coloured or "red" in points.extra
        self.first_epoch_gps_ns = min(self.first_epoch_gps_ns, int(points.epoch_gps_ns.min()))
        for axis, name in enumerate("XYZ"):
            self.low[axis] = min(self.low[axis], records[name].min())
            self.high[axis] = max(self.high[axis], records[name].max())
        for part, own in self._parts(points, records):
            x, y = own["X"], own["Y"]
            low, high = (int(x.min()), int(y.min())), (int(x.max()), int(y.max()))
            self._squares.append(_Square(points.tile, part, self.count, own.size, low, high))
            stream.write(np.ascontiguousarray(own).view(np.uint8).data)
            self.count += own.size

    def _parts(self, points: TilePoints, records: Records) -> Iterator[tuple[int, Records]]:
        """Yield the squares of a tile's points, in the order of the points."""
        grid = self._lattice.grid
        across = max(1, round(grid.size_m / _SQUARE_M))
        if across == 1:
            yield 0, records
            return
        edge = -(-grid.size_quanta // across)
        number = (points.y_quanta // edge).astype(np.int64) * across + points.x_quanta // edge
        order = np.argsort(number, kind="stable")
        starts = np.flatnonzero(np.diff(number[order], prepend=-1))
        for first, end in zip(starts.tolist(), [*starts[1:].tolist(), number.size], strict=True):
            yield int(number[order[first]]), picked(records, order[first:end])

    def columns(self, cube: Cube) -> Iterator[Records]:
        """Yield the points of each column of the octree's cells, columns from the west, points from the south."""
        places: dict[tuple[int, int], list[_Square]] = {}
        for square in self._squares:
            spans = []
            for axis in (0, 1):
                ends = cube.cells(axis, np.array([square.low[axis], square.high[axis]], np.int32)).tolist()
                spans.append(range(ends[0], ends[1] + 1))
            for column in spans[0]:
                for row in spans[1]:
                    places.setdefault((column, row), []).append(square)
        with self._path.open("rb") as stream:
            for place in sorted(places):
                held = [self._inside(stream, square, place, cube) for square in places[place]]
                joined = np.concatenate(held)
                if joined.size:
                    yield joined

    def _inside(self, stream: BinaryIO, square: _Square, place: tuple[int, int], cube: Cube) -> Records:
        stream.seek(square.at * self._kind.itemsize)
        records = np.fromfile(stream, self._kind, square.count)
        if records.size != square.count:
            raise StoreError("points are missing from the scratch file", file=self._path)
        inside = np.ones(records.size, np.bool_)
        for axis, name in enumerate("XY"):
            first, end = (cube.first_step(axis, place[axis] + k) for k in (0, 1))
            if square.low[axis] < first:
                inside &= records[name] >= first
            if square.high[axis] >= end and place[axis] + 1 < 1 << cube.top:
                inside &= records[name] < end
        return records if inside.all() else picked(records, np.flatnonzero(inside))


def write_cloud(path: Path, spool: PointSpool, lattice: Lattice, facts: dict[str, Any]) -> None:
    """Write all points of a spool as COPC 1.0."""
    layout = layout_of(lattice.map, coloured=spool.coloured)
    low, high = (tuple(map(int, one.tolist())) for one in (spool.low, spool.high))
    cube = Cube.around((low[0], low[1], low[2]), (high[0], high[1], high[2]), CELL_M / SCALE_M)
    date = utc_from_gps_ns(spool.first_epoch_gps_ns).date()
    writer = CopcWriter(path, layout, lattice.offsets, date)
    cutter = NodeCutter(cube)
    above: dict[Key, list[Records]] = {}
    with writer.begin(cube.corner, cube.edge, {**facts, "points": spool.count}):
        waiting: list[tuple[Key, Records]] = []
        for column in spool.columns(cube):
            records = column if spool.coloured else without_colours(column, layout.records)
            for node in cutter.nodes(records["X"], records["Y"], records["Z"]):
                own = picked(records, node.points)
                if node.key.level < cube.top:
                    above.setdefault(node.key, []).append(own)
                else:
                    waiting.append((node.key, own))
            waiting = _written(writer, waiting)
        _written(writer, [*waiting, *((key, np.concatenate(above[key])) for key in sorted(above))], at_least=1)


def _written(
    writer: CopcWriter, waiting: Sequence[tuple[Key, Records]], at_least: int = _BATCH_POINTS
) -> list[tuple[Key, Records]]:
    """Return the nodes that remain after enough points were written."""
    if sum(records.size for _, records in waiting) < at_least:
        return list(waiting)
    writer.add(waiting)
    return []


LEAF_POINTS: Final = 65_536
"""Nodes with at most this many points are not divided."""

CELL_M: Final = 8.0
"""Least edge of a cell, which is divided independently."""


class NodeKey(NamedTuple):
    """Place of a node: its level, and its index along x, y and z among the 2^level cubes of an edge."""

    level: int
    x: int
    y: int
    z: int


class Node(NamedTuple):
    """A node with points."""

    key: NodeKey
    points: Int32
    """(n,) indices of the points, in the given order."""


@dataclass(frozen=True)
class Cube:
    """The root's cube, in whole steps of the stored coordinates: the points' box, made as high as it is wide."""

    corner: tuple[int, int, int]
    """Least coordinates (steps)."""
    edge: int
    """Edge (steps); a point at the far end is in the last node."""
    top: int
    """Level of the cells that are divided one after another."""

    @classmethod
    def around(cls, low: tuple[int, int, int], high: tuple[int, int, int], cell_steps: float) -> Cube:
        """The cube of a box, as PDAL and copclib take it; its cells have an edge of `cell_steps` or up to twice that,
        but no more than 128 lie side by side.

        Raises
        ------
        StoreError
            where the box is wider than the steps of a cube.
        """
        edge = max(1, *(b - a for a, b in zip(low, high, strict=True)))
        if edge >= 1 << BITS:
            raise StoreError("the box of a point cloud is too wide", expected=f"at most 2^{BITS} steps")
        top = min(SPAN_BITS, max(0, int(math.log2(edge / cell_steps)))) if edge > cell_steps else 0
        return cls(low, edge, top)

    def cells(self, axis: int, values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Return the index (n,) of the cell along an axis (0, 1, 2) of stored coordinates (n,)."""
        return self.parts(axis, values).astype(np.int64) >> (BITS - self.top)

    def parts(self, axis: int, values: npt.NDArray[Any]) -> Int32:
        """Return stored coordinates (n,) in 2^30 parts of the edge, whose bits give the node on each level."""
        parts: Int32 = parts_of_edge(np.ascontiguousarray(values, np.int32), self.corner[axis], self.edge)
        return parts

    def first_step(self, axis: int, cell: int) -> int:
        """Return the least stored coordinate that can lie in a cell."""
        return self.corner[axis] + -(-cell * self.edge >> self.top)


class NodeCutter:
    """Divides the cells of a cube into nodes; owns the memory for this."""

    def __init__(self, cube: Cube, leaf_points: int = LEAF_POINTS) -> None:
        self._cube, self._leaf = cube, leaf_points

    def nodes(self, x: npt.NDArray[Any], y: npt.NDArray[Any], z: npt.NDArray[Any]) -> Iterator[Node]:
        """Nodes of all points of some whole cells, cell by cell in the order of x, y, z; a node above the cells comes
        once a cell, with that cell's points.

        Parameters
        ----------
        x, y, z : (n,) stored coordinates.
        """
        cube = self._cube
        steps = Steps(cube.parts(0, x), cube.parts(1, y), cube.parts(2, z))
        cells = [one.astype(np.int64) >> (BITS - cube.top) for one in steps]
        number = (cells[0] << 2 * cube.top) | (cells[1] << cube.top) | cells[2]
        order = np.arange(number.size, dtype=np.int32)
        if number.size and (number != number[0]).any():
            order = np.argsort(number, kind="stable").astype(np.int32)
        starts = np.flatnonzero(np.diff(number[order], prepend=-1))
        shape = Shape(cube.top, self._leaf)
        best, distance = self._voxels
        tables = Tables(best, distance, np.empty(number.size, np.int32))
        # A node is divided only if it has more points than a leaf, and gets eight children.
        most = cube.top + 1 + 8 * BITS * (number.size // self._leaf + 1)
        rows = np.empty((min(most, number.size + cube.top + 1), NODE_COLUMNS), np.int64)
        for first, end in zip(starts.tolist(), [*starts[1:].tolist(), number.size], strict=True):
            found = cut_cell(steps, order, first, end, shape, tables, rows)
            for level, column, row, layer, start, count in rows[:found].tolist():
                yield Node(NodeKey(level, column, row, layer), order[start : start + count])

    @cached_property
    def _voxels(self) -> tuple[Int32, npt.NDArray[np.int64]]:
        size = 1 << 3 * SPAN_BITS
        return np.full(size, -1, np.int32), np.empty(size, np.int64)
