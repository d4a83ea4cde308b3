"""Readings into cells, statistics of cells and what is made of them: tiny tiles against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.compute.kernels.arrays import BINS, bounds_of, copy_values, smallest, sort, sort_few
from roadscan.compute.kernels.column_statistics import LANES
from roadscan.compute.kernels.slots import SLOT_SIZE, VECTOR
from roadscan.georeference.kernels.readings import FATES, KEPT
from roadscan.georeference.kernels.timed_readings import CHUNK
from roadscan.tiles.kernels import cell_statistics
from roadscan.tiles.kernels.accumulate import (
    PIECE,
    Heights,
    Pool,
    accumulate,
    accumulate_cells,
    accumulate_points,
    find_cells,
    work_arrays,
)
from roadscan.tiles.kernels.bucket_statistics import bucket_points, finish_buckets, row_arrays
from roadscan.tiles.kernels.cell_statistics import (
    AHEAD,
    CellColumns,
    find_groups,
    finish_cells,
    select_arrays,
    statistics_of_full,
)
from roadscan.tiles.kernels.grey_pictures import grey_intensity, shade_cells, shade_raster
from roadscan.tiles.kernels.pyramid import Cells, Levels, Pixels, reduce_cells, run_end
from roadscan.tiles.kernels.row_buckets import (
    BLOCK,
    PASS,
    TAKEN,
    ActiveTiles,
    Buckets,
    free_row,
    put_in_own_buckets,
    sizes_of_rows,
    take_readings,
)

EDGE, CELL = 20, 500
GROUPS = EDGE * 2
ELEMENTS = 2 * PIECE + 64
FLOOR, QUANTUM_M = 100.0, 1e-5


def empty_tile() -> tuple[ActiveTiles, Pool]:
    """One active tile of 20 × 20 cells, and memory."""
    active = ActiveTiles(
        np.zeros((1, 1), np.int32), (0, 0), CELL, EDGE, np.full((1, GROUPS), -1, np.int32),
        np.zeros((1, EDGE), np.int32), np.zeros((1, 2), np.int64), np.zeros((1, 2)),
    )  # fmt: skip
    slots = np.zeros(ELEMENTS * LANES * SLOT_SIZE, np.int16)
    of_slots = [np.zeros(ELEMENTS * LANES, np.int32) for _ in range(3)]
    free = np.arange(ELEMENTS, dtype=np.int32)
    return active, Pool(slots, slots.view(np.uint64), *of_slots[:2], free, of_slots[2], np.zeros(2, np.int64))


def empty_buckets(blocks: int = 200) -> Buckets:
    before, sizes, owners = (np.zeros(blocks, np.int32) for _ in range(3))
    held = np.zeros(2, np.int64)
    held[PASS] = -1
    return Buckets(
        np.zeros(blocks * BLOCK, np.uint64), before, sizes, owners, np.arange(blocks, dtype=np.int32), held
    )  # fmt: skip


def points(n: int = 600) -> tuple[np.ndarray, ...]:
    """x, y, height (quanta), pass, intensity: cells of 100, of 37 and of few points, some heights far off."""
    rng = np.random.default_rng(n)
    x, y = rng.integers(0, EDGE * CELL, (2, n)).astype(np.int32)
    x[:100], y[:100] = 10, 10
    x[100:137], y[100:137] = 2_600, 10
    height = rng.integers(-800, 800, n).astype(np.int32) + np.where(rng.random(n) < 0.05, 90_000, 0).astype(np.int32)
    return x, y, height, np.sort(rng.integers(0, 2, n)).astype(np.int32), rng.integers(0, 65_536, n).astype(np.uint16)


def columns_of(cells: int) -> CellColumns:
    kinds = np.uint16, np.uint16, np.uint32, *([np.float64] * 4), np.float32, np.float32
    return CellColumns(
        *(np.zeros(cells, kind) for kind in kinds), np.zeros(cells + 1, np.int32), np.zeros(2 * cells, np.uint16)
    )  # fmt: skip


def check(columns: CellColumns, count: int, p: tuple[np.ndarray, ...]) -> None:
    """Hold the statistics of cells against NumPy's of the points."""
    x, y, height, passes, intensity = p
    cell = y // CELL * EDGE + x // CELL
    assert (columns.row[:count].astype(int) * EDGE + columns.column[:count]).tolist() == np.unique(cell).tolist()
    for k, own in enumerate(np.unique(cell)):
        h, light = np.sort(height[cell == own]).astype(float), intensity[cell == own]
        middle = h[(h.size - 1) // 2]
        away = np.sort(np.abs(h - middle))[(h.size - 1) // 2]
        near = h[np.abs(h - middle) <= max(3 * 1.4826 * away, FLOOR)]
        found = [float(values[k]) for values in columns[2:9]]
        expected = [h.size, *(v * QUANTUM_M for v in (h.mean(), near.mean(), h[0], h[-1], h.std())), light.mean()]
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
        ids = columns.pass_ids[columns.pass_offsets[k] : columns.pass_offsets[k + 1]]
        assert ids.tolist() == [(4, 9)[n] for n in np.unique(passes[cell == own])]


NUMBERS = np.array([4, 9], np.uint16)


def finished(active: ActiveTiles, pool: Pool) -> tuple[CellColumns, int]:
    found = np.zeros(GROUPS + AHEAD, np.int32)
    taken, most = find_groups(active.groups[0], pool.chain, found)
    columns = columns_of(taken * LANES)
    work = cell_statistics.work_arrays(int(most) * 28)
    count, _ = finish_cells(
        active.groups[0], found, taken, EDGE, pool, FLOOR, QUANTUM_M, NUMBERS, work, columns
    )  # fmt: skip
    assert (active.groups == -1).all()
    return columns, int(count)


def test_points_become_cells_and_give_their_memory_back() -> None:
    active, pool = empty_tile()
    p = points()
    assert accumulate_points(*p, active, pool, work_arrays(1), 0) == p[0].size
    assert pool.held[0] > 0
    check(*finished(active, pool), p)
    assert pool.held[0] * LANES == pool.held[1]  # but for elements that became spare slots


def test_readings_that_know_their_cells_become_the_same() -> None:
    active, pool = empty_tile()
    x, y, height, passes, intensity = p = points()
    column, row = np.zeros(x.size, np.int32), np.zeros(x.size, np.int32)
    find_cells(x, y, 1.0 / CELL, column, row)
    assert column.tolist() == (x // CELL).tolist() and row.tolist() == (y // CELL).tolist()
    readings, fates = Heights(column, row, np.append(height, np.zeros(VECTOR, np.int32))), np.zeros(FATES, np.int64)
    assert accumulate_cells(readings, passes, intensity, active, pool, work_arrays(1), fates, 0) == x.size
    assert fates[KEPT] == x.size
    check(*finished(active, pool), p)


def test_a_streak_is_counted_once_and_others_lie_outside() -> None:
    active, pool = empty_tile()
    column = np.array([3] * 20 + [EDGE] * 4, np.int32)
    readings = Heights(column, np.full(24, 2, np.int32), np.full(24 + VECTOR, 50, np.int32))
    work = work_arrays(1)
    assert (
        accumulate(readings, (50, 50), np.full(24, 2, np.uint8), np.uint32(257), np.int32(1), work, active, pool) == 20
    )
    assert work.touched.tolist() == [1]
    columns, count = finished(active, pool)
    assert (count, columns.readings[0], columns.intensity_mean[0], columns.pass_ids[0]) == (1, 20, 514.0, 9)


def test_points_in_buckets_make_the_same_cells() -> None:
    active, _ = empty_tile()
    p, ends = points(), active.ends[0]
    assert bucket_points(*p, CELL, ends, empty_buckets(10), 0) == 0  # too few blocks
    buckets, columns = empty_buckets(CHUNK + 200), columns_of(EDGE * EDGE)
    assert bucket_points(*p, CELL, ends, buckets, 0) == p[0].size
    count, _ = finish_buckets(ends, buckets, FLOOR, QUANTUM_M, NUMBERS, row_arrays(EDGE, 2, 600), columns)
    check(columns, int(count), p)


def test_values_are_copied_as_far_as_there_is_room() -> None:
    out = np.zeros(3)
    copy_values(np.arange(5, dtype=np.uint32), out)
    assert out.tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("way", ["statistics", "readings"])
def test_buckets_hand_out_what_was_put_in(way: str) -> None:
    active, _ = empty_tile()
    buckets, (x, y, height, passes, intensity) = empty_buckets(), points()
    ends = active.ends[0]
    for number in (0, 1):
        own = passes == number
        at = (a[own] for a in ((x // CELL).astype(np.int32), (y // CELL).astype(np.int32), height, intensity))
        put_in_own_buckets(*at, np.int32(number), ends, buckets)
    total, most = sizes_of_rows(ends, buckets.before, buckets.sizes)
    assert (total, most) == (x.size, np.bincount(y // CELL).max())
    if way == "statistics":
        columns = columns_of(EDGE * EDGE)
        work = row_arrays(EDGE, 2, int(most))
        count, _ = finish_buckets(ends, buckets, FLOOR, QUANTUM_M, NUMBERS, work, columns)
        check(columns, int(count), (x, y, height, passes, intensity))
    else:
        n = x.size
        readings = Heights(*(np.zeros(n, np.int32) for _ in range(3)))
        found, light = np.zeros(n, np.int32), np.zeros(n, np.uint16)
        take_readings(ends, buckets, 100, 200, readings, found, light)
        one = sorted(zip(*(a.tolist() for a in (*readings, found, light)), strict=True))
        expected = (100 + x // CELL, 200 + y // CELL, height, passes, intensity)
        assert one == sorted(zip(*(a.tolist() for a in expected), strict=True))
    assert buckets.held[TAKEN] == 0 and not ends.any()


def test_a_row_gives_its_blocks_back() -> None:
    buckets, ends = empty_buckets(), np.zeros(EDGE, np.int32)
    many = np.zeros(3 * BLOCK + 1, np.int32)
    put_in_own_buckets(many, many, many, many.astype(np.uint16), np.int32(0), ends, buckets)
    assert buckets.held[TAKEN] == 4
    free_row(ends[0], buckets)
    assert buckets.held[TAKEN] == 0 and sorted(buckets.free) == list(range(200))


def test_a_cell_of_many_heights() -> None:
    rng = np.random.default_rng(7)
    heights, out = rng.integers(-(10**6), 10**6, 1001).astype(np.int32), np.zeros((6, LANES))
    statistics_of_full(heights, 5005, 50.0, 1.0, select_arrays(1001), out, 3)
    own = np.sort(heights).astype(float)
    away = np.abs(own - own[500])
    near = own[away <= np.floor(3 * 1.4826 * np.sort(away)[500])]
    np.testing.assert_allclose(out[:, 3], [own.mean(), near.mean(), own[0], own[-1], own.std(), 5.0], rtol=1e-9)


@pytest.mark.parametrize("n", [1, 48, 49, 3000])
def test_order_statistics(n: int) -> None:
    values = np.random.default_rng(n).integers(-(2**31), 2**31, n).astype(np.int32)
    values[: n // 3] = values[0]
    assert bounds_of(values) == (values.min(), values.max())
    for k in {0, n // 2, n - 1}:
        assert smallest(values.copy(), k, np.zeros(BINS, np.int32), np.zeros(n + 1, np.int32)) == np.sort(values)[k]
    whole = values.astype(np.int64)
    sort(whole)
    assert (whole == np.sort(values)).all()
    some = values[:20].copy()
    sort_few(some)
    assert some.tolist() == sorted(values[:20])


def test_cells_side_by_side() -> None:
    column, row = np.array([3, 4, 5, 7, 8, 9], np.uint16), np.array([1, 1, 1, 1, 1, 2], np.uint16)
    assert [run_end(column, row, start, 6) for start in range(6)] == [3, 3, 3, 5, 5, 6]
    assert run_end(column, row, 0, 2) == 2


def test_grey_of_intensities() -> None:
    picture = np.zeros((2, 3), np.uint8)
    column, row = np.array([5, 6, 7], np.uint16), np.array([8, 8, 9], np.uint16)
    grey_intensity(column, row, np.array([0, 150, 900], np.float32), 100.0, 200.0, 5, 9, picture)
    assert picture.tolist() == [[0, 0, 255], [1, 128, 0]]


def test_shade_of_a_slope_is_lamberts() -> None:
    """A plane that rises 1 in 2 to the east, lit from the west at 45°."""
    row, column = (a.ravel().astype(np.uint16) for a in np.mgrid[0:4, 0:5])
    light = np.float32(-np.sqrt(0.5)), np.float32(0.0), np.float32(np.sqrt(0.5))
    picture = np.zeros((4, 5), np.uint8)
    shade_cells(
        column, row, 100.0 + 0.5 * column, 100.0, np.float32(1 / 8), *light, 0, 3, np.zeros((3, 7), np.float32), picture
    )  # fmt: skip
    bright = (0.5 * np.sqrt(0.5) + np.sqrt(0.5)) / np.sqrt(1.25)
    whole, heights = np.zeros((4, 5), np.uint8), np.full((6, 7), np.nan)
    heights[1:-1, 1:-1] = 100.0 + 0.5 * np.arange(5)
    shade_raster(heights, 1 / 8, 1 / 8, *map(float, light), whole)
    for one in (picture, whole):
        away = np.abs(one.astype(int) - (1 + 254 * bright))
        away[[0, 0, -1, -1], [0, -1, 0, -1]] = 0  # there two of the eight neighbours and their opposites are missing
        assert away.max() <= 1


@pytest.mark.parametrize("cover", [1.0, 0.2])
def test_pixels_of_overviews(cover: float) -> None:
    rng = np.random.default_rng(9)
    row, column = (a.astype(np.uint16) for a in np.nonzero(rng.random((16, 16)) < cover))
    n = row.size
    count, light = rng.integers(1, 9, n).astype(np.uint32), rng.integers(0, 200, n).astype(np.float32)
    height = 70.0 + rng.integers(-(2**20), 2**20, n) / 2.0**20
    factors, edges = np.array([2, 8]), np.array([8, 2])
    levels = Levels(factors, edges, np.array([0, 64]), np.zeros(2, np.int64))
    kinds = np.uint16, np.uint16, np.uint32, np.uint32, np.float64, np.float32
    pixels = Pixels(*(np.zeros(68, kind) for kind in kinds))
    height.flags.writeable = False
    reduce_cells(Cells(column, row, height, light, count), 70.0, levels, np.zeros((2, 4, 8)), pixels)
    for start, factor, edge, written in zip((0, 64), factors, edges, levels.written, strict=True):
        own = slice(start, start + written)
        pixel = row // factor * edge + column // factor
        assert (pixels.row[own].astype(int) * edge + pixels.column[own]).tolist() == np.unique(pixel).tolist()
        for k, p in enumerate(np.unique(pixel)):
            mine, at = pixel == p, start + k
            assert (pixels.cells[at], pixels.readings[at]) == (mine.sum(), count[mine].sum())
            np.testing.assert_allclose(pixels.height_m[at], height[mine].mean(), rtol=1e-13)
            np.testing.assert_allclose(pixels.intensity[at], np.average(light[mine], weights=count[mine]), rtol=1e-6)
