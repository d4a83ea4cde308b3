"""Footprints: which raw block touches which tile. One task a data file."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.jobs.compute import Compute
from roadscan.jobs.fingerprint import key_of
from roadscan.jobs.plan import SurveyPlan
from roadscan.jobs.readings import Ground, Placer, RawSlice
from roadscan.model.errors import StoreError
from roadscan.points.place import FATE_NAMES
from roadscan.tables.manifest import Manifest, OutputRecord
from roadscan.tables.schema import table_schema
from roadscan.tables.store import Store, file_digest
from roadscan.tables.writer import write_parquet

PRODUCT = "footprints"


@dataclass(frozen=True)
class FootprintTask:
    """One data file to index."""

    store: Store
    ground: Ground
    slice: RawSlice
    key: str

    @property
    def target(self) -> str:
        """Where its footprints go, relative to the survey's root."""
        return "tables/footprints/" + self.slice.file.removeprefix("tables/")


@dataclass(frozen=True)
class Footprints:
    """Footprints of all data files: one row a (row group, tile) pair; arrays are (n,)."""

    tile_column: npt.NDArray[np.int32]
    tile_row: npt.NDArray[np.int32]
    slice_index: npt.NDArray[np.int32]
    """Index into `slices`."""
    row_group: npt.NDArray[np.int32]
    readings: npt.NDArray[np.int64]
    first_epoch_gps_ns: npt.NDArray[np.int64]
    last_epoch_gps_ns: npt.NDArray[np.int64]
    slices: tuple[RawSlice, ...]
    """Data files, whole, sorted by run, sensor and time."""


def index_footprints(
    plan: SurveyPlan, manifest: Manifest, compute: Compute, report: Callable[[int, int], None] = lambda _a, _b: None
) -> list[tuple[str, Exception]]:
    """Index the data files whose footprints are missing or stale; returns what failed."""
    tasks = [
        FootprintTask(plan.store, plan.ground, one, key_of(one.source.key, one.file, digest))
        for one, digest in zip(plan.slices(), _digests(plan), strict=True)
    ]
    stale = [t for t in tasks if not manifest.is_current(PRODUCT, t.slice.file, t.key)]
    manifest.remove(r for unit, r in manifest.of(PRODUCT).items() if unit not in {t.slice.file for t in tasks})
    failures: list[tuple[str, Exception]] = []
    report(0, len(stale))
    for number, done in enumerate(compute.map(footprint_task, stale), 1):
        if done.error is not None or done.result is None:
            failures.append((done.task.slice.file, done.error or StoreError("no result")))
        else:
            manifest.add([done.result])
        report(number, len(stale))
    return failures


def footprint_task(task: FootprintTask) -> OutputRecord:
    """Index one data file (runs on a worker)."""
    placer = Placer(task.store, task.ground, [task.slice])
    columns: dict[str, list[npt.NDArray[np.int64]]] = {n: [] for n in ("column", "row", "count", "group")}
    fates = np.zeros(len(FATE_NAMES), np.int64)
    for group in task.slice.groups:
        tiles, own = placer.touched(task.slice, group)
        fates[: own.size] += own
        column, row, count = count_tiles(tiles)
        for name, values in (("column", column), ("row", row), ("count", count)):
            columns[name].append(values)
        columns["group"].append(np.full(column.size, group, np.int64))
    schema = table_schema(PRODUCT)
    group_of = np.concatenate(columns["group"])
    spans = np.array(task.slice.spans, dtype=np.int64).reshape(-1, 2)[group_of]
    rows = pa.table(
        {
            "tile_column": np.concatenate(columns["column"]).astype(np.int32),
            "tile_row": np.concatenate(columns["row"]).astype(np.int32),
            "file": pa.array([task.slice.file] * group_of.size, pa.string()),
            "row_group": group_of.astype(np.int32),
            "readings": np.concatenate(columns["count"]),
            "first_epoch_gps_ns": spans[:, 0],
            "last_epoch_gps_ns": spans[:, 1],
        }
    ).cast(schema.arrow())
    with task.store.scratch() as folder:
        path = folder / "footprints.parquet"
        write_parquet(path, rows, schema)
        size, digest = path.stat().st_size, file_digest(path)
        task.store.publish(path, task.target)
    detail = "{" + ", ".join(f'"{n}": {c}' for n, c in zip(FATE_NAMES, fates, strict=True)) + "}"
    return OutputRecord(PRODUCT, task.slice.file, task.key, task.target, size, digest, detail)


def count_tiles(tiles: npt.NDArray[np.int32]) -> tuple[npt.NDArray[np.int64], ...]:
    """Column, row and count of the tiles that occur in (n, 2) tile numbers, by row and column."""
    if tiles.size == 0:
        empty = np.zeros(0, np.int64)
        return empty, empty, empty
    first = tiles.min(axis=0).astype(np.int64)
    width = int(tiles[:, 0].max()) - int(first[0]) + 1
    height = int(tiles[:, 1].max()) - int(first[1]) + 1
    if width * height > 1 << 26:  # readings far apart: a dense count would not fit
        unique, counts = np.unique(tiles, axis=0, return_counts=True)
        return unique[:, 0].astype(np.int64), unique[:, 1].astype(np.int64), counts.astype(np.int64)
    flat = (tiles[:, 1] - first[1]) * width + (tiles[:, 0] - first[0])
    counts = np.bincount(flat, minlength=width * height)
    occupied = np.flatnonzero(counts)
    return occupied % width + first[0], occupied // width + first[1], counts[occupied]


def load_footprints(plan: SurveyPlan, manifest: Manifest) -> Footprints:
    """All current footprints; a data file without any is left out (its indexing failed)."""
    slices = sorted(
        plan.slices(), key=lambda s: (s.source.run, s.source.sensor, s.source.key, s.spans[0] if s.spans else (0, 0))
    )
    tables: list[pa.Table] = []
    numbers: list[npt.NDArray[np.int32]] = []
    columns = ["tile_column", "tile_row", "row_group", "readings", "first_epoch_gps_ns", "last_epoch_gps_ns"]
    for number, one in enumerate(slices):
        record = manifest.get(PRODUCT, one.file)
        if record is None:
            continue
        table = pq.read_table(io.BytesIO(plan.store.read_bytes(record.path)), columns=columns)
        tables.append(table)
        numbers.append(np.full(table.num_rows, number, np.int32))
    if not tables:
        raise StoreError("the survey has no footprints", change="run `roadscan footprints` first")
    rows = pa.concat_tables(tables)
    column = {c: rows.column(c).to_numpy() for c in columns}
    return Footprints(
        tile_column=column["tile_column"],
        tile_row=column["tile_row"],
        slice_index=np.concatenate(numbers),
        row_group=column["row_group"],
        readings=column["readings"],
        first_epoch_gps_ns=column["first_epoch_gps_ns"],
        last_epoch_gps_ns=column["last_epoch_gps_ns"],
        slices=tuple(slices),
    )


def reading_fates(plan: SurveyPlan, manifest: Manifest) -> dict[str, int]:
    """How many readings of the survey met which fate (kept, no pose, out of range …)."""
    totals = dict.fromkeys(FATE_NAMES, 0)
    for one in plan.slices():
        record = manifest.get(PRODUCT, one.file)
        for name, count in (record.figures() if record else {}).items():
            totals[name] += count
    return {name: count for name, count in totals.items() if count}


def _digests(plan: SurveyPlan) -> Sequence[str]:
    return [f.digest for _, files in plan.sources for f in files]
