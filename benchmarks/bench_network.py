"""A network of 20,000 km in blocks: planning, the scheduler and the manifest at work; the kernels do nothing.

Everything but the readings is real: plans and tasks of the stages, a Dask scheduler with two workers in
processes of their own, and the loops that hand tasks out and keep the records. A survey is a day's drive; footprints
and tiles of all are scheduled as in a run, products of one. The network is run twice: its graph alone, where a task of
tiles ends at once and leaves nothing, and then with four records of each tile, which are made, packed, sent and kept.
At last commands run on stores that are kept, with tiny files.
"""

from __future__ import annotations

import importlib
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import psutil

from benchmarks.kept_stores import of_fleet, of_folder, of_object_store, of_site
from benchmarks.network import Region
from benchmarks.scheduler import Watched, running_scheduler
from benchmarks.settings import Settings
from benchmarks.timing import Figure
from roadscan.footprints.footprints import PRODUCT, FootprintTask, index_footprints
from roadscan.run.engine.compute import Bundle, Ended, LazyTasks, rare_collections
from roadscan.run.engine.on_dask import OnDask
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.records import Packed, Row
from roadscan.store.store import Store
from roadscan.tiles.mosaics.products import OutputTask, make_products
from roadscan.tiles.tasks.tile_plan import OVERVIEWS, TILE, TilePlan, TileTask, plan_tiles, stale_tiles
from roadscan.tiles.tasks.tiles import TaskResult, compute_tiles, run_tasks
from roadscan.tiles.tasks.wanted_products import product_context, wanted_tile_products

_BAR_S = 120.0
_Work: TypeAlias = Callable[[Any], Any]
_NOTHING = TaskResult.of([])
_TILE_FIGURES = (
    '"height_mean_m": 87.1, "height_max_m": 88.2, "height_std_median_m": 0.0004, "intensity_mean": 90.2, "passes": [1],'
    ' "first_epoch_gps_ns": 1454644800000000000, "last_epoch_gps_ns": 1454644800360000000, "sigma_horizontal_m": null,'
    ' "sigma_down_m": null}'
)


@dataclass
class _Stage:
    """What the surveys took together, in one stage."""

    km: float = 0.0
    tasks: int = 0
    bytes: int = 0
    plan_s: float = 0.0
    submit_s: float = 0.0
    whole_s: float = 0.0


@dataclass
class _Seen:
    """What the surveys took together."""

    footprints: _Stage = field(default_factory=_Stage)
    tiles: _Stage = field(default_factory=_Stage)
    products: _Stage = field(default_factory=_Stage)
    tiles_touched: int = 0
    manifest_s: float = 0.0
    whole_s: float = 0.0
    planner_s: float = 0.0
    """Processor time of the planning process; then of the scheduler, and of the workers."""
    scheduler_s: float = 0.0
    workers_s: float = 0.0


def figures(folder: Path) -> Iterator[Figure]:
    """The whole network, a survey after another: its graph, then with all records; the products of the first."""
    size = Settings.current()
    regions = max(1, round(size.network_km / size.network_region_km))
    first = Region.of(1000 * size.network_region_km, folder)
    me = psutil.Process()
    with running_scheduler(workers=2) as (client, scheduler), rare_collections():
        client.run(_imports)
        _network(first.moved(0, folder / "warm"), client, _Seen(), stand_in).compact()
        before, warm = me.memory_info().rss, scheduler.rss_bytes()
        graph = _all(first, folder / "graph", regions, client, scheduler, no_op)
        seen = _all(first, folder / "kept", regions, client, scheduler, stand_in)
        end, peak, most = scheduler.rss_bytes(), scheduler.peak_bytes(), scheduler.most_tasks()
        grown = me.memory_info().rss - before
        region = first.moved(0, folder / "products")
        _products(region, _network(region, client, _Seen(), stand_in), client, seen)
    name = f"{seen.tiles.km:,.0f} km"
    yield Figure(f"{name}: tiles", seen.tiles_touched / seen.tiles.km, "/km")
    yield from _of_stage("footprints", seen.footprints)
    yield from _of_stage("tiles", seen.tiles)
    yield Figure(f"{name}: of this, records in the manifest", seen.manifest_s, "s")
    yield from _of_network(f"{name}: footprints and tiles, the graph planned and run", graph)
    yield from _of_network(f"{name}: footprints and tiles, planned, run, all records kept", seen)
    yield Figure(f"{name}: tasks that the scheduler holds, at most", most, "")
    yield Figure(f"{name}: memory of the scheduler at the end", end / 2**20, "MiB", warm / 2**20, "after one survey")
    yield Figure(f"{name}: peak memory of the scheduler", peak / 2**20, "MiB")
    yield Figure(f"{name}: growth of the planning process", grown / 2**20, "MiB")
    yield from _of_stage("products", seen.products)
    yield from of_folder(folder / "large", size.status_km)
    yield from of_object_store(folder / "objects", size.objects_km)
    yield from of_site(folder / "site")
    yield from of_fleet(folder / "fleet", size.fleet_surveys)


