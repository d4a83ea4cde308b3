"""Tiles: raw readings → points → cells and tile products. One task a block."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.jobs.centre_line import CentreLines, load_buffer
from roadscan.jobs.compute import Compute
from roadscan.jobs.fingerprint import key_of
from roadscan.jobs.footprints import Footprints
from roadscan.jobs.plan import SurveyPlan
from roadscan.jobs.readings import Ground, Placer, RawSlice, ReadingSource
from roadscan.jobs.tile_files import WantedProduct, publish_file, write_product
from roadscan.model.errors import RoadscanError
from roadscan.model.gpstime import utc_from_gps_ns
from roadscan.model.ids import LanePass, TileId
from roadscan.navigation.trajectory import Trajectory
from roadscan.points.centre_line import CentreLineBuffer
from roadscan.points.classes import KEPT, LAS_CLASSES, OFF_CENTRE_LINE, WITHHELD_FLAG
from roadscan.points.cloud import QUANTUM_M, TilePoints, fill_of
from roadscan.points.order import canonical_order
from roadscan.points.place import EXTRA_COLUMNS, Placed, Window, passes_of
from roadscan.products.base import ProductContext, Tile, TileSummary
from roadscan.tables.manifest import Manifest, OutputRecord
from roadscan.tables.schema import table_schema
from roadscan.tables.store import Store
from roadscan.tables.writer import write_parquet
from roadscan.tiles.blocks import Block, cut_blocks
from roadscan.tiles.cells import TileCells
from roadscan.tiles.statistics import cells_of

TILE = "tile"
"""Manifest name of a tile as a whole; its file holds the cells."""

_MOMENT_NS = 50_000_000


@dataclass(frozen=True)
class BlockTask:
    """Everything a worker needs to compute a block; it holds no data."""

    store: Store
    ground: Ground
    block: Block
    keys: tuple[str, ...]
    """Key of each core tile."""
    slices: tuple[RawSlice, ...]
    """Raw blocks that touch the block, sorted by run, sensor and time."""
    readings: int
    """Readings expected."""
    passes: tuple[LanePass, ...]
    centre_lines: CentreLines | None
    products: tuple[WantedProduct, ...]
    context: ProductContext

    @property
    def raw_bytes(self) -> int:
        """Compressed bytes to read, about."""
        return sum(s.bytes for s in self.slices)


@dataclass(frozen=True)
class BlockResult:
    """What a worker did."""

    records: tuple[OutputRecord, ...]
    failures: tuple[tuple[str, str], ...]
    """Tiles that failed, with the reason."""


def plan_tiles(footprints: Footprints, plan: SurveyPlan) -> dict[TileId, tuple[str, int]]:
    """Key and expected readings of every tile that a raw block touches."""
    if not footprints.tile_column.size:
        return {}
    order = np.lexsort((footprints.row_group, footprints.slice_index, footprints.tile_column, footprints.tile_row))
    column, row = footprints.tile_column[order], footprints.tile_row[order]
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(column) != 0) | (np.diff(row) != 0)]))
    digests = {f.path: f.digest for _, files in plan.sources for f in files}
    names = [(s.source.key, digests[s.file], plan.pass_key(s.source.run)) for s in footprints.slices]
    tiles: dict[TileId, tuple[str, int]] = {}
    for start, end in zip(starts, np.append(starts[1:], order.size), strict=True):
        part = order[start:end]
        blocks = zip(footprints.slice_index[part].tolist(), footprints.row_group[part].tolist(), strict=True)
        key = key_of(plan.tile_key, [(*names[s], g) for s, g in blocks])
        tile = TileId(int(column[start]), int(row[start]))
        tiles[tile] = (key, int(footprints.readings[part].sum()))
    return tiles


def stale_tiles(
    tiles: dict[TileId, tuple[str, int]], products: Sequence[WantedProduct], manifest: Manifest
) -> list[TileId]:
    """Tiles that are missing, changed, or lack a wanted product."""
    return [tile for tile, (key, _) in tiles.items() if not _is_current(tile, key, products, manifest)]


def block_tasks(
    chosen: Sequence[TileId],
    tiles: dict[TileId, tuple[str, int]],
    footprints: Footprints,
    plan: SurveyPlan,
    products: Sequence[WantedProduct],
    context: ProductContext,
    edge_tiles: int | None = None,
) -> list[BlockTask]:
    """Blocks of work over the chosen tiles, of at most `edge_tiles`² tiles (the survey file's number)."""
    config = plan.survey.config
    readings = {tile: tiles[tile][1] for tile in chosen}
    blocks = cut_blocks(readings, edge_tiles or config.tiles.block_tiles, config.tiles.max_block_readings)
    by_tile = _rows_by_tile(footprints, frozenset(chosen))
    return [
        BlockTask(
            store=plan.store,
            ground=plan.ground,
            block=block,
            keys=tuple(tiles[t][0] for t in block.tiles),
            slices=_slices_of(block, by_tile, footprints),
            readings=sum(readings[t] for t in block.tiles),
            passes=plan.passes,
            centre_lines=plan.centre_lines,
            products=tuple(products),
            context=context,
        )
        for block in blocks
    ]


def run_blocks(
    tasks: Sequence[BlockTask],
    singly: Callable[[Sequence[TileId]], list[BlockTask]],
    manifest: Manifest,
    compute: Compute,
    report: Callable[[int, int], None] = lambda _a, _b: None,
) -> list[tuple[str, str]]:
    """Compute blocks; returns the failures.

    A block that fails as a whole (a damaged raw block, a worker out of memory) is tried again tile by tile,
    with the tasks that `singly` makes of its tiles, so that only the tiles at fault are lost.
    """
    total = sum(len(t.block.tiles) for t in tasks)
    finished = 0
    failures: list[tuple[str, str]] = []
    again: list[TileId] = []
    report(0, total)

    def rounds() -> Iterator[Sequence[BlockTask]]:
        yield tasks
        if again:
            yield singly(again)

    for round_tasks in rounds():
        for done in compute.map(compute_block, round_tasks):
            tiles = done.task.block.tiles
            if done.result is not None:
                manifest.add(done.result.records)
                failures.extend(done.result.failures)
            elif len(tiles) > 1:
                again.extend(tiles)
                continue
            else:
                failures.append((str(tiles[0]), _reason(done.error)))
            finished += len(tiles)
            report(finished, total)
    return failures


def compute_block(task: BlockTask) -> BlockResult:
    """Compute the tiles of a block and write their files (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    waiting = dict(zip(task.block.tiles, task.keys, strict=True))
    for loaded in load_tiles(task):
        tile = loaded.tile
        if tile not in waiting or loaded.points is None:
            continue  # a tile of the halo, or one without points
        key = waiting.pop(tile)
        try:
            records += _write_tile(task, key, loaded.points, loaded.marked, loaded.sigma)
        except Exception as error:  # noqa: BLE001  one tile's fault must not stop the others
            failures.append((str(tile), _reason(error)))
    for tile, key in waiting.items():
        records.append(OutputRecord(TILE, str(tile), key, "", 0, "", json.dumps({"points": 0})))
    return BlockResult(tuple(records), tuple(failures))


@dataclass(frozen=True)
class LoadedTile:
    """What a tile holds."""

    tile: TileId
    points: TilePoints | None
    """Points that passed all filters; None without any."""
    marked: TilePoints | None
    """Points that a filter leaves out; None without any, or where the survey does not keep them."""
    sigma: PositionSigma
    """Of the poses that placed the points."""


@dataclass(frozen=True)
class PositionSigma:
    """Largest 1 σ of the positions that placed a tile's points (m); None where a trajectory does not state it."""

    horizontal_m: float | None
    down_m: float | None


def load_points(task: BlockTask) -> Iterator[tuple[TileId, TilePoints]]:
    """Points of every tile of the block and its halo that holds any: filtered, in canonical order, tile by tile."""
    for loaded in load_tiles(task):
        if loaded.points is not None:
            yield loaded.tile, loaded.points


def load_tiles(task: BlockTask) -> Iterator[LoadedTile]:
    """As :func:`load_points`, with the points that filters leave out, where the survey keeps them marked."""
    box = task.block.box()
    buffer = None if task.centre_lines is None else load_buffer(task.centre_lines, task.ground.map)
    parts = _Parts()
    placer = Placer(task.store, task.ground, task.slices)
    for one in task.slices:
        own = [p for p in task.passes if p.run == one.source.run]
        for _, placed in placer.place(one, Window(*box)):
            if placed.epoch_gps_ns.size:
                parts.add(one.source, placed, passes_of(placed.epoch_gps_ns, own), placer.trajectory(one.source))
    if not parts.placed:
        return
    joined = parts.join()
    width = box[2] - box[0]
    local = (joined.tiles[:, 1] - box[1]) * width + (joined.tiles[:, 0] - box[0])
    order = np.argsort(local.astype(np.uint16), kind="stable").astype(np.int32)  # 16 bits: a radix sort
    ends = np.cumsum(np.bincount(local, minlength=width * (box[3] - box[1])))
    del local
    for tile in sorted(task.block.with_halo(), key=lambda t: (t.row, t.column)):
        index = (tile.row - box[1]) * width + (tile.column - box[0])
        rows = order[ends[index - 1] if index else 0 : ends[index]]
        rows = rows[joined.passes[rows] > 0]
        if rows.size:
            yield _loaded(tile, rows, joined, buffer, task.ground)


def _loaded(
    tile: TileId,
    rows: npt.NDArray[np.int32],
    joined: _Joined,
    buffer: CentreLineBuffer | None,
    ground: Ground,
) -> LoadedTile:
    """Points of a tile at `rows` of the block, those that filters leave out apart."""
    near = None if buffer is None else near_lines(tile, joined.quanta[rows], buffer, ground)
    if joined.classes is None:
        rows = rows if near is None else rows[near]
        return LoadedTile(tile, joined.tile(tile, rows) if rows.size else None, None, joined.sigma(rows))
    classes = joined.classes[rows]
    if near is not None:
        classes[(classes == KEPT) & ~near] = OFF_CENTRE_LINE
    kept, left = rows[classes == KEPT], rows[classes != KEPT]
    marked = joined.tile(tile, left, LAS_CLASSES[classes[classes != KEPT]]) if left.size else None
    return LoadedTile(tile, joined.tile(tile, kept) if kept.size else None, marked, joined.sigma(kept))


def read_cells(store: Store, record: OutputRecord, cells_per_edge: int) -> TileCells:
    """Cells of a finished tile."""
    rows = pq.read_table(io.BytesIO(store.read_bytes(record.path)))
    passes = rows.column("passes").combine_chunks()
    plain = {n: rows.column(n).to_numpy() for n in rows.column_names if n != "passes"}
    return TileCells(
        tile=TileId.parse(record.unit),
        cells_per_edge=cells_per_edge,
        pass_offsets=passes.offsets.to_numpy(),
        pass_ids=passes.values.to_numpy(),
        **plain,
    )


def summary_of(record: OutputRecord) -> TileSummary | None:
    """Figures of a finished tile; None where it holds no point."""
    figures = record.figures()
    if not figures.get("points"):
        return None
    figures["passes"] = tuple(figures["passes"])
    return TileSummary(tile=TileId.parse(record.unit), **figures)


def _is_current(tile: TileId, key: str, products: Sequence[WantedProduct], manifest: Manifest) -> bool:
    if not manifest.is_current(TILE, str(tile), key):
        return False
    record = manifest.get(TILE, str(tile))
    if record is not None and not record.path:
        return True  # without points there are no files
    return all(manifest.is_current(name, str(tile), key_of(key, w.key)) for w in products for name in w.files)


def _rows_by_tile(footprints: Footprints, chosen: frozenset[TileId]) -> dict[TileId, npt.NDArray[np.int64]]:
    order = np.lexsort((footprints.tile_column, footprints.tile_row))
    column, row = footprints.tile_column[order], footprints.tile_row[order]
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(column) != 0) | (np.diff(row) != 0)]))
    ends = np.append(starts[1:], order.size)
    tiles = (TileId(int(column[s]), int(row[s])) for s in starts)
    return {t: order[s:e] for t, s, e in zip(tiles, starts, ends, strict=True) if t in chosen}


