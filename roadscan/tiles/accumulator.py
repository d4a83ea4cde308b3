"""Accumulates readings into the cells of active tiles, yields finished tiles, and reuses the memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernels.column_statistics import LANES
from roadscan.compute.kernels.slots import SLOT_HEIGHTS, SLOT_SIZE, VECTOR
from roadscan.core.errors import RoadscanError
from roadscan.core.grid import QUANTUM_M, TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.georeference.kernels.readings import FATES
from roadscan.georeference.kernels.timed_readings import CHUNK
from roadscan.tiles.cells import MOST_CELL_BYTES, TileCells, TileEvidence
from roadscan.tiles.kernels import accumulate
from roadscan.tiles.kernels import cell_statistics as finishing
from roadscan.tiles.kernels.accumulate import (
    PIECE,
    CountingWork,
    Heights,
    accumulate_cells,
    accumulate_points,
    work_arrays,
)
from roadscan.tiles.kernels.bucket_statistics import MOST, bucket_points, finish_buckets, row_arrays
from roadscan.tiles.kernels.cell_statistics import AHEAD, CellColumns, find_groups, finish_cells
from roadscan.tiles.kernels.row_buckets import BLOCK, PASS, ActiveTiles, Buckets, sizes_of_rows, take_readings

ROBUST_FLOOR_QUANTA: Final = 100.0
"""Heights within 1 mm of the median always count."""

_BUCKETS: Final = 1 / 3
"""Share of that memory that readings in buckets may take, which are not counted yet."""

_FIRST_ELEMENTS: Final = 4096  # Elements of a new pool.
_COLUMNS: Final = (
    np.uint16, np.uint16, np.uint32, np.float64, np.float64, np.float64, np.float64, np.float32, np.float32,
)  # fmt: skip
"""Types of the columns of ``CellColumns`` except the last two."""
_NEVER: Final = np.array([2**62, -(2**62)])  # First and last epoch (GPS ns) of a tile without readings.


class Pool:
    """Memory for the heights of cells (``tiles.kernels.accumulate``); it grows and never shrinks."""

    def __init__(self) -> None:
        self.held = np.zeros(2, np.int64)
        self._columns: list[npt.NDArray[Any]] = []
        self.buckets = RowBuckets()
        self._make(_FIRST_ELEMENTS)

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(self.free.size)

    @property
    def bytes(self) -> int:
        """Memory of the elements (bytes)."""
        return sum(a.nbytes for a in self.arrays) - self.slots.nbytes  # the headers are views of the slots

    @property
    def arrays(self) -> accumulate.Pool:
        """The elements in the form that kernels take."""
        headers = self.slots.view(np.uint64)
        return accumulate.Pool(self.slots, headers, self.bases, self.chain, self.free, self.spare, self.held)

    def make_room(self, elements: int, most_bytes: int) -> bool:
        """Grow until so many elements are free; return False where that would take more than `most_bytes`."""
        needed = int(self.held[0]) + elements
        if needed <= self.size:
            return True
        size = max(needed, self.size * 4)  # unwritten memory takes no space, but growing copies what is written
        each = self.bytes // self.size
        if size * each > most_bytes:
            size = most_bytes // each
        if size < needed:
            return False
        kept = (self.slots, self.bases, self.chain, self.free, self.spare)
        self._make(size)
        for new, old in zip((self.slots, self.bases, self.chain, self.free, self.spare), kept, strict=True):
            new[: old.size] = old
        return True

    def columns(self, cells: int, passes: int) -> CellColumns:
        """Return arrays for the statistics of so many cells, the same ones at every call."""
        sizes = [cells] * len(_COLUMNS) + [cells + 1, cells * passes]
        kinds = (*_COLUMNS, np.int32, np.uint16)
        for k, (size, kind) in enumerate(zip(sizes, kinds, strict=True)):
            if k == len(self._columns):
                self._columns.append(np.empty(0, kind))
            if self._columns[k].size < size:
                self._columns[k] = np.empty(size * 5 // 4, kind)
        return CellColumns(*(array[:size] for array, size in zip(self._columns, sizes, strict=True)))

    def clear(self) -> None:
        """Return every element to the free list."""
        self.held[:] = 0
        self.free[:] = np.arange(self.size, dtype=np.int32)
        self.buckets.clear()

    def _make(self, size: int) -> None:
        self.slots = _aligned(size * LANES * SLOT_SIZE, np.int16)
        self.bases, self.chain, self.spare = (np.empty(size * LANES, np.int32) for _ in range(3))
        self.free = np.arange(size, dtype=np.int32)


def _aligned(size: int, kind: type[np.generic]) -> npt.NDArray[Any]:
    """Return an array that starts at a cache line; unwritten memory takes no space."""
    size *= np.dtype(kind).itemsize
    raw = np.empty(size + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + size].view(kind)


class Accumulator:
    """Counts readings into the cells of the active tiles.

    Tiles are activated before their first reading, and finished after their last one; readings outside the active
    tiles are not counted. A finished tile does not depend on the order of the readings, nor on what else was active.
    """

    def __init__(
        self,
        grid: TileGrid,
        tiles: Sequence[TileId],
        passes: Sequence[int] | npt.NDArray[np.uint16],
        pool: Pool | None = None,
        most_bytes: int = MOST_CELL_BYTES,
    ) -> None:
        """Create an accumulator without active tiles.

        Parameters
        ----------
        tiles : that may become active.
        passes : ids of those that readings may belong to.
        pool : memory for cells, unused; a new one where left out.
        most_bytes : memory that cells may take.
        """
        self.grid = grid
        self.passes = np.unique(np.asarray(passes, np.uint16))
        self._most_bytes = most_bytes
        columns, rows = [t.column for t in tiles], [t.row for t in tiles]
        self._west, self._south = min(columns), min(rows)
        self.tile_rows = np.full((max(rows) + 1 - self._south, max(columns) + 1 - self._west), -1, np.int32)
        self._pool = Pool() if pool is None else pool
        self._unused: list[int] = []
        self._groups = np.empty((0, self._groups_per_tile), np.int32)
        self._ends = np.empty((0, grid.cells_per_edge), np.int32)
        self.spans = np.empty((0, 2), np.int64)
        self.sigmas = np.empty((0, 2), np.float64)
        self._work = work_arrays(0)
        self._found = np.empty(self._groups_per_tile + AHEAD, np.int32)

    @property
    def corner_quanta(self) -> tuple[int, int]:
        """South-west corner of the box of all tiles."""
        return self._west * self.grid.size_quanta, self._south * self.grid.size_quanta

    @property
    def _groups_per_tile(self) -> int:
        edge = self.grid.cells_per_edge
        return edge * -(-edge // LANES)

    def activate(self, tiles: Sequence[TileId]) -> None:
        """Activate tiles: count their readings from now on."""
        for tile in tiles:
            if self._row(tile) >= 0:
                continue
            if not self._unused:
                self._add_rows(max(4, len(self._groups)))
            row = self._unused.pop()
            self.tile_rows[tile.row - self._south, tile.column - self._west] = row
            self.spans[row], self.sigmas[row] = _NEVER, -1.0

    @property
    def active(self) -> ActiveTiles:
        """The active tiles in the form that kernels take."""
        return ActiveTiles(
            self.tile_rows, self.corner_quanta, self.grid.cell_quanta, self.grid.cells_per_edge, self._groups,
            self._ends, self.spans, self.sigmas,
        )  # fmt: skip

    def run(
        self, kernel: Callable[[ActiveTiles, accumulate.Pool, CountingWork, int], int], items: int, elements: int
    ) -> None:
        """Call `kernel` with the active tiles, the pool, work and the first item until all items are done.

        The kernel stops before an item for which the pool is short of `elements`; the pool is then made larger.
        """
        done = 0
        while True:
            done = kernel(self.active, self._pool.arrays, self._work, done)
            if done >= items:
                return
            if not self._pool.make_room(elements, self._most_bytes):
                raise PoolExhaustedError(f"the cells of the tiles in work take more than {self._most_bytes >> 20} MB")

    def fill(self, kernel: Callable[[ActiveTiles, Buckets, int], int], items: int, blocks: int) -> None:
        """Call `kernel` with the active tiles, the buckets and the first item until all items are done.

        The kernel stops before an item for which there may be too few free `blocks`. Then the buckets get more memory,
        up to their share; beyond it, their readings are counted to free them.
        """
        buckets, done = self._pool.buckets, 0
        while True:
            done = kernel(self.active, buckets.arrays, done)
            if done >= items:
                return
            if not buckets.make_room(blocks, int(_BUCKETS * self._most_bytes)):
                for along, across in np.argwhere(self.tile_rows >= 0).tolist():
                    self._count_buckets(along, across)
                buckets.make_room(blocks, int(_BUCKETS * self._most_bytes))

    def finish(self, tile: TileId) -> tuple[TileCells, TileEvidence] | None:
        """Deactivate a tile and return its cells; None where no reading fell into it.

        The next finished tile overwrites them, since allocating memory would take as long as the statistics.
        """
        row, along, across = self._row(tile), tile.row - self._south, tile.column - self._west
        taken, most_slots = find_groups(self._groups[row], self._pool.chain, self._found)
        left, most_left = self._sizes(row)
        if (taken and left) or most_left >= MOST:
            self._count_buckets(along, across)
            taken, most_slots = find_groups(self._groups[row], self._pool.chain, self._found)
        self.tile_rows[along, across] = -1
        self._unused.append(row)
        if taken:
            cells = self._cells(tile, self._groups[row], taken, most_slots * SLOT_HEIGHTS)
        elif left:
            cells = self._bucketed_cells(tile, row, left, most_left)
        else:
            return None
        (first, last), (horizontal, down) = self.spans[row].tolist(), self.sigmas[row].tolist()
        return cells, TileEvidence(first, last, horizontal, down)

    def drop(self) -> None:
        """Deactivate all tiles without computing their cells."""
        self._groups[:] = -1
        self._ends[:] = 0
        self.tile_rows[:] = -1
        self._unused = list(range(len(self._groups)))
        self._pool.clear()

    def _sizes(self, row: int) -> tuple[int, int]:
        """Return the number of readings in the buckets of a tile, and in its fullest one."""
        buckets = self._pool.buckets
        total, most = sizes_of_rows(self._ends[row], buckets.before, buckets.sizes)
        return int(total), int(most)

    def _count_buckets(self, along: int, across: int) -> None:
        """Count the readings in a tile's buckets into its cells; `along` and `across` are its place in the box."""
        row, edge = int(self.tile_rows[along, across]), self.grid.cells_per_edge
        n, _ = self._sizes(row)
        column, rows, passes = (np.empty(n, np.int32) for _ in range(3))
        readings, intensity = Heights(column, rows, np.zeros(n + VECTOR, np.int32)), np.empty(n, np.uint16)
        buckets = self._pool.buckets.arrays
        take_readings(self._ends[row], buckets, across * edge, along * edge, readings, passes, intensity)
        told = np.zeros(FATES, np.int64)  # counted by outcome when they were put into buckets

        def count(active: ActiveTiles, pool: accumulate.Pool, work: CountingWork, first: int) -> int:
            done: int = accumulate_cells(readings, passes, intensity, active, pool, work, told, first)
            return done

        self.run(count, n, 2 * PIECE)

    def _row(self, tile: TileId) -> int:
        return int(self.tile_rows[tile.row - self._south, tile.column - self._west])

    def _add_rows(self, more: int) -> None:
        before = len(self._groups)
        self._groups = np.concatenate([self._groups, np.full((more, self._groups_per_tile), -1, np.int32)])
        self._ends = np.concatenate([self._ends, np.zeros((more, self._ends.shape[1]), np.int32)])
        self.spans = np.concatenate([self.spans, np.zeros((more, 2), np.int64)])
        self.sigmas = np.concatenate([self.sigmas, np.zeros((more, 2))])
        self._unused += range(before, before + more)
        self._work = work_arrays(before + more)

    def _cells(self, tile: TileId, groups: npt.NDArray[np.int32], taken: int, most: int) -> TileCells:
        columns = self._pool.columns(taken * LANES, self.passes.size)
        cells, written = finish_cells(
            groups, self._found, taken, self.grid.cells_per_edge, self._pool.arrays, ROBUST_FLOOR_QUANTA, QUANTUM_M,
            self.passes, finishing.work_arrays(most), columns,
        )  # fmt: skip
        return self._of_columns(tile, columns, cells, written)

    def _bucketed_cells(self, tile: TileId, row: int, readings: int, most: int) -> TileCells:
        edge = self.grid.cells_per_edge
        columns = self._pool.columns(min(readings, edge * edge), self.passes.size)
        cells, written = finish_buckets(
            self._ends[row], self._pool.buckets.arrays, ROBUST_FLOOR_QUANTA, QUANTUM_M, self.passes,
            row_arrays(edge, self.passes.size, most), columns,
        )  # fmt: skip
        return self._of_columns(tile, columns, cells, written)

    def _of_columns(self, tile: TileId, columns: CellColumns, cells: int, written: int) -> TileCells:
        own = {name: array[:cells] for name, array in columns._asdict().items()}
        offsets = columns.pass_offsets[: cells + 1]
        own["count"] = own.pop("readings")
        own |= {"pass_offsets": offsets, "pass_ids": columns.pass_ids[:written]}
        return TileCells(
            tile=tile, cells_per_edge=self.grid.cells_per_edge, pass_count=np.diff(offsets).astype(np.uint16), **own
        )


