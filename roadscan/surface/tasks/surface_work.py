"""Work of the stage `surfaces`: the existing surfaces compared with those that are wanted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from roadscan.core.ids import TileId
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import SurveyPlan, plan_of
from roadscan.run.session import Session
from roadscan.store.manifest import OutputRecord
from roadscan.surface.settings import SurfaceConfig
from roadscan.surface.tasks.found_regions import REGIONS, FoundRegions, load_found_regions, searched_sources
from roadscan.surface.tasks.surface_colours import check_colours, plan_colours
from roadscan.surface.tasks.surface_plan import SURFACE, SurfacePlan, checked_surface, plan_surfaces
from roadscan.tiles.tasks.selection import chosen_tiles
from roadscan.tiles.tasks.tile_files import surface_file_names
from roadscan.tiles.tasks.tile_plan import TilePlan, tiles_of
from roadscan.tiles.tasks.wanted_products import product_context, wanted_surface_products


@dataclass(frozen=True)
class SurfaceWork:
    """Work of the stage `surfaces`."""

    planned: SurfacePlan | None
    """None where no surface is asked for."""
    chosen: Sequence[TileId]
    """Tiles whose surface is made now."""
    gone: Sequence[OutputRecord]
    """Files of surfaces that are no longer due, and of products no longer wanted."""
    note: str = ""
    why: Mapping[TileId, str] = field(default_factory=dict)
    """Why each tile's surface is due, unless tiles were chosen."""


def plan_surface_work(session: Session) -> SurfaceWork:
    """Returns the difference between existing and wanted surfaces, once the tiles are done.

    With a selection of tiles, it is these, and of those that depend on them the stale ones.
    """
    survey, manifest, selection = session.survey, session.manifest, session.selection
    names = {SURFACE, REGIONS, *surface_file_names()}
    config = SurfaceConfig.stated(survey)
    if config is None:
        return SurfaceWork(None, [], [r for name in names for r in manifest.of(name).values()])
    plan, footprints = plan_of(session), footprints_of(session)
    context = product_context(plan)
    wanted = tuple(wanted_surface_products(survey, context))
    if not wanted:
        note = "the survey file has a section [surface], and no product of the surface is asked for"
        return SurfaceWork(None, [], [r for name in names for r in manifest.of(name).values()], note)
    tiles = TilePlan(plan, footprints, tiles_of(session), (), context)
    found = load_found_regions(plan, manifest)
    pictures = plan_colours(plan, wanted)
    planned = plan_surfaces(tiles, config, wanted, manifest, found, pictures)
    units = {str(tile) for tile in (*planned.keys, *planned.waiting)}
    names_wanted = {SURFACE, *surface_file_names({w.product.name for w in wanted})}
    gone = [
        r
        for name in names - {REGIONS}
        for u, r in manifest.of(name).items()
        if u not in units or name not in names_wanted
    ]
    gone += found.gone
    stale = planned.stale(manifest)
    note = _waiting_note(len(planned.waiting), found)
    if selection is None:
        return SurfaceWork(planned, list(stale), gone, note, stale)
    own = set(chosen_tiles(selection, tiles.tiles, footprints, plan.ground.grid))
    due = own | (planned.near(own) & stale.keys())
    return SurfaceWork(planned, [tile for tile in planned.keys if tile in due], gone, note)


def _waiting_note(waiting: int, found: FoundRegions) -> str:
    if not waiting:
        return ""
    if found.due:
        return f"surfaces of {waiting:,} tiles wait for regions of interest: run `roadscan surfaces`"
    return f"surfaces of {waiting:,} tiles wait for cells that are missing or out of date: run `roadscan tiles`"


def check_surface_ahead(plan: SurveyPlan, *, files: bool) -> None:
    """Raise where the surface that a survey asks for cannot be made: its settings, its regions, its pictures.

    files : whether the files of the pictures are looked at.
    """
    if (config := SurfaceConfig.stated(plan.survey)) is not None:
        checked_surface(plan.survey, config)
        searched_sources(plan)
        check_colours(plan, folders=files)
