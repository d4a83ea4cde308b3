"""A network of 20,000 km in blocks: planning, the scheduler and the manifest at work; the kernels do nothing.

Everything but the readings is real: plans and tasks of :mod:`roadscan.jobs`, a Dask scheduler with two workers in
processes of their own, and the loop that hands tasks out and keeps the records. A survey is a day's drive: the epochs
of a survey's row groups are held in memory while it is planned (2 MB a kilometre), which 20,000 km in one would not
fit into.
"""

from __future__ import annotations

import importlib
import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from benchmarks.network import Region
from benchmarks.scheduler import running_scheduler
from benchmarks.settings import Settings
from benchmarks.timing import Figure
from roadscan.jobs.compute import Done, OnDask
from roadscan.jobs.products import product_context, wanted_tile_products
from roadscan.jobs.tile_plan import TILE, TilePlan, TileTask, plan_tiles
from roadscan.jobs.tiles import TaskResult, run_tasks
from roadscan.tables.manifest import Manifest, OutputRecord

_BAR_S = 120.0


@dataclass
class _Seen:
    """What the regions took together."""

    tasks: int = 0
    tiles: int = 0
    task_bytes: int = 0
    plan_s: float = 0.0
    submit_s: float = 0.0
    run_s: float = 0.0
    manifest_s: float = 0.0
    held: list[int] = field(default_factory=list)


def figures(folder: Path) -> Iterator[Figure]:
    """The whole network, a survey after another."""
    size = Settings.current()
    length_km, region_km = size.network_km, size.network_region_km
    first = Region.of(1000 * region_km, folder)
    seen, me = _Seen(), psutil.Process()
    before = me.memory_info().rss
    with running_scheduler(workers=2) as (client, scheduler):
        compute = _NoKernels(client, seen)
        client.run(_imports)
        _one_region(first.moved(0, folder / "warm"), compute, _Seen())  # the scheduler imports what tasks name
        warm, seen.submit_s = scheduler.rss_bytes(), 0.0
        for number in range(max(1, round(length_km / region_km))):
            _one_region(first.moved(number, folder), compute, seen)
        end, peak, most = scheduler.rss_bytes(), scheduler.peak_bytes(), scheduler.most_tasks()
    km = region_km * max(1, round(length_km / region_km))
    name = f"{km:,.0f} km"
    yield Figure(f"{name}: tiles stage, tasks", seen.tasks / km, "/km", 1.0, "bar")
    yield Figure(f"{name}: tiles", seen.tiles / km, "/km")
    yield Figure(f"{name}: a task on its way", seen.task_bytes / seen.tasks / 1e3, "kB")
    yield Figure(f"{name}: planning (keys of tiles, tasks)", seen.plan_s, "s")
    yield Figure(f"{name}: handing {seen.tasks:,} tasks out", seen.submit_s, "s")
    yield Figure(f"{name}: handing out, no-op, results, manifest", seen.run_s, "s")
    yield Figure(f"{name}: planned and run", seen.plan_s + seen.run_s, "s", _BAR_S, "bar")
    yield Figure(f"{name}: throughput of the scheduler", seen.tasks / (seen.run_s - seen.manifest_s), "tasks/s")
    yield Figure(f"{name}: manifest, {seen.tiles:,} records", seen.manifest_s, "s")
    yield Figure(f"{name}: tasks that the scheduler holds, at most", most, "")
    yield Figure(f"{name}: memory of the scheduler at the end", end / 2**20, "MiB", warm / 2**20, "after one survey")
    yield Figure(f"{name}: peak memory of the scheduler", peak / 2**20, "MiB")
    yield Figure(f"{name}: growth of the planning process", (me.memory_info().rss - before) / 2**20, "MiB")


def _one_region(region: Region, compute: _NoKernels, seen: _Seen) -> None:
    """Plan a survey, run its tasks, keep its records."""
    started = time.perf_counter()
    plan = region.plan
    context = product_context(plan)
    wanted = tuple(wanted_tile_products(plan.survey, context))
    tiles = plan_tiles(region.footprints, plan)
    planned = TilePlan(plan, region.footprints, tiles, wanted, context)
    tasks = planned.tasks(list(tiles), compute.workers)
    seen.plan_s += time.perf_counter() - started
    seen.task_bytes += len(pickle.dumps(tasks[len(tasks) // 2])) * len(tasks)
    seen.tasks += len(tasks)
    seen.tiles += len(tiles)
    started = time.perf_counter()
    manifest = _Timed(Manifest(plan.store), seen)
    failures = run_tasks(tasks, planned.singly, manifest, compute)  # type: ignore[arg-type]
    if failures:
        raise RuntimeError(f"{len(failures)} tiles failed, the first: {failures[0]}")
    started_compact = time.perf_counter()
    manifest.compact()
    seen.manifest_s += time.perf_counter() - started_compact
    seen.run_s += time.perf_counter() - started


def _imports() -> None:
    """What every worker does once, before its first task."""
    importlib.import_module("roadscan.jobs.stages")


def no_kernels(task: TileTask) -> TaskResult:
    """What a worker returns, without the work: a record a tile, with the figures of a tile."""
    detail = (
        '{"points": 40000000, "cells": 1600000, "height_min_m": 86.123456, "height_mean_m": 87.1, "height_max_m": 88.2,'
        ' "height_std_median_m": 0.0004, "intensity_mean": 90.2, "passes": [1], "first_epoch_gps_ns": '
        '1454644800000000000, "last_epoch_gps_ns": 1454644800360000000, "sigma_horizontal_m": null, "sigma_down_m": '
        'null}'
    )  # fmt: skip
    digest = "blake3:" + 32 * "0"
    return TaskResult(
        tuple(
            OutputRecord(TILE, str(t), key, f"tiles/cells/{t}.parquet", 12_345_678, digest, detail)
            for t, key in zip(task.block.tiles, task.keys, strict=True)
        ),
        (),
    )


class _NoKernels:
    """The real way to Dask, with :func:`no_kernels` for what workers do; submitting is timed."""

    def __init__(self, client: Any, seen: _Seen) -> None:
        self._on_dask = OnDask(client)
        submit = client.submit

        def timed(*arguments: Any, **options: Any) -> Any:
            started = time.perf_counter()
            future = submit(*arguments, **options)
            seen.submit_s += time.perf_counter() - started
            return future

        client.submit = timed

    @property
    def workers(self) -> int:
        """Threads of all workers."""
        return self._on_dask.workers

    def map(self, _: Callable[..., Any], tasks: Sequence[Any]) -> Iterator[Done[Any, Any]]:
        """Run the tasks without kernels, whatever function is asked for."""
        return self._on_dask.map(no_kernels, tasks)


class _Timed:
    """A manifest whose writing is timed."""

    def __init__(self, manifest: Manifest, seen: _Seen) -> None:
        self._manifest, self._seen = manifest, seen

    def add(self, records: Sequence[OutputRecord]) -> None:
        """As the manifest underneath."""
        started = time.perf_counter()
        self._manifest.add(records)
        self._seen.manifest_s += time.perf_counter() - started

    def compact(self) -> None:
        """As the manifest underneath."""
        self._manifest.compact()
