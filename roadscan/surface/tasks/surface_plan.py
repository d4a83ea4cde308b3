"""Plan of the stage `surfaces`: keys of surfaces, stale ones, and tasks of neighbouring tiles."""

from __future__ import annotations

import datetime as dt
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import shapely

from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.core.grid import Bounds, TileGrid, TileId
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.pictures.colours import ColourSource
from roadscan.pictures.placed import Pictures, check_folders, check_pictures, plan_pictures, rule_cameras
from roadscan.run.keys import code_digest, key_of
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store
from roadscan.surface.reconstruction import SurfaceGrid
from roadscan.surface.settings import SurfaceConfig
from roadscan.surface.tasks.found_regions import FoundRegions, stated_regions
from roadscan.surface.tile import NodeColours, Regions, SurfaceTile
from roadscan.tiles.product import ProductContext, SurfaceProduct, WantedSurface, surface_file_names
from roadscan.tiles.tasks.tile_plan import TILE, Block, TilePlan, TileTask, cut_blocks
from roadscan.tiles.tasks.wanted_products import product_context, wanted_products, wanted_surface_products

COLOURS: Final = "colours"
"""Key of a tile's record for the figures of its colours."""
_NAMED: Final = 5  # Unreadable pictures that are named.


def check_cameras(survey: Survey) -> None:
    """Raise where products of the surface want colours and the rig has no camera for them; reads no log."""
    for product, options in wanted_products(survey) if survey.has("surface") else ():
        rule = product.picture_rule(options) if isinstance(product, SurfaceProduct) else None
        if rule is not None:
            rule_cameras(survey.rig, rule)


def check_colours(plan: SurveyPlan, *, folders: bool = False) -> None:
    """Raise where products of the surface want colours that the survey cannot give; `folders`: checks the files too."""
    for wanted in wanted_surface_products(plan.survey, product_context(plan)):
        rule = wanted.product.picture_rule(wanted.options)
        if rule is not None:
            (check_folders if folders else check_pictures)(plan, rule)


def plan_colours(plan: SurveyPlan, products: Iterable[WantedSurface]) -> dict[str, Pictures]:
    """Returns pictures of the survey, by the product that wants their colours."""
    rules = {w.product.name: w.product.picture_rule(w.options) for w in products}
    placed = {rule: plan_pictures(plan, rule) for rule in dict.fromkeys(rules.values()) if rule is not None}
    return {name: placed[rule] for name, rule in rules.items() if rule is not None}


def shown_box(grid: SurfaceGrid, tile: TileId) -> Bounds:
    """Returns the box of all that products read of a tile and its neighbours."""
    box, (east, north) = grid.tiles.bounds(tile), grid.cell_m
    beyond = (grid.shown + 1) * east, (grid.shown + 1) * north
    return Bounds(
        box.easting_min_m - beyond[0], box.northing_min_m - beyond[1],
        box.easting_max_m + beyond[0], box.northing_max_m + beyond[1],
    )  # fmt: skip


class Painter:
    """Adds to surfaces the colours that products want."""

    def __init__(self, pictures: Mapping[str, Pictures]) -> None:
        self._pictures = pictures
        self._sources = {name: ColourSource(one) for name, one in pictures.items()}

    def paint(self, wanted: WantedSurface, surface: SurfaceTile) -> tuple[SurfaceTile, dict[str, Any]]:
        """Returns the surface with colours for a product, and figures for the tile's record; none if it wants none."""
        name = wanted.product.name
        if name not in self._sources:
            return surface, {}
        row, column = wanted.product.coloured_nodes(surface, wanted.options)
        height_m = surface.height_m[np.ix_(row, column)]
        known = ~np.isnan(height_m)
        easting_m, northing_m = surface.window.nodes_m()
        places = np.meshgrid(easting_m[column], northing_m[row])
        enh_m = np.stack([places[0][known], places[1][known], height_m[known]], axis=-1)
        near = self._pictures[name].near(surface.window.bounds())
        found = self._sources[name].colours(near, enh_m)
        colour, seen = np.zeros((*known.shape, 3), np.uint8), np.zeros(known.shape, np.bool_)
        colour[known], seen[known] = found.colour, found.seen
        figures = {
            "vertices": len(enh_m),
            "unseen": int(len(enh_m) - np.count_nonzero(found.seen)),
            "pictures": found.pictures,
            "unreadable": list(found.unreadable),
        }
        return replace(surface, colours=NodeColours(colour, seen)), {f"{COLOURS}:{name}": figures}


