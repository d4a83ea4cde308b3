"""Reports what the store contains, what is stale, what failed; and verifies every file."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import DamagedError, RoadscanError, StoreError
from roadscan.core.witness import Finding
from roadscan.footprints.footprints import PRODUCT
from roadscan.georeference.plan.plan import NothingToPlaceError
from roadscan.ingest.overlap import NothingPlacedError
from roadscan.ingest.planned_logs import PlannedLog, UnplannedLog, logs_of
from roadscan.ingest.sources import damaged_sources
from roadscan.navigation.tasks.navigate import known_keys
from roadscan.run.engine.compute import rare_collections
from roadscan.run.session import Session
from roadscan.run.stage import StageState, findings_of, stages
from roadscan.store.digest import UNREADABLE
from roadscan.store.history import history_faults
from roadscan.store.logs import LogRecord, copy_path, has_log, read_log_records, record_path
from roadscan.store.manifest import Manifest, OutputRecord, read_failures
from roadscan.store.salvage import Lost, read_lost
from roadscan.store.stamp import Stamp, stamp_of
from roadscan.store.store import Store
from roadscan.store.verified import fault_of, held_faults, note_verified
from roadscan.store.written_by import VERSION_FILE
from roadscan.survey.forgotten import forgotten_pictures
from roadscan.survey.preflight import preflight
from roadscan.tiles.product import products
from roadscan.tiles.tasks.tile_figures import reading_counts


@dataclass
class Status:
    """State of a survey."""

    logs: list[dict[str, Any]] = field(default_factory=list)
    """Logs of the survey file: run, sensor, path, format, rows, rejected, state."""
    unused_logs: list[str] = field(default_factory=list)
    """Logs in the store that the survey file no longer lists."""
    readings: dict[str, int] = field(default_factory=dict)
    """Number of readings by result."""
    stages: dict[str, StageState] = field(default_factory=dict)
    """State of each stage, without those of which nothing is known yet."""
    outputs: dict[str, int] = field(default_factory=dict)
    """Finished files by product."""
    ingested: dict[str, int] = field(default_factory=dict)
    """Files of ingested rows by table."""
    failures: list[dict[str, str]] = field(default_factory=list)
    """What failed in the last run."""
    checked: list[str] = field(default_factory=list)
    """Notes of the checks before a run."""
    damaged: list[str] = field(default_factory=list)
    """Damaged records of the store; the next run repairs them."""
    lost: list[Lost] = field(default_factory=list)
    """Ingested rows that the store has lost and that could not be read again."""
    findings: list[Finding] = field(default_factory=list)
    """Findings of the witnesses."""
    note: str = ""
    """Why nothing is known of tiles."""
    would_fail: list[str] = field(default_factory=list)
    """Why the next run would fail, as far as known."""
    places_nothing: str = ""
    """Why there are no tiles, and will be none: no log of the survey has readings."""

    @property
    def is_complete(self) -> bool:
        """Return True if nothing is missing, stale or failed, and the user accepted all lost rows."""
        lost = any(not one.accepted for one in self.lost)
        due = any(state.stale or state.hides_rest for state in self.stages.values())
        return not (due or self.failures or self.damaged or self.note or self.would_fail or lost)

    @property
    def notes(self) -> list[str]:
        """Return what the user should know, beside what is to do."""
        found = [one.line for one in self.findings]
        return [*self.checked, *found, *(note for state in self.stages.values() for note in state.notes)]

    def as_json(self) -> dict[str, Any]:
        """Return what `roadscan status` prints as JSON values."""
        states = {
            name: {"current": one.current, "due": one.stale, "empty": one.empty, "why": dict(one.why)}
            for name, one in self.stages.items()
        }
        return {
            "complete": self.is_complete,
            "logs": self.logs,
            "unused_logs": self.unused_logs,
            "readings": self.readings,
            "stages": states,
            "due": self.due,
            "outputs": self.outputs,
            "damaged": self.damaged,
            "lost": [one.as_json() for one in self.lost],
            "notes": self.notes,
            "no_tiles": self.note or self.places_nothing,
            "would_fail": self.would_fail,
            "failures": self.failures,
        }

    @property
    def due(self) -> dict[str, int]:
        """How many units the next run would make, by stage, as far as is known by now; :mod:`roadscan.survey.plan`
        says more.
        """
        return {name: state.stale for name, state in self.stages.items() if state.stale}

    def of(self, stage: str) -> StageState:
        """Return the state of a stage; an empty one where nothing is known of it yet."""
        return self.stages.get(stage, StageState())


def survey_status(session: Session) -> Status:
    """Return the state of a survey from its manifest; no readings are read."""
    with session.store.looked(), rare_collections():
        return _survey_status(session)


def _survey_status(session: Session) -> Status:
    store, damaged = session.store, session.hear_of_damage()
    records = {r.key: r for r in read_log_records(store, damaged=damaged)}  # held from here on, not read again
    found = preflight(session.survey, store)
    causes = [*map(str, found.causes), *found.failing]
    status = Status(failures=read_failures(store), would_fail=causes.copy(), checked=list(found.notes))
    planned, unplanned = logs_of(session)
    unsaid = [u for u in unplanned if not causes]  # otherwise reported there, once per cause
    status.failures += [{"stage": "ingest", "unit": u.path, "reason": str(u.error)} for u in unsaid]
    manifest = session.manifest
    status.damaged = list(map(str, damaged))
    status.lost = read_lost(store)
    status.logs = [_log_state(store, log, records.get(log.key)) for log in planned]
    status.logs += [_unplanned_state(one) for one in unplanned]
    keys = {*(log.key for log in planned), *known_keys(session.survey, store, logs_of(session))}
    status.unused_logs = [f"{r.run}/{r.sensor} {r.path}" for r in records.values() if r.key not in keys]
    shown = ((product, count) for product, count in manifest.files().items() if product.split(".")[0] != PRODUCT)
    status.outputs = dict(shown)
    files = (one for r in records.values() if r.key in keys for one in r.tables.items())
    for table, own in files:
        status.ingested[table] = status.ingested.get(table, 0) + len(own)
    status.readings = reading_counts(manifest).of_all()
    status.findings = findings_of(session.survey, [r for r in records.values() if r.key in keys], manifest)
    for stage in stages():
        pa.default_memory_pool().release_unused()
        try:
            status.stages[stage.name] = state = stage.state(session)
        except NothingPlacedError as error:
            status.would_fail.append(str(error))
            break
        except NothingToPlaceError as nothing:
            status.places_nothing = str(nothing)
            continue
        except RoadscanError as error:
            status.note = str(error)  # a survey may have tables only: poses without readings, readings without poses
            break
        status.would_fail += [f"{unit}: {reason}" for unit, reason in state.faults]
        status.failures = [one for one in status.failures if (one["unit"], one["reason"]) not in state.faults]
        if state.hides_rest:
            break
    return status


def _log_state(store: Store, log: PlannedLog, record: LogRecord | None) -> dict[str, Any]:
    return {
        "run": log.run,
        "sensor": log.sensor,
        "path": str(log.config.path),
        "format": log.format.name,
        "rows": record.rows if record else 0,
        "rejected": record.rejected if record else 0,
        "state": "ingested" if record else "damaged" if has_log(store, log.key) else "waiting",
        "bytes": log.bytes,
    }


def _unplanned_state(log: UnplannedLog) -> dict[str, Any]:
    """Return the entry of a log that cannot be planned: a file of it is missing, or its settings are wrong."""
    unknown = dict.fromkeys(("rows", "rejected", "bytes"), 0)
    return {"run": log.run, "sensor": "", "path": log.path, "format": "", "state": "cannot be read", **unknown}


@dataclass
class Damage:
    """Damage to the files of a store."""

    faults: list[str] = field(default_factory=list)
    """Faults of records, small tables and outputs, in words."""
    ingested: dict[str, str] = field(default_factory=dict)
    """Faults of files of ingested rows, by their paths relative to the survey's root."""


