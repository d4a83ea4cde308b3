"""Stage `navigate`: trajectories from GNSS, IMU and odometer; clocks from shared motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import pyarrow as pa

from roadscan.core.extras import can_draw
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.ingest.ingest import survey_records
from roadscan.ingest.planned_logs import logs_of
from roadscan.navigation.ppk_picture import COLUMNS, PpkPicture, draw_ppk
from roadscan.navigation.tasks.clocks import estimate_clocks
from roadscan.navigation.tasks.navigate import navigate, records_of
from roadscan.navigation.tasks.navigation_status import navigation_status, trajectory_findings
from roadscan.navigation.tasks.recorded_pictures import keep_file, remove_others
from roadscan.navigation.tasks.trajectories import set_damaged_clocks_aside
from roadscan.run.keys import code_digest, key_of
from roadscan.run.session import Session, manifest_of
from roadscan.run.stage import Stage, StageState
from roadscan.store.logs import LogRecord, read_log_records
from roadscan.store.manifest import MISSING, Manifest
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store


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


PPK_PICTURE: Final = "ppk_picture"
"""Product of the records."""
_FOLDER: Final = "products/navigation"
PPK: Final = "ppk"
"""Format of the logs, and entry of their records with the figures."""


def ppk_picture_path(record: LogRecord) -> str:
    """Return the path of the picture of a log, relative to the survey's root."""
    return f"{_FOLDER}/{_unit(record)}.png"


def _unit(record: LogRecord) -> str:
    return f"{record.run}-{record.sensor}-{PPK}-{record.key[:8]}"


def draw_post_processed(
    survey: Survey, store: Store, records: Sequence[LogRecord], report: Callable[[str], None]
) -> None:
    """Draw the pictures of logs that were post-processed which are missing, damaged or stale; remove others.

    Without Matplotlib there are none.

    Parameters
    ----------
    records : of the survey's logs.
    """
    own = {_unit(one): one for one in records if one.format == PPK and PPK in one.attributes} if can_draw() else {}
    if not own and not store.files(_FOLDER):
        return
    manifest = Manifest(store)
    remove_others(manifest, PPK_PICTURE, own)
    for unit, record in own.items():
        title = f"{survey.config.id}, run {record.run}, {record.path}"
        key = key_of(code_digest("roadscan.navigation.ppk_picture"), title, record.key)
        files = record.tables.get("gnss", ())
        if manifest.is_current(PPK_PICTURE, unit, key) or not files:
            continue
        rows = pa.concat_tables(
            [read_groups(store, one.path, range(len(one.group_rows)), list(COLUMNS)) for one in files]
        )
        picture, target = PpkPicture.of(title, rows, record.attributes[PPK]), ppk_picture_path(record)

        def write(path: Path, picture: PpkPicture = picture) -> None:
            draw_ppk(path, picture)

        keep_file(store, manifest, (PPK_PICTURE, unit), key, target, write)
        report(f"drawn: {target}")
