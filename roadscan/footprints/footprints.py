"""Footprints record which row groups of raw data touch which tile; one task indexes about eight km of data.

Profiles and returns are not georeferenced for it: bounds (``georeference/reach.py``) name every tile that a row group
may touch. Clouds, whose points are georeferenced already, are read.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.core.errors import StoreError
from roadscan.footprints.reach import group_spans, opened, touched_tiles
from roadscan.georeference.place import FATE_NAMES, Window
from roadscan.georeference.plan.plan import SurveyPlan, plan_of
from roadscan.georeference.reach import Touched, joined
from roadscan.georeference.reading_counts import LogCounts, fate_words
from roadscan.georeference.sources import Georeferencer, MapSettings, RawSlice
from roadscan.run.engine.compute import Compute, cut_bundles, run_bundles
from roadscan.run.keys import code_digest, key_of
from roadscan.run.session import Session, found_once
from roadscan.run.stage import StageState
from roadscan.store.digest import bytes_digest, sealed_parquet
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store

PRODUCT = "footprints"

_ROW_GROUPS = 65_536
"""Row groups per task: eight kilometres of a pair of profilers at line rate."""
_CLOUD_GROUPS = 8
"""Row groups of profiles that cost as much as one row group of a cloud."""

_LOADED: Final = [
    "tile_column", "tile_row", "first_group", "last_group", "readings", "first_epoch_gps_ns", "last_epoch_gps_ns",
]  # fmt: skip
_NUMBER: Final = "slice_index"
JOINED: Final = f"{PRODUCT}.joined"
"""Manifest name of the file with the footprints of all data files."""
_ALL: Final = "all"
_JOINED_FILE: Final = "manifest/joined/footprints.parquet"
_JOINED_ROWS: Final = pa.schema([table_schema(PRODUCT).arrow().field(n) for n in _LOADED] + [(_NUMBER, pa.int32())])


@dataclass(frozen=True)
class FootprintTask:
    """The indexing of one data file, as a worker gets it."""

    store: Store
    ground: MapSettings
    slice: RawSlice
    key: str

    @property
    def target(self) -> str:
        """Path of its footprints, relative to the survey's root."""
        return "tables/footprints/" + self.slice.file.removeprefix("tables/")

    @property
    def work(self) -> int:
        """Cost in row groups that have a bound; clouds are read reading by reading."""
        return len(self.slice.groups) * (_CLOUD_GROUPS if self.slice.source.table == "cloud" else 1)


@dataclass(frozen=True)
class FootprintRanges:
    """Footprints of data files: one row for each tile and run of row groups that touch it; arrays are (n,)."""

    tile_column: npt.NDArray[np.int32]
    tile_row: npt.NDArray[np.int32]
    slice_index: npt.NDArray[np.int32]
    """Index into `slices`."""
    first_group: npt.NDArray[np.int32]
    last_group: npt.NDArray[np.int32]
    readings: npt.NDArray[np.int64]
    """Approximate number of the groups' readings in the tile."""
    first_epoch_gps_ns: npt.NDArray[np.int64]
    last_epoch_gps_ns: npt.NDArray[np.int64]
    slices: tuple[RawSlice, ...]
    """Whole data files, sorted by run, sensor and time."""


def index_footprints(
    plan: SurveyPlan, manifest: Manifest, compute: Compute, report: Callable[[int, int], None] = lambda _a, _b: None
) -> list[tuple[str, str]]:
    """Index the data files whose footprints are missing or stale; return what failed."""
    tasks = _tasks(plan)
    due = {t.slice.file for t in tasks}
    manifest.remove(r for unit, r in manifest.of(PRODUCT).items() if unit not in due)
    stale = _stale(tasks, manifest)
    failed = run_bundles(footprint_task, stale, lambda t: t.work, _ROW_GROUPS, manifest, compute, report)
    return [(task.slice.file, reason) for task, reason in failed]