def _slices_of(
    block: Block, by_tile: dict[TileId, npt.NDArray[np.int64]], footprints: Footprints
) -> tuple[RawSlice, ...]:
    rows = np.concatenate([by_tile[t] for t in block.with_halo() if t in by_tile])
    pairs = np.unique(np.column_stack([footprints.slice_index[rows], footprints.row_group[rows]]), axis=0)
    out: list[RawSlice] = []
    for index in np.unique(pairs[:, 0]):
        whole = footprints.slices[index]
        groups = pairs[pairs[:, 0] == index, 1]
        ordered = [g for _, g in sorted((whole.spans[g], g) for g in groups.tolist())]
        share = whole.bytes * len(ordered) // max(len(whole.groups), 1)
        out.append(RawSlice(whole.source, whole.file, tuple(ordered), tuple(whole.spans[g] for g in ordered), share))
    return tuple(out)


class _Parts:
    """Placed readings of a block as they come, with their pass and source."""

    def __init__(self) -> None:
        self.placed: list[Placed] = []
        self._passes: list[npt.NDArray[np.uint16]] = []
        self._sources: list[npt.NDArray[np.uint16]] = []
        self._numbers: dict[str, int] = {}
        self._profiles: list[bool] = []
        self.trajectories: list[Trajectory | None] = []

    def add(
        self,
        source: ReadingSource,
        placed: Placed,
        passes: npt.NDArray[np.uint16],
        trajectory: Trajectory | None,
    ) -> None:
        """Take a chunk of one source; sources are numbered as they come."""
        number = self._numbers.setdefault(source.key, len(self._numbers))
        if number == len(self._profiles):
            self._profiles.append(source.table == "scans")
            self.trajectories.append(trajectory)
        self.placed.append(placed)
        self._passes.append(passes)
        self._sources.append(np.full(passes.size, number, np.uint16))

    def join(self) -> _Joined:
        """All chunks as one set of arrays; the chunks are given up, so that memory holds each point once."""
        placed, self.placed = self.placed, []
        extra = {c: v for c in EXTRA_COLUMNS if (v := _joined_extra(placed, c)) is not None}
        lacking = {c: _lacks(placed, c) for c in extra if any(c not in p.extra for p in placed)}
        columns: dict[str, npt.NDArray[Any]] = {}
        for name in ("tiles", "quanta", "epoch_gps_ns", "intensity", "classification"):
            columns[name] = np.concatenate([getattr(p, name) for p in placed])
        marks = [p.classes for p in placed if p.classes is not None]
        classes = np.concatenate(marks) if marks else None
        placed.clear()
        return _Joined(
            passes=np.concatenate(self._passes),
            sources=np.concatenate(self._sources),
            profiles=np.array(self._profiles),
            trajectories=self.trajectories,
            extra=extra,
            lacking=lacking,
            classes=classes,
            **columns,
        )


