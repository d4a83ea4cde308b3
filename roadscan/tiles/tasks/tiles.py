"""Computes tiles: raw readings become cells and tile products, with points where needed. One task per stretch."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

import numpy as np

from roadscan.compute.arrays import scatter_about
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.core.grid import QUANTUM_M, LanePass, TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.georeference.reading_counts import ReadingCounts
from roadscan.run.engine.compute import Compute, reason_of
from roadscan.store.manifest import Manifest
from roadscan.store.records import OutputRecord, Packed, Row, table_of
from roadscan.store.store import naming_full_disk
from roadscan.tiles.cells import TileCells, TileEvidence, write_cells, write_overviews
from roadscan.tiles.product import Tile, publish_file, write_product
from roadscan.tiles.tasks.tile_plan import APART_FIGURE, OVERVIEWS, TILE, Block, TileTask
from roadscan.tiles.tasks.tile_points import load_tiles


@dataclass(frozen=True)
class TaskResult:
    """Result of a task."""

    records: Packed
    failures: tuple[tuple[str, str], ...]
    """Tiles that failed, with the reason."""
    damaged: frozenset[str] = frozenset()
    """Files of the store that were found damaged."""

    @classmethod
    def of(
        cls, records: Sequence[Row], failures: Sequence[tuple[str, str]] = (), damaged: Collection[str] = ()
    ) -> TaskResult:
        """Pack finished outputs in the manifest's form, so that the run only has to write them."""
        return cls(Packed.of(table_of(records)), tuple(failures), frozenset(damaged) - {""})


@dataclass(frozen=True)
class ComputedTile:
    """A computed tile whose files are not written yet."""

    tile: TileId
    content: Tile | None
    """Content of the tile; None where no reading fell into it."""
    evidence: TileEvidence | None
    failure: str = ""


class OfTiles(Protocol):
    """A task over some tiles."""

    @property
    def block(self) -> Block:
        """Block of the task's tiles."""


T = TypeVar("T", bound=OfTiles)


def run_tasks(
    function: Callable[[T], TaskResult],
    tasks: Sequence[T],
    total: int,
    singly: Callable[[Sequence[TileId]], list[T]],
    manifest: Manifest,
    compute: Compute,
    report: Callable[[int, int], None] = lambda _a, _b: None,
) -> list[tuple[str, str]]:
    """Compute tasks over `total` tiles by `function`; return the failures.

    A task that fails as a whole (a worker out of memory, a damaged raw block where points are made) is tried again
    tile by tile, with the tasks that `singly` makes of its tiles, so that only the tiles at fault are lost.
    """
    finished = 0
    failures: list[tuple[str, str]] = []
    again: list[TileId] = []
    report(0, total)

    def rounds() -> Iterator[Sequence[T]]:
        yield tasks
        if again:
            yield singly(again)

    for round_tasks in rounds():
        for done in compute.map(function, round_tasks):
            tiles = done.task.block.tiles
            if done.result is not None:
                manifest.add_packed(done.result.records)
                failures.extend(done.result.failures)
                manifest.doubt_files(done.result.damaged)
            elif len(tiles) > 1:
                again.extend(tiles)
                continue
            else:
                failures.append((str(tiles[0]), reason_of(done.error)))
            finished += len(tiles)
            report(finished, total)
    manifest.settle()
    return failures


