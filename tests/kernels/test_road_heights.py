"""Kernels of the road's own frame and of its cross-sections, against NumPy, SciPy and plain geometry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from roadscan.condition.kernels.road_frame import place
from roadscan.condition.kernels.ruts import straightedge, stretched_wire, water, wire_places
from roadscan.condition.kernels.sampling import CellTable, factorise, sample
from roadscan.condition.kernels.steps import step_heights
from roadscan.condition.tasks.stretches import cell_table
from roadscan.core.grid import TileId
from roadscan.tiles.cells import TileCells

CELL_M = 0.05
RNG = np.random.default_rng(4)


def test_places_beside_an_arc_lie_on_arcs_of_their_own() -> None:
    radius = 60.0  # turns right: the centre lies to the right of the line
    angle = np.arange(40) / radius
    nodes = np.column_stack([radius * (1 - np.cos(angle)), radius * np.sin(angle)])
    station, offset = np.array([5.25, 20.0, 33.7]), np.array([0.0, 2.0, -3.0])
    out = np.empty((3, 4))
    place(nodes, 0, station, offset, out)
    true = np.column_stack([
        radius - (radius - offset) * np.cos(station / radius), (radius - offset) * np.sin(station / radius),
        np.sin(station / radius), np.cos(station / radius),
    ])  # fmt: skip
    np.testing.assert_allclose(out, true, atol=2e-6)
    beyond = np.empty((1, 4))
    place(nodes, 0, np.array([41.0]), np.zeros(1), beyond)
    end = np.empty((1, 4))
    place(nodes, 0, np.array([39.0]), np.zeros(1), end)
    np.testing.assert_allclose(beyond[0, :2], end[0, :2] + 2.0 * end[0, 2:])


def tile(column: int, row: int, height_of: object, share: float = 1.0) -> TileCells:
    """A tile of 1 m with cells of 50 mm whose heights follow a function of easting and northing."""
    edge = round(1.0 / CELL_M)
    rows, columns = (a.ravel() for a in np.indices((edge, edge)))
    kept = RNG.random(rows.size) <= share
    rows, columns = rows[kept], columns[kept]
    e, n = column + (columns + 0.5) * CELL_M, row + (rows + 0.5) * CELL_M
    height = height_of(e, n)  # type: ignore[operator]
    ones = np.ones(rows.size, np.uint16)
    return TileCells(
        TileId(column, row), edge, columns.astype(np.uint16), rows.astype(np.uint16), 4 * ones.astype(np.uint32),
        height, height, height, height, np.full(rows.size, 0.001, np.float32), ones.astype(np.float32), ones,
        np.arange(rows.size + 1, dtype=np.int32), ones,
    )  # fmt: skip


def heights(table: CellTable, places: np.ndarray, bend: bool = False) -> np.ndarray:
    out = np.empty((len(places), 3))
    sample(table, np.ascontiguousarray(places), 0.1, 0.1, bend, out)
    return out


@pytest.mark.slow
def test_heights_of_a_plane_are_exact_whatever_cells_lack_and_across_tiles() -> None:
    def plane(e: np.ndarray, n: np.ndarray) -> np.ndarray:
        return 500.0 + 0.03 * e - 0.05 * n

    tiles = [tile(c, r, plane, 0.8) for c in (-1, 0) for r in (7, 8)]
    table = cell_table(tiles, CELL_M)
    places = np.array([[0.0, 8.0, 0.6, 0.8], [-0.31, 7.77, 1.0, 0.0], [0.4, 8.003, 0.0, 1.0]])
    found = heights(table, places)
    np.testing.assert_allclose(found[:, 0], plane(places[:, 0], places[:, 1]), atol=1e-9)
    assert ((found[:, 2] > 0.5) & (found[:, 2] <= 1.0)).all()
    assert (found[:, 1] > 0.0).all()
    np.testing.assert_array_equal(heights(cell_table(tiles[::-1], CELL_M), places), found)


def test_of_a_dense_window_some_rows_and_columns_tell_the_same() -> None:
    table = cell_table([tile(c, r, lambda e, n: 2.0 + 0.03 * e - 0.05 * n) for c in (0, 1) for r in (0, 1)], CELL_M)
    out = np.empty((1, 3))
    sample(table, np.array([[1.02, 0.97, 0.8, 0.6]]), 0.7, 0.7, False, out)  # 784 cells
    assert out[0, 0] == pytest.approx(2.0 + 0.03 * 1.02 - 0.05 * 0.97, abs=1e-9)
    assert out[0, 2] == pytest.approx(1.0, abs=0.05)


def test_a_surface_that_bends_keeps_the_bottom_of_a_rut_and_an_outlier_is_left_out() -> None:
    def rut(e: np.ndarray, n: np.ndarray) -> np.ndarray:
        return 10.0 + 0.6 * (e - 0.5) ** 2

    table = cell_table([tile(0, 0, rut)], CELL_M)
    middle = np.array([[0.5, 0.5, 0.0, 1.0]])
    assert heights(table, middle, True)[0, 0] == pytest.approx(10.0, abs=1e-9)
    assert heights(table, middle)[0, 0] > 10.0005
    spoilt = tile(0, 0, rut)
    spoilt.height_robust_m[(spoilt.row == 10) & (spoilt.column == 10)] += 0.3
    assert heights(cell_table([spoilt], CELL_M), middle, True)[0, 0] == pytest.approx(10.0, abs=5e-4)


def test_nothing_is_told_where_cells_lie_on_one_side() -> None:
    table = cell_table([tile(0, 0, lambda e, _: e)], CELL_M)
    found = heights(table, np.array([[-0.02, 0.5, 0.0, 1.0], [-3.0, 0.5, 0.0, 1.0], [0.12, 0.5, 0.0, 1.0]]))
    assert np.isnan(found[:2, 0]).all() and found[1, 2] == 0.0
    assert found[2, 0] == pytest.approx(0.12)
    assert np.isnan(heights(cell_table([], CELL_M), np.array([[0.0, 0.0, 0.0, 1.0]]))[0, 0])


def test_the_standard_deviation_is_that_of_repeated_measurements() -> None:
    rng = np.random.default_rng(1)
    middle = np.array([[0.5, 0.5, 0.28, 0.96]])
    found = []
    for _ in range(150):
        made = tile(0, 0, lambda e, n: 3.0 + rng.normal(0.0, 0.0005, e.size))
        found.append(heights(cell_table([made], CELL_M), middle)[0])
    height, sigma = np.array(found)[:, 0], np.array(found)[:, 1]
    assert np.mean(sigma) == pytest.approx(np.std(height), rel=0.25)


def test_the_wire_is_the_convex_hull() -> None:
    x = np.linspace(-1.75, 1.75, 71)
    h = RNG.normal(0.0, 0.01, 71)
    out = np.zeros(71, np.int64)
    count = wire_places(x, h, out)
    vertices = ConvexHull(np.column_stack([x, h])).vertices
    tops = [k for k in vertices if h[k] >= np.interp(x[k], [x[0], x[-1]], [h[0], h[-1]]) - 1e-12]
    assert out[:count].tolist() == sorted(tops)
    figures = np.zeros((1, 2, 5))
    stretched_wire(x, h[None], figures)
    gap = np.interp(x, x[out[:count]], h[out[:count]]) - h
    for half, own in enumerate((x < 0.0, x >= 0.0)):
        assert figures[0, half, 0] == pytest.approx(gap[own].max(), rel=1e-3)
        assert figures[0, half, 3] == x[own][np.argmax(gap[own])]
    assert figures[0, :, 2].sum() == pytest.approx(np.trapezoid(gap, x), rel=1e-3)


def two_ruts(left_m: float, right_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A lane with two ruts of 0.8 m as the simulator makes them, on a slope."""
    x = np.linspace(-1.75, 1.75, 141)
    h = -0.02 * x
    for middle, depth in ((-0.85, left_m), (0.85, right_m)):
        wall = np.clip(1.0 - ((x - middle) / 0.4) ** 2, 0.0, None)
        h = h - depth * wall**3
    return x, h


