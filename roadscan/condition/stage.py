"""Stage `condition`: computes profiles, cross-sections, index values and the section table from cells along lanes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

from roadscan.condition.index import condition_indices
from roadscan.condition.roads import LEAST_M
from roadscan.condition.settings import ConditionConfig
from roadscan.core.errors import RoadscanError
from roadscan.core.extras import need
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.engine.compute import run_bundles
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest
from roadscan.tiles.tasks.tiles import TaskResult
from roadscan.tiles.tasks.wanted_products import product_context

if TYPE_CHECKING:
    from roadscan.condition.tasks.tasks import P, PieceTask, S
    from roadscan.condition.tasks.work import ConditionWork

_PICTURES = 20
"""Pictures that one task draws."""
_NAMED = 4
"""Most quantities that a finding names."""

NOT_MEASURED: Final = Witness(
    "condition_not_measured",
    "cells",
    "The drive is too short, the cells too coarse or too sparse for a figure of the road's condition.",
    "the least length, the least share measured and the coarsest cells of each index, section by section",
    "the figure stays empty in every section, and the limit is named",
    ("findings",),
)


class Condition(Stage):
    """The road's condition along its lanes, where the survey file has a section `[condition]`."""

    name = "condition"
    title = "the road's condition along its lanes: roughness, ruts, slopes, cracks, by section"
    after = ("surfaces", "products")
    section = "condition"
    units = "outputs"
    reads = ("cells", "surface", "cracks", "trajectory", "trajectory_accuracy")
    writes = (
        "reference_lines", "lanes", "profiles_longitudinal", "cross_sections", "lane_texture", "lane_line_offsets",
        "road_edge_offsets", "road_surface", "roughness_regions", "roughness_sections", "condition_values",
        "condition_sections", "condition_tiles", "ravelling_patches",
    )  # fmt: skip

    def run(self, session: Session) -> None:
        """Compute what is missing or stale."""
        from roadscan.condition.tasks.lines import write_lines
        from roadscan.condition.tasks.pictures import draw_picture
        from roadscan.condition.tasks.ravelling import patches_of_group
        from roadscan.condition.tasks.road_edges import edges_of_pieces
        from roadscan.condition.tasks.roughness_regions import regions_of_pieces
        from roadscan.condition.tasks.sections import write_sections, write_tiles
        from roadscan.condition.tasks.stretches import stretch_tasks, survey_stretches
        from roadscan.condition.tasks.tasks import run_units
        from roadscan.condition.tasks.values import GroupTask, values_of_group
        from roadscan.condition.tasks.work import plan_condition

        config = ConditionConfig.stated(session.survey)
        work = plan_condition(session)
        if config is None:
            session.manifest.remove(work.gone)
            return
        if work.lines_due:
            session.manifest.add(write_lines(plan_of(session), config, work.lines_key))
            work = plan_condition(session)
        session.manifest.remove(work.gone)
        if not work.stretches:
            session.note("condition: no drive of 20 m or more lies on the tiles that hold cells")
        settings, grid = config.sections(), plan_of(session).ground.grid
        context = product_context(plan_of(session))
        tasks = stretch_tasks(work.due_stretches, session.store, context, settings)
        bar = session.bar("profiles of lanes")
        session.failed(self.name, run_units(survey_stretches, tasks, session.manifest, session.compute, bar))
        self._look_through(session, edges_of_pieces, config.road_edges, work.due_edges, "edges of roads")
        work = plan_condition(session) if tasks or work.due_edges else work
        self._look_through(session, regions_of_pieces, config.roughness_regions, work.due_pieces, "roughness regions")
        values = [GroupTask(session.store, settings, grid.cell_m, context, one) for one in work.due_groups]
        bar = session.bar("values of condition")
        session.failed(self.name, run_units(values_of_group, values, session.manifest, session.compute, bar))
        work = plan_condition(session) if values else work
        if work.files is not None and work.due_files:
            session.manifest.add(write_sections(work.files))
        if work.files is not None and work.due_tiles:
            session.manifest.add([write_tiles(work.files, work.due_tiles)])
        bar = session.bar("ravelled patches")
        session.failed(self.name, run_units(patches_of_group, work.due_patches, session.manifest, session.compute, bar))
        manifest, due = session.manifest, work.due_pictures
        bar = session.bar("pictures of condition")
        failed = run_bundles(draw_picture, due, lambda _: 1, _PICTURES, manifest, session.compute, bar) if due else []
        session.failed(self.name, [(one.unit, reason) for one, reason in failed])

    def _look_through(
        self,
        session: Session,
        function: Callable[[PieceTask[P, S]], TaskResult],
        settings: S | None,
        due: Sequence[P],
        title: str,
    ) -> None:
        """Compute pieces of roads, one to a task; none without settings."""
        from roadscan.condition.tasks.tasks import PieceTask, run_units

        if settings is None:
            return
        grid, context = plan_of(session).ground.grid, product_context(plan_of(session))
        tasks = [PieceTask(session.store, grid, context, settings, (one,)) for one in due]
        session.failed(self.name, run_units(function, tasks, session.manifest, session.compute, session.bar(title)))

    def check(self, survey: Survey) -> list[RoadscanError]:
        """Check that layers open as stated, and that a surface is made where its heights are requested."""
        from roadscan.condition.tasks.lines import check_layer
        from roadscan.condition.tasks.road_edges import check_edge_polygons
        from roadscan.condition.tasks.stretches import check_surface_cells

        try:
            config = ConditionConfig.stated(survey)
            if config is not None and config.roughness_regions is not None:
                need("cv2", "the section [condition.roughness_regions]")
            check_layer(survey)
            check_surface_cells(survey)
            check_edge_polygons(survey)
        except RoadscanError as error:
            return [error]
        return []

    def state(self, session: Session) -> StageState:
        """Stretches and values that are there, and those that are due."""
        if not session.survey.has("condition"):
            return StageState()
        from roadscan.condition.tasks.work import plan_condition

        work = plan_condition(session)
        stale = self._stale(work)
        units = len(work.stretches) + len(work.edges) + len(work.pieces) + len(work.patches)
        units += sum(len(g.indices) for g in work.groups)
        current = units - stale
        return StageState(max(current, 0), stale)

    def _stale(self, work: ConditionWork) -> int:
        return (
            int(work.lines_due)
            + len(work.due_stretches)
            + len(work.due_edges)
            + work.values_due
            + len(work.due_files)
            + bool(work.due_tiles)
            + len(work.due_pictures)
            + len(work.due_patches)
            + len(work.due_pieces)
        )

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """Return steps of wheel paths that no road has, and quantities that no section has, by the limit missed."""
        if not survey.has("condition"):
            return ()
        from roadscan.condition.tasks.lines import LINES
        from roadscan.condition.tasks.sections import known_sections
        from roadscan.condition.tasks.values import value_findings

        if not manifest.of(LINES):
            return ()
        told = known_sections(manifest)
        if told is None or not told[0]:
            said = f"No section of a lane was made: no drive of {LEAST_M:g} m or more lies on tiles that hold cells."
            return (NOT_MEASURED.finds("condition", said),)
        of_cracks = {q.name for one in condition_indices().values() if one.needs_cracks for q in one.quantities}
        found = [*value_findings(manifest)]
        for reason, quantities in told[1].items():
            named = [name for name in quantities if name not in of_cracks]  # the product `cracks` is optional
            if named:
                found.append(NOT_MEASURED.finds("condition", f"{_some(named)}: no section has a value; {reason}."))
        return found

    def folders(self) -> Sequence[str]:
        """Tables of lines, lanes and what was surveyed of them, of edges, values, patches, regions and sections."""
        return (
            "tables/reference_lines", "tables/lanes", "tables/profiles_longitudinal",
            "tables/cross_sections", "tables/lane_texture", "tables/lane_line_offsets",
            "products/ravelling_patches", "products/ravelling_pictures", "tables/road_edge_offsets",
            "products/road_surface", "tables/condition_values", "products/condition_sections",
            "products/condition_tiles", "products/condition_pictures", "tables/roughness_sections",
            "products/roughness_regions", "products/roughness_pictures",
        )  # fmt: skip


def _some(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more:,} more" if more > 0 else "")
