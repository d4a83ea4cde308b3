"""Islands: small patches of ground returns that lie far above or below the ground around them."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.grid import Grid
from roadscan.assets.ground.surface import Place, Surface
from roadscan.assets.kernels.ground_cells import cell_heights
from roadscan.core.extras import cv2

Bools = npt.NDArray[np.bool_]

_LARGEST_M2: Final = 1.25
"""Larger patches (m²) are ground, such as a terrace."""
_RISE_M: Final = 0.3
"""A patch is an island where it lies farther from the height of the nearest larger one (m), and as much more as the
steepest slope makes on the way there. On sweeps 0–3 of the labelled street all patches beyond it are leaves, hedges and
parts of cars."""
_BESIDE: Final = np.ones((3, 3), np.uint8)
"""Cells with no more than two empty ones between them are one patch: rings of a lidar lie apart."""


def without_islands(place: Place, base: Surface, above_m: npt.NDArray[np.float32], found: Bools, grid: Grid) -> Bools:
    """Returns the mask (n,) of the returns on the ground without those on islands.

    Behind a hedge or a wall the ground is hidden, and the lowest that is seen there is no ground.

    base : the first estimate of the ground. above_m, found : (n,) heights above it, and which returns are ground.
    grid : of the cells in which patches are told.
    """
    x, y, per_m = place.returns.x_m, place.returns.y_m, 1.0 / grid.cell_m
    sums = np.zeros((*grid.shape, 3))
    cell_heights(x, y, above_m, found, grid.origin, per_m, np.zeros(grid.shape, np.float32),
                 np.full(grid.shape, np.inf, np.float32), sums)  # fmt: skip
    seen = sums[..., 0] > 0
    height = base.at(grid) + np.divide(sums[..., 1], sums[..., 0], out=np.zeros(grid.shape), where=seen)
    count, label = cv2.connectedComponents(cv2.dilate(seen.view(np.uint8), _BESIDE), connectivity=8)
    cells = np.bincount(label[seen], minlength=count)
    whole = seen & (cells * grid.cell_m**2 > _LARGEST_M2)[label]
    if not whole.any():
        return found
    away, near = cv2.distanceTransformWithLabels(
        (~whole).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    known = np.zeros(int(near.max()) + 1)
    known[near[whole]] = height[whole]
    small = seen & ~whole
    rise = np.bincount(label[small], (height - known[near])[small], count) / np.maximum(cells, 1)
    way = np.bincount(label[small], away[small], count) * grid.cell_m / np.maximum(cells, 1)
    island = small & (np.abs(rise) > _RISE_M + place.settings.steepest * way)[label]
    if not island.any():
        return found
    rows = np.flatnonzero(found)
    column, row = (np.floor((v[rows] - v0) * per_m).astype(np.int64) for v, v0 in zip((x, y), grid.origin, strict=True))
    inside = (column >= 0) & (row >= 0) & (column < grid.columns) & (row < grid.rows)
    out = found.copy()
    out[rows[inside][island[row[inside], column[inside]]]] = False
    return out
