"""The detailed model beside SciPy's Clough–Tocher interpolant: time, and error on Franke's function.

The patch is the paper's: 10 m × 3.6 m, 26,310 points, some 275,000 nodes. All times are CPU times of one thread.
`ROADSCAN_SEEDS` says how many sets of random points (20).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.spatial import Delaunay

from benchmarks.timing import Figure, thread_seconds
from roadscan.surfaces.clough_tocher import cubic_surface
from roadscan.surfaces.detailed import DetailedSettings, detailed_surface
from roadscan.surfaces.normals import slopes_at
from roadscan.surfaces.sites import sites
from roadscan.surfaces.triangulation import triangulate
from roadscan.surfaces.window import GridWindow
from roadscan.tiles.grid import Bounds
from tests.surfaces.test_detailed import franke

ORIGIN = np.array([431_000.0, 5_400_000.0, 0.0])
POINTS = 26_310
CELLS_M = (0.0131, 0.01)
SPACINGS = 7.0
"""Widest gap on Franke's function, in mean spacings of points; without this cut slivers of the hull decide."""


def figures(_: Path) -> Iterator[Figure]:
    """Stages of the patch, then errors."""
    yield from _patch()
    for count in (100, 300, 1_000, 3_000, 10_000):
        yield from _franke(count, int(os.environ.get("ROADSCAN_SEEDS", "20")))


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
    qhull = _ms(lambda: Delaunay(local))
    other = _ms(lambda: scipy(asked))
    yield Figure("order, duplicates", _ms(lambda: sites(points)), "ms")
    yield Figure(
        f"triangulation, {POINTS:,} points",
        _ms(lambda: triangulate(places, 0.3)),
        "ms",
        qhull,
        "Qhull alone",
    )
    yield Figure("slopes, cubic", _ms(lambda: slopes_at(places, mesh, "cubic")), "ms")
    yield Figure("slopes, quadratic", _ms(lambda: slopes_at(places, mesh, "quadratic")), "ms")
    yield Figure("control points", _ms(lambda: cubic_surface(places, mesh, slopes)), "ms")
    nodes = f"{window.rows * window.columns:,} nodes (bar: a fifth)"
    yield Figure(f"heights, {nodes}", _ms(lambda: surface.heights(window)), "ms", other, "SciPy, slopes given")
    yield Figure(
        "control points and heights",
        _ms(lambda: cubic_surface(places, mesh, slopes).heights(window)),
        "ms",
        other,
        "SciPy, slopes given",
    )
    yield Figure(
        "whole detailed stage (bar: 500)",
        _ms(lambda: detailed_surface(points, window, settings)),
        "ms",
    )


def _franke(count: int, seeds: int) -> Iterator[Figure]:
    window = GridWindow(0, 0, 200, 200, 1.0 / 200, 1.0 / 200)
    nodes = np.meshgrid(*window.nodes_m())
    truth = franke(*nodes)
    settings = DetailedSettings(max_gap_m=SPACINGS / count**0.5)
    errors = []
    for seed in range(seeds):
        places = np.random.default_rng(seed).uniform(0.0, 1.0, (count, 2))
        heights = franke(*places.T)
        here = detailed_surface(np.column_stack([places, heights]), window, settings)
        off = [found - truth for found in (here, CloughTocher2DInterpolator(places, heights)(*nodes))]
        both = np.isfinite(off[0]) & np.isfinite(off[1])
        errors.append([(np.sqrt(np.mean(e[both] ** 2)), np.abs(e[both]).max()) for e in off])
    for k, name in enumerate(("RMS", "largest")):
        here, there = np.array(errors)[:, :, k].T
        yield Figure(
            f"Franke, {count:,} points: {name} error, mean of {seeds} sets",
            here.mean(),
            "",
            there.mean(),
            f"SciPy; larger than it in {(here > there).sum()} sets, by at most {(here / there).max():.2f}",
        )


def _ms(function: Callable[[], object]) -> float:
    return 1e3 * thread_seconds(function)