def colour_notes(pictures: Mapping[str, Pictures], made: Iterable[OutputRecord]) -> list[str]:
    """Returns notes on the colours of surfaces, from their records; each damaged picture is reported once."""
    figures = [record.figures() for record in made]
    notes: list[str] = []
    for name, placed in pictures.items():
        own = [f[f"{COLOURS}:{name}"] for f in figures if f"{COLOURS}:{name}" in f]
        notes += [f"{name}: {note}" for note in placed.notes]
        vertices, unseen = (sum(f[k] for f in own) for k in ("vertices", "unseen"))
        if unseen:
            notes.append(f"{name}: {unseen:,} of {vertices:,} vertices are in no picture, and stay grey")
        bad = sorted({one for f in own for one in f["unreadable"]})
        more = f"; and {len(bad) - _NAMED} more" if len(bad) > _NAMED else ""
        if bad:
            notes.append(f"{name}: {len(bad):,} pictures cannot be read: {'; '.join(bad[:_NAMED])}{more}")
    return notes


SURFACE = "surfaces"
"""Manifest name of a tile's surface as a whole; it has no separate file."""

_MOST_SMOOTHED = 500
"""Cells on each side on which smoothing may depend: the window of a tile of 2,000 cells is twice its size."""

_BLOCK_TILES = 4
"""Edge of the largest block of tiles whose surface is made from cells: each tile's cells are read once or twice."""


@dataclass(frozen=True)
class SurfaceTask:
    """Everything that a worker needs to make the surface of some tiles; it carries no data."""

    store: Store
    grid: SurfaceGrid
    block: Block
    keys: tuple[str, ...]
    """Key of each tile's surface."""
    cells: tuple[OutputRecord, ...]
    """Records of the cells in reach, where the surface is made from cells."""
    readings: TileTask | None
    """Source of the points in reach, where it is made from points."""
    regions: Regions | None
    """Polygons or found regions in reach; None where the surface is made everywhere."""
    pictures: Mapping[str, Pictures]
    """Pictures that may show some of the tiles, by the product that wants their colours."""
    dates: tuple[dt.date, ...]
    """UTC date of each tile's first reading."""
    products: tuple[WantedSurface, ...]
    context: ProductContext


