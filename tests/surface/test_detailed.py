"""The detailed model: polynomials, smoothness, SciPy's interpolant, seams, poor input."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CloughTocher2DInterpolator, RBFInterpolator
from scipy.spatial import Delaunay

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.grid import Bounds
from roadscan.surface.clough_tocher import CubicSurface, cubic_surface
from roadscan.surface.normals import slopes_at
from roadscan.surface.reconstruction import DetailedSettings
from roadscan.surface.tile import GridWindow
from roadscan.surface.triangulation import sites, triangulate
from tests.surface.detailed_surface import detailed_surface, surface_through

UNIT = GridWindow(0, 0, 80, 60, 1.0 / 80, 1.0 / 60)
EAST, NORTH = np.meshgrid(*UNIT.nodes_m())


def quadratic(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 1.0 + 2.0 * x - y + 3.0 * x * x - x * y + 0.5 * y * y


def cubic(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return quadratic(x, y) + x**3 - 2.0 * x * x * y + 0.3 * x * y * y - y**3


def cubic_slopes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    east = 2.0 + 6.0 * x - y + 3.0 * x * x - 4.0 * x * y + 0.3 * y * y
    return np.column_stack([east, -1.0 - x + y - 2.0 * x * x + 0.6 * x * y - 3.0 * y * y])


def franke(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Franke (1979), the test of scattered data interpolation."""
    return (
        0.75 * np.exp(-((9 * x - 2) ** 2 + (9 * y - 2) ** 2) / 4)
        + 0.75 * np.exp(-((9 * x + 1) ** 2) / 49 - (9 * y + 1) / 10)
        + 0.5 * np.exp(-((9 * x - 7) ** 2 + (9 * y - 3) ** 2) / 4)
        - 0.2 * np.exp(-((9 * x - 4) ** 2) - (9 * y - 7) ** 2)
    )


def scattered(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 1.0, (count, 2))


def with_slopes(places: np.ndarray, heights: np.ndarray, slopes: object, gap_m: float = 0.5) -> CubicSurface:
    found = sites(np.column_stack([places, heights]))
    return cubic_surface(found, triangulate(found, gap_m), slopes(*at(found)))  # type: ignore[operator]


def at(found: object) -> tuple[np.ndarray, np.ndarray]:
    return found.x_steps / 2.0**36, found.y_steps / 2.0**36  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["quadratic", "cubic"])
def test_a_quadratic_comes_back_from_its_points_alone(kind: str) -> None:
    places = scattered(300, 0) * [1.0, 0.2] + [0.0, 0.4]  # spacing five times larger one way
    heights = detailed_surface(
        np.column_stack([places, quadratic(*places.T)]), UNIT, DetailedSettings(max_gap_m=0.2, slopes=kind)
    )
    seen = np.isfinite(heights)
    assert seen.mean() > 0.15
    np.testing.assert_allclose(heights[seen], quadratic(EAST, NORTH)[seen], atol=1e-9)


def test_a_cubic_comes_back_from_its_points_and_slopes() -> None:
    places = scattered(200, 1)
    heights = with_slopes(places, cubic(*places.T), cubic_slopes).heights(UNIT)
    seen = np.isfinite(heights)
    assert seen.mean() > 0.8
    np.testing.assert_allclose(heights[seen], cubic(EAST, NORTH)[seen], atol=1e-9)


def test_noise_is_not_multiplied_by_thin_triangles() -> None:
    rng = np.random.default_rng(8)  # profiles 40 mm apart, points 2 mm apart, scatter 20 µm
    x, y = np.meshgrid(np.arange(150) * 0.002, np.arange(8) * 0.04)
    places = np.column_stack([x.ravel(), y.ravel() + 0.01 * x.ravel()]) + rng.normal(0.0, 2e-5, (x.size, 2))
    points = np.column_stack([places, rng.normal(0.0, 0.0005, x.size)])
    heights = detailed_surface(points, GridWindow(0, 0, 300, 140, 0.001, 0.002), DetailedSettings(slopes="cubic"))
    assert np.isfinite(heights).mean() > 0.9
    assert np.nanmax(np.abs(heights)) < 5 * 0.0005


def test_one_triangle_alone_keeps_a_quadratic() -> None:
    places = np.array([[0.1, 0.1], [0.9, 0.2], [0.3, 0.9]])
    surface = with_slopes(
        places,
        quadratic(*places.T),
        lambda x, y: np.column_stack([2.0 + 6.0 * x - y, -1.0 - x + y]),
        gap_m=5.0,
    )
    heights = surface.heights(UNIT)
    seen = np.isfinite(heights)
    np.testing.assert_allclose(heights[seen], quadratic(EAST, NORTH)[seen], atol=1e-12)


