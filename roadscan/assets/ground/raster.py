"""The raster of bare earth: robust heights of the returns on the ground, and a membrane between them."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.filling import distances, filled
from roadscan.assets.ground.grid import Grid, grid_over
from roadscan.assets.ground.surface import Found, Place
from roadscan.assets.kernels.ground_cells import cell_heights
from roadscan.assets.scene import GroundModel
from roadscan.assets.statistics import Statistics
from roadscan.compute.array_types import Float32

_TIMES, _LEAST_M = 2.5, 0.01
"""Returns of a cell count within this many standard deviations of their mean, and at least within this distance (m).
"""
_SEVERAL: Final = 5
"""Least number of returns for their scatter."""
_UNKNOWN_M: Final = 0.05
"""Scatter of returns where no cell shows it (m)."""
_GROWTH: Final = 0.05
"""σ of an interpolated height over its distance from seen ground: parts of two recorded streets that were hidden and
interpolated again was wrong by so much (m/m, RMS)."""


def ground_model(place: Place, found: Found) -> GroundModel:
    """Returns heights of the cells in which ground was seen; between them a membrane, as far as the settings say."""
    grid = grid_over(place.window, place.settings.cell_m)
    x, y = place.returns.x_m, place.returns.y_m
    middle, half = np.zeros(grid.shape, np.float32), np.full(grid.shape, np.inf, np.float32)
    for _ in range(2):
        sums = np.zeros((*grid.shape, 3))
        cell_heights(x, y, found.above_m, found.on_ground, grid.origin, 1.0 / grid.cell_m, middle, half, sums)
        middle, scatter = means(sums, middle)
        half = np.maximum(np.float32(_TIMES) * scatter, np.float32(_LEAST_M))
    seen = sums[..., 0] > 0
    height = filled(found.base.at(grid) + middle, seen, grid.corner, grid.cell_m)
    away = distances(seen, grid.cell_m)
    sigma = sigmas(sums[..., 0], scatter, away, grid, place.statistics)
    for array in (height, sigma):
        array[(away > place.settings.reach_m) | ~seen.any()] = np.nan
    return GroundModel(grid.x_min_m, grid.y_min_m, grid.cell_m, height, seen, sigma)


def sigmas(
    count: npt.NDArray[np.float64], scatter: Float32, away_m: Float32, grid: Grid, statistics: Statistics
) -> Float32:
    """Returns 1 σ (rows, columns) of the heights of cells: of a mean where returns were seen, else by distance.

    count : returns of each cell; scatter : their standard deviation (m), which few returns underestimate: it is no less
    than the median of the survey.
    """
    seen = count > 0
    several = count >= _SEVERAL
    told = statistics.of("ground_scatter_m", 0.5, lambda: scatter[several])
    usual = np.float32(_UNKNOWN_M if told is None else told)
    single = np.where(several, scatter, np.maximum(scatter, usual))
    mean = (single / np.sqrt(np.maximum(count, 1.0))).astype(np.float32)
    return np.asarray(
        np.hypot(filled(mean, seen, grid.corner, grid.cell_m), np.where(seen, 0.0, _GROWTH * away_m)), np.float32
    )


def means(sums: npt.NDArray[np.float64], middle: Float32) -> tuple[Float32, Float32]:
    """Returns means and standard deviations (rows, columns) of cells from their sums about `middle`; 0 of none."""
    held = np.maximum(sums[..., 0], 1.0)
    mean = sums[..., 1] / held
    variance = np.maximum(sums[..., 2] / held - mean * mean, 0.0)
    return (middle + mean).astype(np.float32), np.sqrt(variance).astype(np.float32)
