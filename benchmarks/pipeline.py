"""A run of a benchmark's survey in a process of its own, as `roadscan run` does it; prints figures as JSON.

``python -m benchmarks.pipeline SURVEY.toml STORE WORKERS [default | PRODUCT …]``; started by
:mod:`benchmarks.measured_run`. With `default` the survey file stays as it is, and all its stages run: what a
user gets. Else only what the products need is run, with the poses as they were recorded.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path

import psutil

from roadscan.core.strict import load_toml
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Compute
from roadscan.run.engine.compute_on import compute_on
from roadscan.run.session import Session
from roadscan.run.stage import Stage, stages
from roadscan.store.logs import read_log_records
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.survey.run import close_run, run_stage
from roadscan.tiles.product import products
from roadscan.tiles.tasks.tile_plan import TILE
from roadscan.tiles.tasks.wanted_products import wanted_products

READING_TABLES = ("scans", "returns")
WANTED = ("geotiff", "model_las")
"""5 mm height, intensity and count; LAZ at 100 mm."""
END_TO_END = ("navigate", "footprints", "tiles", "products")
"""Stages from stored readings to products."""
FROM_LOGS = ("ingest", *END_TO_END)
"""Stages that run where products are named."""
DEFAULT = "default"
"""Stands for the products that a survey file without a word about them makes."""


def main() -> None:
    """Run all stages, one after another."""
    file, asked = Path(sys.argv[1]), sys.argv[4:]
    survey = Survey.load(file) if asked == [DEFAULT] else survey_with(file, asked or list(WANTED))
    store = Store(sys.argv[2], survey.config.id)
    figures: dict[str, object] = {"products": [product.name for product, _ in wanted_products(survey)]}
    timed: dict[str, dict[str, float]] = {}
    chosen = [stage for stage in stages() if asked == [DEFAULT] or stage.name in FROM_LOGS]
    with compute_on(int(sys.argv[3])) as compute:
        started = time.perf_counter()
        for _ in compute.map(_imports, range(int(sys.argv[3]))):
            pass
        figures["start_s"] = time.perf_counter() - started
        run = Session(survey, store, _Counted(compute))
        with store.lock():
            for stage in chosen:
                timed[stage.name] = _timed(run, stage)
            close_run(run, chosen)
    print(json.dumps(figures | {"stages": timed} | _stored(store)))


def survey_with(file: Path, wanted: list[str]) -> Survey:
    """The survey, making those of the wanted products that there are; of a cell its surface is kept (`cell_table`)."""
    made = [name for name in wanted if name in products()]
    values = load_toml(file)
    values["tiles"]["cell_table"] = "surface"
    return Survey.parse(values | {"products": {"make": made}}, folder=file.resolve().parent, file=file)


class _Counted:
    """Compute that counts its tasks."""

    def __init__(self, compute: Compute) -> None:
        self._compute = compute
        self.tasks = 0

    def __getattr__(self, name: str) -> object:
        return getattr(self._compute, name)

    def map(self, function, tasks):  # type: ignore[no-untyped-def]
        """As the compute underneath."""
        self.tasks += len(tasks)
        return self._compute.map(function, tasks)


def _imports(_: int) -> None:
    """What a worker does once, before its first task: import the code of the stages that are timed."""
    for name in ("ingest", "navigation", "tiles.footprints", "tiles", "tiles.mosaics"):
        importlib.import_module(f"roadscan.{name}.stage")


def _timed(run: Session, stage: Stage) -> dict[str, float]:
    """Wall and processor seconds of a stage, and its tasks."""
    counted = run.compute
    tasks, cpu, started = counted.tasks, _cpu_s(), time.perf_counter()  # type: ignore[attr-defined]
    run_stage(run, stage)
    return {
        "wall_s": time.perf_counter() - started,
        "cpu_s": _cpu_s() - cpu,
        "tasks": counted.tasks - tasks,  # type: ignore[attr-defined]
    }


def _cpu_s() -> float:
    """Processor seconds so far of this process and its workers."""
    me = psutil.Process()
    times = [p.cpu_times() for p in (me, *me.children(recursive=True))]
    return sum(t.user + t.system for t in times)


def _stored(store: Store) -> dict[str, float]:
    """Bytes of the tables of readings and of everything written, readings placed, tiles and cells."""
    files = [f for r in read_log_records(store) for t in READING_TABLES for f in r.tables.get(t, ())]
    records = Manifest(store).all()
    tiles = [r.figures() for r in records if r.product == TILE and r.path]
    return {
        "reading_bytes": sum(f.bytes for f in files),
        "tile_bytes": sum(r.bytes for r in records if r.path),
        "tiles": len(tiles),
        "placed": sum(t["points"] for t in tiles),
        "cells": sum(t["cells"] for t in tiles),
    }


if __name__ == "__main__":
    main()