def bezier(patch: np.ndarray, k: int, corners: np.ndarray, place: np.ndarray) -> tuple[float, np.ndarray]:
    """Height and gradient of the cubic of edge k by de Casteljau; table: ``kernels/surface/clough_tocher``."""
    i, j, c = (k + 1) % 3, (k + 2) % 3, corners.mean(axis=0)
    net = {
        (3, 0, 0): patch[i], (0, 3, 0): patch[j], (0, 0, 3): patch[18],
        (2, 1, 0): patch[3 + 2 * k], (1, 2, 0): patch[4 + 2 * k],
        (2, 0, 1): patch[9 + i], (0, 2, 1): patch[9 + j], (1, 1, 1): patch[12 + k],
        (1, 0, 2): patch[15 + i], (0, 1, 2): patch[15 + j],
    }  # fmt: skip
    system = np.vstack([np.stack([corners[i], corners[j], c]).T, np.ones(3)])
    weights = np.linalg.solve(system, np.append(place, 1.0))
    for degree in (2, 1):
        indices = [(a, b, degree - a - b) for a in range(degree + 1) for b in range(degree + 1 - a)]
        net = {
            n: sum(w * net[tuple(np.add(n, e))] for w, e in zip(weights, np.eye(3, dtype=int), strict=True))
            for n in indices
        }
    last = np.array([net[1, 0, 0], net[0, 1, 0], net[0, 0, 1]])
    slopes = 3.0 * np.linalg.solve(system.T, last)[:2]
    return float(weights @ last), slopes


