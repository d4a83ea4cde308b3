"""An octree over the points of a cloud, in which each node samples its cube in ever finer voxels.

A point stands in one node: the coarsest in which it lies nearest to the centre of its voxel among all points that no
coarser node took (the additive sampling of Schütz, *Potree*, 2016, and of COPC 1.0).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import StoreError
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

Int32 = npt.NDArray[np.int32]

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
