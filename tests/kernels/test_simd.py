"""Instructions on vector registers against NumPy, in tiny kernels: they have no entry for Python."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from roadscan.compute.kernel_options import bare
from roadscan.compute.kernels.column_statistics import LANES, medians_of_16, statistics_of_64, store_group
from roadscan.compute.kernels.covariances import LANES as EIGHT
from roadscan.compute.kernels.covariances import PEAK, RISE, TOGETHER, covariances, factorise, slope_covariances
from roadscan.compute.kernels.covariances import REACH as COVARIANCE_REACH
from roadscan.compute.kernels.patch_heights import POINTS, SCALE, heights_of_eight
from roadscan.compute.kernels.slots import (
    LIGHT_SHIFT,
    MARK_SHIFT,
    SLOT_HEIGHTS,
    SLOT_SIZE,
    VECTOR,
    chained_cells,
    open_group,
    prefetch,
    put_apart,
    store_heights,
)
from roadscan.compute.kernels.streaks import AT_ONCE, find_known_slots, find_streaks, lowest_bit, sum_up
from roadscan.tiles.kernels.cell_statistics import CellColumns


@bare
def stored(heights, first, base, slots, at):
    prefetch(slots, np.uint64(at))
    store_heights(heights, np.uint64(first), np.int32(base), slots, np.uint64(at))


def test_eight_heights_are_stored_less_their_base() -> None:
    heights, slots = np.arange(1000, 1020, dtype=np.int32), np.full(SLOT_SIZE, 7, np.int16)
    stored(heights, 3, 1010, slots, 5)
    assert slots[5 : 5 + VECTOR].tolist() == list(range(-7, 1)) and set(slots[:5]) | set(slots[13:]) == {7}


@pytest.mark.parametrize("n", [1, 16, 17, 100])
def test_streaks_are_runs_of_equal_cells(n: int) -> None:
    rng = np.random.default_rng(n)
    column, row = (np.repeat(rng.integers(0, 3, n), rng.integers(1, 9, n))[:n].astype(np.int32) for _ in range(2))
    starts, columns, rows = np.zeros(n + 1, np.uint32), *(np.zeros(n + 16, np.int32) for _ in range(2))
    count = int(find_streaks(column, row, starts, columns, rows))
    begins = np.flatnonzero(np.append(True, (np.diff(column) != 0) | (np.diff(row) != 0)))
    assert starts[: count + 1].tolist() == [*begins, n]
    assert columns[:count].tolist() == column[begins].tolist() and rows[:count].tolist() == row[begins].tolist()


@pytest.mark.parametrize("n", [0, 15, 16, 50])
def test_sums_of_intensities(n: int) -> None:
    intensity, sums = np.random.default_rng(n).integers(0, 256, n).astype(np.uint8), np.zeros(n + 1, np.uint32)
    sum_up(intensity, sums)
    assert sums.tolist() == [0, *np.cumsum(intensity)]


@bare
def lowest(bits):
    return lowest_bit(np.uint64(bits))


def test_lowest_bit() -> None:
    assert [int(lowest(np.uint64(bits))) for bits in (1, 12, 1 << 63)] == [0, 2, 63]


@bare
def known(columns, rows, count, tile, table, slots):
    return find_known_slots(
        columns, rows, np.uint64(0), np.uint64(count), tile, np.int32(-9), table, np.uint64(1), slots
    )


def test_known_slots_of_streaks() -> None:
    """What is not known is told bit by bit; a machine that cannot gather knows of none."""
    columns, rows = np.full(AT_ONCE, -9, np.int32), np.zeros(AT_ONCE, np.int32)
    columns[:4], rows[:4] = [100, 117, 131, 500], [200, 201, 200, 200]
    table = np.array([-1, 4, -1, -1, 6, -1, -1], np.int32)  # from element 1: two groups a row of a tile of 32 cells
    tile = tuple(np.int32(v) for v in (100, 200, 32, 2))
    slots = np.full(AT_ONCE, 77, np.int32)
    unknown = int(known(columns, rows, 5, tile, table, slots))
    expected, gathered = [4 * 16 + 0, 6 * 16 + 1, -1, -1, -1], unknown != 0b1111
    assert unknown == (0b1100 if gathered else 0b1111)
    assert slots[:5].tolist() == (expected if gathered else [-1] * 5)


@bare
def opened(slots, chain, pairs, counts, light, marks, heights):
    open_group(slots, np.uint64(0), pairs, counts, light, marks)
    put_apart(pairs, heights)
    return chained_cells(chain, np.uint64(0))


def test_a_group_of_slots_is_turned_into_a_table() -> None:
    rng = np.random.default_rng(0)
    own = rng.integers(-32_000, 32_000, (LANES, SLOT_SIZE)).astype(np.int16)
    count, shine, mark = rng.integers(0, 29, LANES), rng.integers(0, 1 << 21, LANES), rng.integers(0, 1 << 24, LANES)
    own.view(np.uint64)[:, -1] = count | shine << LIGHT_SHIFT | mark << MARK_SHIFT
    pairs, heights = np.zeros((SLOT_HEIGHTS // 2, LANES), np.int32), np.zeros((64, LANES), np.int32)
    rows = np.zeros((3, LANES), np.int32)
    chain = np.full(LANES, -1, np.int32)
    chain[[2, 15]] = 3
    assert int(opened(own.reshape(-1), chain, pairs, *rows, heights)) == 1 << 2 | 1 << 15
    assert (heights[:SLOT_HEIGHTS] == own[:, :SLOT_HEIGHTS].T).all()
    assert rows.tolist() == [count.tolist(), shine.tolist(), mark.tolist()]


def test_medians_and_statistics_of_columns() -> None:
    rng = np.random.default_rng(1)
    heights = rng.integers(-900, 900, (64, LANES)).astype(np.int32)
    counts = np.arange(1, LANES + 1, dtype=np.int32)
    light, bases = rng.integers(0, 9000, (2, LANES)).astype(np.int32)
    median, away, out = np.zeros(LANES, np.int32), np.zeros(LANES, np.int32), np.zeros((6, LANES))
    medians_of_16(heights[:16].copy(), counts, median, away)
    statistics_of_64(heights, counts, light, bases, 50.0, 1e-5, out)
    for lane, n in enumerate(counts):
        own = np.sort(heights[:n, lane])
        middle = own[(n - 1) // 2]
        distance = np.sort(np.abs(own - middle))
        assert (median[lane], away[lane]) == (middle, distance[(n - 1) // 2])
        near = own[np.abs(own - middle) <= max(3 * 1.4826 * away[lane], 50.0)]
        expected = np.array([own.mean(), near.mean(), own[0], own[-1]]) + bases[lane]
        np.testing.assert_allclose(out[:, lane], [*expected * 1e-5, own.std() * 1e-5, light[lane] / n], rtol=1e-9)


@bare
def put(out, counts, columns):
    store_group(
        out, counts, np.uint16(48), np.uint16(9), np.uint64(2), np.int32(5), np.uint16(77), columns
    )  # fmt: skip


def test_statistics_of_sixteen_cells_are_stored_behind_one_another() -> None:
    kinds = np.uint16, np.uint16, np.uint32, *([np.float64] * 4), np.float32, np.float32, np.int32, np.uint16
    columns = CellColumns(*(np.zeros(40, kind) for kind in kinds))
    out, counts = np.random.default_rng(2).normal(size=(6, LANES)), np.arange(LANES, dtype=np.int32)
    put(out, counts, columns)
    own = slice(2, 2 + LANES)
    assert columns.column[own].tolist() == list(range(48, 64)) and set(columns.row[own]) == {9}
    assert columns.readings[own].tolist() == counts.tolist()
    for values, row in zip(columns[3:9], out, strict=True):
        assert (values[own] == row.astype(values.dtype)).all() and values[18] == 0
    assert columns.pass_offsets[own].tolist() == list(range(5, 21))
    assert columns.pass_ids.tolist() == [0] * 5 + [77] * 16 + [0] * 19


def test_factors_of_eight_matrices_side_by_side() -> None:
    """Pivots and what is left are those of NumPy's elimination."""
    size, rng = 5, np.random.default_rng(3)
    made = rng.normal(size=(EIGHT, size, size))
    matrices = made @ made.swapaxes(1, 2) + size * np.eye(size)
    system = np.zeros((size + TOGETHER, size, EIGHT))
    system[:size] = matrices.transpose(1, 2, 0)
    root, other, inverse, product = np.zeros_like(system), *np.zeros((2, size, EIGHT)), np.zeros(EIGHT)
    factorise(system, root, other, inverse, product, size - 1, size)
    for lane, matrix in enumerate(matrices):
        pivots = np.diag(np.linalg.cholesky(matrix)) ** 2
        np.testing.assert_allclose(1.0 / inverse[: size - 1, lane], pivots[:-1], rtol=1e-10)
        np.testing.assert_allclose(product[lane], np.prod(pivots[: size - 2]), rtol=1e-10)