def turn_rad(one: np.ndarray, two: np.ndarray) -> float:
    """Angle between the normals of two slopes."""
    a, b = np.append(-one, 1.0), np.append(-two, 1.0)
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def test_normals_agree_on_both_sides_of_every_edge() -> None:
    rng = np.random.default_rng(2)
    points = np.column_stack([scattered(20, 2), rng.normal(0.0, 0.1, 20)])
    found = sites(points)
    mesh = triangulate(found, 1.0)
    surface = cubic_surface(found, mesh, rng.normal(0.0, 1.0, (20, 2)))
    x, y = at(found)
    worst, edges = 0.0, 0
    for t, corners in enumerate(np.stack([x, y], axis=-1)[mesh.triangles]):
        patch, centre = surface.patches[t], corners.mean(axis=0)
        for k in range(3):
            ends = corners[(k + 1) % 3], corners[(k + 2) % 3]
            for share in (0.3, 0.9):
                inner = ends[0] + share * (centre - ends[0])
                one, two = bezier(patch, k, corners, inner), bezier(patch, (k + 2) % 3, corners, inner)
                assert one[0] == pytest.approx(two[0], abs=1e-12)
                worst = max(worst, turn_rad(one[1], two[1]))
                beyond = mesh.opposite[t, k]
                if beyond >= 0:
                    outer, there = (
                        ends[0] + share * (ends[1] - ends[0]),
                        np.stack([x, y], -1)[mesh.triangles[beyond // 3]],
                    )
                    one, two = (
                        bezier(patch, k, corners, outer),
                        bezier(surface.patches[beyond // 3], beyond % 3, there, outer),
                    )
                    assert one[0] == pytest.approx(two[0], abs=1e-12)
                    worst, edges = max(worst, turn_rad(one[1], two[1])), edges + 1
    assert edges > 60
    assert worst <= 1e-7


def test_heights_on_the_grid_are_those_of_the_control_points() -> None:
    points = np.column_stack([scattered(30, 3), np.random.default_rng(3).normal(0.0, 0.1, 30)])
    surface = surface_through(points, DetailedSettings(max_gap_m=0.8))
    window = GridWindow(0, 0, 9, 7, 1.0 / 9, 1.0 / 7)
    heights = surface.heights(window)
    corners = np.stack(at(surface.sites), axis=-1)[surface.mesh.triangles]
    for row, north in enumerate(window.nodes_m()[1]):
        for column, east in enumerate(window.nodes_m()[0]):
            place = np.array([east, north])
            expected = np.nan
            for patch, three in zip(surface.patches, corners, strict=True):
                weights = np.linalg.solve(np.vstack([three.T, np.ones(3)]), np.append(place, 1.0))
                if weights.min() >= 0.0:
                    expected = bezier(patch, int(np.argmin(weights)), three, place)[0]
            np.testing.assert_allclose(heights[row, column], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("count", "seeds", "share"), [(100, [2, 6, 8, 15, 24], 1.0), (300, range(5), 0.75), (700, [0], 0.35)]
)
def test_closer_to_franke_than_scipy(count: int, seeds: list[int], share: float) -> None:
    for seed in seeds:  # of 100 points those of 40 sets on which SciPy comes nearest
        places = scattered(count, seed)
        heights = franke(*places.T)
        here = detailed_surface(np.column_stack([places, heights]), UNIT, DetailedSettings(max_gap_m=7.0 / count**0.5))
        there = CloughTocher2DInterpolator(places, heights)(EAST, NORTH)
        seen = np.isfinite(here) & np.isfinite(there)
        errors = [np.abs(found - franke(EAST, NORTH))[seen] for found in (here, there)]
        assert seen.mean() > 0.7
        assert np.sqrt(np.mean(errors[0] ** 2)) < share * np.sqrt(np.mean(errors[1] ** 2))


def test_noise_is_not_taken_for_ground() -> None:
    places, noise = scattered(700, 9), np.random.default_rng(9).normal(0.0, 0.01, 700)
    points = np.column_stack([places, quadratic(*places.T) + noise])
    off = {}
    for kind in ("quadratic", "cubic"):
        heights = detailed_surface(points, UNIT, DetailedSettings(max_gap_m=0.2, slopes=kind))
        off[kind] = np.sqrt(np.nanmean((heights - quadratic(EAST, NORTH)) ** 2))
    assert off["cubic"] < min(off["quadratic"], 0.01)


def test_slopes_are_those_of_a_spline_of_all_neighbours() -> None:
    """SciPy's quintic spline (r⁵) through the same neighbourhood, where there is no noise."""
    places = scattered(21, 12)
    found = sites(np.column_stack([places, franke(*(0.3 * places.T))]))
    slopes = slopes_at(found, triangulate(found, 10.0), "cubic")
    x, y = at(found)
    spline = RBFInterpolator(np.column_stack([x, y]), found.height_m, kernel="quintic", degree=2)
    step = 1e-5 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    around = spline((np.column_stack([x, y])[:, None] + step).reshape(-1, 2)).reshape(-1, 4)
    expected = (around[:, [0, 2]] - around[:, [1, 3]]) / 2e-5
    assert (slopes.sources == 0).all()
    np.testing.assert_allclose(slopes.slopes, expected, atol=0.02 * np.ptp(expected))


def test_triangles_of_random_points_are_qhulls() -> None:
    points = np.column_stack([scattered(200, 4), np.zeros(200)])
    found = sites(points)
    ours = {frozenset(t) for t in triangulate(found, 100.0).triangles.tolist()}
    places = np.stack(at(found), axis=1)
    theirs = Delaunay(places).simplices
    sides = [np.linalg.norm(places[theirs[:, k]] - places[theirs[:, k - 1]], axis=1) for k in range(3)]
    area = np.abs(np.linalg.det(np.stack([places[theirs[:, k]] - places[theirs[:, 0]] for k in (1, 2)], axis=1))) / 2.0
    narrow = np.prod(sides, axis=0) / (2.0 * area) < 100.0
    assert ours == {frozenset(t) for t in theirs[narrow].tolist()}


def gridded(step_m: float, columns: int, rows: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns) * step_m, np.arange(rows) * step_m)
    return np.column_stack([x.ravel(), y.ravel(), np.sin(40.0 * x.ravel()) * np.cos(30.0 * y.ravel())])


def test_squares_of_gridded_points_are_cut_from_their_first_point() -> None:
    found = sites(gridded(0.01, 6, 5) + np.array([431_000.0, 5_400_000.0, 0.0]))
    triangles = triangulate(found, 0.1).triangles
    assert len(triangles) == 2 * 5 * 4
    column, row = triangles % 6, triangles // 6
    for c, r in zip(column, row, strict=True):
        assert {(c.min(), r.min()), (c.max(), r.max())} <= set(zip(c, r, strict=True))


@pytest.mark.parametrize("kind", ["gridded", "scattered"])
def test_regions_that_overlap_agree_to_the_bit(kind: str) -> None:
    rng = np.random.default_rng(5)
    points = gridded(0.02, 60, 30) if kind == "gridded" else rng.uniform(0.0, 1.0, (1500, 3)) * [1.2, 0.6, 0.01]
    points += [431_000.0, 5_400_000.0, 300.0]
    settings = DetailedSettings(max_gap_m=0.07)
    east = points[:, 0] - 431_000.0
    border = Bounds(431_000.5, 5_400_000.0, 431_000.7, 5_400_000.6)
    window = GridWindow.over(border, 0.01, 0.0137)
    whole = detailed_surface(points, window, settings)
    assert np.isfinite(whole).mean() > 0.9
    for part in (east < 0.7 + settings.halo_m, east > 0.5 - settings.halo_m):
        some = rng.permutation(points[part])
        assert len(some) < len(points)
        np.testing.assert_array_equal(detailed_surface(some, window, settings), whole)


def test_windows_side_by_side_share_no_node_and_leave_none() -> None:
    left = GridWindow.over(Bounds(0.0, 0.0, 10.0, 1.0), 0.03, 0.01)
    right = GridWindow.over(Bounds(10.0, 0.0, 20.0, 1.0), 0.03, 0.01)
    assert left.first_column + left.columns == right.first_column
    assert left.nodes_m()[0].max() < 10.0 <= right.nodes_m()[0].min()
    with pytest.raises(ConfigError, match="above 0"):
        GridWindow(0, 0, 1, 1, 0.0, 1.0)


def test_a_hole_stays_open() -> None:
    points = gridded(0.05, 21, 21)
    away = np.hypot(points[:, 0] - 0.5, points[:, 1] - 0.5)
    heights = detailed_surface(points[away > 0.25], UNIT, DetailedSettings(max_gap_m=0.3))
    distance = np.hypot(EAST - 0.5, NORTH - 0.5)
    assert np.isnan(heights[distance < 0.2]).all()
    assert np.isfinite(heights[distance > 0.32]).all()
    assert np.isfinite(detailed_surface(points[away > 0.25], UNIT, DetailedSettings(max_gap_m=0.7))).all()


@pytest.mark.parametrize(
    "places",
    [
        np.empty((0, 2)),
        np.array([[0.5, 0.5]]),
        np.array([[0.1, 0.1], [0.9, 0.9]]),
        np.column_stack([np.linspace(0.0, 1.0, 50), np.linspace(0.0, 0.3, 50)]),
        np.full((7, 2), 0.25),
        np.column_stack([np.zeros(40), np.arange(40) / 64]),
    ],
)
def test_points_without_area_give_no_surface(places: np.ndarray) -> None:
    points = np.column_stack([places, np.ones(len(places))])
    assert np.isnan(detailed_surface(points, UNIT, DetailedSettings())).all()


def test_points_at_one_place_count_as_their_mean() -> None:
    places = scattered(60, 6)
    once = np.column_stack([places, places[:, 0]])
    up = np.array([0.0, 0.0, 0.25])
    twice = np.concatenate([once + up, once - up])
    settings = DetailedSettings(max_gap_m=0.5)
    np.testing.assert_allclose(detailed_surface(twice, UNIT, settings), detailed_surface(once, UNIT, settings))


def test_a_strip_two_profiles_wide_is_a_surface() -> None:
    x = np.linspace(0.0, 1.0, 101)
    points = np.concatenate([np.column_stack([x, np.full(101, y), 2.0 * x + y]) for y in (0.5, 0.52)])
    heights = detailed_surface(points, GridWindow(0, 50, 100, 2, 0.01, 0.01), DetailedSettings(max_gap_m=0.1))
    np.testing.assert_allclose(heights, 2.0 * (np.arange(100) + 0.5) * 0.01 + np.array([[0.505], [0.515]]), atol=1e-9)


def test_slopes_where_neighbours_are_too_few() -> None:
    found = sites(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 3.0], [0.0, 1.0, 2.0]]))
    slopes = slopes_at(found, triangulate(found, 10.0), "cubic")
    np.testing.assert_allclose(slopes.slopes, [[2.0, 1.0]] * 3, atol=1e-12)
    assert slopes.sources.tolist() == [1, 1, 1]


def test_values_that_are_not_finite_are_named() -> None:
    points = np.zeros((5, 3))
    points[[2, 4], [0, 2]] = np.nan
    with pytest.raises(RoadscanError, match=r"2 of 5 points .* first at row 2"):
        detailed_surface(points, UNIT, DetailedSettings())
    with pytest.raises(RoadscanError, match=r"shape \(5, 2\)"):
        detailed_surface(points[:, :2], UNIT, DetailedSettings())
    with pytest.raises(RoadscanError, match="m apart"):
        detailed_surface(np.array([[0.0, 0.0, 0.0], [1e6, 0.0, 0.0]]), UNIT, DetailedSettings())
