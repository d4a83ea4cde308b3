"""Filling of holes in rasters, and distances to known cells."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.filling import begin, halved, relax
from roadscan.compute.array_types import Float32
from roadscan.core.extras import cv2

Bools = npt.NDArray[np.bool_]


def filled(height_m: Float32, known: Bools) -> Float32:
    """Returns heights (rows, columns), the unknown ones on a membrane through the known ones; 0 if none is known.

    height_m : (rows, columns), read where `known` is True.
    """
    z = np.where(known, height_m, np.float32(0.0)).astype(np.float32)
    if known.all() or min(z.shape) == 0:
        return z
    if max(z.shape) > 1:
        shape = (z.shape[0] + 1) // 2, (z.shape[1] + 1) // 2
        coarse, coarse_known = np.empty(shape, np.float32), np.empty(shape, np.bool_)
        halved(z, known, coarse, coarse_known)
        begin(filled(coarse, coarse_known), known, z)
        relax(z, known)
    return z


def distances(found: Bools, cell_m: float) -> Float32:
    """Returns the distance (rows, columns) of each cell from the nearest one that is True (m)."""
    away = cv2.distanceTransform((~found).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(away * np.float32(cell_m))