def verify_store(store: Store, report: Callable[[int, int], None] = lambda _a, _b: None) -> list[str]:
    """Read every file that the store should have and compare it with its record; return the faults.

    A product that is not whole counts as stale from then on: the next run makes it again.
    """
    with store.lock():
        found = find_damage(store, report)
    return found.faults + [
        f"{fault}; `roadscan verify --repair` reads its log again" for fault in found.ingested.values()
    ]


def find_damage(store: Store, report: Callable[[int, int], None] = lambda _a, _b: None) -> Damage:
    """Return the damage to a store (requires its lock); sound files are noted, so that SQL need not verify them."""
    damaged: list[StoreError] = []
    manifest = Manifest(store, damaged)
    logs = read_log_records(store, damaged=damaged)
    found = Damage(
        [
            *map(str, damaged),
            *damaged_sources(store),
            *_version_faults(store),
            *_forgotten_faults(store),
            *_copy_faults(store, [r.key for r in logs]),
            *held_faults(store),
            *history_faults(store).values(),
        ]
    )
    data = [f for r in logs for own in r.tables.values() for f in own]
    outputs = [r for r in manifest.all() if r.path]
    odd: list[OutputRecord] = []
    whole: dict[str, Stamp] = {}
    total = len(data) + len(outputs)
    with store.scratch() as folder:
        for number, file in enumerate(data, 1):
            stamp = stamp_of(store, file.path)  # before it is read
            fault = fault_of(store, folder, file.path, file.bytes, file.digest)
            if fault:
                found.ingested[file.path] = fault
            elif stamp is not None:
                whole[file.path] = stamp
            report(number, total)
        for number, record in enumerate(outputs, len(data) + 1):
            stamp = stamp_of(store, record.path)
            fault = _check_output(store, folder, record)
            if fault:
                found.faults.append(f"{fault}; the next run makes it again")
                odd.append(record)
            elif stamp is not None and record.path.endswith(".parquet"):
                whole[record.path] = stamp
            report(number, total)
    manifest.doubt(odd)
    note_verified(store, whole, anew=True)
    return found


