"""A survey's store without readings: real records, real folders of tiny files, made by the library's own writers.

The raw logs are some profiles and poses, which are ingested; the records of their rows then name as many data files,
row groups and epochs as a drive at line rate has. The stages run as in any run, and where they hand a task to a
worker, it writes tiny files in place of what it would compute: a tile is one cell. So records, keys, folders and names
are as many and as long as those of a survey, and every command of roadscan works on it.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from benchmarks.course import CRS, GEODETIC, START_S, WEEK, Course
from benchmarks.network import HEADS, TILE_M, Drive
from benchmarks.pavement import write_scans
from benchmarks.surveys import LINE_SPEED_M_PER_S
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.survey import Survey
from roadscan.footprints.footprints import PRODUCT, FootprintTask
from roadscan.georeference.cloud import TilePoints
from roadscan.georeference.tick_clocks import PRODUCT as TICKS
from roadscan.georeference.tick_clocks import TickTask
from roadscan.run.engine.compute import Bundle, Done, Ended, Inline
from roadscan.run.engine.measured import Measured
from roadscan.run.keys import key_of
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.store.digest import bytes_digest
from roadscan.store.logs import log_of, read_log_records, write_log_record
from roadscan.store.manifest import OutputRecord
from roadscan.store.records import Row
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store
from roadscan.strips.work import PRODUCT as STRIPS
from roadscan.strips.work import StripTask
from roadscan.survey.run import run_stages
from roadscan.tiles.accumulator import cells_of
from roadscan.tiles.cells import overview_factors, pyramid_of, write_cells, write_overviews
from roadscan.tiles.product import Tile
from roadscan.tiles.tasks.tile_plan import OVERVIEWS, TILE, TileTask
from roadscan.tiles.tasks.tiles import TaskResult

_PROFILES = 4
_READINGS = 8
_POSES_PER_S = 2
_CELL_M = 0.005
_SMALL_GRID = TileGrid(2.0, 0.1)
"""Of the tiny files: a raster of a whole tile in cells of 5 mm takes 58 kB when it is empty."""
_POINT_M = 87.1
_RASTER = "geotiff"
"""Product whose file of a tile stands for a sheet of a kilometre."""
_WINDOW = '{"window": [56321, 593487, 56350, 593512]}'
"""Detail of a data file's footprints."""


def simulated_survey(
    folder: Path, name: str, length_m: float, store: str = "store", poses_per_s: int = _POSES_PER_S
) -> Path:
    """The survey file of a drive of that length, in `folder`, whose logs are ingested in the store."""
    folder.mkdir(parents=True, exist_ok=True)
    file = _write_logs(folder, name, length_m, store, poses_per_s)
    survey = Survey.load(file)
    target = Store(survey.store_url, name)
    run_stages(Session(survey, target), [stage_named("ingest")])
    drives = {drive.run: drive for drive in Drive.all_of(length_m)}
    for record in read_log_records(target):
        if "scans" not in record.tables:
            continue
        content = target.read_bytes(record.tables["scans"][0].path)
        own = {"bytes": len(content), "digest": bytes_digest(content)}
        files = tuple(dataclasses.replace(one, **own) for one in drives[record.run].files(record.sensor, record.key))
        for one in record.tables["scans"]:
            target.remove(one.path)
        for one in files:
            target.write_bytes(one.path, content, lasting=False)
        rows = sum(one.rows for one in files)
        write_log_record(target, dataclasses.replace(record, tables=record.tables | {"scans": files}, rows=rows))
    return file


