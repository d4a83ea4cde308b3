"""What the tiles stage has to do: keys of tiles, which are stale, and the tasks that compute them."""

from __future__ import annotations

from collections.abc import Sequence
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

STRETCH_M = 1000.0
"""About as much road as one task computes, where no product needs points."""


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
    owned: tuple[tuple[int, int, TileId], ...]
    """(slice, position of the group, tile): groups whose readings are told by fate with that tile."""
    readings: int
    """Readings expected."""
    passes: tuple[LanePass, ...]
    centre_lines: CentreLines | None
    products: tuple[WantedProduct, ...]
    context: ProductContext
    cell_table: CellColumns = "full"

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
    names = [(s.source.key, digests[s.file], plan.pass_key(s.source.run)) for s in f.slices]
    tiles: dict[TileId, PlannedTile] = {}
    for start, end in zip(starts, np.append(starts[1:], order.size), strict=True):
        part = order[start:end]
        ranges = zip(
            f.slice_index[part].tolist(), f.first_group[part].tolist(), f.last_group[part].tolist(), strict=True
        )
        key = key_of(plan.tile_key, [(*names[s], a, b) for s, a, b in ranges])
        tiles[TileId(int(column[start]), int(row[start]))] = PlannedTile(key, int(f.readings[part].sum()), part)
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
        blocks = cut_blocks({t: self.tiles[t].readings for t in chosen}, config.block_tiles, config.max_block_readings)
        probe = self.task(Block(()))
        if blocks and not self._points_of(probe):
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
        readings = {t: self.tiles[t].readings for t in chosen}
        edge = max(1, round(STRETCH_M / 10 / config.size_m))
        first = self.footprints.first_epoch_gps_ns
        parts = sorted(
            (b.tiles for b in cut_blocks(readings, edge, 1 << 62)),
            key=lambda tiles: min(int(first[self.tiles[t].rows].min()) for t in tiles),
        )
        together = max(1, min(10, len(parts) // (4 * workers)))
        ordered: list[Block] = []
        for start in range(0, len(parts), together):
            tiles = [t for part in parts[start : start + together] for t in part]
            tiles.sort(key=lambda t: (int(first[self.tiles[t].rows].min()), t.row, t.column))
            ordered.append(Block(tuple(tiles)))
        return ordered

    def task(self, block: Block) -> TileTask:
        """A task over a block."""
        f = self.footprints
        core = set(block.tiles)
        rows = [self.tiles[t].rows for t in sorted(block.with_halo()) if t in self.tiles]
        every = np.concatenate([np.zeros(0, np.int64), *rows])
        slices: list[RawSlice] = []
        numbers: dict[int, int] = {}
        places: dict[int, dict[int, int]] = {}
        for index in np.unique(f.slice_index[every]).tolist():
            own = every[f.slice_index[every] == index]
            groups = _groups(f.first_group[own], f.last_group[own])
            whole = f.slices[index]
            ordered = [g for _, g in sorted((whole.spans[g], g) for g in groups.tolist())]
            share = whole.bytes * len(ordered) // max(len(whole.groups), 1)
            numbers[index] = len(slices)
            places[index] = {g: k for k, g in enumerate(ordered)}
            spans = tuple(whole.spans[g] for g in ordered)
            slices.append(RawSlice(whole.source, whole.file, tuple(ordered), spans, share))
        touches = tuple(
            tuple(
                touch
                for r in self.tiles[tile].rows.tolist()
                for touch in _touches(
                    numbers[int(f.slice_index[r])], places[int(f.slice_index[r])], f.first_group[r], f.last_group[r]
                )
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
            owned=tuple(
                (numbers[index], own[group], owner)
                for index, own in places.items()
                for group in own
                if (owner := self._owner(index, group)) in core
            ),
            readings=sum(self.tiles[t].readings for t in block.tiles),
            passes=self.plan.passes,
            centre_lines=self.plan.centre_lines,
            products=self.products,
            context=self.context,
            cell_table=config.cell_table,
        )

    @cached_property
    def _owners(self) -> dict[int, npt.NDArray[np.int32]]:
        """(groups, 2) column and row of the tile that tells the fates of a group's readings, by slice.

        It is the first of those that the group touches, by row and column; −1 −1 … where it touches none.
        """
        f = self.footprints
        found = {
            s: np.full((len(f.slices[s].groups), 2), -(2**31), np.int32) for s in np.unique(f.slice_index).tolist()
        }
        for r in np.lexsort((f.tile_column, f.tile_row))[::-1].tolist():
            found[int(f.slice_index[r])][f.first_group[r] : f.last_group[r] + 1] = f.tile_column[r], f.tile_row[r]
        return found

    def _owner(self, index: int, group: int) -> TileId:
        column, row = self._owners[index][group].tolist()
        return TileId(column, row)


def _groups(first: npt.NDArray[np.int32], last: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
    """Numbers of all row groups of some ranges."""
    return np.unique(np.concatenate([np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]))


def _touches(index: int, places: dict[int, int], first: int, last: int) -> list[TileTouch]:
    """Runs of positions of the row groups `first` to `last`."""
    at = np.sort([places[g] for g in range(first, last + 1)])
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
