"""Normals of points from the plane that fits those in the same cube best."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float32

_CUBE_M: Final = 0.5
"""Edge of the cubes (m); they are anchored at the origin of the points."""
_LEAST_POINTS: Final = 8  # Fewest points of a plane.
_FLAT: Final = 0.1
"""Largest share of the variance that may lie across a plane: more is a shrub, or a corner."""

_LOW_RELIEF_M: Final = 0.08
"""Points whose heights vary by no more (m, 1 σ) and that lie in no plane are ground with a kerb: it lies level."""


def normals_of(point_m: npt.NDArray[np.floating]) -> Float32:
    """Returns unit normals (n, 3) of points (n, 3); NaN where those around lie in no plane and are not level."""
    if not len(point_m):
        return np.zeros((0, 3), np.float32)
    low = np.floor(point_m.min(axis=0) / _CUBE_M)
    size = (np.floor(point_m.max(axis=0) / _CUBE_M) - low).astype(np.int64) + 1
    number = np.zeros(len(point_m), np.int64)
    for k in (2, 1, 0):  # column by column: there may be millions of points
        number = number * size[k] + (np.floor(point_m[:, k] / _CUBE_M) - low[k]).astype(np.int64)
    _, which, count = np.unique(number, return_inverse=True, return_counts=True)
    del number
    which = which.astype(np.int32)
    off = []
    for k in range(3):
        middle = np.bincount(which, point_m[:, k], count.size) / count
        off.append((point_m[:, k] - middle[which]).astype(np.float32))
    spread = np.empty((count.size, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            spread[:, i, j] = spread[:, j, i] = np.bincount(which, off[i] * off[j], count.size)
    values, vectors = np.linalg.eigh(spread)
    flat = (count >= _LEAST_POINTS) & (values[:, 0] <= _FLAT * values[:, 1]) & (values[:, 1] > 0.0)
    level = (count >= _LEAST_POINTS) & (spread[:, 2, 2] <= _LOW_RELIEF_M**2 * count)
    normal = np.where(flat[:, None], vectors[:, :, 0], np.where(level[:, None], [0.0, 0.0, 1.0], np.nan))
    return normal.astype(np.float32)[which]
