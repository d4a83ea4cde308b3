"""Triangulation and natural neighbours, against Qhull, areas of Voronoi polygons by GEOS, and fields by formula."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from roadscan.condition.kernels.natural_neighbour import (
    STEP_M,
    circle_centres,
    dig,
    mesh_of,
    natural_neighbour_raster,
    slopes_of_points,
    triangulate,
    walk,
)
from roadscan.condition.roughness_rasters import insertion_order, interpolate


def scattered(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 1.0, (n, 2))


def meshed(places: np.ndarray):
    x, y = (np.rint(v / STEP_M).astype(np.int64) for v in places.T)
    mesh = mesh_of(x, y)
    return mesh, triangulate(mesh, insertion_order(x, y))


def real_triangles(mesh, count: int) -> set[tuple[int, ...]]:
    beyond = mesh.x.size
    return {tuple(sorted(t)) for t in mesh.triangles[:count].tolist() if beyond not in t}


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 4, 50, 400])
def test_triangles_are_those_of_qhull(n: int) -> None:
    places = scattered(n, n)
    mesh, count = meshed(places)
    assert real_triangles(mesh, count) == {tuple(sorted(t)) for t in Delaunay(places).simplices.tolist()}


def test_walk_finds_the_triangle_and_dig_the_circles() -> None:
    places = scattered(120, 5)
    mesh, _ = meshed(places)
    qhull, beyond = Delaunay(places), mesh.x.size
    for number, q in enumerate(scattered(40, 6), start=1000):
        mesh.x[-1], mesh.y[-1] = (round(v / STEP_M) for v in q)
        t = walk(mesh, 0, beyond - 1)
        held = int(qhull.find_simplex(q))
        if held < 0:
            assert beyond in mesh.triangles[t]
            continue
        assert sorted(mesh.triangles[t]) == sorted(qhull.simplices[held])
        many, edges = dig(mesh, t, beyond - 1, number)
        hole = {tuple(sorted(c)) for c in mesh.triangles[mesh.hole[:many]].tolist()}
        inside = set()
        for corners in qhull.simplices:
            a, b, c = places[corners]
            lengths = np.array([p @ p for p in (a, b, c)])
            centre = np.linalg.solve(2 * np.array([b - a, c - a]), lengths[1:] - lengths[0])
            if np.linalg.norm(q - centre) < np.linalg.norm(a - centre):
                inside.add(tuple(sorted(corners.tolist())))
        assert hole == inside
        assert edges == many + 2


@pytest.mark.slow
def test_weights_are_the_areas_that_voronoi_cells_lose() -> None:
    """With and without the place, by GEOS; the values make each weight visible in turn."""
    places, value = scattered(60, 2), np.random.default_rng(3).normal(size=60)
    cells = interpolate(*places.T, value, (0.35, 0.35), 0.06, (5, 5))
    frame = shapely.box(-5, -5, 6, 6)
    before = voronoi(places, frame)
    for i in range(5):
        for j in range(5):
            q = np.array([0.35 + 0.06 * (j + 0.5), 0.35 + 0.06 * (i + 0.5)])
            own = voronoi(np.vstack([places, q]), frame)[-1]
            taken = np.array([own.intersection(cell).area for cell in before])
            assert cells[i, j] == pytest.approx(taken @ value / taken.sum(), abs=1e-9)


def voronoi(places: np.ndarray, frame: shapely.Polygon) -> list[shapely.Polygon]:
    polygons = shapely.voronoi_polygons(shapely.MultiPoint(places), extend_to=frame, ordered=True)
    return [p.intersection(frame) for p in polygons.geoms]


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("kind", ["scattered", "lattice", "clustered"])
def test_exact_on_linear_fields(kind: str, smooth: bool) -> None:
    """Lattices have all their points on common circles, and cells' centres on edges and corners."""
    places = {
        "scattered": scattered(400),
        "lattice": np.stack(np.meshgrid(np.arange(21) / 20, np.arange(21) / 20), axis=-1).reshape(-1, 2),
        "clustered": scattered(400) ** 3,
    }[kind]
    x, y = (10.0 * places).T
    out = interpolate(x, y, 31.0 + 0.7 * x - 0.3 * y, (0.0, 0.0), 0.5, (20, 20), smooth=smooth)
    centre = 0.5 * (np.arange(20) + 0.5)
    wrong = np.abs(out - (31.0 + 0.7 * centre[None, :] - 0.3 * centre[:, None]))
    inside = (
        Delaunay(places).find_simplex(np.stack(np.meshgrid(centre, centre), -1).reshape(-1, 2) / 10).reshape(20, 20)
        >= 0
    )
    assert np.array_equal(np.isnan(out), ~inside)
    assert np.nanmax(wrong) < 1e-9


