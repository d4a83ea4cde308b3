"""Products over many tiles, made from the tiles' cells. One task some files that draw the same tiles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from roadscan.core.errors import ConfigError
from roadscan.core.ids import TileId
from roadscan.core.strict import Strict
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.run.code_reach import code_digest, name_of
from roadscan.run.engine.bundles import run_bundles
from roadscan.run.engine.compute import Compute
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded
from roadscan.store.store import Store, file_digest
from roadscan.surface.reconstruction import SurfaceGrid
from roadscan.tiles.cells import TileCells
from roadscan.tiles.drives import Drives
from roadscan.tiles.product import (
    Output,
    Product,
    ProductContext,
    SurfaceProduct,
    SurveyProduct,
    TileProduct,
    TileSummary,
    is_default,
    product_named,
    products,
)
from roadscan.tiles.products.lane_direction import LaneDirections
from roadscan.tiles.pyramid import Level, pyramid_of
from roadscan.tiles.tasks.cell_files import read_cells, read_overview
from roadscan.tiles.tasks.tile_files import WantedProduct, WantedSurface
from roadscan.tiles.tasks.tile_plan import OVERVIEWS, TILE
from roadscan.tiles.tasks.tiles import summary_of

_TILES_DRAWN = 2000
"""Tiles that one task draws, each as often as it draws it: `kilometre`, with its six rasters, over two kilometres."""
_NOWHERE = TileId(0, 0)
_OF_SURVEY = ("roadscan.tiles.drives:Drives", "roadscan.tiles.mosaics.products:StoredTiles")
"""Code by which survey products get what they draw."""


@dataclass(frozen=True)
class OutputTask:
    """One file of a survey product."""

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
    """Records of the files of surface products that the output is made from."""
    drives: Drives | None = None
    """Where the vehicles drove, for a product that asks."""

    @property
    def target(self) -> str:
        """Where the file goes, relative to the survey's root."""
        return f"products/{self.product.name}/{self.output.name}"


def wanted_products(survey: Survey) -> list[tuple[Product, Strict]]:
    """Products that the survey file asks for, with their checked settings."""
    config = survey.config.products
    cell_m = survey.config.tiles.cell_m
    with_surface = survey.config.surface is not None
    names = config.make if config.make is not None else _default_names(cell_m, with_surface)
    for name in config.options:
        product_named(name)
    wanted = [product_named(n) for n in names]
    read = (n for p in wanted if isinstance(p, SurveyProduct) for n in p.reads if n not in names)
    wanted += [product_named(n) for n in dict.fromkeys(read)]
    for product in wanted:
        _check_surface(survey, product)
    stated = [(p, _stated_options(p, config.options.get(p.name, {}))) for p in wanted]
    by_name = {p.name: options for p, options in stated}
    for product, options in stated:
        if isinstance(product, SurveyProduct):
            product.check_reads(options, {name: by_name[name] for name in product.reads})
    return stated


def check_product(survey: Survey, name: str) -> None:
    """Raise :class:`ConfigError` where a product that the survey file names does not exist, has other settings than
    those stated, or needs a surface that is not made; reads nothing.
    """
    product, config = product_named(name), survey.config.products
    if name in (config.make or ()):
        _check_surface(survey, product)
    _stated_options(product, config.options.get(name, {}))


def _check_surface(survey: Survey, product: Product) -> None:
    of_surface = isinstance(product, SurfaceProduct) or (isinstance(product, SurveyProduct) and product.reads)
    if of_surface and survey.config.surface is None:
        raise ConfigError(
            f"the product '{product.name}' is made of the reconstructed surface, and the survey has none",
            change="add the section [surface] to the survey file, or leave the product out",
        )


def _stated_options(product: Product, values: dict[str, Any]) -> Strict:
    try:
        return product.options.parse(values)
    except ConfigError as error:
        raise ConfigError(
            f"[products.options.{product.name}] {error.arrived}", expected=error.expected, change=error.change
        ) from error


def _default_names(cell_m: float, with_surface: bool) -> list[str]:
    made = [(n, p) for n, p in products().items() if is_default(p, cell_m)]
    return [n for n, p in made if with_surface or not isinstance(p, SurfaceProduct)]


def product_context(plan: SurveyPlan) -> ProductContext:
    """What products know of the survey."""
    config, grid = plan.survey.config, plan.ground.grid
    cell_m = None if config.surface is None else SurfaceGrid(grid, config.surface).cell_m
    return ProductContext(config.id, config.title, plan.ground.map, grid, plan.passes, plan.date, cell_m)


def wanted_tile_products(survey: Survey, context: ProductContext) -> list[WantedProduct]:
    """Tile products of the survey, their settings checked, with the keys of what shapes them beside the tile."""
    wanted: list[WantedProduct] = []
    for product, options in wanted_products(survey):
        if isinstance(product, TileProduct):
            product.check_options(options, context)
            wanted.append(WantedProduct(product, options, _product_key(product, options, context)))
    return wanted


def wanted_surface_products(survey: Survey, context: ProductContext) -> list[WantedSurface]:
    """The same, of products of the reconstructed surface."""
    config = survey.config.surface
    grid = None if config is None else SurfaceGrid(context.grid, config)
    wanted: list[WantedSurface] = []
    for product, options in wanted_products(survey):
        if isinstance(product, SurfaceProduct) and grid is not None:
            product.check_options(options, context)
            product.check_cells(options, grid.cell_m, grid.shown)
            wanted.append(WantedSurface(product, options, _product_key(product, options, context)))
    return wanted


