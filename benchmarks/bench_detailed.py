"""The detailed model beside SciPy's Clough–Tocher interpolant: time, and error on Franke's function.

The patch is the paper's: 10 m × 3.6 m, 26,310 points, some 275,000 nodes. All times are CPU times of one thread.
`ROADSCAN_SEEDS` says how many sets of random points (40; 20 of the other functions).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.spatial import Delaunay

from benchmarks.timing import Figure, in_turns, thread_seconds
from roadscan.core.grid import Bounds
from roadscan.surface.clough_tocher import cubic_surface
from roadscan.surface.normals import slopes_at
from roadscan.surface.reconstruction import DetailedSettings
from roadscan.surface.tile import GridWindow
from roadscan.surface.triangulation import sites, triangulate
from tests.surface.detailed_surface import detailed_surface
from tests.surface.test_detailed import franke

ORIGIN = np.array([431_000.0, 5_400_000.0, 0.0])
POINTS = 26_310
CELLS_M = (0.0131, 0.01)
SPACINGS = 7.0
"""Widest gap on Franke's function, in mean spacings of points; without this cut slivers of the hull decide."""


Height = Callable[[npt.NDArray[np.float64], npt.NDArray[np.float64]], npt.NDArray[np.float64]]
OTHERS: dict[str, Height] = {
    "Cliff": lambda x, y: (np.tanh(9 * y - 9 * x) + 1) / 9,
    "Saddle": lambda x, y: (1.25 + np.cos(5.4 * y)) / (6 * (1 + (3 * x - 1) ** 2)),
    "Gentle": lambda x, y: np.exp(-81 / 16 * ((x - 0.5) ** 2 + (y - 0.5) ** 2)) / 3,
    "Steep": lambda x, y: np.exp(-81 / 4 * ((x - 0.5) ** 2 + (y - 0.5) ** 2)) / 3,
    "Sphere": lambda x, y: np.sqrt(64 - 81 * ((x - 0.5) ** 2 + (y - 0.5) ** 2)) / 9 - 0.5,
    "F7": lambda x, y: 2 * np.cos(10 * x) * np.sin(10 * y) + np.sin(10 * x * y),
}
"""Franke's other five functions (1979), and a wavy one, after Renka & Brown (1999), ACM TOMS 25, 78-94, F2 to F7."""


def figures(_: Path) -> Iterator[Figure]:
    """Stages of the patch, then errors."""
    yield from _patch()
    seeds = int(os.environ.get("ROADSCAN_SEEDS", "40"))
    for count in (100, 300, 1_000, 3_000, 10_000):
        yield from _scattered("Franke", franke, count, seeds)
    for name, function in OTHERS.items():
        for count in (100, 1_000):
            yield from _scattered(name, function, count, (seeds + 1) // 2)


def _patch() -> Iterator[Figure]:
    points = np.random.default_rng(0).uniform(0.0, 1.0, (POINTS, 3)) * [10.0, 3.6, 0.02] + ORIGIN
    settings = DetailedSettings()
    easting, northing = ORIGIN[:2].tolist()
    window = GridWindow.over(Bounds(easting, northing, easting + 10.0, northing + 3.6), *CELLS_M)
    places = sites(points)
    mesh = triangulate(places, settings.max_gap_m)
    slopes = slopes_at(places, mesh, settings.slopes).slopes
    surface = cubic_surface(places, mesh, slopes)
    local = points[:, :2] - ORIGIN[:2]
    asked = np.stack([v.ravel() for v in np.meshgrid(*window.nodes_m())], axis=1) - ORIGIN[:2]
    scipy = CloughTocher2DInterpolator(Delaunay(local), points[:, 2])
    triangles, qhull = (1e3 * s for s in in_turns([lambda: triangulate(places, 0.3), lambda: Delaunay(local)], 5))
    heights, both, other = (
        1e3 * s
        for s in in_turns(
            [
                lambda: surface.heights(window),
                lambda: cubic_surface(places, mesh, slopes).heights(window),
                lambda: scipy(asked),
            ]
        )
    )
    yield Figure("order, duplicates", _ms(lambda: sites(points)), "ms")
    yield Figure(f"triangulation, {POINTS:,} points", triangles, "ms", qhull, "Qhull alone")
    yield Figure("slopes, cubic", _ms(lambda: slopes_at(places, mesh, "cubic")), "ms")
    yield Figure("slopes, quadratic", _ms(lambda: slopes_at(places, mesh, "quadratic")), "ms")
    yield Figure("control points", _ms(lambda: cubic_surface(places, mesh, slopes)), "ms")
    nodes = f"{window.rows * window.columns:,} nodes (bar: a fifth)"
    yield Figure(f"heights, {nodes}", heights, "ms", other, "SciPy, slopes given")
    yield Figure("control points and heights", both, "ms", other, "SciPy, slopes given")
    yield Figure(
        "whole detailed stage (bar: 500)",
        _ms(lambda: detailed_surface(points, window, settings)),
        "ms",
    )


def _scattered(name: str, function: Height, count: int, seeds: int) -> Iterator[Figure]:
    window = GridWindow(0, 0, 200, 200, 1.0 / 200, 1.0 / 200)
    nodes = np.meshgrid(*window.nodes_m())
    truth = function(*nodes)
    settings = DetailedSettings(max_gap_m=SPACINGS / count**0.5)
    errors = []
    for seed in range(seeds):
        places = np.random.default_rng(seed).uniform(0.0, 1.0, (count, 2))
        heights = function(*places.T)
        here = detailed_surface(np.column_stack([places, heights]), window, settings)
        off = [found - truth for found in (here, CloughTocher2DInterpolator(places, heights)(*nodes))]
        both = np.isfinite(off[0]) & np.isfinite(off[1])
        errors.append([(np.sqrt(np.mean(e[both] ** 2)), np.abs(e[both]).max()) for e in off])
    for k, kind in enumerate(("RMS", "largest")):
        here, there = np.array(errors)[:, :, k].T
        what = f"{name}, {count:,} points: {kind} error"
        yield Figure(f"{what}, mean of {seeds} sets", here.mean(), "", there.mean(), "SciPy")
        worst = f"at most {(here / there).max():.2f} times SciPy's"
        yield Figure(f"{what} larger than SciPy's", int((here > there).sum()), f"of {seeds} sets", None, worst)


def _ms(function: Callable[[], object]) -> float:
    return 1e3 * thread_seconds(function)
