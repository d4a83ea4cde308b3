"""Heights above the ground of which the difference between passes is taken off.

Passes of a survey differ in height by as much as their trajectories are wrong, so that ground that two of them saw
looks rougher than it is, and rougher than ground that one saw.
"""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np

from roadscan.assets.bins import cells_of, sums_around
from roadscan.assets.kernels.low_returns import low_moments
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Bool, Float32, Float64

_ALIKE: Final = 15
"""Edge of the square in which the difference of two passes counts as the same (cells): 3.75 m of cells of 0.25 m."""
_POOLED: Final = 3
"""Passes are compared where both see one of the cells of a square of this edge: rings of sparse lidars interleave."""


def heights_of_one_pass_m(
    scene: Scene, counted: Bool, limits_m: Float64, corner: Float64, cell_m: float, shape: tuple[int, int]
) -> Float32:
    """Returns heights above the ground (n,) (m), those of all passes and sensors moved to their common level.

    That level is the mean of the levels of all that see the square of 3.75 m around, each with the number of cells
    that it sees. Where one alone sees it, heights are as they are.

    Parameters
    ----------
    counted : (n,) returns that are compared.
    limits_m : (2,) the least and the greatest height of these.
    corner : x and y of the corner of the cells.
    shape : rows and columns of cells of `cell_m`.
    """
    returns, above = scene.returns, scene.above_ground_m
    source = returns.pass_id.astype(np.int64) * 256 + returns.sensor
    sources = np.unique(source[counted])
    if sources.size < 2:
        return above
    means, seen = [], []
    for one in sources.tolist():
        sums = np.zeros((*shape, 4))
        own = counted & (source == one)
        low_moments(returns.x_m, returns.y_m, above, returns.intensity, own, limits_m, corner, cell_m, sums)
        number, total = (sums_around(sums[..., k], _POOLED) for k in (0, 1))
        seen.append(number > 0.5)
        means.append(np.where(seen[-1], total / np.maximum(number, 1.0), 0.0))
    weights = np.stack([sums_around(s, _ALIKE) for s in seen])
    offsets = np.zeros((sources.size, *shape))
    for a, b in itertools.combinations(range(sources.size), 2):
        both = seen[a] & seen[b]
        number = sums_around(both, _ALIKE)
        apart = sums_around(np.where(both, means[a] - means[b], 0.0), _ALIKE) / np.maximum(number, 1.0)
        offsets[a] += weights[b] * apart
        offsets[b] -= weights[a] * apart
    offsets /= np.maximum(weights.sum(axis=0), 1.0)
    cell = cells_of(returns.x_m, returns.y_m, (float(corner[0]), float(corner[1]), cell_m), shape)
    rows = np.flatnonzero(counted & (cell >= 0))
    at = np.searchsorted(sources, source[rows])
    out = above.copy()
    out[rows] -= offsets.reshape(sources.size, -1)[at, cell[rows]].astype(np.float32)
    return out