class TinyFiles(Inline):
    """Runs tasks in this process: those of tiles, footprints and products write tiny files."""

    def __init__(self, length_m: float) -> None:
        self._touched = {
            (drive.run, head): drive.touched(head, drive.files(head, ""))
            for drive in Drive.all_of(length_m)
            for head in HEADS
        }
        self._made: dict[str, tuple[bytes, str]] = {}

    def map(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[Done[Any, Any]]:
        """Run the tasks; those that have no stand-in as they are."""
        own: Callable[[Any], Any] = function.function if isinstance(function, Measured) else function

        def work(task: Any) -> Any:
            if isinstance(task, TileTask):
                return self._tiles(task)
            if isinstance(task, Bundle):
                return [Ended(self._piece(one, task.function)) for one in task.pieces]
            return own(task)

        return super().map(Measured(work) if isinstance(function, Measured) else work, tasks)

    def _tiles(self, task: TileTask) -> TaskResult:
        self._made = self._made or _one_cell(task)
        rows: list[Row] = []
        detail = _detail(task)
        for tile, key in zip(map(str, task.block.tiles), task.keys, strict=True):
            for wanted in task.products:
                own_key, folder = key_of(key, wanted.key), f"tiles/{wanted.product.name}"
                for name, suffix in wanted.files.items():
                    rows.append(self._put(task.store, name, tile, own_key, f"{folder}/{tile}{suffix}"))
            rows.append(self._put(task.store, OVERVIEWS, tile, key, f"tiles/overviews/{tile}.parquet"))
            rows.append(self._put(task.store, TILE, tile, key, f"tiles/cells/{tile}.parquet", detail))
        return TaskResult.of(rows)

    def _put(self, store: Store, name: str, tile: str, key: str, target: str, detail: str = "") -> Row:
        content, digest = self._made[name]
        store.write_bytes(target, content, lasting=False)
        return name, tile, key, target, len(content), digest, detail

    def _piece(self, task: Any, function: Callable[[Any], OutputRecord]) -> OutputRecord:
        if isinstance(task, StripTask):
            figures = {"run": task.run, "sigma_m": task.sigma_m, "speed_m_per_s": 0.0, "sensors": [], "pairs": []}
            return OutputRecord(STRIPS, task.unit, task.key, "", 0, "", json.dumps(figures))
        if isinstance(task, TickTask):
            figures = {"run": task.source.run, "file": task.files[0].path, "jumps": [], "offset": None, "still_m": 0.0}
            return OutputRecord(TICKS, task.unit, task.key, "", 0, "", json.dumps(figures))
        if isinstance(task, FootprintTask):
            content, name, unit, detail = self._footprints(task), PRODUCT, task.slice.file, _WINDOW
        elif task.output.name.endswith(".tif"):
            content, name, unit, detail = self._made[_RASTER][0], task.product.name, task.output.name, ""
        else:
            return function(task)
        task.store.write_bytes(task.target, content, lasting=False)
        return OutputRecord(name, unit, task.key, task.target, len(content), bytes_digest(content), detail)

    def _footprints(self, task: FootprintTask) -> bytes:
        """Rows of one data file, of those of its head's drive."""
        source, schema = task.slice.source, table_schema(PRODUCT)
        columns = self._touched[source.run, source.sensor]
        spans = task.slice.spans
        own = (columns["first_epoch_gps_ns"] >= spans[0][0]) & (columns["last_epoch_gps_ns"] <= spans[-1][1])
        rows = {name: values[own] for name, values in columns.items() if name != "file"}
        rows["file"] = pa.array([task.slice.file] * int(own.sum()), pa.string())
        return parquet_bytes(pa.table(rows).select(schema.arrow().names).cast(schema.arrow()), schema)


def _one_cell(task: TileTask) -> dict[str, tuple[bytes, str]]:
    """Content and digest of each file of a tile with one point, by the library's writers."""
    found: dict[str, tuple[bytes, str]] = {}
    quanta, one = np.full(1, round(_POINT_M * 1e5), np.int32), np.ones(1, np.uint16)
    points = TilePoints(
        TileId(56321, 593487), one.astype(np.int32), one.astype(np.int32), quanta, np.zeros(1, np.int64), one,
        one.astype(np.uint8), one,
    )  # fmt: skip
    context = dataclasses.replace(task.context, grid=_SMALL_GRID)
    tile = Tile(points, cells_of(points, _SMALL_GRID))
    with tempfile.TemporaryDirectory() as place:
        files = {TILE: Path(place) / "cells.parquet", OVERVIEWS: Path(place) / "overviews.parquet"}
        write_cells(files[TILE], tile.cells, task.cell_table)
        edge = task.context.grid.cells_per_edge
        whole = dataclasses.replace(tile.cells, cells_per_edge=edge)
        write_overviews(files[OVERVIEWS], pyramid_of(whole, overview_factors(edge)))
        for wanted in task.products:
            path = Path(place) / f"{wanted.product.name}{wanted.product.suffix_for(wanted.options)}"
            wanted.product.write(tile, wanted.options, context, path)
            files |= {name: path.with_suffix(suffix) for name, suffix in wanted.files.items()}
        for name, path in files.items():
            content = path.read_bytes()
            found[name] = content, bytes_digest(content)
    return found


def _detail(task: TileTask) -> str:
    """Figures of a tile, as long as those of a real one."""
    logs = sorted({log_of(one.file) for one in task.slices})
    return json.dumps(_FIGURES | {"fates": {log: {"kept": 27_100_123, "no_return": 12_345} for log in logs}})


_FIGURES = {
    "points": 27_100_123, "cells": 1_403_117, "overlapped_cells": 1203, "height_min_m": 86.912_345,
    "height_mean_m": 87.123_456_789_012, "height_max_m": 88.212_345, "height_std_median_m": 0.000_412_345,
    "intensity_mean": 90.212_345_678_901, "passes": [1], "first_epoch_gps_ns": 1454644800000000000,
    "last_epoch_gps_ns": 1454644800360000000, "sigma_horizontal_m": None, "sigma_down_m": None,
}  # fmt: skip


def _write_logs(folder: Path, name: str, length_m: float, store: str, poses_per_s: int) -> Path:
    """Write poses and some profiles of each run, and the survey file."""
    geometry = {
        "kind": "cartesian", "readings": _READINGS, "first": -1.0, "step": 0.25, "range_offset_m": 0.2,
        "range_step_m": 0.0001,
    }  # fmt: skip
    lines = [f'id = "{name}"', f'store = "{store}"', "[rig.sensors]"]
    lines += [f'{head} = {{ kind = "profiler", lever_arm_body_m = [-2.0, 0.0, 0.2] }}' for head in sorted(HEADS)]
    lines += ["[map]", f'crs = "{CRS}"', 'height = "ellipsoidal"']
    lines += ["[tiles]", f"size_m = {TILE_M}", f"cell_m = {_CELL_M}", 'cell_table = "surface"']
    lines += ["[adjust]", "on = false"]
    for drive in Drive.all_of(length_m):
        lines += ["[[runs]]", f'id = "{drive.run}"', "[[runs.logs]]", f'path = "{drive.run}.sbet"', 'format = "sbet"']
        lines += [f'crs = "{GEODETIC}"', f'clock = {{ system = "gps_week_seconds", week = {WEEK} }}']
        start_s = START_S + (drive.start_gps_ns - Drive.all_of(length_m)[0].start_gps_ns) / 1e9
        Course(LINE_SPEED_M_PER_S, drive.length_m, start_s, poses_per_s).write_sbet(folder / f"{drive.run}.sbet")
        for number, head in enumerate(sorted(HEADS)):
            log = f"{drive.run}_{head}.arrow"
            ranges = np.full((_PROFILES, _READINGS), 10_000 + number, np.uint16)
            ends = np.linspace(drive.start_gps_ns, drive.end_gps_ns - 1, _PROFILES).astype(np.int64)
            epochs, light = ends.__getitem__, np.full(ranges.shape, 90, np.uint8)
            write_scans(folder / log, geometry, lambda a, b, of=epochs: of(slice(a, b)), iter([(ranges, light)]))
            lines += ["[[runs.logs]]", f'path = "{log}"', 'format = "scans"', f'sensor = "{head}"']
    file = folder / "SURVEY.toml"
    file.write_text("\n".join(lines) + "\n")
    return file


def simulated_fleet(folder: Path, surveys: int, length_m: float) -> Path:
    """A folder of surveys of that length: the first with all its files, the others copies of it without tiles."""
    first = simulated_survey(folder / "s000", "s000", length_m)
    survey = Survey.load(first)
    run_stages(Session(survey, Store(survey.store_url, "s000"), TinyFiles(length_m)))
    for number in range(1, surveys):
        name = f"s{number:03d}"
        place = folder / name
        place.mkdir()
        (place / first.name).write_text(first.read_text().replace('"s000"', f'"{name}"'))
        for log in first.parent.glob("run*"):
            (place / log.name).hardlink_to(log)
        held = first.parent / "store" / "survey=s000"
        for part in ("manifest", "tables", "products"):
            shutil.copytree(held / part, place / "store" / f"survey={name}" / part)
    return folder
