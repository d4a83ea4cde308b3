"""The stages of a run, in their order: the one list that the command line and the flows wrap."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from roadscan.jobs.calibrate import outdated_calibrations
from roadscan.jobs.clock_tables import set_damaged_clocks_aside
from roadscan.jobs.clocks import estimate_clocks
from roadscan.jobs.compute import Compute, Made, damaged_file, rare_collections
from roadscan.jobs.footprints import index_footprints, load_ranges
from roadscan.jobs.found_regions import find_due_regions, searched_sources
from roadscan.jobs.ingest import ingest
from roadscan.jobs.navigate import navigate
from roadscan.jobs.plan import plan_survey
from roadscan.jobs.products import (
    make_products,
    product_context,
    recorded_folders,
    wanted_products,
    wanted_tile_products,
)
from roadscan.jobs.selection import Selection
from roadscan.jobs.surface_colours import check_cameras, check_colours, colour_notes
from roadscan.jobs.surface_plan import SURFACE, checked_surface, files_without_surface, plan_surface_work
from roadscan.jobs.surfaces import compute_surfaces
from roadscan.jobs.tile_files import tile_file_names
from roadscan.jobs.tile_plan import OVERVIEWS, TILE, TilePlan, TileTask, plan_tiles, stale_tiles
from roadscan.jobs.tiles import compute_tiles, run_tasks
from roadscan.model.errors import RoadscanError, RunError
from roadscan.model.ids import TileId
from roadscan.model.survey import Survey
from roadscan.tables.manifest import Manifest, OutputRecord, begin_changes, end_changes, write_failures
from roadscan.tables.mend import mend_records
from roadscan.tables.store import Store


class Reporter:
    """Hears what a run does; the command line shows it as bars or lines."""

    def line(self, text: str) -> None:
        """One thing that happened."""

    def progress(self, stage: str, done: int, total: int) -> None:
        """So many units of a stage are done."""


@dataclass
class Run:
    """A run of a survey: what the stages share."""

    survey: Survey
    store: Store
    compute: Compute
    selection: Selection | None = None
    """Only these tiles, and these whether stale or not."""
    reporter: Reporter = field(default_factory=Reporter)
    failures: list[tuple[str, str, str]] = field(default_factory=list)
    """Stage, unit and reason of everything that failed."""
    raw_bytes_read: int = 0
    """Compressed bytes of readings that the tiles stage asked for."""
    goes_on: bool | None = None
    """True where a run before this one did not come to its end; None before the first stage."""

    def handed_out(self, task: TileTask) -> TileTask:
        """Count what a task reads."""
        self.raw_bytes_read += task.raw_bytes
        return task

    def failed(self, stage: str, found: Sequence[tuple[str, object]]) -> None:
        """Keep failures of a stage."""
        for unit, reason in found:
            self.failures.append((stage, unit, str(reason)))
            self.reporter.line(f"failed: {stage} {unit}: {reason}")


def run_ingest(run: Run) -> None:
    """Raw logs → tables."""
    wanted_products(run.survey)  # a wrong name or option is told before a log is read
    check_cameras(run.survey)
    ingest(run.survey, run.store, run.reporter.line, run.compute)


def run_navigate(run: Run) -> None:
    """GNSS, IMU and odometer → trajectories; shared motion → clocks."""
    for done in set_damaged_clocks_aside(run.store):
        run.reporter.line(f"note: {done}")
    if any(evidence.against != "trajectory" for evidence in run.survey.config.clocks):
        estimate_clocks(run.survey, run.store, before_navigation=True)
    navigate(run.survey, run.store, run.reporter.line)
    estimate_clocks(run.survey, run.store, run.reporter.line)


def run_footprints(run: Run) -> None:
    """Which raw block touches which tile."""
    plan = plan_survey(run.survey, run.store)
    for note in outdated_calibrations(plan):
        run.reporter.line(f"note: {note}")
    found = index_footprints(plan, Manifest(run.store), run.compute, _bar(run, "footprints"))
    run.failed("footprints", found)


def run_tiles(run: Run) -> None:
    """Readings → cells and tile products, by way of points where these are asked for."""
    manifest = Manifest(run.store)
    work = plan_tile_work(run, manifest)
    if work.chosen:
        check_colours(work.planned.plan, folders=True)  # before the tiles are computed for them
    manifest.remove(work.gone)
    tasks = Made(work.planned.tasks(work.chosen, run.compute.workers), run.handed_out)
    report = _bar(run, "tiles")
    failures = run_tasks(compute_tiles, tasks, len(work.chosen), work.planned.singly, manifest, run.compute, report)
    manifest.forget(TILE, [unit for unit, _ in failures])
    empty = manifest.without_file(TILE)
    names = {OVERVIEWS, *tile_file_names()} if empty else ()
    manifest.remove([r for name in names for unit, r in manifest.of(name).items() if unit in empty])
    run.failed("tiles", failures)


def run_surfaces(run: Run) -> None:
    """Cells or points → the reconstructed surface and its products."""
    manifest = Manifest(run.store)
    surface = run.survey.config.surface
    if surface is not None and surface.regions == "found":
        plan = plan_survey(run.survey, run.store)
        run.failed("surfaces", find_due_regions(plan, manifest, run.compute, _bar(run, "regions of interest")))
    work = plan_surface_work(run.survey, run.store, run.selection, manifest)
    manifest.remove(work.gone)
    if work.note:
        run.reporter.line(f"note: {work.note}")
    if work.planned is None or not work.chosen:
        return
    check_colours(work.planned.tiles.plan, folders=True)
    tasks = work.planned.tasks(work.chosen, run.compute.workers)
    report = _bar(run, "surfaces")
    failures = run_tasks(compute_surfaces, tasks, len(work.chosen), work.planned.singly, manifest, run.compute, report)
    manifest.forget(SURFACE, [unit for unit, _ in failures])
    manifest.remove(files_without_surface(manifest))
    made = manifest.of(SURFACE)
    for note in colour_notes(work.planned.pictures, [made[str(t)] for t in work.chosen if str(t) in made]):
        run.reporter.line(f"note: {note}")
    run.failed("surfaces", failures)


def run_products(run: Run) -> None:
    """Cells → mosaics, pictures, tables."""
    plan = plan_survey(run.survey, run.store)
    manifest = Manifest(run.store)
    run.failed("products", make_products(plan, manifest, run.compute, _bar(run, "products")))
    manifest.compact()
    if run.selection is None and not run.failures:  # else files without a record may be due
        end_changes(run.store, manifest, recorded_folders() if run.goes_on else ())


@dataclass(frozen=True)
class Stage:
    """One stage of a run."""

    name: str
    title: str
    run: Callable[[Run], None]


STAGES: tuple[Stage, ...] = (
    Stage("ingest", "raw logs into tables", run_ingest),
    Stage("navigate", "trajectories from GNSS, IMU and odometer, clocks from shared motion", run_navigate),
    Stage("footprints", "which raw block touches which tile", run_footprints),
    Stage("tiles", "readings into points, cells and tile files", run_tiles),
    Stage("surfaces", "cells or points into the reconstructed surface and its files", run_surfaces),
    Stage("products", "mosaics, pictures and tables over all tiles", run_products),
)


def run_stages(run: Run, stages: Sequence[Stage] = STAGES) -> None:
    """Run stages in their order, then close the run.

    Raises
    ------
    RunError
        at the end, if any unit failed; all others are finished and kept.
    """
    with run.store.lock():
        for stage in stages:
            started = time.perf_counter()
            run_stage(run, stage)
            run.reporter.line(f"{stage.name}: {time.perf_counter() - started:.1f} s")
        close_run(run)


def run_stage(run: Run, stage: Stage) -> None:
    """Run one stage; where units of an earlier one failed, its own end joins their list instead of hiding it."""
    if run.goes_on is None:
        mend_records(run.store, lambda text: run.reporter.line(f"note: {text}"))
        run.goes_on = begin_changes(run.store)
    try:
        with rare_collections():
            stage.run(run)
    except RoadscanError as error:
        if damaged := damaged_file(error):
            Manifest(run.store).doubt_files({damaged})  # the next run makes it again
        if not run.failures:
            raise
        run.failed(stage.name, [("as a whole", error)])


def close_run(run: Run) -> None:
    """Keep the list of failures for `roadscan status`, and raise if there are any."""
    write_failures(run.store, [{"stage": s, "unit": u, "reason": r} for s, u, r in run.failures])
    if run.failures:
        listed = "; ".join(f"{s} {u}: {r}" for s, u, r in run.failures[:10])
        more = f"; and {len(run.failures) - 10} more (`roadscan status`)" if len(run.failures) > 10 else ""
        raise RunError(
            f"{len(run.failures)} units failed: {listed}{more}",
            change="everything else is finished; the next run does only these",
        )


@dataclass(frozen=True)
class TileWork:
    """What the tiles stage has to do."""

    planned: TilePlan
    chosen: list[TileId]
    """Tiles to compute now."""
    gone: list[OutputRecord]
    """Files of tiles that no reading touches any more, and of products no longer wanted."""


def plan_tile_work(run: Run, manifest: Manifest) -> TileWork:
    """Compare what there is with what there should be."""
    plan = plan_survey(run.survey, run.store)
    context = product_context(plan)
    if run.survey.config.surface is not None:
        checked_surface(run.survey, run.survey.config.surface)  # before the tiles are computed for it
        searched_sources(plan)
        check_colours(plan)
    footprints = load_ranges(plan, manifest)
    wanted = tuple(wanted_tile_products(run.survey, context))
    tiles = plan_tiles(footprints, plan)
    if run.selection is not None:
        chosen = run.selection.tiles(tiles, footprints, plan.ground.grid)
    else:
        chosen = stale_tiles(tiles, wanted, manifest)
    per_tile = tile_file_names()
    dropped = per_tile - tile_file_names({w.product.name for w in wanted})
    gone = manifest.beside({TILE, OVERVIEWS, *per_tile} - dropped, {str(t) for t in tiles})
    gone += manifest.beside(dropped, ())
    return TileWork(TilePlan(plan, footprints, tiles, wanted, context), chosen, gone)


def _bar(run: Run, stage: str) -> Callable[[int, int], None]:
    return lambda done, total: run.reporter.progress(stage, done, total)