@dataclass(frozen=True)
class _Joined:
    """Placed readings of a block, in the order they were loaded."""

    tiles: npt.NDArray[np.int32]
    quanta: npt.NDArray[np.int32]
    epoch_gps_ns: npt.NDArray[np.int64]
    intensity: npt.NDArray[np.uint16]
    classification: npt.NDArray[np.uint8]
    passes: npt.NDArray[np.uint16]
    sources: npt.NDArray[np.uint16]
    profiles: npt.NDArray[np.bool_]
    """(sources,) True for scans."""
    trajectories: Sequence[Trajectory | None]
    """Of each source; None for clouds."""
    extra: dict[str, npt.NDArray[Any]]
    lacking: dict[str, npt.NDArray[np.bool_]]
    """(n,) True for points without a recorded value, for columns that some points lack."""
    classes: npt.NDArray[np.uint8] | None
    """(n,) class of each reading, where those that a filter leaves out were placed too."""

    def sigma(self, rows: npt.NDArray[np.integer[Any]]) -> PositionSigma:
        """Largest σ of the poses that placed the points at `rows`."""
        sources, epochs = self.sources[rows], self.epoch_gps_ns[rows]
        found = [np.full((1, 3), np.nan)]
        for number in np.unique(sources).tolist():
            trajectory = self.trajectories[number]
            if trajectory is None:
                return PositionSigma(None, None)
            found.append(trajectory.position_sigma_m(_moments(epochs[sources == number])))
        sigma = np.concatenate(found[1:] or found)
        if np.isnan(sigma).any():
            return PositionSigma(None, None)
        return PositionSigma(float(np.hypot(sigma[:, 0], sigma[:, 1]).max()), float(sigma[:, 2].max()))

    def tile(
        self,
        tile: TileId,
        rows: npt.NDArray[np.integer[Any]],
        marks: npt.NDArray[np.uint8] | None = None,
    ) -> TilePoints:
        """Points of one tile, in canonical order; with `marks` (n,), the classes they get, they are withheld."""
        sources = self.sources[rows]
        # A tile has the columns that its own points have, whatever else was loaded with it.
        extra = {c: v for c, v in self.extra.items() if c not in self.lacking or not self.lacking[c][rows].all()}
        content = [*extra.values(), self.quanta, self.intensity, self.classification]
        order = canonical_order(
            sources, self.epoch_gps_ns[rows], self.profiles[sources], lambda: [c[rows] for c in content]
        )
        if order is not None:
            rows = rows[order]
            marks = None if marks is None else marks[order]
        recorded = {c: v[rows] for c, v in extra.items()}
        if marks is not None:
            recorded["flags"] = recorded.get("flags", np.zeros(rows.size, np.uint8)) | np.uint8(WITHHELD_FLAG)
        quanta = self.quanta[rows]
        return TilePoints(
            tile=tile,
            x_quanta=np.ascontiguousarray(quanta[:, 0]),
            y_quanta=np.ascontiguousarray(quanta[:, 1]),
            height_quanta=np.ascontiguousarray(quanta[:, 2]),
            epoch_gps_ns=self.epoch_gps_ns[rows],
            intensity=self.intensity[rows],
            classification=self.classification[rows] if marks is None else marks,
            pass_id=self.passes[rows],
            extra=recorded,
        )