@dataclass(frozen=True)
class SurfacePlan:
    """Tiles whose surface is due, and the sources of it."""

    tiles: TilePlan
    grid: SurfaceGrid
    cells: Mapping[TileId, OutputRecord]
    """Records of the tiles that have cells."""
    regions: Regions | None
    products: tuple[WantedSurface, ...]
    keys: Mapping[TileId, str]
    """Key of each tile's surface that is due."""
    pictures: Mapping[str, Pictures]
    """Pictures of the survey, by the product that wants their colours."""
    waiting: frozenset[TileId] = frozenset()
    """Tiles whose surface depends on missing or outdated cells: its files stay as they are."""

    def stale(self, manifest: Manifest) -> dict[TileId, str]:
        """Tiles whose surface is missing or out of date, or lacks a product, each with the reason."""
        reasons = ((tile, self._why_due(str(tile), key, manifest)) for tile, key in self.keys.items())
        return {tile: why for tile, why in reasons if why}

    def near(self, chosen: Iterable[TileId]) -> set[TileId]:
        """Returns tiles whose surface depends on one of the chosen."""
        seen = {t for tile in chosen for t in self._in_reach(tile)}
        return seen & set(self.keys)

    def tasks(self, chosen: Sequence[TileId], workers: int = 1) -> list[SurfaceTask]:
        """Returns tasks over the chosen tiles, in blocks of neighbours."""
        config = self.tiles.plan.survey.config.tiles
        if self.grid.config.method == "points":
            numbers = self.tiles.tiles.number
            readings = {t: int(self.tiles.tiles.readings[numbers[t]]) if t in numbers else 0 for t in chosen}
            blocks = cut_blocks(readings, config.block_tiles, config.max_block_readings)
        else:
            edge = _BLOCK_TILES if len(chosen) >= 4 * _BLOCK_TILES * workers else 2
            blocks = cut_blocks(dict.fromkeys(chosen, 1), edge, edge * edge)
        return [self.task(b.tiles) for b in blocks]

    def singly(self, chosen: Sequence[TileId]) -> list[SurfaceTask]:
        """Returns a task for each tile."""
        return [self.task((tile,)) for tile in chosen]

    def task(self, tiles: tuple[TileId, ...]) -> SurfaceTask:
        """Returns a task over some tiles."""
        block = Block(tiles, self.grid.rings())
        reach = sorted({t for tile in tiles for t in self._in_reach(tile)})
        of_points = self.grid.config.method == "points"
        boxes = [self.grid.reach(tile) for tile in tiles]
        return SurfaceTask(
            store=self.tiles.plan.store,
            grid=self.grid,
            block=block,
            keys=tuple(self.keys[t] for t in tiles),
            cells=() if of_points else tuple(self.cells[t] for t in reach if t in self.cells),
            readings=self.tiles.task(Block(tuple(t for t in reach if t in self.tiles.tiles))) if of_points else None,
            regions=None if self.regions is None else self.regions.near(*boxes),
            pictures={n: p.near(*(shown_box(self.grid, t) for t in tiles)) for n, p in self.pictures.items()},
            dates=tuple(_date(t, self.cells) for t in tiles),
            products=self.products,
            context=self.tiles.context,
        )

    def _in_reach(self, tile: TileId) -> list[TileId]:
        return self.grid.tiles.tiles_in(self.grid.reach(tile))

    def _why_due(self, unit: str, key: str, manifest: Manifest) -> str:
        record = manifest.get(SURFACE, unit)
        why = manifest.why_due(SURFACE, unit, key)
        if why or record is None or not record.figures()["cells"]:
            return why
        files = ((name, key_of(key, wanted.key)) for wanted in self.products for name in wanted.files)
        faults = ((name, manifest.why_due(name, unit, own)) for name, own in files)
        return next((f"{name} {why}" for name, why in faults if why), "")


def plan_surfaces(
    tiles: TilePlan,
    config: SurfaceConfig,
    products: tuple[WantedSurface, ...],
    manifest: Manifest,
    found: FoundRegions,
    pictures: Mapping[str, Pictures],
) -> SurfacePlan:
    """Returns surfaces that are due: of all tiles that have cells, of points those between them too, or those that a
    polygon or a found region touches.
    """
    grid, regions = checked_surface(tiles.plan.survey, config)
    beyond_m = [one.product.around_m(one.options, grid.cell_m) for one in products]
    grid = replace(grid, around_m=max(beyond_m, default=0.0))
    regions = found.regions if config.regions == "found" else regions
    expected = dict(zip(tiles.tiles.ids, tiles.tiles.keys, strict=True))
    records = {TileId.parse(unit): r for unit, r in manifest.of(TILE).items()}
    cells = {tile: r for tile, r in records.items() if r.path}
    of_points = config.method == "points"
    inputs = expected if of_points else {tile: r.digest for tile, r in cells.items()}
    behind = found.waiting(tiles.footprints)
    if not of_points:
        behind |= {t for t, key in expected.items() if t not in records or records[t].key != key}
    due = cells.keys() | (bridged_tiles(cells) if of_points else set())
    near = ((t, grid.tiles.tiles_in(grid.reach(t))) for t in due | expected.keys()) if behind else ()
    waiting = {t for t, around in near if behind.intersection(around)}
    code = code_digest("roadscan.surface.tasks.surfaces:compute_surfaces")
    common = key_of(code, config.model_dump(mode="json", exclude={"polygons", "search"}), grid.tiles)
    keys: dict[TileId, str] = {}
    for tile in sorted(due - waiting, key=lambda t: (t.row, t.column)):
        box = grid.reach(tile)
        within = None if regions is None else regions.near(box)
        if within is not None and not within.near(grid.tiles.bounds(tile)).shapes.size:
            continue
        around = [(str(t), inputs[t]) for t in grid.tiles.tiles_in(box) if t in inputs]
        seen = [(name, all_.near(shown_box(grid, tile)).key()) for name, all_ in pictures.items()]
        keys[tile] = key_of(common, str(_date(tile, cells)), around, None if within is None else within.key(), *seen)
    if config.regions == "polygons" and regions is not None and cells and not keys:
        raise _beside(regions, config, list(cells), grid)
    return SurfacePlan(tiles, grid, cells, regions, products, keys, pictures, frozenset(waiting))


