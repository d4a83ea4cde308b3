"""Readings put into buckets by row make the cells that points make, to the bit, whatever becomes of the buckets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from roadscan.core.grid import TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.georeference.kernels.readings import (
    CLASS_KEPT,
    CLASS_TOO_HIGH,
    FATES,
    KEPT,
    OUTSIDE,
    Georeferenced,
)
from roadscan.tiles.accumulator import Accumulator, cells_of
from roadscan.tiles.kernels.row_buckets import TAKEN, ActiveTiles, Buckets, Measured, Places, fill_buckets

GRID = TileGrid(10.0, 0.5)
TILE, OTHER, NOT_ACTIVE = TileId(-3, 7), TileId(-2, 7), TileId(-3, 8)
AT_ONCE = 500


def points(n: int, passes: np.ndarray, seed: int = 1) -> TilePoints:
    """Points of a tile: a tenth in one cell, a tenth on a tall mast, the others all over it."""
    rng = np.random.default_rng(seed)
    x, y = (rng.integers(0, 1_000_000, n).astype(np.int32) for _ in range(2))
    x[: n // 10], y[: n // 10] = 321_000, 456_000
    height = rng.integers(-300, 300, n) - 5_000_000
    height[n // 10 : n // 5] += rng.integers(0, 3_000_000, n // 5 - n // 10)
    order = rng.permutation(n)
    return TilePoints(
        TILE, x[order], y[order], height[order].astype(np.int32), rng.integers(10**18, 2 * 10**18, n),
        rng.integers(0, 65_536, n).astype(np.uint16), np.ones(n, np.uint8), passes.astype(np.uint16),
    )  # fmt: skip


def fill(accumulator: Accumulator, p: TilePoints, tile: TileId, fates: Any, classes: Any = None) -> None:
    """Put points into buckets as readings of a tile, pass 0 being none; ever so many at a time."""
    east, north, height = (np.float64(a) for a in (p.x_quanta, p.y_quanta, p.height_quanta))
    east, north = east + tile.column * GRID.size_quanta, north + tile.row * GRID.size_quanta
    numbers = np.where(p.pass_id == 0, -1, np.searchsorted(accumulator.passes, p.pass_id)).astype(np.int32)
    kinds = np.full(len(p), CLASS_KEPT, np.uint8) if classes is None else classes
    intervals, sigmas = np.arange(len(p), dtype=np.int32) // 100, np.linspace(0.0, 1.0, 2 * len(p)).reshape(-1, 2)

    def put(active: ActiveTiles, buckets: Buckets, first: int) -> int:
        for start in range(first, len(p), AT_ONCE):
            if buckets.free.size - buckets.held[TAKEN] < AT_ONCE:
                return start
            own = slice(start, start + AT_ONCE)
            placed = Georeferenced(east[own], north[own], height[own], kinds[own], intervals[own])
            epochs, light = p.epoch_gps_ns[own].copy(), p.intensity[own].copy()
            measured = Measured(epochs, numbers[own], light, np.uint32(1), sigmas)
            work = [np.empty(AT_ONCE, np.int32) for _ in range(3)]
            places = Places(*work, np.full(len(accumulator.spans), -1, np.int32))
            fill_buckets(placed, measured, places, active, buckets, fates)
        return len(p)

    accumulator.fill(put, len(p), AT_ONCE)


def same(one: Any, other: Any) -> bool:
    """True if cells are equal to the bit."""
    return all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())


PASSES = {
    "one": np.full(8_000, 3),
    "one after another": 1 + np.arange(8_000) // 3_000,
    "in turns": 1 + np.arange(8_000) % 2,
    "many": 1 + np.arange(8_000) // 100,
}


@pytest.mark.parametrize("most_mb", [800, 8], ids=["roomy", "tight"])
@pytest.mark.parametrize("name", PASSES)
def test_cells_are_those_of_points(name: str, most_mb: int, monkeypatch: pytest.MonkeyPatch) -> None:
    counted, count = [], Accumulator._count_buckets
    monkeypatch.setattr(Accumulator, "_count_buckets", lambda self, *a: (counted.append(a), count(self, *a)))
    p, fates = points(8_000, PASSES[name]), np.zeros(FATES, np.int64)
    accumulator = Accumulator(GRID, [TILE, OTHER, NOT_ACTIVE], np.unique(p.pass_id), most_bytes=most_mb << 20)
    accumulator.activate([TILE, OTHER])
    half = TilePoints(OTHER, **{k: v[::2] for k, v in vars(p).items() if isinstance(v, np.ndarray)})
    for _ in range(2):
        fill(accumulator, half, OTHER, fates)
    fill(accumulator, p, TILE, fates)
    found = accumulator.finish(TILE)
    assert found is not None and same(found[0], cells_of(p, GRID))
    assert found[1].first_epoch_gps_ns == p.epoch_gps_ns.min()
    assert found[1].last_epoch_gps_ns == p.epoch_gps_ns.max()
    twice = TilePoints(OTHER, **{k: np.tile(v, 2) for k, v in vars(half).items() if isinstance(v, np.ndarray)})
    other = accumulator.finish(OTHER)
    assert other is not None and same(other[0], cells_of(twice, GRID))
    assert fates[KEPT] == 2 * len(p) and fates[OUTSIDE] == 0
    assert bool(counted) == (most_mb == 8 and name == "in turns")
    assert accumulator._pool.buckets.held[TAKEN] == 0


def test_what_is_not_wanted_is_told_and_not_counted() -> None:
    passes = np.where(np.arange(1_000) < 100, 0, 5)
    p, fates = points(1_000, passes), np.zeros(FATES, np.int64)
    classes = np.where(np.arange(1_000) < 300, CLASS_TOO_HIGH, CLASS_KEPT).astype(np.uint8)
    accumulator = Accumulator(GRID, [TILE, OTHER, NOT_ACTIVE], [5])
    accumulator.activate([TILE])
    fill(accumulator, p, TILE, fates, classes)
    for tile in (NOT_ACTIVE, TileId(-1, 7), TileId(-3, 2_000_000)):
        fill(accumulator, p, tile, fates)
    found = accumulator.finish(TILE)
    kept = TilePoints(TILE, **{k: v[300:] for k, v in vars(p).items() if isinstance(v, np.ndarray)})
    assert found is not None and same(found[0], cells_of(kept, GRID))
    assert (fates[KEPT], fates[OUTSIDE]) == (700, 3_000)
    accumulator.activate([TILE])
    fill(accumulator, p, TILE, fates)
    accumulator.drop()
    accumulator.activate([TILE])
    assert accumulator.finish(TILE) is None
