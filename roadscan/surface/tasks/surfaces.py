"""Surfaces: cells or points of a tile and its surroundings → its surface → files. One task is a block of tiles."""

from __future__ import annotations

import dataclasses
import json
from collections import OrderedDict
from functools import partial
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from roadscan.core.grid import TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.run.engine.compute import damaged_file, reason_of
from roadscan.store.manifest import OutputRecord
from roadscan.surface.reconstruction import Patch, SurfaceGrid, patch_of_cells, patch_of_points, surface_of
from roadscan.surface.regions import FILLED, INTERPOLATED, MEASURED
from roadscan.surface.tasks.surface_plan import SURFACE, Painter, SurfaceTask
from roadscan.surface.tile import SurfaceTile
from roadscan.tiles.cells import TileCells, read_cells
from roadscan.tiles.product import ProductContext, publish_product
from roadscan.tiles.tasks.tile_plan import TileTask
from roadscan.tiles.tasks.tile_points import load_points
from roadscan.tiles.tasks.tiles import TaskResult

_CELLS_KEPT = 24_000_000
"""Cells cached for the following tiles: six full tiles with cells of 5 mm, 700 MB."""


def compute_surfaces(task: SurfaceTask) -> TaskResult:
    """Make the surfaces of a task's tiles and write their files (runs on a worker)."""
    source = source_of(task)
    painter = Painter(task.pictures)
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    damaged: set[str] = set()
    for tile, key, date in zip(task.block.tiles, task.keys, task.dates, strict=True):
        context = dataclasses.replace(task.context, date=date)
        try:
            wanted = None if task.regions is None else task.regions.holds(task.grid.window(tile))
            surface = surface_of(tile, source.patch(tile, wanted), task.grid, wanted)
            records += _write(task, key, surface, context, painter)
        except Exception as error:  # noqa: BLE001  one tile's fault must not stop the others
            failures.append((str(tile), reason_of(error)))
            damaged.add(damaged_file(error))
    return TaskResult.of(records, failures, damaged)


class Source(Protocol):
    """Source of the heights of a surface."""

    def patch(self, tile: TileId, wanted: npt.NDArray[np.bool_] | None) -> Patch:
        """Returns heights of a tile and its surroundings before smoothing; `wanted` are the cells that are kept."""


def source_of(task: SurfaceTask) -> Source:
    """Returns the cells or points of a task, as it states."""
    return _Cells(task) if task.readings is None else _Points(task.grid, task.readings)


class _Cells:
    """Cells of finished tiles, read once and cached in bounded memory."""

    def __init__(self, task: SurfaceTask) -> None:
        self._task = task
        self._records = {TileId.parse(r.unit): r for r in task.cells}
        self._kept: OrderedDict[TileId, TileCells] = OrderedDict()

    def patch(self, tile: TileId, wanted: npt.NDArray[np.bool_] | None) -> Patch:
        """Returns a tile and its surroundings from cells."""
        grid = self._task.grid
        near = [t for t in grid.tiles.tiles_in(grid.reach(tile)) if t in self._records]
        return patch_of_cells(grid.window(tile), map(self._read, near))

    def _read(self, tile: TileId) -> TileCells:
        cells = self._kept.pop(tile, None)
        if cells is None:
            cells = read_cells(self._task.store, self._records[tile], self._task.grid.tiles.cells_per_edge)
        self._kept[tile] = cells
        while len(self._kept) > 1 and sum(map(len, self._kept.values())) > _CELLS_KEPT:
            self._kept.popitem(last=False)
        return cells


class _Points:
    """Points of a block and its surroundings, georeferenced at once."""

    def __init__(self, grid: SurfaceGrid, readings: TileTask) -> None:
        self._grid = grid
        self._points: dict[TileId, TilePoints] = dict(load_points(readings))

    def patch(self, tile: TileId, wanted: npt.NDArray[np.bool_] | None) -> Patch:
        """Returns the detailed model of a tile and its surroundings."""
        near = self._grid.tiles.tiles_in(self._grid.reach(tile))
        own = [self._points[t] for t in near if t in self._points]
        return patch_of_points(self._grid.window(tile), own, self._grid, wanted)


def _write(
    task: SurfaceTask, key: str, surface: SurfaceTile, context: ProductContext, painter: Painter
) -> list[OutputRecord]:
    """Write the files of a surface; its record comes last, so that a tile is current only with all its files."""
    unit, figures = str(surface.tile), _figures(surface)
    records: list[OutputRecord] = []
    with task.store.scratch() as folder:
        for wanted in task.products if figures["cells"] else ():
            painted, told = painter.paint(wanted, surface)
            figures |= told
            write = partial(wanted.product.write, painted, wanted.options, context)
            records += publish_product(wanted, unit, write, key, task.store, folder)
    return [*records, OutputRecord(SURFACE, unit, key, "", 0, "", json.dumps(figures))]


def _figures(surface: SurfaceTile) -> dict[str, Any]:
    origin = surface.origin[surface.inner]
    change = (surface.height_m - surface.raw_m)[surface.inner]
    known = change[~np.isnan(change)]
    lowest = 0 if surface.lowest is None else np.count_nonzero(~np.isnan(surface.lowest.drop_m[surface.inner]))
    return {
        "cells": int(np.count_nonzero(origin)),
        "measured": int(np.count_nonzero(origin == MEASURED)),
        "interpolated": int(np.count_nonzero(origin == INTERPOLATED)),
        "filled": int(np.count_nonzero(origin == FILLED)),
        "lowest_known": int(lowest),
        "change_rms_m": float(np.sqrt(np.mean(known * known))) if known.size else None,
    }