def checked_surface(survey: Survey, config: SurfaceConfig) -> tuple[SurfaceGrid, Regions | None]:
    """Returns grid and polygons of a survey's surface; ConfigError where its settings do not fit the tiles."""
    tiles = TileGrid(survey.config.tiles.size_m, survey.config.tiles.cell_m)
    grid = SurfaceGrid(tiles, config)
    if grid.smoothed > _MOST_SMOOTHED:
        raise ConfigError(
            f"with these weights smoothing depends on {grid.smoothed:,} cells on each side",
            expected=f"at most {_MOST_SMOOTHED}",
            change="lower surface.smoothing.curvature_weight or median_weight",
        )
    if config.method == "points" and config.max_gap_m > tiles.size_m / 2:
        raise ConfigError(
            f"surface.max_gap_m {config.max_gap_m:g} bridges more than half a tile of {tiles.size_m:g} m",
            change="make it smaller, or tiles.size_m larger",
        )
    return grid, stated_regions(survey)


def _beside(regions: Regions, config: SurfaceConfig, tiles: Sequence[TileId], grid: SurfaceGrid) -> ConfigError:
    """Returns the error for polygons that touch no tile."""
    boxes = [grid.tiles.bounds(tile) for tile in tiles]
    survey = (
        min(b.easting_min_m for b in boxes), min(b.northing_min_m for b in boxes),
        max(b.easting_max_m for b in boxes), max(b.northing_max_m for b in boxes),
    )  # fmt: skip
    layer, there = (", ".join(f"{v:.1f}" for v in box) for box in (shapely.total_bounds(regions.shapes), survey))
    return ConfigError(
        f"the polygons of {config.polygons} touch no tile: on the map they span {layer} (west, south, east, north)",
        expected=f"polygons within {there}",
        change="check surface.polygons_crs and the order of the layer's axes",
    )


def files_without_surface(manifest: Manifest) -> list[OutputRecord]:
    """Returns files of tiles that turned out to have no surface."""
    empty = {unit for unit, r in manifest.of(SURFACE).items() if not r.figures()["cells"]}
    return [r for name in surface_file_names() for unit, r in manifest.of(name).items() if unit in empty]


def bridged_tiles(cells: Collection[TileId]) -> set[TileId]:
    """Returns tiles without cells across whose corner a triangle may reach.

    Its corners lie in tiles on two adjoining sides: were they in one, or in one and the tile at its corner, a straight
    line would separate the triangle from this tile.
    """
    beside = {side for t in cells for side in _sides(t)}
    return {
        t
        for t in beside - set(cells)
        if any(TileId(t.column + c, t.row) in cells for c in (-1, 1))
        and any(TileId(t.column, t.row + r) in cells for r in (-1, 1))
    }


def _sides(tile: TileId) -> list[TileId]:
    return [TileId(tile.column + c, tile.row + r) for c, r in ((1, 0), (-1, 0), (0, 1), (0, -1))]


def _date(tile: TileId, cells: Mapping[TileId, OutputRecord]) -> dt.date:
    """Returns the UTC date of a tile's first reading; of an empty one, of the first in the tiles on its sides."""
    own = [tile] if tile in cells else [t for t in _sides(tile) if t in cells]
    return utc_from_gps_ns(min(cells[t].figures()["first_epoch_gps_ns"] for t in own)).date()