def test_slopes_of_a_plane_and_of_a_paraboloid() -> None:
    """Those of a plane at all points; those of x² + y², 2 x and 2 y, at points whose cells have an end well inside."""
    places = STEP_M * np.rint(scattered(300, 4) / STEP_M)
    mesh, count = meshed(places)
    centres, slopes = np.empty((len(mesh.triangles), 2)), np.empty((300, 2))
    circle_centres(mesh, count, centres)
    slopes_of_points(mesh, count, centres, 5.0 + places @ [0.7, -0.3], slopes)
    assert slopes == pytest.approx(np.tile([0.7, -0.3], (300, 1)), abs=1e-9)
    slopes_of_points(mesh, count, centres, np.sum(places**2, axis=1), slopes)
    inside = (np.abs(places - 0.5) < 0.3).all(axis=1)
    assert slopes[inside] == pytest.approx(2.0 * places[inside], abs=1e-6)


def test_franke_beside_linear() -> None:
    """Franke's test function (1979) on the unit square, at random points.

    The smooth values (C1) are nearer than linear interpolation on the same points in every draw. The plain ones (C0)
    are not: in the mean of many draws their mean error is that of linear interpolation or up to 2 % above, and their
    root mean square error 1 to 6 % above (100 to 2,000 points). No weights could do better where a field bends alike
    in all directions, see below.
    """
    ratios: dict[bool, list[float]] = {False: [], True: []}
    for seed in range(6):
        places = scattered(400, seed)
        grid = np.meshgrid(0.05 * (np.arange(20) + 0.5), 0.05 * (np.arange(20) + 0.5))
        truth, linear = franke(*grid), LinearNDInterpolator(places, franke(*places.T))(*grid)
        for smooth, found in ratios.items():
            out = interpolate(*places.T, franke(*places.T), (0.0, 0.0), 0.05, (20, 20), smooth=smooth)
            known = ~np.isnan(out) & ~np.isnan(linear)
            own, other = (np.square(v - truth)[known] for v in (out, linear))
            found.append(float(np.sqrt(own.mean() / other.mean())))
    assert np.mean(ratios[False]) < 1.05
    assert np.max(ratios[True]) < 0.7
    assert np.mean(ratios[True]) < 0.45


def test_on_a_paraboloid() -> None:
    """Weights ≥ 0 that are exact on linear fields err by Σ wᵢ dᵢ² on x² + y², least those in Delaunay triangles.

    (The lower hull of points on the paraboloid is their Delaunay triangulation.) The smooth values are exact there
    (Sibson 1981), but for the neighbours of the hull.
    """
    places = scattered(400, 7)
    grid = np.meshgrid(0.05 * (np.arange(20) + 0.5), 0.05 * (np.arange(20) + 0.5))
    truth, value = grid[0] ** 2 + grid[1] ** 2, np.sum(places**2, axis=1)
    linear = LinearNDInterpolator(places, value)(*grid) - truth
    plain, smooth = (interpolate(*places.T, value, (0.0, 0.0), 0.05, (20, 20), smooth=s) - truth for s in (False, True))
    known = ~np.isnan(plain) & ~np.isnan(linear)
    assert (plain >= linear - 1e-9)[known].all()
    assert np.abs(smooth[4:-4, 4:-4]).max() < 1e-9


def franke(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (
        0.75 * np.exp(-((9 * x - 2) ** 2 + (9 * y - 2) ** 2) / 4)
        + 0.75 * np.exp(-((9 * x + 1) ** 2) / 49 - (9 * y + 1) / 10)
        + 0.5 * np.exp(-((9 * x - 7) ** 2 + (9 * y - 3) ** 2) / 4)
        - 0.2 * np.exp(-((9 * x - 4) ** 2) - (9 * y - 7) ** 2)
    )


def test_points_at_one_place_and_on_a_line() -> None:
    x, y = np.array([0.0, 1.0, 0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0, 0.0])
    out = interpolate(x, y, np.array([1.0, 2.0, 3.0, 4.0, 99.0]), (0.0, 0.0), 1.0, (1, 1))
    assert out[0, 0] == pytest.approx(2.5)
    assert np.isnan(interpolate(x, x, x, (0.0, 0.0), 0.5, (2, 2))).all()
    assert np.isnan(interpolate(x[:2], y[:2], x[:2], (0.0, 0.0), 0.5, (2, 2))).all()
    with pytest.raises(ValueError, match="200 m from the raster's corner"):
        interpolate(200.0 * x, y, x, (0.0, 0.0), 0.5, (2, 2))


def test_values_at_the_points_are_theirs() -> None:
    places = scattered(80, 9)
    mesh, count = meshed(places)
    value, centres, out = np.arange(80.0), np.empty((len(mesh.triangles), 2)), np.empty((1, 1))
    circle_centres(mesh, count, centres)
    for k in (3, 40, 77):
        first = np.array([mesh.x[k], mesh.y[k]], np.float64)
        natural_neighbour_raster(mesh, count, centres, value, np.empty((0, 2)), first, 1.0, out)
        assert out[0, 0] == k
