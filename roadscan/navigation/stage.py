"""Stage `navigate`: trajectories from GNSS, IMU and odometer; clocks from shared motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.ingest.ingest import survey_records
from roadscan.ingest.planned_logs import logs_of
from roadscan.navigation.tasks.clock_tables import set_damaged_clocks_aside
from roadscan.navigation.tasks.clocks import estimate_clocks
from roadscan.navigation.tasks.navigate import navigate, records_of
from roadscan.navigation.tasks.navigation_status import navigation_status, trajectory_findings
from roadscan.navigation.tasks.ppk_pictures import draw_post_processed
from roadscan.run.session import Session, manifest_of
from roadscan.run.stage import Stage, StageState
from roadscan.store.logs import LogRecord, read_log_records
from roadscan.store.manifest import MISSING, Manifest


class Navigate(Stage):
    """Computes trajectories, which are stored like logs, and clocks, which are a small table."""

    name = "navigate"
    title = "trajectories from GNSS, IMU and odometer, clocks from shared motion"
    after = ("ingest",)
    units = "trajectories"
    reads = ("gnss", "imu", "encoder", "trajectory", "trajectory_accuracy")
    writes = (
        "trajectory", "trajectory_accuracy", "navigation_states", "innovations", "clocks", "clock_residuals",
    )  # fmt: skip
    uses_workers = False

    def run(self, session: Session) -> None:
        """Compute what is missing or out of date."""
        survey, store, say = session.survey, session.store, session.reporter.line
        for done in set_damaged_clocks_aside(store):
            session.note(done)
        try:
            if any(evidence.against != "trajectory" for evidence in survey.config.clocks):
                estimate_clocks(survey, store, before_navigation=True, logs=logs_of(session))
            draw_post_processed(survey, store, survey_records(survey, store, logs_of(session)), say)
            navigate(survey, store, say, logs_of(session))
            estimate_clocks(survey, store, say, logs=logs_of(session))
        finally:
            session.forget(records_of)
            session.forget(manifest_of)  # pictures were recorded meanwhile

    def state(self, session: Session) -> StageState:
        """Computed trajectories, estimated clocks."""
        held = {r.key: r for r in read_log_records(session.store, damaged=[])}
        own = [held[log.key] for log in logs_of(session)[0] if log.key in held]
        found = navigation_status(session.survey, session.store, own, held)
        why = Counter(one["state"] for one in found.trajectories if one["state"] != "computed")
        why = Counter({MISSING if state == "waiting" else state: count for state, count in why.items()})
        due = why.total()
        return StageState(len(found.trajectories) - due, due, why=why, tasks=due, lines=list(found.lines()))

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """Return computed trajectories that their measurements contradict."""
        return trajectory_findings(records)
