"""Filling of holes in rasters, and distances to known cells."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.filling import begin, halved, relax
from roadscan.compute.array_types import Float32
from roadscan.core.extras import cv2

Bools = npt.NDArray[np.bool_]


_COARSEST_M: Final = 8.0
"""Cells are halved up to this edge (m): windows of the ground end at multiples of it in the map."""


def filled(height_m: Float32, known: Bools, corner: tuple[int, int] = (0, 0), cell_m: float = 1.0) -> Float32:
    """Returns heights (rows, columns), the unknown ones on a membrane through the known ones; 0 if none is known.

    Beyond 8 m from what is known the heights around go on, ring by ring: so they depend on no more than lies twice as far
    away as the nearest known one, however much of the map is filled at once.

    height_m : (rows, columns), read where `known` is True. corner : row and column of the first cell in the map, so that
    coarser cells are the same for any part of it. cell_m : edge of a cell (m).
    """
    z = np.where(known, height_m, np.float32(0.0)).astype(np.float32)
    if known.all() or not known.any():
        return z
    if cell_m > 0.5 * _COARSEST_M:
        z = _continued(z, known)
        relax(z, known)
        return z
    odd = corner[0] % 2, corner[1] % 2
    shape = (z.shape[0] + odd[0] + 1) // 2, (z.shape[1] + odd[1] + 1) // 2
    coarse, coarse_known = np.empty(shape, np.float32), np.empty(shape, np.bool_)
    halved(z, known, odd, coarse, coarse_known)
    begin(filled(coarse, coarse_known, (corner[0] // 2, corner[1] // 2), 2.0 * cell_m), known, odd, z)
    relax(z, known)
    return z


def _continued(z: Float32, known: Bools) -> Float32:
    """Returns heights (rows, columns): ring by ring, each unknown one is the mean of those known beside it."""
    rows, columns = z.shape
    while not known.all():
        sums, counts = np.zeros(z.shape), np.zeros(z.shape)
        wide, held = np.pad(np.where(known, z, 0.0), 1), np.pad(known, 1)
        for r in range(3):
            for c in range(3):
                sums += wide[r : r + rows, c : c + columns]
                counts += held[r : r + rows, c : c + columns]
        ring = ~known & (counts > 0)
        z = np.where(ring, sums / np.maximum(counts, 1.0), z).astype(np.float32)
        known = known | ring
    return z


def distances(found: Bools, cell_m: float) -> Float32:
    """Returns the distance (rows, columns) of each cell from the nearest one that is True (m)."""
    away = cv2.distanceTransform((~found).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(away * np.float32(cell_m))
