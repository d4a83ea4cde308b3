"""Plans the tiles stage: keys of tiles, stale tiles, and the tasks that compute them.

A block is of neighbouring tiles that one task computes, with the halo around them. The content of a tile never depends
on the block it was computed in.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64
from roadscan.core.grid import LanePass, TileId
from roadscan.core.survey import CellColumns
from roadscan.footprints.footprints import FootprintRanges, footprints_of
from roadscan.footprints.row_groups import GroupsByTile
from roadscan.georeference.plan.plan import SurveyPlan, plan_of
from roadscan.georeference.sources import CentreLines, MapSettings, RawSlice, road_key
from roadscan.run.engine.compute import LazyTasks
from roadscan.run.keys import key_of, keys_beside, keys_of
from roadscan.run.session import Session, found_once
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext, WantedProduct


@dataclass(frozen=True)
class Block:
    """Tiles that are computed together."""

    tiles: tuple[TileId, ...]
    """Core tiles, by row and column."""
    halo_tiles: int = 0
    """Rings of neighbouring tiles whose points are loaded as well."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the tiles as one array: one by one they take longer than the rest of a task."""
        packed = np.array(self.tiles, np.int32).reshape(-1, 2)
        return _unpacked, (packed, self.halo_tiles)

    def box(self) -> tuple[int, int, int, int]:
        """First column, first row, end column, end row of core and halo."""
        columns = [t.column for t in self.tiles]
        rows = [t.row for t in self.tiles]
        h = self.halo_tiles
        return min(columns) - h, min(rows) - h, max(columns) + 1 + h, max(rows) + 1 + h

    def with_halo(self) -> frozenset[TileId]:
        """Return core tiles and the halo around each of them."""
        reach = range(-self.halo_tiles, self.halo_tiles + 1)
        return frozenset(TileId(t.column + c, t.row + r) for t in self.tiles for c in reach for r in reach)


def _unpacked(packed: npt.NDArray[np.int32], halo_tiles: int) -> Block:
    return Block(tuple(map(TileId._make, packed.tolist())), halo_tiles)


