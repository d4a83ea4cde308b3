"""Points of a tile → its cells."""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.kernels.accumulate import PIECE, accumulate_points
from roadscan.points.cloud import TilePoints
from roadscan.tiles.accumulator import Accumulator
from roadscan.tiles.cells import TileCells
from roadscan.tiles.grid import TileGrid


def cells_of(points: TilePoints, grid: TileGrid) -> TileCells:
    """Statistics of every cell with a point; equal to the bit whatever the order of the points.

    Sums are made of whole 10 µm, so they are exact. The squared deviations of one cell stay below 2⁶³ for
    up to 250,000 points spread over 60 m of height, and for more where the spread is less.

    Parameters
    ----------
    points : at least one.
    """
    tile, n = points.tile, len(points)
    ids = points.pass_id
    one = bool((ids == ids[0]).all())
    accumulator = Accumulator(grid, [tile], ids[:1] if one else np.unique(ids), most_bytes=1 << 40)
    accumulator.activate([tile])
    passes = np.zeros(n, np.int32) if one else np.searchsorted(accumulator.passes, ids).astype(np.int32)
    x, y, height = (np.ascontiguousarray(a) for a in (points.x_quanta, points.y_quanta, points.height_quanta))
    intensity = np.ascontiguousarray(points.intensity)

    def count(tile_rows: Any, groups: Any, pool: Any, work: Any, _spans: Any, _sigmas: Any, first: int) -> int:
        done: int = accumulate_points(
            x, y, height, passes, intensity, grid.cell_quanta, grid.cells_per_edge,
            tile_rows, groups, pool, work, first,
        )  # fmt: skip
        return done

    accumulator.run(count, n, 2 * PIECE)
    finished = accumulator.finish(tile)
    if finished is None:
        raise ValueError(f"tile {tile} holds no point")
    return finished[0]
