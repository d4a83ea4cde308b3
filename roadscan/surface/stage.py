"""Stage `surfaces`: cells or points are turned into the reconstructed surface and its products."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from roadscan.core.grid import TileId
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import SurveyPlan, plan_of
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.store.manifest import OutputRecord
from roadscan.surface.settings import SurfaceConfig
from roadscan.surface.tasks.found_regions import (
    REGIONS,
    FoundRegions,
    find_due_regions,
    load_found_regions,
    searched_sources,
)
from roadscan.surface.tasks.surface_plan import (
    SURFACE,
    SurfacePlan,
    check_colours,
    checked_surface,
    colour_notes,
    files_without_surface,
    plan_colours,
    plan_surfaces,
)
from roadscan.surface.tasks.surfaces import compute_surfaces
from roadscan.tiles.product import SurfaceProduct, surface_file_names
from roadscan.tiles.tasks.tile_plan import TilePlan, tiles_of
from roadscan.tiles.tasks.tiles import run_tasks
from roadscan.tiles.tasks.wanted_products import chosen_tiles, product_context, wanted_surface_products


class Surfaces(Stage):
    """The stage of the road's surface; it runs where the survey file has a section `[surface]`."""

    name = "surfaces"
    title = "cells or points into the reconstructed surface and its files"
    after = ("tiles",)
    section = "surface"
    units = "tiles"
    reads = ("cells", "scans", "returns", "cloud", "trajectory", "corrections", "footprints", "images")
    writes = ("regions", SurfaceProduct)

    def check_ahead(self, session: Session, *, files: bool) -> None:
        """Raise where the surface that the survey asks for cannot be made: its settings, regions or pictures."""
        check_surface_ahead(plan_of(session), files=files)

    def run(self, session: Session) -> None:
        """Reconstruct what is missing or stale."""
        manifest, surface = session.manifest, SurfaceConfig.stated(session.survey)
        if surface is not None and surface.regions == "found":
            bar = session.bar("regions of interest")
            session.failed(self.name, find_due_regions(plan_of(session), manifest, session.compute, bar))
        work = plan_surface_work(session)
        manifest.remove(work.gone)
        if work.note:
            session.note(work.note)
        if work.planned is None or not work.chosen:
            return
        check_colours(plan_of(session), folders=True)
        tasks = work.planned.tasks(work.chosen, session.compute.workers)
        failures = run_tasks(
            compute_surfaces, tasks, len(work.chosen), work.planned.singly, manifest, session.compute,
            session.bar(self.name),
        )  # fmt: skip
        manifest.forget(SURFACE, [unit for unit, _ in failures])
        manifest.remove(files_without_surface(manifest))
        made = manifest.of(SURFACE)
        for note in colour_notes(work.planned.pictures, [made[str(t)] for t in work.chosen if str(t) in made]):
            session.note(note)
        session.failed(self.name, failures)

    def state(self, session: Session) -> StageState:
        """Returns tiles whose surface is missing or stale, of those that have cells by now."""
        work = plan_surface_work(session)
        if work.planned is None:
            return StageState()
        waiting = work.planned.waiting & work.planned.cells.keys()
        return StageState(
            len(work.planned.keys) - len(work.chosen),
            len(work.chosen) + len(waiting),
            why=Counter([*work.why.values(), *("tile due" for _ in waiting)]),
            keys=[*work.planned.keys.values()],
            tasks=len(work.planned.tasks(work.chosen, session.compute.workers)),
        )

    def folders(self) -> Sequence[str]:
        """Returns folders: outlines of the regions; files of surfaces are beside those of tiles."""
        return ("tables/regions",)


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
