"""Scatter of heights within passes, and heights of which the difference between passes is taken off.

Passes of a survey differ in height by as much as their trajectories are wrong, so that ground that two of them saw
looks rougher than it is, and rougher than ground that one saw.
"""

from __future__ import annotations

import itertools
from typing import Final, NamedTuple

import numpy as np

from roadscan.assets.bins import cells_of, sums_around
from roadscan.assets.kernels.low_returns import low_moments
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Bool, Float32, Float64, Int64

_ALIKE: Final = 15
"""Edge of the square in which the difference of two passes counts as the same (cells): 3.75 m of cells of 0.25 m."""
_POOLED: Final = 3
"""Moments are those of squares of this edge (cells): rings of sparse lidars interleave."""


class CellGrid(NamedTuple):
    """Cells of a raster: x and y of its corner (m), the edge of a cell (m), and its rows and columns."""

    corner: Float64
    cell_m: float
    shape: tuple[int, int]


class PassMoments(NamedTuple):
    """Moments of the low heights of each pass and sensor about each cell."""

    source: Int64
    """(n,) the pass and sensor of each return: pass · 256 + sensor."""
    sources: Int64
    """(s,) those that there are."""
    sums: Float64
    """(s, 3, rows, columns) Σ1, Σh and Σh² of the returns of each in a cell with the eight around it."""

    def scatter_m(self) -> Float64:
        """Returns how heights scatter (rows, columns) within passes (m); 0 where there are none."""
        number, total, square = np.moveaxis(self.sums, 1, 0)
        within = (square - total * total / np.maximum(number, 1.0)).sum(axis=0)
        free = number.sum(axis=0) - np.maximum((number > 0.5).sum(axis=0) - 1, 0)
        return np.asarray(np.sqrt(np.maximum(within / np.maximum(free, 1.0), 1e-8)))


def pass_moments(scene: Scene, counted: Bool, limits_m: Float64, grid: CellGrid) -> PassMoments:
    """Returns moments of the heights above the ground of the returns that count (n,), between two limits (2,) (m)."""
    returns = scene.returns
    source = returns.pass_id.astype(np.int64) * 256 + returns.sensor
    sources = np.unique(source[counted])
    sums = np.zeros((sources.size, 3, *grid.shape))
    for k, one in enumerate(sources.tolist()):
        cells = np.zeros((*grid.shape, 4))
        low_moments(
            returns.x_m, returns.y_m, scene.above_ground_m, returns.intensity, counted & (source == one), limits_m,
            grid.corner, grid.cell_m, cells,
        )  # fmt: skip
        for i in range(3):
            sums[k, i] = sums_around(cells[..., i], _POOLED)
    return PassMoments(source, sources, sums)


def heights_of_one_pass_m(scene: Scene, counted: Bool, moments: PassMoments, flat_m: float, grid: CellGrid) -> Float32:
    """Returns heights above the ground (n,) (m), those of all passes and sensors moved to their common level.

    That level is the mean of the returns of the square of 3.75 m around. Passes are compared where each by itself
    scatters by less than `flat_m`: two passes see plants differently. Where one alone sees it, heights are as they are.
    """
    above, number, means = scene.above_ground_m, moments.sums[:, 0], moments.sums[:, 1]
    if moments.sources.size < 2:
        return above
    means = means / np.maximum(number, 1.0)
    flat = [moments._replace(sums=one[None]).scatter_m() < flat_m for one in moments.sums]
    weights = np.stack([sums_around(one, _ALIKE) for one in number])
    offsets = np.zeros_like(means)
    for a, b in itertools.combinations(range(len(means)), 2):
        both = (number[a] > 0.5) & (number[b] > 0.5) & flat[a] & flat[b]
        apart = sums_around(np.where(both, means[a] - means[b], 0.0), _ALIKE)
        apart /= np.maximum(sums_around(both, _ALIKE), 1.0)
        offsets[a] += weights[b] * apart
        offsets[b] -= weights[a] * apart
    offsets /= np.maximum(weights.sum(axis=0), 1.0)
    corner = (float(grid.corner[0]), float(grid.corner[1]), grid.cell_m)
    cell = cells_of(scene.returns.x_m, scene.returns.y_m, corner, grid.shape)
    rows = np.flatnonzero(counted & (cell >= 0))
    at = np.searchsorted(moments.sources, moments.source[rows])
    out = above.copy()
    out[rows] -= offsets.reshape(len(offsets), -1)[at, cell[rows]].astype(np.float32)
    return out