def _moments(epochs_gps_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Middle of each twentieth of a second that holds an epoch, not beyond the first and last of them."""
    if epochs_gps_ns.size == 0:
        return epochs_gps_ns
    first, last = int(epochs_gps_ns.min()), int(epochs_gps_ns.max())
    number = first // _MOMENT_NS
    held = np.flatnonzero(np.bincount(epochs_gps_ns // _MOMENT_NS - number))
    return np.clip((number + held) * _MOMENT_NS + _MOMENT_NS // 2, first, last)


def _joined_extra(parts: list[Placed], column: str) -> npt.NDArray[Any] | None:
    known = [p.extra[column] for p in parts if column in p.extra]
    if not known:
        return None
    kind = known[0].dtype
    return np.concatenate([p.extra.get(column, fill_of(column, p.epoch_gps_ns.size, kind)) for p in parts])


def _lacks(parts: list[Placed], column: str) -> npt.NDArray[np.bool_]:
    return np.concatenate([np.full(p.epoch_gps_ns.size, column not in p.extra) for p in parts])


def near_lines(
    tile: TileId, quanta: npt.NDArray[np.int32], buffer: CentreLineBuffer, ground: Ground
) -> npt.NDArray[np.bool_]:
    """Which points (n, …) of a tile lie in the buffer about the centre lines; `quanta` from the tile's corner."""
    b = ground.grid.bounds(tile)
    easting = b.easting_min_m + quanta[:, 0].astype(np.float64) * QUANTUM_M
    northing = b.northing_min_m + quanta[:, 1].astype(np.float64) * QUANTUM_M
    return buffer.keeps(easting, northing, (b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m))


def _write_tile(
    task: BlockTask, key: str, points: TilePoints, marked: TilePoints | None, sigma: PositionSigma
) -> list[OutputRecord]:
    tile = points.tile
    cells = cells_of(points, task.ground.grid)
    context = dataclasses.replace(task.context, date=utc_from_gps_ns(int(points.epoch_gps_ns.min())).date())
    records: list[OutputRecord] = []
    with task.store.scratch() as folder:
        for wanted in task.products:
            records += write_product(wanted, Tile(points, cells, marked), context, key, task.store, folder)
        path = folder / "cells.parquet"
        write_parquet(path, cells_table(cells), table_schema("cells"))
        detail = json.dumps(_figures(points, cells, sigma))
        records.append(
            publish_file(task.store, path, f"tiles/cells/{tile}.parquet", TILE, str(tile), key, detail)
        )  # last: a tile is current only with all its files
    return records


def cells_table(cells: TileCells) -> pa.Table:
    """Cells as rows of ``schemas/cells.toml``."""
    schema = table_schema("cells").arrow()
    passes = pa.ListArray.from_arrays(cells.pass_offsets, cells.pass_ids, type=schema.field("passes").type)
    return pa.table([passes if n == "passes" else getattr(cells, n) for n in schema.names], schema=schema)


def _figures(points: TilePoints, cells: TileCells, sigma: PositionSigma) -> dict[str, Any]:
    return {
        "points": len(points),
        "cells": len(cells),
        "height_min_m": float(cells.height_min_m.min()),
        "height_mean_m": float(cells.height_robust_m.mean()),
        "height_max_m": float(cells.height_max_m.max()),
        "height_std_median_m": float(np.median(cells.height_std_m)),
        "intensity_mean": float(points.intensity.mean(dtype=np.float64)),
        "passes": np.unique(points.pass_id).tolist(),
        "first_epoch_gps_ns": int(points.epoch_gps_ns.min()),
        "last_epoch_gps_ns": int(points.epoch_gps_ns.max()),
        "sigma_horizontal_m": sigma.horizontal_m,
        "sigma_down_m": sigma.down_m,
    }


def _reason(error: Exception | None) -> str:
    if error is None:
        return "the worker gave no result"
    return str(error) if isinstance(error, RoadscanError) else f"{type(error).__name__}: {error}"