class PoolExhaustedError(RoadscanError):
    """The active tiles have more readings than memory allows: compute fewer of them at a time."""


_FIRST_BLOCKS: Final = 4096  # Blocks of new buckets, at least.
_RECORD, _BLOCK_NUMBERS = 8, 4 * 4  # Bytes of a reading, and of a block's four numbers.
BLOCK_BYTES: Final = BLOCK * _RECORD + _BLOCK_NUMBERS
"""Bytes of a block."""


class RowBuckets:
    """Blocks of readings; the memory grows and never shrinks."""

    def __init__(self) -> None:
        self.held = np.zeros(2, np.int64)
        self._make(0)
        self.clear()

    @property
    def size(self) -> int:
        """Number of blocks."""
        return int(self.free.size)

    @property
    def arrays(self) -> Buckets:
        """The blocks in the form that kernels take."""
        return Buckets(self.records, self.before, self.sizes, self.owners, self.free, self.held)

    def make_room(self, blocks: int, most_bytes: int) -> bool:
        """Grow until so many blocks are free; False where that takes more than `most_bytes` and some are in use."""
        needed = int(self.held[0]) + blocks
        if needed <= self.size:
            return True
        if needed * BLOCK_BYTES > most_bytes and self.held[0]:
            return False
        size = max(needed, min(self.size * 4, most_bytes // BLOCK_BYTES), _FIRST_BLOCKS)
        kept: tuple[npt.NDArray[Any], ...] = self.arrays[:-1]
        self._make(size)
        made: tuple[npt.NDArray[Any], ...] = self.arrays[:-1]
        for new, old in zip(made, kept, strict=True):
            new[: old.size] = old
        return True

    def clear(self) -> None:
        """Return every block to the free list."""
        self.held[:] = 0
        self.held[PASS] = -1
        self.free[:] = np.arange(self.size, dtype=np.int32)

    def _make(self, size: int) -> None:
        self.records = np.empty(size * BLOCK, np.uint64)
        self.before, self.sizes, self.owners = (np.empty(size, np.int32) for _ in range(3))
        self.free = np.arange(size, dtype=np.int32)


_SAMPLE: Final = 1 << 16
"""Number of points from which the order is determined."""
_MOST_CHANGES: Final = 256
"""With more changes of the pass than this, points are not put into buckets: each change closes a block of every row."""


def cells_of(points: TilePoints, grid: TileGrid) -> TileCells:
    """Return statistics of every cell with a point, independent of the order of the points to the bit.

    Sums are made of whole 10 µm, so they are exact. The squared deviations of one cell stay below 2⁶³ for
    up to 250,000 points spread over 60 m of height, and for more where the spread is less.

    Points that come cell by cell, as along a profile, are counted as they come; others by way of buckets.

    Parameters
    ----------
    points : at least one.
    """
    tile, n = points.tile, len(points)
    ids = points.pass_id
    one = bool((ids == ids[0]).all())
    accumulator = Accumulator(grid, [tile], ids[:1] if one else np.unique(ids), most_bytes=1 << 40)
    accumulator.activate([tile])
    passes = np.zeros(n, np.int32) if one else np.searchsorted(accumulator.passes, ids).astype(np.int32)
    x, y, height = (np.ascontiguousarray(a) for a in (points.x_quanta, points.y_quanta, points.height_quanta))
    intensity = np.ascontiguousarray(points.intensity)

    def count(active: ActiveTiles, pool: accumulate.Pool, work: CountingWork, first: int) -> int:
        done: int = accumulate_points(x, y, height, passes, intensity, active, pool, work, first)
        return done

    def fill(active: ActiveTiles, buckets: Buckets, first: int) -> int:
        own = active.ends[active.rows[0, 0]]
        done: int = bucket_points(x, y, height, passes, intensity, grid.cell_quanta, own, buckets, first)
        return done

    mixed = not one and np.count_nonzero(np.diff(passes)) > _MOST_CHANGES
    if mixed or _cell_by_cell(x, y, grid.cell_quanta):
        accumulator.run(count, n, 2 * PIECE)
    else:
        accumulator.fill(fill, n, CHUNK)
    finished = accumulator.finish(tile)
    if finished is None:
        raise ValueError(f"tile {tile} holds no point")
    return finished[0]


def _cell_by_cell(x: npt.NDArray[np.int32], y: npt.NDArray[np.int32], cell_quanta: int) -> bool:
    """Return whether half of the points lie in the cell of the point before."""
    column, row = x[:_SAMPLE] // cell_quanta, y[:_SAMPLE] // cell_quanta
    return bool(2 * np.count_nonzero((np.diff(column) == 0) & (np.diff(row) == 0)) >= len(column))