def footprint_state(plan: SurveyPlan, manifest: Manifest, workers: int) -> StageState:
    """Data files of which it is known, or not known any more, which tiles they touch."""
    tasks = _tasks(plan)
    stale = _stale(tasks, manifest)
    state = StageState.of(manifest, [(PRODUCT, t.slice.file, t.key) for t in tasks])
    state.tasks = len(cut_bundles([t.work for t in stale], _ROW_GROUPS, workers))
    state.raw_bytes = sum(t.slice.bytes for t in stale)
    return state


def _tasks(plan: SurveyPlan) -> list[FootprintTask]:
    """Return a task for each data file."""
    code = code_digest("roadscan.footprints.footprints:footprint_task")
    return [
        FootprintTask(
            plan.store, plan.ground, one, key_of(code, one.source.key, one.source.allowance, one.file, digest)
        )
        for one, digest in zip(plan.slices(), _digests(plan), strict=True)
    ]


def _stale(tasks: Sequence[FootprintTask], manifest: Manifest) -> list[FootprintTask]:
    return [t for t in tasks if not manifest.is_current(PRODUCT, t.slice.file, t.key)]


def unplaced_logs(plan: SurveyPlan, manifest: Manifest) -> list[tuple[str, str]]:
    """Return the logs without a single reading in a tile, and what became of their readings."""
    paths = {f.path: r.path for r in plan.records for files in r.tables.values() for f in files}
    found: list[tuple[str, str]] = []
    for source, files in plan.sources:
        records = [manifest.get(PRODUCT, f.path) for f in files]
        figures = [record.figures() for record in records if record is not None]
        if len(figures) < len(files) or any("window" in one for one in figures):
            continue
        fates = LogCounts(record for record in records if record is not None).of_all()
        found.append(
            (
                paths[files[0].path],
                f"not one of the {sum(fates.values()):,} readings of '{source.sensor}' in run '{source.run}' touches "
                f"a tile: {fate_words(fates)}; check the settings that leave them out",
            )
        )
    return found


def footprint_task(task: FootprintTask) -> OutputRecord:
    """Index one data file (runs on a worker): by bounds, or by georeferencing all readings where there is no bound."""
    one = task.slice
    with opened(task.store, one) as file:
        spans = group_spans(one, file)
        bounded = None if one.source.table == "cloud" else touched_tiles(task.store, task.ground, one, file)
    if bounded is None:
        pairs, fates = _placed(task, range(len(one.groups)))
    else:
        pairs, fates = bounded, None
        beyond = np.flatnonzero(bounded.unbounded).tolist()
        if beyond:
            pairs = joined([bounded, _placed(task, beyond)[0]])
        apart = sorted(set(range(len(one.groups))) - set(pairs.group.tolist()))
        if apart:  # no tile reports what became of their readings
            fates = _placed(task, apart)[1]
    rows, schema = _ranges(pairs, one, spans), table_schema(PRODUCT)
    content = parquet_bytes(rows.cast(schema.arrow()), schema)
    task.store.write_bytes(task.target, content, lasting=False)
    return OutputRecord(
        PRODUCT, one.file, task.key, task.target, len(content), bytes_digest(content), _detail(rows, fates)
    )


def _placed(task: FootprintTask, numbers: Sequence[int]) -> tuple[Touched, npt.NDArray[np.int64]]:
    """Return the tiles of some groups of a slice, by georeferencing their readings, and the counts of these."""
    one = task.slice
    placer = Georeferencer(task.store, task.ground, [one], recorded=True)
    parts: list[Touched] = []
    fates = np.zeros(len(FATE_NAMES), np.int64)
    for number in numbers:
        tiles, own = placer.touched(one, one.groups[number])
        fates[: own.size] += own
        column, row, count = _with_neighbours(count_tiles(tiles), placer.moved_tiles(one, one.groups[number]))
        parts.append(Touched(np.full(column.size, number), column, row, count, np.zeros(0, dtype=bool)))
    return joined(parts), fates


