"""Stage `tiles`: counts readings into cells and writes tile files, with points where these are requested."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from roadscan.core.grid import TileId
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.footprints.footprints import PRODUCT as FOOTPRINTS
from roadscan.footprints.footprints import footprints_of
from roadscan.footprints.stage import faults_of_plan
from roadscan.georeference.plan.plan import plan_of
from roadscan.georeference.reading_counts import LogCounts, fate_words, lost_findings
from roadscan.run.engine.compute import LazyTasks
from roadscan.run.session import Session
from roadscan.run.stage import BYTES_PER_READING, WORKER_BASE_BYTES, Stage, StageState, check_stages_ahead
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.tiles.cells import MOST_CELL_BYTES
from roadscan.tiles.product import TileProduct, tile_file_names
from roadscan.tiles.tasks.tile_figures import apart_findings, reading_counts, tile_figures
from roadscan.tiles.tasks.tile_plan import OVERVIEWS, TILE, TilePlan, TileTask, stale_tiles, tiles_of
from roadscan.tiles.tasks.tiles import compute_tiles, run_tasks
from roadscan.tiles.tasks.wanted_products import chosen_tiles, product_context, wanted_tile_products


class Tiles(Stage):
    """Cells, overviews and tile products of each tile that a reading touches."""

    name = "tiles"
    title = "readings into points, cells and tile files"
    after = ("adjust",)
    command = "tile"
    units = "tiles"
    reads = (
        "scans", "returns", "cloud", "trajectory", "clocks", "mountings", "mounting_corrections", "corrections",
        "footprints",
    )  # fmt: skip
    writes = ("cells", "overviews", TileProduct)

    def run(self, session: Session) -> None:
        """Compute the tiles that are missing or stale, or those that are chosen."""
        check_stages_ahead(session, files=False)
        manifest, work = session.manifest, plan_tile_work(session)
        if work.chosen:
            check_stages_ahead(session, files=True)  # before tiles are computed for them
        manifest.remove(work.gone)

        def counted(task: TileTask) -> TileTask:
            session.raw_bytes_read += task.raw_bytes
            return task

        tasks = LazyTasks(work.planned.tasks(work.chosen, session.compute.workers), counted)
        failures = run_tasks(
            compute_tiles, tasks, len(work.chosen), work.planned.singly, manifest, session.compute,
            session.bar(self.name),
        )  # fmt: skip
        manifest.forget(TILE, [unit for unit, _ in failures])
        empty = manifest.without_file(TILE)
        names = {OVERVIEWS, *tile_file_names()} if empty else ()
        manifest.remove([r for name in names for unit, r in manifest.of(name).items() if unit in empty])
        if work.chosen:
            held = len({str(tile) for tile in work.chosen} - empty - {unit for unit, _ in failures})
            session.reporter.line(f"tiles: {len(work.chosen):,} looked at, {held:,} of them hold readings")
        session.failed(self.name, failures)
        self._tell_of_readings(session, work.chosen)

    def _tell_of_readings(self, session: Session, chosen: Sequence[TileId]) -> None:
        """Fail logs without a usable reading, and the survey where no tile has any; report the share of readings
        without a pose.
        """
        manifest = session.manifest
        session.failed(self.name, faults_of_plan(session))
        computed = [manifest.get(TILE, str(tile)) for tile in chosen]
        counts = LogCounts([*manifest.of(FOOTPRINTS).values(), *(record for record in computed if record is not None)])
        if manifest.without_file(TILE) and not manifest.files().get(TILE):
            nowhere = "all lie off the centre lines of filters.centre_line, or outside all passes"
            why = fate_words(counts.of_all()) or nowhere
            reason = f"no tile holds a reading: {why}; check the settings that leave them out"
            session.failed(self.name, [("as a whole", reason)])

    def state(self, session: Session) -> StageState:
        """Tiles, tasks and memory."""
        check_stages_ahead(session, files=False)
        work = plan_tile_work(session)
        tasks = list(work.planned.tasks(work.chosen, session.compute.workers))
        stale = {str(tile) for t in tasks for tile in t.block.tiles}
        held = session.manifest.column(TILE, "unit", "path")
        current = sum(1 for unit, path in held if path and unit not in stale)
        return StageState(
            current,
            len(stale),
            len(session.manifest.without_file(TILE) - stale),
            why=Counter(work.why.values()),
            keys=work.planned.tiles.keys,
            tasks=len(tasks),
            raw_bytes=sum(t.raw_bytes for t in tasks),
            worker_memory_bytes=memory_of(tasks),
        )

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """Return logs of which many readings have no pose, and passes that lie at different heights."""
        logs = reading_counts(manifest).by_log()
        lost = lost_findings(logs, records, survey.config.checks.lost_share)
        return [*lost, *apart_findings(tile_figures(manifest).apart)]

    def folders(self) -> Sequence[str]:
        """Return the folders of tile files, those of surfaces included."""
        return ("tiles",)


@dataclass(frozen=True)
class TileWork:
    """Work of the stage."""

    planned: TilePlan
    chosen: list[TileId]
    """Tiles to compute now."""
    gone: list[OutputRecord]
    """Files of tiles that no reading touches any more, and of products no longer wanted."""
    why: Mapping[TileId, str] = field(default_factory=dict)
    """Why each tile is due, unless tiles were chosen."""


def plan_tile_work(session: Session) -> TileWork:
    """Compare existing tiles with required ones."""
    plan, manifest, survey = plan_of(session), session.manifest, session.survey
    context = product_context(plan)
    wanted = tuple(wanted_tile_products(survey, context))
    tiles, footprints = tiles_of(session), footprints_of(session)
    why = {} if session.selection is not None else stale_tiles(tiles, wanted, manifest)
    chosen = list(why)
    if session.selection is not None:
        chosen = chosen_tiles(session.selection, tiles, footprints, plan.ground.grid)
    per_tile = tile_file_names()
    dropped = per_tile - tile_file_names({w.product.name for w in wanted})
    gone = manifest.beside({TILE, OVERVIEWS, *per_tile} - dropped, tiles.units)
    gone += manifest.beside(dropped, ())
    return TileWork(TilePlan(plan, footprints, tiles, wanted, context), chosen, gone, why)


def memory_of(tasks: Sequence[TileTask]) -> int:
    """Return the approximate memory (bytes) that a worker needs for the largest of some tasks."""
    largest = max((t.readings * BYTES_PER_READING if t.needs_points else MOST_CELL_BYTES for t in tasks), default=0)
    return WORKER_BASE_BYTES + largest if tasks else 0
