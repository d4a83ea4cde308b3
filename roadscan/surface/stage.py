"""Stage `surfaces`: cells or points are turned into the reconstructed surface and its products."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.surface.settings import SurfaceConfig
from roadscan.surface.tasks.found_regions import find_due_regions
from roadscan.surface.tasks.surface_colours import check_colours, colour_notes
from roadscan.surface.tasks.surface_plan import SURFACE, files_without_surface
from roadscan.surface.tasks.surface_work import check_surface_ahead, plan_surface_work
from roadscan.surface.tasks.surfaces import compute_surfaces
from roadscan.tiles.product import SurfaceProduct
from roadscan.tiles.tasks.tiles import run_tasks


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
