"""Joins the cells of some tiles into one table, from which heights of the road are sampled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from roadscan.condition.kernels.sampling import CellTable
from roadscan.tiles.cells import TileCells


def cell_table(tiles: Sequence[TileCells], cell_m: float) -> CellTable:
    """Return the cells of tiles of one grid, in any order, as a table; `cell_m` is a cell's edge (m)."""
    held = sorted(tiles, key=lambda t: (t.tile.row, t.tile.column))
    edge = held[0].cells_per_edge if held else 1
    columns, rows = [t.tile.column for t in held] or [0], [t.tile.row for t in held] or [0]
    first = np.array([min(rows), min(columns)], np.int64)
    slot = np.full((max(rows) - min(rows) + 1, max(columns) - min(columns) + 1), -1, np.int32)
    starts = np.zeros((len(held), edge + 1), np.int64)
    before = 0
    for number, tile in enumerate(held):
        slot[tile.tile.row - first[0], tile.tile.column - first[1]] = number
        starts[number] = before + np.searchsorted(tile.row, np.arange(edge + 1))
        before += len(tile)
    count = _joined([t.count for t in held], np.float32)
    std = _joined([t.height_std_m for t in held], np.float32)
    return CellTable(
        slot=slot,
        first=first,
        row_start=starts,
        column=_joined([t.column for t in held], np.int32),
        height=_joined([t.height_robust_m for t in held], np.float64),
        noise=std * std * count,
        readings=count,
        intensity=_joined([t.intensity_mean for t in held], np.float32),
        passes=_joined([t.pass_count for t in held], np.float32),
        cell=np.array([cell_m, cell_m]),
        edge=np.array([edge, edge], np.int64),
    )


def _joined(parts: Sequence[np.ndarray], kind: type) -> np.ndarray:
    return np.concatenate([np.empty(0, kind), *(p.astype(kind, copy=False) for p in parts)])