def _version_faults(store: Store) -> list[str]:
    """Return the fault of the file that names the version which wrote last, if it has one."""
    if store.exists(VERSION_FILE) and not store.last_version():
        return [f"{VERSION_FILE}: it is damaged; the next run writes it anew"]
    return []


def _forgotten_faults(store: Store) -> list[str]:
    """Return the fault of the record of forgotten pictures, if it has one."""
    try:
        forgotten_pictures(store)
    except DamagedError as error:
        return [str(error)]
    return []


def _copy_faults(store: Store, keys: Sequence[str]) -> list[str]:
    """Return faults of record copies that differ from sound log records; they are set aside and written again."""
    faults: list[str] = []
    for key in keys:
        copy = copy_path(key)
        if store.exists(copy) and store.read_bytes(copy) != store.read_bytes(record_path(key)):
            aside = store.set_aside(copy)
            faults.append(f"{copy}: differs from the log's record and was set aside ({aside}); the next run copies it")
    return faults


def _check_output(store: Store, folder: Path, record: OutputRecord) -> str | None:
    return fault_of(store, folder, record.path, record.bytes, record.digest, functools.partial(_unopened, record))


def _unopened(record: OutputRecord, local: Path) -> str | None:
    """Return why an output's file, of which `local` is a copy, is not what it should be."""
    try:
        if record.product in products():
            products()[record.product].check(local)
        elif record.path.endswith(".parquet"):
            pq.ParquetFile(local).read(use_threads=False)
    except (RoadscanError, *UNREADABLE) as error:
        return f"{record.path}: {error}"
    return None
