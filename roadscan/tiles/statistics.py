"""Points of a tile → its cells."""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.kernels.accumulate import PIECE, accumulate_placed
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
    accumulator = Accumulator(grid, [tile], np.unique(points.pass_id).tolist(), most_bytes=1 << 40)
    accumulator.activate([tile])
    east, north = accumulator.corner_quanta
    zeros = np.zeros(n, np.int32)
    passes = np.searchsorted(accumulator.passes, points.pass_id).astype(np.int32)

    def count(tile_rows: Any, groups: Any, pool: Any, work: Any, spans: Any, sigmas: Any, first: int) -> int:
        done, _ = accumulate_placed(
            points.x_quanta + np.float64(east), points.y_quanta + np.float64(north),
            points.height_quanta.astype(np.float64), zeros.astype(np.uint8), passes, points.intensity, np.uint32(1),
            points.epoch_gps_ns, zeros, (east, north), grid.cell_quanta, grid.cells_per_edge,
            tile_rows, groups, pool, work, spans, sigmas, np.zeros((1, 2)), first,
        )  # fmt: skip
        return int(done)

    accumulator.run(count, n, 2 * PIECE)
    finished = accumulator.finish(tile)
    if finished is None:
        raise ValueError(f"tile {tile} holds no point")
    return finished[0]
