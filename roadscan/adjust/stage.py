"""Stage `adjust`: corrections of the poses, from passes that overlap and from ground control."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from roadscan.adjust.settings import AdjustConfig
from roadscan.adjust.tasks.adjustment import adjust_survey, is_current, solution_key, why_due, withdraw
from roadscan.adjust.tasks.control_work import read_picked
from roadscan.adjust.tasks.hand_ties import read_hand_ties
from roadscan.adjust.tasks.near import memory_of
from roadscan.adjust.tasks.outcome import FOLDER, TABLES, known_findings, known_lines
from roadscan.adjust.tasks.tracks import adjusted_sources
from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.footprints.footprints import footprints_of, index_footprints, join_footprints
from roadscan.georeference.plan.plan import plan_of, poses_plan_of
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest
from roadscan.store.schema import table_schema


class Adjust(Stage):
    """The stage of the adjustment: evidence is a file for some places or a point; corrections are a small table."""

    name = "adjust"
    title = "corrections of the poses, from passes that overlap and from ground control"
    after = ("footprints", "picture_ties")
    section = "adjust"
    units = "solutions"
    reads = (
        "scans", "returns", "cloud", "trajectory", "trajectory_accuracy", "control_points", "control_lines", "clocks",
        "mountings", "footprints", "picture_tracks", "images",
    )  # fmt: skip
    writes = (
        "ties", "control_sightings", "tie_returns", "edge_scores", *TABLES, "corrections", "mounting_corrections",
        "camera_corrections", "camera_covariances",
    )  # fmt: skip

    def run(self, session: Session) -> None:
        """Adjust where evidence, settings or code differ from those of the last solution."""
        if is_current(poses_plan_of(session), session.manifest):
            return
        if AdjustConfig.of(session.survey).on:
            adjust_survey(session)
        else:
            withdraw(session)
        if not poses_plan_of(session).sources:
            return
        session.take(plan_of, plan_of(session).corrected_anew())
        # Corrections beyond the margin of footprints make these anew, and nothing else does.
        found = index_footprints(plan_of(session), session.manifest, session.compute, session.bar("footprints"))
        join_footprints(plan_of(session), session.manifest)
        session.forget(footprints_of)
        session.failed(self.name, found)

    def check(self, survey: Survey) -> list[RoadscanError]:
        """Check that the files of picked targets and of ties by hand are valid."""
        if not AdjustConfig.of(survey).on:
            return []
        found: list[RoadscanError] = []
        for read in (read_picked, read_hand_ties):
            try:
                read(survey)
            except ConfigError as error:
                found.append(error)
        return found

    def state(self, session: Session) -> StageState:
        """Whether the corrections are those of the survey as it is, and what they are worth."""
        plan, asked = poses_plan_of(session), self.is_asked(session.survey)
        why = why_due(plan, session.manifest)
        notes = ["the adjustment is due: it may make more tiles stale than these"] if why and asked else []
        return StageState(
            int(not why),
            int(bool(why)),
            why=Counter([why] if why else []),
            keys=[solution_key(plan, session.manifest)] if asked else [],
            notes=notes,
            worker_memory_bytes=memory_of(adjusted_sources(plan)) if why and asked else None,
            lines=known_lines(session.manifest),
        )

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """Returns the findings of the last solution."""
        return known_findings(manifest)

    def folders(self) -> Sequence[str]:
        """Returns folders: evidence, tables of the outcome, pictures."""
        locations = [
            table_schema(name).location for name in ("ties", "control_sightings", "tie_returns", "edge_scores", *TABLES)
        ]
        return [*(location for location in locations if location is not None), FOLDER]