def plan_outputs(plan: SurveyPlan, manifest: Manifest) -> tuple[list[OutputTask], list[OutputRecord]]:
    """Files of survey products that are missing or stale, and records of those no longer due."""
    context = product_context(plan)
    records = sorted((r for r in manifest.of(TILE).values() if r.path), key=lambda r: TileId.parse(r.unit))
    keys = {r.unit: r.key for r in records}
    overviews = {unit: r for unit, r in manifest.of(OVERVIEWS).items() if r.path and keys.get(unit) == r.key}
    by_tile = {TileId.parse(r.unit): r for r in records}
    summaries = {s.tile: s for s in map(summary_of, records) if s is not None}
    tasks = [
        task
        for product, options in wanted_products(plan.survey)
        if isinstance(product, SurveyProduct)
        for task in _tasks(
            product,
            options,
            plan,
            context,
            by_tile,
            overviews,
            summaries,
            [r for name in product.reads for r in manifest.of(name).values()],
        )
    ]
    due = {(t.product.name, t.output.name) for t in tasks}
    kinds = {name for name, p in products().items() if isinstance(p, SurveyProduct)}
    gone = [r for r in manifest.beside(kinds, ()) if (r.product, r.unit) not in due]
    return [t for t in tasks if not manifest.is_current(t.product.name, t.output.name, t.key)], gone


def make_products(
    plan: SurveyPlan,
    manifest: Manifest,
    compute: Compute,
    report: Callable[[int, int], None] = lambda _a, _b: None,
) -> list[tuple[str, str]]:
    """Make the survey products that are missing or stale; remove those no longer due. Returns the failures."""
    stale, gone = plan_outputs(plan, manifest)
    manifest.remove(gone)
    stale.sort(key=lambda t: (t.product.name, min(t.output.tiles, default=_NOWHERE)))  # what draws the same tiles
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
    """Finished tiles of the store, as survey products ask for them."""

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
        """Cells of a tile; None where the survey has no such tile."""
        record = self._cells.get(str(tile))
        return None if record is None else read_cells(self._store, record, self._edge)

    def file(self, product: str, tile: TileId) -> bytes | None:
        """Content of a tile's file of a surface product; None where there is none."""
        record = self._files.get((product, str(tile)))
        return None if record is None else read_recorded(self._store, record)

    def lanes(self) -> LaneDirections:
        """Which way the lanes run; nowhere known for a product that does not need it."""
        return LaneDirections.of_path([]) if self._drives is None else self._drives.lanes(self._store)

    def overview(self, tile: TileId, factor: int) -> Level | None:
        """Overview of a tile; made from its cells where none was stored with them."""
        record = self._overviews.get(str(tile))
        if record is not None:
            return read_overview(self._store, record, factor)
        cells = self(tile)
        return None if cells is None else pyramid_of(cells, (factor,))[0]


def _tasks(
    product: SurveyProduct,
    options: Strict,
    plan: SurveyPlan,
    context: ProductContext,
    by_tile: Mapping[TileId, OutputRecord],
    overviews: Mapping[str, OutputRecord],
    summaries: Mapping[TileId, TileSummary],
    files: Sequence[OutputRecord],
) -> list[OutputTask]:
    tasks: list[OutputTask] = []
    drives = Drives.of(plan) if product.needs_lanes else None
    own_key = _product_key(product, options, context)
    driven = [] if drives is None else [drives.key()]
    bridged = {TileId.parse(r.unit) for r in files} - summaries.keys()  # they have a surface, and no reading
    known = [*summaries.values(), *map(TileSummary.without_readings, sorted(bridged))]
    for output in product.outputs(known, options, context) if summaries else []:
        own = tuple(by_tile[t] for t in output.tiles if t in by_tile)
        read = _read(product, files, output)
        parts = [(r.unit, r.digest, r.detail) for r in (*own, *read)]
        key = key_of(own_key, output.name, parts, *driven)
        tasks.append(
            OutputTask(
                plan.store,
                product,
                options,
                context,
                output,
                key,
                tuple(summaries[t] for t in sorted(output.tiles) if t in summaries),
                own,
                tuple(overviews[r.unit] for r in own if r.unit in overviews),
                read,
                drives,
            )
        )
    return tasks


def _read(product: SurveyProduct, files: Sequence[OutputRecord], output: Output) -> tuple[OutputRecord, ...]:
    """Files of surface products that an output is made from, in the order of tiles."""
    units = {str(t) for t in output.tiles} if product.reads else set()
    return tuple(sorted((r for r in files if r.unit in units), key=lambda r: (r.product, TileId.parse(r.unit))))


def _product_key(product: Product, options: Strict, context: ProductContext) -> str:
    stated = [asdict(p) for p in context.passes] if isinstance(product, SurveyProduct) else []
    around = _OF_SURVEY if isinstance(product, SurveyProduct) else ()
    return key_of(
        product.name, product.version, options.model_dump(mode="json"), code_digest(name_of(type(product)), *around),
        context.survey_id, context.title, context.map, context.grid, stated,
    )  # fmt: skip