def _all(first: Region, folder: Path, regions: int, client: Any, scheduler: Watched, work: _Work) -> _Seen:
    """Every survey of the network, one after another, with what that takes."""
    seen = _Seen()
    started, mine = time.perf_counter(), time.process_time()
    its, theirs = scheduler.cpu_s(), scheduler.workers_cpu_s()
    for number in range(regions):
        _network(first.moved(number, folder / f"{number}"), client, seen, work).compact()
    seen.whole_s, seen.planner_s = time.perf_counter() - started, time.process_time() - mine
    seen.scheduler_s, seen.workers_s = scheduler.cpu_s() - its, scheduler.workers_cpu_s() - theirs
    return seen


def _of_network(name: str, seen: _Seen) -> Iterator[Figure]:
    yield Figure(name, seen.whole_s, "s", _BAR_S, "bar")
    yield Figure(f"{name}, processor time of the planning process", seen.planner_s, "s")
    yield Figure(f"{name}, processor time of the scheduler", seen.scheduler_s, "s")
    yield Figure(f"{name}, processor time of the workers", seen.workers_s, "s")
    tasks, planning = seen.tiles.tasks + seen.footprints.tasks, seen.tiles.plan_s + seen.footprints.plan_s
    yield Figure(f"{name}, throughput", tasks / (seen.whole_s - planning), "tasks/s")


def _of_stage(name: str, stage: _Stage) -> Iterator[Figure]:
    length = f"{stage.km:,.0f} km: {name}"
    yield Figure(f"{length}, tasks", stage.tasks / stage.km, "/km", 1.0, "bar")
    yield Figure(f"{length}, a task on its way", stage.bytes / stage.tasks / 1e3, "kB")
    yield Figure(f"{length}, planning", stage.plan_s, "s")
    yield Figure(f"{length}, handing {stage.tasks:,} tasks out", stage.submit_s, "s")
    yield Figure(f"{length}, planned and run", stage.whole_s, "s")


def _network(region: Region, client: Any, seen: _Seen, work: _Work) -> Manifest:
    """Plan the footprints and tiles of a survey, run their tasks, keep their records."""
    plan, manifest = region.plan, _Timed(region.plan.store, seen)
    with _timed(seen.footprints, region, client, work) as compute:
        _check(index_footprints(plan, manifest, compute))
    with _timed(seen.tiles, region, client, work) as compute:
        context = product_context(plan)
        wanted = tuple(wanted_tile_products(plan.survey, context))
        tiles = plan_tiles(region.footprints, plan)
        planned = TilePlan(plan, region.footprints, tiles, wanted, context)
        chosen = stale_tiles(tiles, wanted, manifest)
        tasks = planned.tasks(chosen, compute.workers)
        _check(run_tasks(compute_tiles, tasks, len(chosen), planned.singly, manifest, compute))
        seen.tiles_touched += len(tiles)
    return manifest


def _products(region: Region, manifest: Manifest, client: Any, seen: _Seen) -> None:
    """The same for its sheets, pictures and tables."""
    with _timed(seen.products, region, client, stand_in) as compute:
        _check(make_products(region.plan, manifest, compute))


def _check(failures: Sequence[object]) -> None:
    if failures:
        raise RuntimeError(f"{len(failures)} units failed, the first: {failures[0]}")


