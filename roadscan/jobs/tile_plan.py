"""What the tiles stage has to do: keys of tiles, which are stale, and the tasks that compute them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from roadscan.jobs.centre_line import CentreLines
from roadscan.jobs.fingerprint import key_of
from roadscan.jobs.footprints import FootprintRanges
from roadscan.jobs.plan import SurveyPlan
from roadscan.jobs.readings import Ground, RawSlice
from roadscan.jobs.tile_files import WantedProduct
from roadscan.model.ids import LanePass, TileId
from roadscan.model.survey import CellColumns
from roadscan.products.base import ProductContext
from roadscan.tables.manifest import Manifest
from roadscan.tables.store import Store
from roadscan.tiles.blocks import Block, cut_blocks

TILE = "tile"
"""Manifest name of a tile as a whole; its file holds the cells."""

OVERVIEWS = "overviews"
"""Manifest name of a tile's overviews; their record has the key of the tile's own."""

_SQUARE_M = 100.0
"""Edge of the squares whose tiles stay together, where no product needs points."""

_SQUARES = 15
"""Squares that one task computes at most: a kilometre of road oblique to the grid, one and a half along it."""


@dataclass(frozen=True)
class PlannedTile:
    """A tile that readings may touch."""

    key: str
    readings: int
    """About how many."""
    rows: npt.NDArray[np.int64]
    """Its rows in the footprints."""


@dataclass(frozen=True)
class TileTouch:
    """Row groups that may touch a tile of a task: positions in the groups of one of its slices."""

    slice_index: int
    first: int
    end: int


@dataclass(frozen=True)
class TileTask:
    """Everything a worker needs to compute some tiles; it holds no data."""

    store: Store
    ground: Ground
    block: Block
    """The tiles, and the halo whose points are loaded as well."""
    keys: tuple[str, ...]
    """Key of each core tile."""
    slices: tuple[RawSlice, ...]
    """Raw blocks that may touch the tiles, sorted by run, sensor and time."""
    touches: tuple[tuple[TileTouch, ...], ...]
    """Of each core tile."""
    owned_runs: tuple[tuple[int, int, int, TileId], ...]
    """(slice, first position, end, tile): groups whose readings are told by fate with that tile."""
    readings: int
    """Readings expected."""
    passes: tuple[LanePass, ...]
    centre_lines: CentreLines | None
    products: tuple[WantedProduct, ...]
    context: ProductContext
    cell_table: CellColumns = "full"

    @property
    def owned(self) -> Iterator[tuple[int, int, TileId]]:
        """(slice, position of the group, tile), group by group."""
        return ((s, k, tile) for s, first, end, tile in self.owned_runs for k in range(first, end))

    @property
    def raw_bytes(self) -> int:
        """Compressed bytes to read, about."""
        return sum(s.bytes for s in self.slices)

    @property
    def needs_points(self) -> bool:
        """True where single points have to be placed: for a product, for a filter, or because they are given."""
        return (
            any(w.product.needs_points for w in self.products)
            or self.centre_lines is not None
            or self.ground.marks
            or any(s.source.table == "cloud" for s in self.slices)
        )


def plan_tiles(footprints: FootprintRanges, plan: SurveyPlan) -> dict[TileId, PlannedTile]:
    """Every tile that a raw block may touch."""
    if not footprints.tile_column.size:
        return {}
    f = footprints
    order = np.lexsort((f.first_group, f.slice_index, f.tile_column, f.tile_row))
    column, row = f.tile_column[order], f.tile_row[order]
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(column) != 0) | (np.diff(row) != 0)]))
    digests = {one.path: one.digest for _, files in plan.sources for one in files}
    names = [key_of(s.source.key, digests[s.file], plan.pass_key(s.source.run)) for s in f.slices]
    ranges = list(
        zip(f.slice_index[order].tolist(), f.first_group[order].tolist(), f.last_group[order].tolist(), strict=True)
    )
    readings = np.add.reduceat(f.readings[order], starts).tolist()
    ends = [*starts[1:].tolist(), order.size]
    places = zip(column[starts].tolist(), row[starts].tolist(), strict=True)
    tiles: dict[TileId, PlannedTile] = {}
    for place, start, end, expected in zip(places, starts.tolist(), ends, readings, strict=True):
        key = key_of(plan.tile_key, [(names[s], a, b) for s, a, b in ranges[start:end]])
        tiles[TileId(*place)] = PlannedTile(key, expected, order[start:end])
    return tiles


def stale_tiles(
    tiles: dict[TileId, PlannedTile], products: Sequence[WantedProduct], manifest: Manifest
) -> list[TileId]:
    """Tiles that are missing, changed, or lack a wanted product."""
    return [tile for tile, planned in tiles.items() if not _is_current(tile, planned.key, products, manifest)]


@dataclass(frozen=True)
class TilePlan:
    """Tiles of a survey and what is to be made of them."""

    plan: SurveyPlan
    footprints: FootprintRanges
    tiles: dict[TileId, PlannedTile]
    products: tuple[WantedProduct, ...]
    context: ProductContext

    def tasks(self, chosen: Sequence[TileId], workers: int = 1) -> list[TileTask]:
        """Tasks over the chosen tiles: a kilometre each, or less where there are few for that many workers.

        Where products need points, a task is a block that fits into memory.
        """
        config = self.plan.survey.config.tiles
        if not chosen:
            return []
        if self._points_of(self.task(Block(()))):
            readings = {t: self.tiles[t].readings for t in chosen}
            blocks = cut_blocks(readings, config.block_tiles, config.max_block_readings)
        else:
            blocks = self._stretches(chosen, workers)
        return [self.task(block) for block in blocks]

    def singly(self, chosen: Sequence[TileId]) -> list[TileTask]:
        """A task for each tile."""
        return [self.task(Block((tile,))) for tile in chosen]

    def _points_of(self, task: TileTask) -> bool:
        return task.needs_points or any(s.source.table == "cloud" for s in self.footprints.slices)

    def _stretches(self, chosen: Sequence[TileId], workers: int) -> list[Block]:
        """Tiles in the order in which they were driven over, cut into stretches."""
        config = self.plan.survey.config.tiles
        edge = max(1, round(_SQUARE_M / config.size_m))
        epoch_gps_ns = self.footprints.first_epoch_gps_ns
        first = {t: int(epoch_gps_ns[self.tiles[t].rows].min()) for t in chosen}
        squares = sorted(
            (b.tiles for b in cut_blocks({t: self.tiles[t].readings for t in chosen}, edge, 1 << 62)),
            key=lambda tiles: min(first[t] for t in tiles),
        )
        together = max(1, min(_SQUARES, len(squares) // (4 * workers)))
        ordered: list[Block] = []
        for start in range(0, len(squares), together):
            tiles = [t for square in squares[start : start + together] for t in square]
            tiles.sort(key=lambda t: (first[t], t.row, t.column))
            ordered.append(Block(tuple(tiles)))
        return ordered

    def task(self, block: Block) -> TileTask:
        """A task over a block."""
        f = self.footprints
        core = {(t.column, t.row): t for t in block.tiles}
        rows = [self.tiles[t].rows for t in sorted(block.with_halo()) if t in self.tiles]
        every = np.concatenate([np.zeros(0, np.int64), *rows])
        slices: list[RawSlice] = []
        numbers: dict[int, int] = {}
        places: dict[int, npt.NDArray[np.int64]] = {}
        owned: list[tuple[int, int, int, TileId]] = []
        for index in np.unique(f.slice_index[every]).tolist():
            own = every[f.slice_index[every] == index]
            whole = f.slices[index]
            groups = _groups(f.first_group[own], f.last_group[own])
            groups = groups[np.argsort(self._ranks(index)[groups])]
            share = whole.bytes * groups.size // max(len(whole.groups), 1)
            numbers[index] = len(slices)
            places[index] = np.full(len(whole.groups), -1)
            places[index][groups] = np.arange(groups.size)
            owners = self._owners[index][groups]
            cuts = np.flatnonzero((np.diff(owners, axis=0) != 0).any(axis=1)) + 1
            runs = zip([0, *cuts.tolist()], [*cuts.tolist(), groups.size], strict=True)
            owned += [
                (len(slices), start, end, tile)
                for start, end in runs
                if (tile := core.get((int(owners[start, 0]), int(owners[start, 1])))) is not None
            ]
            ordered = groups.tolist()
            spans = tuple(whole.spans[g] for g in ordered)
            slices.append(RawSlice(whole.source, whole.file, tuple(ordered), spans, share))
        touches = tuple(
            tuple(
                touch
                for s, a, b in (self._ranges[r] for r in self.tiles[tile].rows.tolist())
                for touch in _touches(numbers[s], places[s][a : b + 1])
            )
            for tile in block.tiles
        )
        config = self.plan.survey.config.tiles
        return TileTask(
            store=self.plan.store,
            ground=self.plan.ground,
            block=block,
            keys=tuple(self.tiles[t].key for t in block.tiles),
            slices=tuple(slices),
            touches=touches,
            owned_runs=tuple(owned),
            readings=sum(self.tiles[t].readings for t in block.tiles),
            passes=self.plan.passes,
            centre_lines=self.plan.centre_lines,
            products=self.products,
            context=self.context,
            cell_table=config.cell_table,
        )

    @cached_property
    def _ranges(self) -> list[tuple[int, int, int]]:
        """Slice, first and last group of each row of the footprints."""
        f = self.footprints
        return list(zip(f.slice_index.tolist(), f.first_group.tolist(), f.last_group.tolist(), strict=True))

    @cached_property
    def _owners(self) -> dict[int, npt.NDArray[np.int32]]:
        """(groups, 2) column and row of the tile that tells the fates of a group's readings, by slice.

        It is the first of those that the group touches, by row and column; −1 −1 … where it touches none.
        """
        f = self.footprints
        found = {
            s: np.full((len(f.slices[s].groups), 2), -(2**31), np.int32) for s in np.unique(f.slice_index).tolist()
        }
        order = np.lexsort((f.tile_column, f.tile_row))[::-1]
        for r, place in zip(order.tolist(), np.column_stack([f.tile_column, f.tile_row])[order], strict=True):
            index, first, last = self._ranges[r]
            found[index][first : last + 1] = place
        return found

    def _ranks(self, index: int) -> npt.NDArray[np.int64]:
        """(groups,) place of each row group of a slice in the order of time."""
        if index not in self._rank_of:
            spans = np.array(self.footprints.slices[index].spans, dtype=np.int64).reshape(-1, 2)
            ranks = np.empty(len(spans), np.int64)
            ranks[np.lexsort((spans[:, 1], spans[:, 0]))] = np.arange(len(spans))
            self._rank_of[index] = ranks
        return self._rank_of[index]

    @cached_property
    def _rank_of(self) -> dict[int, npt.NDArray[np.int64]]:
        return {}


def _groups(first: npt.NDArray[np.int32], last: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
    """Numbers of all row groups of some ranges, ascending."""
    end = int(last.max()) + 2
    begun = np.bincount(first, minlength=end) - np.bincount(last + 1, minlength=end)
    return np.flatnonzero(np.cumsum(begun))


def _touches(index: int, places: npt.NDArray[np.int64]) -> list[TileTouch]:
    """Runs of the positions of consecutive row groups."""
    low, high = int(places.min()), int(places.max())
    if high - low + 1 == places.size:  # in the order of time, as nearly always
        return [TileTouch(index, low, high + 1)]
    at = np.sort(places)
    breaks = np.flatnonzero(np.diff(at) != 1) + 1
    return [TileTouch(index, int(part[0]), int(part[-1]) + 1) for part in np.split(at, breaks)]


def _is_current(tile: TileId, key: str, products: Sequence[WantedProduct], manifest: Manifest) -> bool:
    if not manifest.is_current(TILE, str(tile), key):
        return False
    record = manifest.get(TILE, str(tile))
    if record is not None and not record.path:
        return True  # without points there are no files
    if not manifest.is_current(OVERVIEWS, str(tile), key):
        return False
    return all(
        manifest.is_current(name, str(tile), key_of(key, wanted.key)) for wanted in products for name in wanted.files
    )
