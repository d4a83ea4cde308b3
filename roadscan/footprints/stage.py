"""Stage `footprints`: which raw data touch which tile."""

from __future__ import annotations

from collections.abc import Sequence

from roadscan.calibrate.tasks.calibrate import mounting_lines, outdated_calibrations, renew_reports
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.footprints.footprints import (
    PRODUCT,
    footprint_state,
    footprints_of,
    index_footprints,
    join_footprints,
    unplaced_logs,
)
from roadscan.georeference.plan.plan import empty_passes, plan_of
from roadscan.georeference.tick_clocks import check_tick_clocks, tick_findings, tick_state
from roadscan.run.session import Session, manifest_of
from roadscan.run.stage import Stage, StageState
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest


def faults_of_plan(session: Session) -> list[tuple[str, str]]:
    """Return logs that contribute nothing, and passes without a reading."""
    plan = plan_of(session)
    return [*(fault.told for fault in plan.apart), *empty_passes(plan), *unplaced_logs(plan, session.manifest)]


class Footprints(Stage):
    """Records the tiles of each data file, from bounds; without bounds its readings are georeferenced."""

    name = "footprints"
    title = "which raw block touches which tile"
    after = ("navigate",)
    units = "data files, clocks"
    reads = ("scans", "returns", "cloud", "trajectory", "clocks", "mountings")
    writes = ("footprints",)

    def run(self, session: Session) -> None:
        """Index the data files whose footprints are missing or stale."""
        renew_reports(session.store, session.reporter.line)
        session.forget(manifest_of)  # pictures were recorded meanwhile
        plan, manifest = plan_of(session), session.manifest
        session.failed(self.name, [*(fault.told for fault in plan.apart), *empty_passes(plan)])
        for note in outdated_calibrations(plan):
            session.note(note)
        found = index_footprints(plan, manifest, session.compute, session.bar(self.name))
        join_footprints(plan, manifest)
        session.forget(footprints_of)
        found += check_tick_clocks(plan, manifest, session.compute, session.bar("clocks by ticks"))
        session.failed(self.name, [*found, *unplaced_logs(plan, manifest)])

    def state(self, session: Session) -> StageState:
        """Data files of which it is not known, or not known any more, which tiles they touch; and clocks by ticks."""
        asked = plan_of(session), session.manifest, session.compute.workers
        state = footprint_state(*asked)
        state.notes = outdated_calibrations(plan_of(session))
        state.lines = mounting_lines(session.store)
        state.faults = faults_of_plan(session)
        if not session.manifest.of(PRODUCT):
            state.hides_rest = True
        elif state.stale:
            state.notes.append(
                f"{state.stale:,} data files have no footprints, or old ones: more tiles than these may be due"
            )
        state.join(tick_state(*asked))
        state.raw_bytes = state.raw_bytes or None  # clocks alone: of their rows two columns are read
        return state

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """Clocks that wheel ticks and poses contradict."""
        return tick_findings(records, manifest)

    def folders(self) -> Sequence[str]:
        """One file a data file."""
        return ("tables/footprints",)
