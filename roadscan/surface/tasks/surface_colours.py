"""Colours of the survey's pictures for products of the surface: planned, applied, and reported."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from roadscan.core.grid import Bounds
from roadscan.core.ids import TileId
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.pictures.colours import ColourSource
from roadscan.pictures.placed import Pictures, check_folders, check_pictures, plan_pictures, rule_cameras
from roadscan.store.manifest import OutputRecord
from roadscan.surface.reconstruction import SurfaceGrid
from roadscan.surface.tile import NodeColours, SurfaceTile
from roadscan.tiles.product import SurfaceProduct
from roadscan.tiles.tasks.tile_files import WantedSurface
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
