"""Makes products over many tiles from the tiles' cells. One task makes several files that draw the same tiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from roadscan.core.grid import TileId
from roadscan.core.strict import Strict
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.run.engine.compute import Compute, run_bundles
from roadscan.run.keys import key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded
from roadscan.store.store import Store
from roadscan.tiles.cells import CellValues, Level, TileCells, pyramid_of, read_cells, read_overview, read_values
from roadscan.tiles.lane_direction import Drives, LaneDirections
from roadscan.tiles.product import (
    Output,
    ProductContext,
    SurveyProduct,
    TileSummary,
    products,
)
from roadscan.tiles.tasks.tile_figures import tile_figures
from roadscan.tiles.tasks.tile_plan import OVERVIEWS, TILE
from roadscan.tiles.tasks.wanted_products import product_context, product_key, wanted_products

_TILES_DRAWN = 2000
"""Tiles that one task draws, counted as often as they are drawn: six rasters of `kilometre` over two kilometres."""
_NOWHERE = TileId(0, 0)  # Sorts before other tiles, for an output without tiles.


@dataclass(frozen=True)
class OutputTask:
    """One file of a survey product, as a task gets it."""

    store: Store
    product: SurveyProduct
    options: Strict
    context: ProductContext
    output: Output
    key: str
    summaries: tuple[TileSummary, ...]
    cells: tuple[OutputRecord, ...]
    """Records of the cells that the output may read."""
    overviews: tuple[OutputRecord, ...] = ()
    """Records of the overviews of the same tiles, where there are any."""
    files: tuple[OutputRecord, ...] = ()
    """Records of the files of surface products from which the output is made."""
    drives: Drives | None = None
    """Trajectories of the vehicles, for a product that needs them."""

    @property
    def target(self) -> str:
        """Path of the file, relative to the survey's root."""
        return f"products/{self.product.name}/{self.output.name}"


@dataclass(frozen=True)
class PlannedOutput:
    """One file of a survey product that there should be."""

    product: SurveyProduct
    options: Strict
    output: Output
    key: str
    read: tuple[OutputRecord, ...]
    """Records of the files of surface products from which it is made."""

    @property
    def unit(self) -> tuple[str, str, str]:
        """Its product, name and key, as the manifest knows it."""
        return self.product.name, self.output.name, self.key


def plan_outputs(plan: SurveyPlan, manifest: Manifest) -> tuple[list[OutputTask], list[OutputRecord]]:
    """Files of survey products that are missing or stale, and records of those no longer due."""
    due, gone = wanted_outputs(plan, manifest)
    stale = [one for one in due if not manifest.is_current(*one.unit)]
    return _tasks(stale, plan, manifest), gone


def wanted_outputs(plan: SurveyPlan, manifest: Manifest) -> tuple[list[PlannedOutput], list[OutputRecord]]:
    """Files of survey products that there should be of the tiles that there are, and records of others."""
    context = product_context(plan)
    planned = [
        one
        for product, options in wanted_products(plan.survey)
        if isinstance(product, SurveyProduct)
        for one in _planned(product, options, plan, context, manifest)
    ]
    due = {(one.product.name, one.output.name) for one in planned}
    kinds = {name for name, p in products().items() if isinstance(p, SurveyProduct)}
    return planned, [r for r in manifest.beside(kinds, ()) if (r.product, r.unit) not in due]


def make_products(
    plan: SurveyPlan,
    manifest: Manifest,
    compute: Compute,
    report: Callable[[int, int], None] = lambda _a, _b: None,
) -> list[tuple[str, str]]:
    """Make the survey products that are missing or stale, and remove those no longer due; return the failures."""
    stale, gone = plan_outputs(plan, manifest)
    manifest.remove(gone)
    stale.sort(key=lambda t: (t.product.name, min(t.output.tiles, default=_NOWHERE)))  # by tiles drawn
    failed = run_bundles(write_output, stale, lambda t: len(t.output.tiles), _TILES_DRAWN, manifest, compute, report)
    return [(f"{task.product.name}/{task.output.name}", reason) for task, reason in failed]


def write_output(task: OutputTask) -> OutputRecord:
    """Write one file of a survey product (runs on a worker)."""
    with task.store.scratch() as folder:
        path = folder / Path(task.output.name).name
        task.product.write(
            task.output, task.summaries,
            StoredTiles(task.store, task.cells, task.overviews, task.context, task.files, task.drives),
            task.options, task.context, path,
        )  # fmt: skip
        size, digest = path.stat().st_size, file_digest(path)
        task.store.publish(path, task.target)
    return OutputRecord(task.product.name, task.output.name, task.key, task.target, size, digest)