def _with_neighbours(
    tiles: tuple[npt.NDArray[np.int64], ...], within: int
) -> tuple[npt.NDArray[np.int64], ...]:  # fmt: skip
    """Return column, row and readings of tiles, and of the tiles around them within so many columns and rows."""
    if not within:
        return tiles
    column, row, count = tiles
    steps = np.arange(-within, within + 1)
    wide = np.stack(np.broadcast_arrays(column[:, None, None] + steps[:, None], row[:, None, None] + steps), axis=-1)
    around, where = np.unique(wide.reshape(-1, 2), axis=0, return_inverse=True)
    middle = where.reshape(column.size, steps.size, steps.size)[:, within, within]
    readings = np.zeros(len(around), np.int64)
    readings[middle] = count
    return around[:, 0], around[:, 1], readings


def _ranges(pairs: Touched, one: RawSlice, group_spans_ns: npt.NDArray[np.int64]) -> pa.Table:
    """Turn pairs of row group and tile into rows: consecutive groups that touch one tile become one row."""
    order = np.lexsort((pairs.group, pairs.row, pairs.column))
    number, column, row = pairs.group[order], pairs.column[order], pairs.row[order]
    breaks = (np.diff(column) != 0) | (np.diff(row) != 0) | (np.diff(number) != 1)
    starts = np.flatnonzero(np.concatenate([[True], breaks])) if number.size else np.zeros(0, np.int64)
    ends = np.append(starts[1:], number.size)[: starts.size] - 1
    spans = group_spans_ns[number]
    groups = np.array(one.groups, dtype=np.int32)[number]
    return pa.table(
        {
            "tile_column": column[starts].astype(np.int32),
            "tile_row": row[starts].astype(np.int32),
            "file": pa.array([one.file] * starts.size, pa.string()),
            "first_group": groups[starts],
            "last_group": groups[ends],
            "readings": np.add.reduceat(pairs.readings[order], starts) if starts.size else np.zeros(0, np.int64),
            "first_epoch_gps_ns": np.minimum.reduceat(spans[:, 0], starts) if starts.size else spans[:0, 0],
            "last_epoch_gps_ns": np.maximum.reduceat(spans[:, 1], starts) if starts.size else spans[:0, 1],
        }
    )


def _detail(rows: pa.Table, fates: npt.NDArray[np.int64] | None) -> str:
    """Return the box of a data file's tiles, and the counts of readings that no tile reports: those of clouds,
    and of row groups that touch no tile.
    """
    figures: dict[str, Any] = {}
    if rows.num_rows:
        column, row = (rows.column(name).to_numpy() for name in ("tile_column", "tile_row"))
        figures["window"] = [int(column.min()), int(row.min()), int(column.max()) + 1, int(row.max()) + 1]
    if fates is not None:
        figures["fates"] = dict(zip(FATE_NAMES, fates.tolist(), strict=True))
    return json.dumps(figures)


def count_tiles(tiles: npt.NDArray[np.int32]) -> tuple[npt.NDArray[np.int64], ...]:
    """Return column, row and count of the distinct tiles in (n, 2) tile numbers, sorted by row and column."""
    if tiles.size == 0:
        empty = np.zeros(0, np.int64)
        return empty, empty, empty
    first = tiles.min(axis=0).astype(np.int64)
    width = int(tiles[:, 0].max()) - int(first[0]) + 1
    height = int(tiles[:, 1].max()) - int(first[1]) + 1
    if width * height > 1 << 26:  # tiles so far apart that a dense count would not fit into memory
        unique, counts = np.unique(tiles, axis=0, return_counts=True)
        return unique[:, 0].astype(np.int64), unique[:, 1].astype(np.int64), counts.astype(np.int64)
    flat = (tiles[:, 1] - first[1]) * width + (tiles[:, 0] - first[0])
    counts = np.bincount(flat, minlength=width * height)
    occupied = np.flatnonzero(counts)
    return occupied % width + first[0], occupied // width + first[1], counts[occupied]