def wendland(distance):
    """Wendland's C⁴ function, scaled as the module says."""
    d = np.minimum(distance / COVARIANCE_REACH, 1.0)
    return PEAK * (1 - d) ** 6 * (35 * d**2 + 18 * d + 3) / 3


def test_covariances_are_wendlands_function() -> None:
    u, v = np.random.default_rng(4).uniform(-8, 8, (2, 4, EIGHT))
    out, slopes = np.zeros((4, 4, EIGHT)), np.zeros((2, 4, EIGHT))
    covariances(u, v, out, 4)
    slope_covariances(u, v, *slopes, 4)
    step = 1e-5
    for p in range(4):
        for q in range(p):
            np.testing.assert_allclose(out[p, q], wendland(np.hypot(u[p] - u[q], v[p] - v[q])), rtol=1e-12, atol=1e-9)
        by_u = (wendland(np.hypot(u[p] - step, v[p])) - wendland(np.hypot(u[p] + step, v[p]))) / (2 * step)
        np.testing.assert_allclose(slopes[0, p], by_u, rtol=1e-6, atol=1e-6 * RISE)


class _Patch(NamedTuple):
    edges: np.ndarray
    patches: np.ndarray


def plane_patch() -> _Patch:
    """A triangle (0, 0), (4, 0), (0, 4) whose control points all lie on z = 1 + x / 4 + y / 2."""
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    c = corners.mean(axis=0)
    places = [*corners]
    for k in range(3):
        i, j = corners[(k + 1) % 3], corners[(k + 2) % 3]
        places += [(2 * i + j) / 3, (i + 2 * j) / 3]
    places += [(2 * corners[k] + c) / 3 for k in range(3)]
    places += [(corners[(k + 1) % 3] + corners[(k + 2) % 3] + c) / 3 for k in range(3)]
    places += [(corners[k] + 2 * c) / 3 for k in range(3)] + [c]
    heights = np.array([1.0 + x / 4 + y / 2 for x, y in places])
    edges = []
    for k in range(3):
        i, j = corners[(k + 1) % 3], corners[(k + 2) % 3]
        edges += [*i, *(j - i)]
    return _Patch(np.array([*edges, 1.0 / 16.0]), heights)


@bare
def eight(edges, patches, x, y, heights):
    heights_of_eight(edges, patches, np.uint64(0), x, y, heights, np.uint64(0))


def test_heights_of_a_patch_at_eight_nodes() -> None:
    patch = plane_patch()
    assert patch.patches.size == POINTS and patch.edges.size == SCALE + 1
    x, y = np.array([0.5, 1, 2, 0.1, 3, -1, 1, 2.0]), np.array([0.5, 1, 1, 3.5, 0.2, 1, -0.5, 2.5])
    heights = np.zeros(8)
    eight(*patch, x, y, heights)
    inside = (x >= 0) & (y >= 0) & (x + y <= 4)
    np.testing.assert_allclose(heights[inside], (1.0 + x / 4 + y / 2)[inside], rtol=1e-13)
    assert np.isnan(heights[~inside]).all() and inside.sum() == 5
