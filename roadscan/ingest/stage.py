"""Stage `ingest`: raw logs into tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.ingest.epoch_order import one_stamp_findings, one_stamp_logs
from roadscan.ingest.ingest import DATA_TABLES, ingest, ingested_of
from roadscan.ingest.overlap import NothingPlacedError, apart_logs, can_be_placed, empty_logs, reject_findings
from roadscan.ingest.planned_logs import PlannedLog, logs_of
from roadscan.ingest.reading.format import LogFormat
from roadscan.ingest.sources import same_content_findings
from roadscan.run.session import Session
from roadscan.run.stage import BYTES_PER_READING, WORKER_BASE_BYTES, Stage, StageState
from roadscan.store.logs import Fault, LogRecord, has_log, read_log_records
from roadscan.store.manifest import CHANGED, MISSING, Manifest
from roadscan.store.salvage import read_lost


class Ingest(Stage):
    """A table row a record; a damaged record costs itself alone."""

    name = "ingest"
    title = "raw logs into tables"
    units = "logs"
    writes = (LogFormat, "rejects")

    def run(self, session: Session) -> None:
        """Read the logs that the store does not hold."""
        try:
            ingest(session.survey, session.store, session.reporter.line, session.compute, logs_of(session))
        finally:
            session.forget(ingested_of)
        records = ingested_of(session)
        faults = [*_empty(session, records), *apart_logs(session.survey, records, {}, estimated=False)]
        faults += one_stamp_logs(records)
        has_readings = any(r.tables.get(table) for r in records for table in DATA_TABLES)
        if faults and has_readings and not can_be_placed(records, faults, DATA_TABLES):
            raise NothingPlacedError.of(faults)
        session.failed(self.name, [fault.told for fault in faults])

    def state(self, session: Session) -> StageState:
        """Logs that wait to be read."""
        planned, unplanned = logs_of(session)
        waiting = [log for log in planned if not has_log(session.store, log.key)]
        state = StageState(len(planned) - len(waiting), keys=[log.key for log in planned])
        if not waiting and not unplanned:
            state.faults = [fault.told for fault in _empty(session, ingested_of(session))]
            return state
        known = {(r.run, r.path): r.content for r in read_log_records(session.store, damaged=[])}
        state.why = Counter(_why_due(log, known, session.only_looks) for log in waiting)
        state.why.update({"cannot be read": len(unplanned)} if unplanned else {})
        state.stale = len(waiting) + len(unplanned)
        state.tasks, state.raw_bytes = len(waiting), sum(log.bytes for log in waiting)
        most = session.survey.config.tiles.max_block_readings
        state.worker_memory_bytes = WORKER_BASE_BYTES + BYTES_PER_READING * most
        state.hides_rest = True
        return state

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """What readers and checks of rows doubt, and logs of which much was rejected or stands under one stamp."""
        share = survey.config.checks.lost_share
        own = [one for record in records for one in record.findings]
        own += same_content_findings(survey, records)
        return [*own, *reject_findings(records, share), *one_stamp_findings(records)]


def _why_due(log: PlannedLog, known: Mapping[tuple[str, str], str], only_looks: bool) -> str:
    """Why a log is to be read, `known` being the fingerprints of the logs of the store by run and path."""
    before = known.get((log.run, str(log.config.path)))
    if before is None:
        return MISSING
    if before == log.content:
        return "with other settings or another reader"
    return "of another size or time" if only_looks else CHANGED


def _empty(session: Session, records: Sequence[LogRecord]) -> list[Fault]:
    """Logs without a row, but for those whose rows were lost later: `verify` lists them until their logs are back."""
    lost = {one.log for one in read_lost(session.store)}
    return empty_logs([record for record in records if record.key not in lost])