def test_ruts_below_wire_and_straightedge() -> None:
    x, h = two_ruts(0.012, 0.025)
    figures, edge = np.zeros((1, 2, 5)), np.zeros((1, 2))
    stretched_wire(x, h[None], figures)
    assert figures[0, :, 0] == pytest.approx([0.012, 0.025], abs=2e-5)
    tenth = 0.8 * np.sqrt(1.0 - 0.1 ** (1 / 3))  # where (1 − x²)³ is a tenth
    assert figures[0, :, 1] == pytest.approx([tenth, tenth], abs=0.06)
    area = [depth * 0.8 * 16 / 35 for depth in (0.012, 0.025)]  # integral of (1 − x²)³
    assert figures[0, :, 2] == pytest.approx(area, rel=0.01)
    for length in (1.2, 2.0, 3.0):
        straightedge(x, h[None], length, edge)
        assert edge[0] == pytest.approx([0.012, 0.025], abs=3e-5), length
    straightedge(x, h[None], 0.4, edge)
    assert (edge[0] < [0.010, 0.021]).all()  # too short to span them


def test_water_stands_up_to_the_lower_side() -> None:
    h = np.array([[3.0, 1.0, 2.0, 0.0, 1.5, 0.5, 0.7]])
    out = np.zeros_like(h)
    water(h, out)
    assert out.tolist() == [[0.0, 1.0, 0.0, 1.5, 0.0, pytest.approx(0.2), 0.0]]


def test_a_step_is_told_with_its_height() -> None:
    x = np.arange(0.0, 4.0, 0.05)
    h = 0.02 * x + np.where(x > 2.01, 0.005, 0.0)
    out = np.zeros((x.size, 3))
    step_heights(x, h, np.full(x.size, 1e-4), (0.1, 0.6), out)
    k = int(np.nanargmax(np.abs(out[:, 0])))
    assert x[k] == pytest.approx(2.0, abs=0.06)
    assert out[k, 0] == pytest.approx(0.005, abs=1e-9)
    assert out[k, 2] == pytest.approx(0.005, rel=0.05)
    assert np.isnan(out[:2]).all() and 0.0 < out[k, 1] < 0.001


def test_a_factor_is_that_of_cholesky_as_far_as_rows_are_independent() -> None:
    points = np.random.default_rng(2).standard_normal((30, 4))
    normal, factor = points.T @ points, np.zeros((4, 4))
    assert factorise(normal, 4, factor) == 4
    np.testing.assert_allclose(factor, np.linalg.cholesky(normal), rtol=1e-12)
    points[:, 2] = points[:, 0] + points[:, 1]
    assert factorise(points.T @ points, 4, factor) == 2
