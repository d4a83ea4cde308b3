"""Runs stages one after another on a session; failures are collected and reported at the end."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import Final

from roadscan import __version__
from roadscan.core.counted import counted
from roadscan.core.errors import RoadscanError, RunError
from roadscan.georeference.plan.plan import NothingToPlaceError
from roadscan.ingest.planned_logs import logs_of
from roadscan.navigation.tasks.navigate import known_keys
from roadscan.run.engine.compute import damaged_file, rare_collections
from roadscan.run.session import SelectionError, Session
from roadscan.run.stage import Stage, findings_of, stages
from roadscan.run.told import reported_run, reported_stage
from roadscan.store.holders import look_again
from roadscan.store.logs import read_log_records
from roadscan.store.manifest import begin_changes, end_changes, write_failures
from roadscan.store.small_tables import digests_fault
from roadscan.store.verified import note_written, recorded_files, repair_records
from roadscan.store.written_by import VERSION_FILE, version_content
from roadscan.surface.tasks.surface_plan import check_cameras
from roadscan.survey.status import survey_status
from roadscan.tiles.tasks.wanted_products import wanted_products

_CLOCK_TICK_NS: Final = 50_000_000
"""Tolerance (ns): a file's time may be this much before the clock's."""


def run_stages(session: Session, chosen: Sequence[Stage] | None = None) -> None:
    """Run stages in their order (all, where none are chosen), then close the run.

    Raises
    ------
    RunError
        at the end, if any unit failed; all others are finished and kept.
    """
    wanted = stages() if chosen is None else chosen
    wanted_products(session.survey)  # a wrong name or option is reported before a log is read
    check_cameras(session.survey)
    with reported_run(session, [stage.name for stage in wanted]), session.store.lock():
        for stage in wanted:
            started = time.perf_counter()
            run_stage(session, stage)
            session.reporter.line(f"{stage.name}: {time.perf_counter() - started:.1f} s")
        close_run(session, wanted)


def run_stage(session: Session, stage: Stage) -> None:
    """Run one stage. If an earlier stage had failures, append this error to them instead of raising it."""
    session.stage = stage.name
    look_again()
    if session.goes_on is None:
        repair_records(session.store, session.note)
        if fault := digests_fault(session.store):
            session.note(fault)
        _tell_upgrade(session)
        session.goes_on = begin_changes(session.store)
        session.began_ns = time.time_ns() - _CLOCK_TICK_NS
    with reported_stage(session, stage.name):
        _run_stage(session, stage)


def _run_stage(session: Session, stage: Stage) -> None:
    try:
        with rare_collections():
            stage.run(session)
        _tell_findings(session, stage)
    except SelectionError:
        raise
    except NothingToPlaceError as nothing:
        if not session.places_nothing:
            session.note(str(nothing))
        session.places_nothing = True
    except RoadscanError as error:
        if damaged := damaged_file(error):
            session.manifest.doubt_files({damaged})  # the next run makes it again
        if not session.failures:
            with contextlib.suppress(RoadscanError):  # a store that cannot be written is raised as it is
                write_failures(session.store, [{"stage": stage.name, "unit": "as a whole", "reason": str(error)}])
            raise
        session.failed(stage.name, [("as a whole", error)])


def _tell_upgrade(session: Session) -> None:
    """Say what this version of roadscan makes anew of a store that another one wrote, before it does so."""
    store, last = session.store, session.store.last_version()
    if last == __version__:
        return
    if store.exists("manifest/logs"):
        due = survey_status(Session(session.survey, store, only_looks=True)).due
        made = ", ".join(f"{count:,} of {stage}" for stage, count in due.items()) or "nothing"
        by = f"roadscan {last}" if last else "an older version"
        if not last and store.exists(VERSION_FILE):
            by = f"a version that is not known, because {VERSION_FILE} is damaged and is written anew"
        session.note(
            f"the store was written by {by}, this is roadscan {__version__}; to be made anew, as far as is known "
            f"before: {made}"
        )
    store.write_bytes(VERSION_FILE, version_content())


def _tell_findings(session: Session, stage: Stage) -> None:
    if type(stage).findings is Stage.findings:  # it queries no stage: no record need be read
        return
    listed = set(known_keys(session.survey, session.store, logs_of(session)))
    records = [r for r in read_log_records(session.store, damaged=[]) if r.key in listed]
    for one in findings_of(session.survey, records, session.manifest, [stage]):
        session.note(one.line)


def _removed_words(paths: Sequence[str]) -> str:
    folders = dict.fromkeys(path.rpartition("/")[0] for path in paths)
    return f"removed {counted(len(paths), 'file')} that a stopped run left without a record, in {', '.join(folders)}"


def close_run(session: Session, done: Sequence[Stage]) -> None:
    """Store the list of failures for `roadscan status`, and raise an error if there are any.

    A whole run without failures has a record for every file that is due: what a run before it left without one is
    removed.
    """
    whole = {stage.name for stage in done}.issuperset(stage.name for stage in stages())
    write_failures(session.store, [{"stage": s, "unit": u, "reason": r} for s, u, r in session.failures])
    if whole:
        _report(session)
        session.manifest.compact()
        if session.selection is None and not session.failures:
            folders = [folder for stage in stages() for folder in stage.folders()]
            removed = end_changes(session.store, session.manifest, folders if session.goes_on else ())
            if removed:
                session.note(_removed_words(removed))
    if session.store.is_folder:
        logs = read_log_records(session.store, damaged=[])
        note_written(session.store, session.began_ns, recorded_files(session.store, logs, session.manifest))
    if session.failures:
        listed = "; ".join(f"{s} {u}: {r}" for s, u, r in session.failures[:10])
        more = f"; and {len(session.failures) - 10} more (`roadscan status`)" if len(session.failures) > 10 else ""
        error = RunError(
            f"{counted(len(session.failures), 'unit')} failed: {listed}{more}",
            change="everything else is finished; the next run does only these",
        )
        error.passes = session.passes
        raise error


def _report(session: Session) -> None:
    """Write the report; if it fails, nothing else does."""
    from roadscan.report.page import keep_report

    try:
        path = keep_report(session)
    except RoadscanError as error:
        session.note(f"the report could not be written: {error}")
    else:
        session.reporter.line(f"report: {session.store.path(path)}")