@contextmanager
def _timed(stage: _Stage, region: Region, client: Any, work: _Work) -> Iterator[_NoKernels]:
    """Where the tasks of a stage go; what they and the stage take is added to what was seen."""
    started = time.perf_counter()
    yield _NoKernels(client, stage, work)
    stage.km += region.length_m / 1000
    stage.whole_s += time.perf_counter() - started


def _imports() -> None:
    """What every worker does once, before its first task."""
    importlib.import_module("roadscan.survey.run")


class _NoKernels(OnDask):
    """The real way to Dask, with other work for the workers."""

    def __init__(self, client: Any, stage: _Stage, work: _Work) -> None:
        super().__init__(client)
        self._stage, self._work, self._begun = stage, work, time.perf_counter()

    def map(self, _: Callable[..., Any], tasks: Sequence[Any]) -> Iterator[Any]:
        """Run the tasks without kernels, whatever function is asked for."""
        self._stage.tasks += len(tasks)
        self._stage.plan_s += time.perf_counter() - self._begun
        self._stage.bytes += len(tasks) * len(pickle.dumps(tasks[len(tasks) // 2])) if tasks else 0

        def planned(number: int) -> Any:
            started = time.perf_counter()
            task = tasks[number]
            self._stage.plan_s += time.perf_counter() - started
            return task

        return super().map(self._work, LazyTasks(range(len(tasks)), planned))

    def send(self, function: Callable[..., Any], tasks: Sequence[Any]) -> list[Any]:
        """As the way to Dask, timed."""
        started = time.perf_counter()
        futures = super().send(function, tasks)
        self._stage.submit_s += time.perf_counter() - started
        return futures


def no_op(task: TileTask | Bundle[Any]) -> TaskResult | list[Ended]:
    """What a worker returns at least: nothing of tiles, and of other pieces that they ended."""
    return _NOTHING if isinstance(task, TileTask) else stand_in(task)


def stand_in(task: TileTask | Bundle[Any]) -> TaskResult | list[Ended]:
    """What a worker returns, without the work: records with the figures of a tile, a data file or a sheet."""
    if isinstance(task, TileTask):
        return TaskResult.of(list(_tile_records(task)))
    return [Ended(_piece_record(piece)) for piece in task.pieces]


def _tile_records(task: TileTask) -> Iterator[Row]:
    files = [item for wanted in task.products for item in wanted.files.items()]
    for tile, key in zip(map(str, task.block.tiles), task.keys, strict=True):
        number, own_key, digest = hash(key) & 0xFFFFFF, key[8:] + key[:8], "blake3:" + key + key
        for name, suffix in files:
            yield name, tile, own_key, f"tiles/{name}/{tile}{suffix}", number, digest, ""
        yield OVERVIEWS, tile, key, f"tiles/overviews/{tile}.parquet", number, digest, ""
        figures = f'{{"points": {number}, "cells": {number}, "height_min_m": 86.{number}, ' + _TILE_FIGURES
        yield TILE, tile, key, f"tiles/cells/{tile}.parquet", number, digest, figures


def _piece_record(piece: FootprintTask | OutputTask) -> OutputRecord:
    digest = "blake3:" + piece.key + piece.key
    if isinstance(piece, FootprintTask):
        detail = '{"window": [56321, 593487, 56350, 593512]}'
        return OutputRecord(PRODUCT, piece.slice.file, piece.key, piece.target, 12_345, digest, detail)
    return OutputRecord(piece.product.name, piece.output.name, piece.key, piece.target, 12_345_678, digest)


class _Timed(Manifest):
    """A manifest whose writing is timed."""

    def __init__(self, store: Store, seen: _Seen) -> None:
        super().__init__(store)
        self._seen = seen

    @contextmanager
    def _timing(self) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self._seen.manifest_s += time.perf_counter() - started

    def add(self, records: Iterable[OutputRecord]) -> None:
        """As the manifest underneath."""
        with self._timing():
            super().add(records)

    def add_packed(self, records: Packed) -> None:
        """As the manifest underneath."""
        with self._timing():
            super().add_packed(records)

    def compact(self) -> None:
        """As the manifest underneath, with the parts that are read for it."""
        with self._timing():
            super().compact()