class StoredTiles:
    """Finished tiles of the store, for survey products."""

    def __init__(
        self,
        store: Store,
        cells: Sequence[OutputRecord],
        overviews: Sequence[OutputRecord],
        context: ProductContext,
        files: Sequence[OutputRecord] = (),
        drives: Drives | None = None,
    ) -> None:
        self._store = store
        self._drives = drives
        self._files = {(r.product, r.unit): r for r in files}
        self._cells = {r.unit: r for r in cells}
        self._overviews = {r.unit: r for r in overviews}
        self._edge = context.grid.cells_per_edge

    def __call__(self, tile: TileId) -> TileCells | None:
        """Return the cells of a tile; None where the survey has no such tile."""
        record = self._cells.get(str(tile))
        return None if record is None else read_cells(self._store, record, self._edge)

    def values(self, tile: TileId, name: str) -> CellValues | None:
        """Return one column of the cells of a tile; None where the survey has no such tile."""
        record = self._cells.get(str(tile))
        return None if record is None else read_values(self._store, record, self._edge, name)

    def file(self, product: str, tile: TileId) -> bytes | None:
        """Return the content of a tile's file of a surface product; None where there is none."""
        record = self._files.get((product, str(tile)))
        return None if record is None else read_recorded(self._store, record)

    def lanes(self) -> LaneDirections:
        """Return the directions of the lanes; empty for a product that does not need them."""
        return LaneDirections.of_path([]) if self._drives is None else self._drives.lanes(self._store)

    def overview(self, tile: TileId, factor: int) -> Level | None:
        """Return an overview of a tile, made from its cells where none was stored."""
        record = self._overviews.get(str(tile))
        if record is not None:
            return read_overview(self._store, record, factor)
        cells = self(tile)
        return None if cells is None else pyramid_of(cells, (factor,))[0]


def _planned(
    product: SurveyProduct, options: Strict, plan: SurveyPlan, context: ProductContext, manifest: Manifest
) -> Iterator[PlannedOutput]:
    found = tile_figures(manifest)
    files = [r for name in product.reads for r in manifest.of(name).values()]
    driven = [Drives.of(plan).key()] if product.needs_lanes else []
    own_key = product_key(product, options, context)
    bridged = {TileId.parse(r.unit) for r in files} - found.summaries.keys()  # tiles with a surface and no reading
    known = [*sorted(found.summaries), *sorted(bridged)]
    outputs = product.outputs(known, options, context) if found.summaries else []
    drawn = {id(one.tiles): one.tiles for one in outputs}  # views of one sheet share them
    contents = {at: [content for tile in tiles if (content := found.contents.get(tile))] for at, tiles in drawn.items()}
    for output in outputs:
        read = _read(product, files, output)
        parts = [(r.unit, r.digest, r.detail) for r in read]
        key = key_of(own_key, output.name, contents[id(output.tiles)], parts, *driven)
        yield PlannedOutput(product, options, output, key, read)


def _tasks(due: Sequence[PlannedOutput], plan: SurveyPlan, manifest: Manifest) -> list[OutputTask]:
    """Return the tasks of some files, with the records of their tiles."""
    context, found = product_context(plan), tile_figures(manifest)
    drives = Drives.of(plan) if any(one.product.needs_lanes for one in due) else None
    units = {str(tile) for one in due for tile in one.output.tiles}
    cells = {TileId.parse(r.unit): r for r in manifest.chosen(TILE, units) if r.path}
    keys = {r.unit: r.key for r in cells.values()}
    overviews = {r.unit: r for r in manifest.chosen(OVERVIEWS, units) if r.path and keys.get(r.unit) == r.key}
    tasks: list[OutputTask] = []
    for one in due:
        drawn = tuple(cells[tile] for tile in one.output.tiles if tile in cells)
        tasks.append(
            OutputTask(
                plan.store,
                one.product,
                one.options,
                context,
                one.output,
                one.key,
                tuple(found.summaries[t] for t in sorted(one.output.tiles) if t in found.summaries),
                drawn,
                tuple(overviews[r.unit] for r in drawn if r.unit in overviews),
                one.read,
                drives if one.product.needs_lanes else None,
            )
        )
    return tasks


def _read(product: SurveyProduct, files: Sequence[OutputRecord], output: Output) -> tuple[OutputRecord, ...]:
    """Return the files of surface products that an output is made from, in the order of tiles."""
    units = {str(t) for t in output.tiles} if product.reads else set()
    return tuple(sorted((r for r in files if r.unit in units), key=lambda r: (r.product, TileId.parse(r.unit))))
