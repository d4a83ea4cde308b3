"""Natural neighbours and roughness regions: seconds a section of 30 × 10 m takes on one core."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from benchmarks.timing import Figure, thread_seconds
from roadscan.condition.roughness_rasters import RoadPoints, interpolate, pyramid
from roadscan.condition.roughness_regions import find_regions
from roadscan.condition.settings import RoughnessRegionsConfig

POINTS, CELL_M, SHAPE = 100_000, 0.06, (500, 167)


def figures(_: Path) -> Iterator[Figure]:
    """The raster of all points, that of thinned ones, and all steps."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0.0, 10.0, POINTS), rng.uniform(0.0, 30.0, POINTS)
    dim = (np.abs(x - 4.0) < 0.6) & (np.abs(y - 20.0) < 4.0)
    intensity = np.where(dim, 60.0, 100.0) + rng.normal(0.0, 9.0, POINTS)
    points = RoadPoints.of(x, y, 0.02 * y + rng.normal(0.0, 0.002, POINTS), intensity)
    grid = np.meshgrid(CELL_M * (np.arange(SHAPE[1]) + 0.5), CELL_M * (np.arange(SHAPE[0]) + 0.5))

    def raster(of: RoadPoints) -> object:
        return interpolate(of.x_m, of.y_m, of.intensity, (0.0, 0.0), CELL_M, SHAPE)

    def linear() -> object:
        return LinearNDInterpolator(np.column_stack([x, y]), intensity)(*grid)

    other = thread_seconds(linear, 3)
    yield Figure("natural-neighbour raster, 100,000 points", thread_seconds(lambda: raster(points)), "s", other,
                 "SciPy's linear interpolation in triangles")  # fmt: skip
    yield Figure("the same, points thinned first", thread_seconds(lambda: raster(pyramid(points, CELL_M, 1)[1])), "s")
    settings = RoughnessRegionsConfig()
    yield Figure(
        "regions, all steps", thread_seconds(lambda: find_regions(points, (5.0, 15.0), np.pi / 2, settings)), "s"
    )