def compute_tiles(task: TileTask) -> TaskResult:
    """Compute the tiles of a task and write their files (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    fates = ReadingCounts()
    waiting = dict(zip(task.block.tiles, task.keys, strict=True))
    empty: list[tuple[TileId, str]] = []
    with task.store.scratch() as folder:
        for computed in computed_tiles(task, fates):
            key = waiting.pop(computed.tile, None)
            if key is None:
                continue  # a tile of the halo
            if computed.failure:
                failures.append((str(computed.tile), computed.failure))
                continue
            if computed.content is None or computed.evidence is None:
                empty.append((computed.tile, key))
                continue
            try:
                with naming_full_disk(folder):
                    records += _write_tile(task, key, computed.content, computed.evidence, folder)
            except Exception as error:  # noqa: BLE001  one tile's fault must not stop the others
                failures.append((str(computed.tile), reason_of(error)))
    for tile, key in [*empty, *waiting.items()]:
        records.append(OutputRecord(TILE, str(tile), key, "", 0, "", json.dumps({"points": 0})))
    return TaskResult.of([_with_fates(r, fates) for r in records], failures)


def computed_tiles(task: TileTask, fates: ReadingCounts) -> Iterator[ComputedTile]:
    """Yield the tiles of a task, counted from the readings, or from points where these are needed."""
    if not task.needs_points:
        from roadscan.tiles.tasks.tile_cells import count_tiles

        for counted in count_tiles(task, fates):
            content = None if counted.cells is None else Tile(None, counted.cells)
            yield ComputedTile(counted.tile, content, counted.evidence, counted.failure)
        return
    from roadscan.tiles.accumulator import cells_of

    for loaded in load_tiles(task, fates):
        if loaded.points is not None:
            cells = cells_of(loaded.points, task.ground.grid)
            yield ComputedTile(loaded.tile, Tile(loaded.points, cells, loaded.marked), loaded.evidence)


def _write_tile(task: TileTask, key: str, content: Tile, evidence: TileEvidence, folder: Path) -> list[OutputRecord]:
    cells, unit = content.cells, str(content.cells.tile)
    context = dataclasses.replace(task.context, date=utc_from_gps_ns(evidence.first_epoch_gps_ns).date())
    horizontal, upright = _known(evidence.sigma_horizontal_m), _known(evidence.sigma_down_m)
    content = dataclasses.replace(content, sigma_horizontal_m=horizontal, sigma_height_m=upright)
    records: list[OutputRecord] = []
    for wanted in task.products:
        records += write_product(wanted, content, context, key, task.store, folder)
    path = folder / "overviews.parquet"
    write_overviews(path, content.overviews)
    target = f"tiles/overviews/{unit}.parquet"
    records.append(publish_file(task.store, path, target, OVERVIEWS, unit, key))
    path = folder / "cells.parquet"
    write_cells(path, cells, task.cell_table)
    figures = _figures(cells, evidence)
    if content.points is not None and (apart := apart_in_tile(content.points, task.ground.grid, task.passes)):
        figures[APART_FIGURE] = apart
    detail = json.dumps(figures)
    records.append(
        publish_file(task.store, path, f"tiles/cells/{unit}.parquet", TILE, unit, key, detail)
    )  # last, since a tile is current only with all its files
    return records


def _figures(cells: TileCells, evidence: TileEvidence) -> dict[str, Any]:
    from roadscan.tiles.kernels.cell_statistics import median, totals  # loads Numba, which `status` does without

    points, light, heights_m = totals(cells.count, cells.intensity_mean, cells.height_robust_m)
    lone = cells.pass_ids.size > 0 and cells.pass_ids.min() == cells.pass_ids.max()
    return {
        "points": int(points),
        "cells": len(cells),
        "overlapped_cells": 0 if lone else int(np.count_nonzero(cells.pass_count > 1)),
        "height_min_m": float(cells.height_min_m.min()),
        "height_mean_m": heights_m / len(cells),
        "height_max_m": float(cells.height_max_m.max()),
        "height_std_median_m": median(cells.height_std_m),
        "intensity_mean": light / points,
        "passes": [int(cells.pass_ids[0])] if lone else np.unique(cells.pass_ids).tolist(),
        "first_epoch_gps_ns": evidence.first_epoch_gps_ns,
        "last_epoch_gps_ns": evidence.last_epoch_gps_ns,
        "sigma_horizontal_m": _known(evidence.sigma_horizontal_m),
        "sigma_down_m": _known(evidence.sigma_down_m),
    }


def _known(sigma_m: float) -> float | None:
    return sigma_m if np.isfinite(sigma_m) else None


def _with_fates(record: OutputRecord, fates: ReadingCounts) -> OutputRecord:
    """Return a tile's record, with the counts of the readings that it reports."""
    told = fates.of(TileId.parse(record.unit)) if record.product == TILE else {}
    if not told:
        return record
    return record._replace(detail=json.dumps({**record.figures(), "fates": told}))


_MOST_PASSES: Final = 6
"""Most passes of a tile that are compared, those with the most points."""


_LEAST_CELLS: Final = 20  # Least number of cells that both passes saw.


def apart_in_tile(points: TilePoints, grid: TileGrid, passes: Sequence[LanePass]) -> list[list[Any]]:
    """Return for each pair of passes of a tile: both in words, common cells, median and 1 σ of the differences (m)."""
    ids, counts = np.unique(points.pass_id, return_counts=True)
    if ids.size < 2:
        return []
    ids = np.sort(ids[np.argsort(-counts, kind="stable")[:_MOST_PASSES]])
    across = int(points.x_quanta.max()) // grid.cell_quanta + 1
    cell = points.y_quanta.astype(np.int64) // grid.cell_quanta * across + points.x_quanta // grid.cell_quanta
    size = int(cell.max()) + 1
    datum = int(points.height_quanta[0])
    means = np.full((ids.size, size), np.nan)
    for k, one in enumerate(ids.tolist()):
        own = points.pass_id == one
        count = np.bincount(cell[own], minlength=size)
        total = np.bincount(cell[own], (points.height_quanta[own] - datum).astype(np.float64), minlength=size)
        means[k, count > 0] = total[count > 0] / count[count > 0] * QUANTUM_M
    words = {int(p.pass_id): f"run '{p.run}' (pass {p.pass_id})" for p in passes}
    found: list[list[Any]] = []
    for a, b in zip(*np.triu_indices(ids.size, 1), strict=True):
        off = means[b] - means[a]
        off = off[np.isfinite(off)]
        if off.size >= _LEAST_CELLS:
            middle = float(np.median(off))
            scatter = scatter_about(off, middle)
            names = [words.get(int(ids[k]), f"pass {ids[k]}") for k in (a, b)]
            found.append([*names, int(off.size), round(middle, 6), round(scatter, 6)])
    return found
