"""What the store holds, what is stale, what failed; and whether every file is whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.jobs.calibrate import outdated_calibrations
from roadscan.jobs.compute import Inline
from roadscan.jobs.footprints import PRODUCT, stale_footprints
from roadscan.jobs.navigate import known_keys
from roadscan.jobs.plan import plan_survey
from roadscan.jobs.planned_logs import plan_logs
from roadscan.jobs.products import plan_outputs
from roadscan.jobs.sources import damaged_sources
from roadscan.jobs.stages import Run, plan_tile_work
from roadscan.jobs.surface_plan import plan_surface_work
from roadscan.jobs.tile_fates import told
from roadscan.jobs.tile_plan import TILE
from roadscan.model.errors import RoadscanError, StoreError
from roadscan.model.survey import Survey
from roadscan.products.base import products
from roadscan.tables.held import WAY_OUT, read_held
from roadscan.tables.logs import copy_path, has_log, read_log_records, record_path
from roadscan.tables.manifest import Manifest, OutputRecord, read_failures
from roadscan.tables.mend import fault_of
from roadscan.tables.store import Store
from roadscan.tiles.accumulator import MOST_BYTES


@dataclass
class Status:
    """State of a survey."""

    logs: list[dict[str, Any]] = field(default_factory=list)
    """Logs of the survey file: run, sensor, path, format, rows, rejected, state."""
    unused_logs: list[str] = field(default_factory=list)
    """Logs in the store that the survey file no longer lists."""
    readings: dict[str, int] = field(default_factory=dict)
    """Readings by fate."""
    footprints_stale: int = 0
    """Data files of which it is not known, or not known any more, which tiles they touch: these are not counted."""
    tiles_current: int = 0
    tiles_stale: int = 0
    surfaces_stale: int = 0
    """Tiles whose reconstructed surface is missing or stale, of those that hold cells by now."""
    products_stale: int = 0
    """Files of survey products that are missing or stale."""
    outputs: dict[str, int] = field(default_factory=dict)
    """Finished files by product."""
    failures: list[dict[str, str]] = field(default_factory=list)
    """What failed in the last run."""
    next_run: dict[str, int] = field(default_factory=dict)
    """What the next run would do: tasks, tiles, raw bytes, bytes of memory a worker."""
    damaged: list[str] = field(default_factory=list)
    """Records of the store that are damaged; the next run mends them."""
    notes: list[str] = field(default_factory=list)
    """What the user should know, beside what is to do."""
    note: str = ""
    """Why nothing can be said of tiles."""

    @property
    def is_complete(self) -> bool:
        """True if nothing is missing, stale or failed."""
        ingested = all(log["state"] == "ingested" for log in self.logs)
        done = not (self.footprints_stale or self.tiles_stale or self.surfaces_stale or self.products_stale)
        return ingested and done and not (self.failures or self.damaged or self.note)


BYTES_PER_READING = 100
"""Memory of a worker per reading of its block, measured: points, sorting and one tile's products."""
WORKER_BASE_BYTES = 400 << 20
"""Memory of a worker before its first block: Python and its libraries."""


def survey_status(survey: Survey, store: Store) -> Status:
    """Look at everything the manifest says; reads no readings."""
    status = Status(failures=read_failures(store))
    planned, unplanned = plan_logs(survey, store)
    status.failures += [{"stage": "ingest", "unit": u.path, "reason": str(u.error)} for u in unplanned]
    damaged: list[StoreError] = []
    manifest = Manifest(store, damaged)
    records = {r.key: r for r in read_log_records(store, damaged=damaged)}
    status.damaged = list(map(str, damaged))
    for log in planned:
        record = records.get(log.key)
        status.logs.append(
            {
                "run": log.run,
                "sensor": log.sensor,
                "path": str(log.config.path),
                "format": log.format.name,
                "rows": record.rows if record else 0,
                "rejected": record.rejected if record else 0,
                "state": "ingested" if record else "damaged" if has_log(store, log.key) else "waiting",
                "bytes": log.bytes,
            }
        )
    keys = {*(log.key for log in planned), *known_keys(survey, store)}
    status.unused_logs = [f"{r.run}/{r.sensor} {r.path}" for r in records.values() if r.key not in keys]
    status.outputs = {product: count for product, count in manifest.files().items() if product != PRODUCT}
    waiting = [log for log in status.logs if log["state"] != "ingested"]
    if unplanned or waiting:
        status.next_run = {
            "logs": len(waiting),
            "raw_bytes": sum(log["bytes"] for log in waiting),
            "worker_memory_bytes_at_most": WORKER_BASE_BYTES
            + BYTES_PER_READING * survey.config.tiles.max_block_readings,
        }
        return status
    try:
        _tile_status(status, survey, store, manifest)
    except RoadscanError as error:
        status.note = str(error)  # a survey may hold tables only: poses without readings, readings without poses
    return status


