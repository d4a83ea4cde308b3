"""What a run is asked for: products with their checked settings and their context, and tiles."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np

from roadscan.core.errors import ConfigError
from roadscan.core.grid import Bounds, TileGrid, TileId
from roadscan.core.strict import Strict
from roadscan.core.survey import Survey
from roadscan.footprints.footprints import FootprintRanges
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.run.keys import code_digest, key_of, name_of
from roadscan.run.session import Selection, SelectionError
from roadscan.surface.reconstruction import SurfaceGrid
from roadscan.surface.settings import SurfaceConfig
from roadscan.tiles.product import (
    Product,
    ProductContext,
    SurfaceProduct,
    SurveyProduct,
    TileProduct,
    WantedProduct,
    WantedSurface,
    is_default,
    product_named,
    products,
)

_OF_SURVEY = ("roadscan.tiles.lane_direction:Drives", "roadscan.tiles.mosaics.products:StoredTiles")
"""Code that supplies survey products with their data."""


def wanted_products(survey: Survey) -> list[tuple[Product, Strict]]:
    """Return the products that the survey file requests, with their checked settings."""
    config = survey.config.products
    cell_m = survey.config.tiles.cell_m
    with_surface = survey.has("surface")
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
    """Raise :class:`ConfigError` where a product in the survey file does not exist, has other settings than those
    stated, or needs a surface that is not made; reads nothing.
    """
    product, config = product_named(name), survey.config.products
    if name in (config.make or ()):
        _check_surface(survey, product)
    _stated_options(product, config.options.get(name, {}))


def _check_surface(survey: Survey, product: Product) -> None:
    of_surface = isinstance(product, SurfaceProduct) or (isinstance(product, SurveyProduct) and product.reads)
    if of_surface and not survey.has("surface"):
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
    """Return the context of products for a survey."""
    config, grid = plan.survey.config, plan.ground.grid
    surface = SurfaceConfig.stated(plan.survey)
    cell_m = None if surface is None else SurfaceGrid(grid, surface).cell_m
    return ProductContext(config.id, config.title, plan.ground.map, grid, plan.passes, plan.date, cell_m)


def wanted_tile_products(survey: Survey, context: ProductContext) -> list[WantedProduct]:
    """Return the survey's tile products with checked settings, and keys of what changes them besides the tile."""
    wanted: list[WantedProduct] = []
    for product, options in wanted_products(survey):
        if isinstance(product, TileProduct):
            product.check_options(options, context)
            wanted.append(WantedProduct(product, options, product_key(product, options, context)))
    return wanted


def wanted_surface_products(survey: Survey, context: ProductContext) -> list[WantedSurface]:
    """Return the survey's products of the reconstructed surface likewise."""
    config = SurfaceConfig.stated(survey)
    grid = None if config is None else SurfaceGrid(context.grid, config)
    wanted: list[WantedSurface] = []
    for product, options in wanted_products(survey):
        if isinstance(product, SurfaceProduct) and grid is not None:
            product.check_options(options, context)
            product.check_cells(options, grid.cell_m, grid.shown)
            wanted.append(WantedSurface(product, options, product_key(product, options, context)))
    return wanted


def product_key(product: Product, options: Strict, context: ProductContext) -> str:
    """Return the key of a product with its settings and its context."""
    stated = [asdict(p) for p in context.passes] if isinstance(product, SurveyProduct) else []
    around = _OF_SURVEY if isinstance(product, SurveyProduct) else ()
    return key_of(
        product.name, product.version, options.model_dump(mode="json"), code_digest(name_of(type(product)), *around),
        context.survey_id, context.title, context.map, context.grid, stated,
    )  # fmt: skip


def chosen_tiles(
    selection: Selection, known: Iterable[TileId], footprints: FootprintRanges, grid: TileGrid
) -> list[TileId]:
    """Return the chosen tiles among those with readings, by row and column."""
    with_readings = set(known)
    unknown = [t for t in selection.named if t not in with_readings]
    if unknown:
        raise SelectionError(
            f"no reading touches tile {unknown[0]}", expected="a tile of the survey (see the tile table)"
        )
    chosen = set(selection.named)
    if selection.box is not None:
        chosen |= {t for t in with_readings if _touches(t, selection.box, grid)}
    if selection.span_gps_ns is not None:
        first, last = selection.span_gps_ns
        rows = (footprints.first_epoch_gps_ns <= last) & (footprints.last_epoch_gps_ns >= first)
        pairs = np.unique(np.column_stack([footprints.tile_column, footprints.tile_row])[rows], axis=0)
        chosen |= {TileId(int(c), int(r)) for c, r in pairs}
    if not chosen:
        raise SelectionError("the choice holds no tile with readings", expected="tiles of the survey")
    return sorted(chosen, key=lambda t: (t.row, t.column))


def _touches(tile: TileId, box: Bounds, grid: TileGrid) -> bool:
    own = grid.bounds(tile)
    return (
        own.easting_min_m < box.easting_max_m
        and own.easting_max_m > box.easting_min_m
        and own.northing_min_m < box.northing_max_m
        and own.northing_max_m > box.northing_min_m
    )