def cut_blocks(readings: Mapping[TileId, int], edge_tiles: int, max_readings: int, halo_tiles: int = 0) -> list[Block]:
    """Cut tiles into blocks of at most `edge_tiles`² tiles and about `max_readings` readings.

    Parameters
    ----------
    readings : readings expected in each tile to be computed.
    edge_tiles : edge of the largest block; blocks lie on the lattice of that edge.
    max_readings : a block with more is divided into four, down to single tiles.
    """
    groups: dict[tuple[int, int], list[TileId]] = {}
    for tile in sorted(readings, key=lambda t: (t.row, t.column)):
        groups.setdefault((tile.row // edge_tiles, tile.column // edge_tiles), []).append(tile)
    blocks: list[Block] = []
    for _, tiles in sorted(groups.items()):
        too_many = sum(readings[t] for t in tiles) > max_readings
        if too_many and edge_tiles > 1 and len(tiles) > 1:
            part = {t: readings[t] for t in tiles}
            blocks += cut_blocks(part, max(edge_tiles // 2, 1), max_readings, halo_tiles)
        else:
            blocks.append(Block(tuple(tiles), halo_tiles))
    return blocks


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


TILE = "tile"
"""Manifest name of a tile as a whole; its file holds the cells."""

OVERVIEWS = "overviews"
"""Manifest name of a tile's overviews; their record has the tile's key."""


@dataclass(frozen=True)
class PlannedTiles(DrivenTiles):
    """Every tile that readings may touch, by row and column, with its key."""

    keys: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.keys)

    def __iter__(self) -> Iterator[TileId]:
        return iter(self.ids)

    def __contains__(self, tile: object) -> bool:
        return tile in self.number

    @cached_property
    def ids(self) -> tuple[TileId, ...]:
        """All tiles."""
        return tuple(map(TileId._make, zip(self.column.tolist(), self.row.tolist(), strict=True)))

    @cached_property
    def units(self) -> list[str]:
        """Name of each tile in the manifest."""
        return [f"{column}_{row}" for column, row in zip(self.column.tolist(), self.row.tolist(), strict=True)]

    @cached_property
    def number(self) -> dict[TileId, int]:
        """Index of each tile in the arrays."""
        return {tile: number for number, tile in enumerate(self.ids)}

    def numbers(self, tiles: Iterable[TileId]) -> npt.NDArray[np.int64]:
        """Return the indices of some tiles; raises `KeyError` for an unknown one."""
        asked = list(tiles)
        found, is_held = self._found(asked)
        if not is_held.all():
            raise KeyError(asked[int(np.argmin(is_held))])
        return found

    def held(self, tiles: Iterable[TileId]) -> npt.NDArray[np.int64]:
        """Return the indices of those of some tiles that are among these."""
        found, is_held = self._found(list(tiles))
        return found[is_held]

    def _found(self, tiles: Sequence[TileId]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        wanted = np.array([(tile.row, tile.column) for tile in tiles], dtype=np.int64).reshape(-1, 2)
        place = _places(*wanted.T)
        found = np.searchsorted(self._place, place)
        return found, self._place.take(found, mode="clip") == place if len(self) else np.zeros(found.shape, bool)

    @cached_property
    def _place(self) -> npt.NDArray[np.int64]:
        return _places(self.row, self.column)


def _places(row: npt.NDArray[Any], column: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return numbers that order tiles by row and column."""
    return (row.astype(np.int64) << 32) + column.astype(np.int64)


@dataclass(frozen=True)
class TileTouch:
    """Row groups that may touch a tile of a task: positions in the groups of one of its slices."""

    slice_index: int
    first: int
    end: int


@dataclass(frozen=True)
class TileTask:
    """Everything a worker needs to compute some tiles; it holds no data, and no epoch of single row groups."""

    store: Store
    ground: MapSettings
    block: Block
    """The tiles, and the halo whose points are loaded as well."""
    keys: tuple[str, ...]
    """Key of each core tile."""
    slices: tuple[RawSlice, ...]
    """Raw blocks that may touch the tiles, sorted by run, sensor and time."""
    touched: npt.NDArray[np.int32]
    """(n, 4) core tile by its index in the block, slice, first position and end in its groups."""
    owned_runs: npt.NDArray[np.int32]
    """(n, 4) slice, first position, end, core tile: groups on whose readings that tile reports."""
    readings: int
    """Expected number of readings."""
    passes: tuple[LanePass, ...]
    centre_lines: CentreLines | None
    products: tuple[WantedProduct, ...]
    context: ProductContext
    cell_table: CellColumns = "full"

    @cached_property
    def touches(self) -> tuple[tuple[TileTouch, ...], ...]:
        """Row groups that may touch each core tile."""
        found: list[list[TileTouch]] = [[] for _ in self.block.tiles]
        for place, index, first, end in self.touched.tolist():
            found[place].append(TileTouch(index, first, end))
        return tuple(map(tuple, found))

    @property
    def owned(self) -> Iterator[tuple[int, int, TileId]]:
        """(slice, position of the group, tile), group by group."""
        tiles = self.block.tiles
        return ((s, k, tiles[place]) for s, first, end, place in self.owned_runs.tolist() for k in range(first, end))

    @property
    def raw_bytes(self) -> int:
        """Approximate compressed bytes to read."""
        return sum(s.bytes for s in self.slices)

    @property
    def needs_points(self) -> bool:
        """True where points are needed: for a product, for a filter, or because the data are points."""
        return (
            any(w.product.needs_points for w in self.products)
            or self.centre_lines is not None
            or self.ground.marks
            or any(s.source.table == "cloud" for s in self.slices)
        )


def plan_tiles(footprints: FootprintRanges, plan: SurveyPlan) -> PlannedTiles:
    """Return every tile that raw data may touch."""
    f = footprints
    order = np.lexsort((f.first_group, f.slice_index, f.tile_column, f.tile_row))
    column, row = f.tile_column[order], f.tile_row[order]
    is_first = np.concatenate([np.ones(min(order.size, 1), bool), (np.diff(column) != 0) | (np.diff(row) != 0)])
    starts = np.flatnonzero(is_first)
    ends = np.append(starts[1:], order.size)[: starts.size]
    digests = {one.path: one.digest for _, files in plan.sources for one in files}
    names = np.array(
        [key_of(s.source.key, digests[s.file], plan.pass_key(s.source.run), *road_key(s.source)) for s in f.slices],
        "S16",
    )
    content = np.empty(order.size, dtype=[("name", "S16"), ("corrections", "<u8"), ("first", "<i4"), ("last", "<i4")])
    content["name"] = names[f.slice_index[order]]
    content["corrections"] = _correction_digests(f, plan)[order]
    content["first"], content["last"] = f.first_group[order], f.last_group[order]
    return PlannedTiles(
        column=column[starts],
        row=row[starts],
        keys=tuple(keys_of(plan.tile_key, content, ends)),
        readings=np.add.reduceat(f.readings[order], starts) if starts.size else f.readings[:0],
        first_epoch_gps_ns=np.minimum.reduceat(f.first_epoch_gps_ns[order], starts)
        if starts.size
        else f.first_epoch_gps_ns[:0],
        groups=GroupsByTile(f, order, np.append(starts, order.size)),
    )


def _correction_digests(f: FootprintRanges, plan: SurveyPlan) -> npt.NDArray[np.uint64]:
    """Return a digest (n,) of the corrections that affect the readings of each run of row groups."""
    found = np.zeros(f.slice_index.size, np.uint64)
    order = np.argsort(f.slice_index, kind="stable")
    ends = np.searchsorted(f.slice_index[order], np.arange(len(f.slices)), side="right").tolist()
    for one, (first, end) in zip(f.slices, itertools.pairwise([0, *ends]), strict=True):
        if one.source.run in plan.corrections.by_run or one.source.mounting_change is not None:
            own = order[first:end]
            spans = np.column_stack([f.first_epoch_gps_ns[own], f.last_epoch_gps_ns[own]])
            found[own] = plan.corrections.digests(one.source, spans, plan.ground.max_gap_s)
    return found


def stale_tiles(tiles: PlannedTiles, products: Sequence[WantedProduct], manifest: Manifest) -> dict[TileId, str]:
    """Tiles that are missing, changed, or lack a wanted product, each with the reason."""
    units = tiles.units
    found = manifest.reasons(TILE, units, tiles.keys)
    bare = found.keys() | manifest.without_file(TILE)  # without points, and so without files
    kept = [number for number, unit in enumerate(units) if unit not in bare]
    own, keys = [units[number] for number in kept], [tiles.keys[number] for number in kept]
    wanted = ((name, keys_beside(keys, one.key)) for one in products for name in one.files)
    for name, theirs in itertools.chain([(OVERVIEWS, keys)], wanted):
        for unit, why in manifest.reasons(name, own, theirs).items():
            found.setdefault(unit, f"{name} {why}")
    return {tile: found[unit] for tile, unit in zip(tiles.ids, units, strict=True) if unit in found} if found else {}


@dataclass(frozen=True)
class TilePlan:
    """Tiles of a survey and the products to be made of them."""

    plan: SurveyPlan
    footprints: FootprintRanges
    tiles: PlannedTiles
    products: tuple[WantedProduct, ...]
    context: ProductContext

    def tasks(self, chosen: Sequence[TileId], workers: int = 1) -> Sequence[TileTask]:
        """Return tasks over the chosen tiles: two kilometres each, or less to occupy so many workers.

        Where products need points, a task is a block that fits into memory.
        """
        config = self.plan.survey.config.tiles
        if not chosen:
            return []
        numbers = self.tiles.numbers(chosen)
        if self._points_of(self.task(Block(()))):
            readings = dict(zip(chosen, self.tiles.readings[numbers].tolist(), strict=True))
            return [self.task(b) for b in cut_blocks(readings, config.block_tiles, config.max_block_readings)]
        return LazyTasks(cut_stretches(self.tiles, numbers, config.size_m, workers), self._stretch)

    def _stretch(self, own: npt.NDArray[np.int64]) -> TileTask:
        """Return a task over tiles by number, without halo."""
        return self._task(Block(tuple(map(self.tiles.ids.__getitem__, own.tolist()))), own, own)

    def singly(self, chosen: Sequence[TileId]) -> list[TileTask]:
        """Return a task for each tile."""
        return [self.task(Block((tile,))) for tile in chosen]

    def _points_of(self, task: TileTask) -> bool:
        return task.needs_points or any(s.source.table == "cloud" for s in self.footprints.slices)

    def task(self, block: Block) -> TileTask:
        """Return a task over a block."""
        return self._task(block, self.tiles.numbers(block.tiles), self.tiles.held(block.with_halo()))

    def _task(self, block: Block, core: npt.NDArray[np.int64], near: npt.NDArray[np.int64]) -> TileTask:
        """Return a task over the tiles numbered `core`, with the row groups of those numbered `near`."""
        tiles = self.tiles
        runs = tiles.groups.runs(near)
        cuts = np.flatnonzero(np.diff(runs.slice, prepend=-1))
        spans = list(zip(runs.first_epoch_gps_ns.tolist(), runs.last_epoch_gps_ns.tolist(), strict=True))
        slices: list[RawSlice] = []
        for start, end in itertools.pairwise([*cuts.tolist(), len(spans)]):
            whole = self.footprints.slices[int(runs.source[start])]
            groups = tiles.groups.groups(runs, start, end)
            share = whole.bytes * len(groups) // max(len(whole.groups), 1)
            slices.append(RawSlice(whole.source, whole.file, groups, tuple(spans[start:end]), share))
        return TileTask(
            store=self.plan.store,
            ground=self.plan.ground,
            block=block,
            keys=tuple(map(tiles.keys.__getitem__, core.tolist())),
            slices=tuple(slices),
            touched=tiles.groups.touched(runs, core),
            owned_runs=tiles.groups.owned(runs, core),
            readings=int(tiles.readings[core].sum()),
            passes=self.plan.passes,
            centre_lines=self.plan.centre_lines,
            products=self.products,
            context=self.context,
            cell_table=self.plan.survey.config.tiles.cell_table,
        )


@found_once
def tiles_of(session: Session) -> PlannedTiles:
    """Return the tiles that a reading may touch, with their keys."""
    return plan_tiles(footprints_of(session), plan_of(session))


APART_FIGURE: Final = "passes_apart"
"""Name of the figure in a tile's record."""