def _tile_status(status: Status, survey: Survey, store: Store, manifest: Manifest) -> None:
    plan = plan_survey(survey, store)
    status.notes += outdated_calibrations(plan)
    status.readings = told([*manifest.of(PRODUCT).values(), *manifest.of(TILE).values()])
    status.footprints_stale = len(stale_footprints(plan, manifest))
    if not any(manifest.of(PRODUCT)):
        status.next_run = {"footprints": status.footprints_stale, "raw_bytes": plan.raw_bytes}
        return
    if status.footprints_stale:
        status.notes.append(
            f"{status.footprints_stale:,} data files have no footprints, or old ones: more tiles than these may be due"
        )
    work = plan_tile_work(Run(survey, store, Inline()), manifest)
    tasks = list(work.planned.tasks(work.chosen))
    stale = {str(tile) for t in tasks for tile in t.block.tiles}
    status.tiles_stale = len(stale)
    status.tiles_current = sum(1 for r in manifest.of(TILE).values() if r.path and r.unit not in stale)
    surfaces = plan_surface_work(survey, store, None, manifest)
    waiting = set() if surfaces.planned is None else surfaces.planned.waiting & surfaces.planned.cells.keys()
    status.surfaces_stale = len(surfaces.chosen) + len(waiting)
    status.products_stale = len(plan_outputs(work.planned.plan, manifest)[0])
    largest = max((t.readings * BYTES_PER_READING if t.needs_points else MOST_BYTES for t in tasks), default=0)
    status.next_run = {
        "footprints": status.footprints_stale,
        "tasks": len(tasks),
        "tiles": len(stale),
        "surfaces": status.surfaces_stale,
        "products": status.products_stale,
        "raw_bytes": sum(t.raw_bytes for t in tasks),
        "worker_memory_bytes": WORKER_BASE_BYTES + largest if tasks else 0,
    }


def verify_store(store: Store, report: Callable[[int, int], None] = lambda _a, _b: None) -> list[str]:
    """Read every file the store should hold and compare it with what was recorded; returns the faults.

    A product that is not whole counts as stale from then on: the next run makes it again.
    """
    with store.lock():
        return _verify(store, report)


def _verify(store: Store, report: Callable[[int, int], None]) -> list[str]:
    damaged: list[StoreError] = []
    manifest = Manifest(store, damaged)
    logs = read_log_records(store, damaged=damaged)
    faults = [
        *map(str, damaged),
        *damaged_sources(store),
        *_copy_faults(store, [r.key for r in logs]),
        *_held_faults(store),
    ]
    data = [f for r in logs for own in r.tables.values() for f in own]
    outputs = [r for r in manifest.all() if r.path]
    odd: list[OutputRecord] = []
    total = len(data) + len(outputs)
    with store.scratch() as folder:
        for number, file in enumerate(data, 1):
            fault = fault_of(store, folder, file.path, file.bytes, file.digest)
            key = file.path.split("/log=")[1].split("/")[0]
            faults += [f"{fault}; to ingest it again, remove manifest/logs/{key}.json"] if fault else []
            report(number, total)
        for number, record in enumerate(outputs, len(data) + 1):
            fault = _check_output(store, folder, record)
            if fault:
                faults.append(f"{fault}; the next run makes it again")
                odd.append(record)
            report(number, total)
    manifest.doubt(odd)
    return faults


def _copy_faults(store: Store, keys: Sequence[str]) -> list[str]:
    """Copies of sound log records that differ from them; they are set aside, so that the next run writes them anew."""
    faults: list[str] = []
    for key in keys:
        copy = copy_path(key)
        if store.exists(copy) and store.read_bytes(copy) != store.read_bytes(record_path(key)):
            aside = store.set_aside(copy)
            faults.append(f"{copy}: differs from the log's record and was set aside ({aside}); the next run copies it")
    return faults


def _held_faults(store: Store) -> list[str]:
    """Tables without a record that cannot be read."""
    faults: list[str] = []
    for name in WAY_OUT:
        try:
            read_held(store, name)
        except StoreError as error:
            faults.append(str(error))
    return faults


def _check_output(store: Store, folder: Path, record: OutputRecord) -> str | None:
    fault = fault_of(store, folder, record.path, record.bytes, record.digest)
    if fault is not None:
        return fault
    local = store.local_copy(record.path, folder)
    try:
        if record.product in products():
            products()[record.product].check(local)
        elif record.path.endswith(".parquet"):
            pq.ParquetFile(local).read(use_threads=False)
    except (RoadscanError, OSError, pa.ArrowInvalid) as error:
        return f"{record.path}: {error}"
    return None