def load_ranges(
    plan: SurveyPlan, manifest: Manifest, files: Collection[str] | None = None, window: Window | None = None
) -> FootprintRanges:
    """Load the current footprints of some data files (default: all) in some tiles (default: all).

    A data file without footprints is left out (its indexing failed); one outside the window is not opened.
    """
    slices = _in_order(plan)
    if not manifest.of(PRODUCT):
        raise StoreError("the survey has no footprints", change="run `roadscan footprints` first")
    whole = manifest.get(JOINED, _ALL) if files is None and window is None else None
    if whole is not None and whole.key == _key_of_joined(slices, manifest):
        rows = recorded_table(plan.store, whole)
    else:
        rows = _rows_of(plan, manifest, slices, files, window)
    column = {name: rows.column(name).to_numpy() for name in _LOADED}
    return FootprintRanges(**column, slice_index=rows.column(_NUMBER).to_numpy(), slices=tuple(slices))


def _rows_of(
    plan: SurveyPlan,
    manifest: Manifest,
    slices: Sequence[RawSlice],
    files: Collection[str] | None = None,
    window: Window | None = None,
) -> pa.Table:
    """Return the footprints of some data files in some tiles, with the number of each row's file among `slices`."""
    wanted = None if window is None else _in_window(window)
    tables: list[pa.Table] = [_JOINED_ROWS.empty_table()]
    for number, one in enumerate(slices):
        record = manifest.get(PRODUCT, one.file)
        if record is None or (files is not None and one.file not in files) or _is_apart(record, window):
            continue
        table = recorded_table(plan.store, record, _LOADED)
        if wanted is not None:
            table = table.filter(wanted)
        numbers = pa.array(np.full(table.num_rows, number, np.int32))
        tables.append(table.append_column(_NUMBER, numbers).cast(_JOINED_ROWS))
    return pa.concat_tables(tables).combine_chunks()


def join_footprints(plan: SurveyPlan, manifest: Manifest) -> None:
    """Keep the footprints of all data files in one file, too, where that is not done: a survey has thousands of them,
    and each run and `status` asks for all.
    """
    slices = _in_order(plan)
    key = _key_of_joined(slices, manifest)
    if not manifest.of(PRODUCT) or manifest.is_current(JOINED, _ALL, key):
        return
    content = sealed_parquet(_rows_of(plan, manifest, slices), compression="zstd")
    plan.store.write_bytes(_JOINED_FILE, content, lasting=False)
    manifest.add([OutputRecord(JOINED, _ALL, key, _JOINED_FILE, len(content), bytes_digest(content))])


def _in_order(plan: SurveyPlan) -> list[RawSlice]:
    """Return all data files by run, sensor and time."""
    return sorted(
        plan.slices(), key=lambda s: (s.source.run, s.source.sensor, s.source.key, s.spans[0] if s.spans else (0, 0))
    )


def _key_of_joined(slices: Sequence[RawSlice], manifest: Manifest) -> str:
    """Return the key of the file with all footprints: the data files in their order, and the footprints of each."""
    known = ((one.file, manifest.get(PRODUCT, one.file)) for one in slices)
    return key_of(_LOADED, [(file, record and record.digest) for file, record in known])


def _in_window(window: Window) -> pc.Expression:
    column, row = pc.field("tile_column"), pc.field("tile_row")
    return (
        (column >= window.first_column) & (column < window.end_column)
        & (row >= window.first_row) & (row < window.end_row)
    )  # fmt: skip


def _is_apart(record: OutputRecord, window: Window | None) -> bool:
    """Return True if a data file touches no tile of a window."""
    own = record.figures().get("window") if window is not None else None
    if window is None or own is None:
        return window is not None
    return bool(
        own[0] >= window.end_column or own[2] <= window.first_column
        or own[1] >= window.end_row or own[3] <= window.first_row
    )  # fmt: skip


def _digests(plan: SurveyPlan) -> Sequence[str]:
    return [f.digest for _, files in plan.sources for f in files]


@found_once
def footprints_of(session: Session) -> FootprintRanges:
    """Return the session's footprints: which row group touches which tile."""
    return load_ranges(plan_of(session), session.manifest)
