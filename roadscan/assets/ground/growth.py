"""Ground that goes out from the drive: a cell belongs to it that goes on from ground nearer to the road."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.filling import filled
from roadscan.assets.ground.grid import Grid
from roadscan.assets.ground.morphological import objects

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

_SEEDS_M: Final = 8.0
"""Ground begins this near to the drive …"""
_SEED_M: Final = 0.3
"""… where the depth below the sensor is the median one, within this."""
_STEP_M, _SLOPE = 0.15, 0.15
"""A cell goes on from ground whose membrane it meets within this, and this times the distance (m, m/m)."""
_GAP_M: Final = 6.0
"""Greatest distance that ground is followed over cells without."""
_TURNS: Final = 200
_STEEPEST: Final = 0.3
"""What stands out of ground that was found by more than this slope times a window's radius is no ground after all."""


def grown_cells(lowest_m: Float32, grid: Grid, drive_xyh_m: Float64, largest_m: float) -> Bools | None:
    """Cells (rows, columns) whose lowest return lies on ground that goes on from the drive; None where none is near.

    lowest_m : (rows, columns), inf where a cell holds no return; drive_xyh_m : (p, 3 or more).
    """
    found = seeds(lowest_m, grid, drive_xyh_m)
    if found is None:
        return None
    known = np.isfinite(lowest_m)
    for _ in range(_TURNS):
        membrane = filled(lowest_m, found)
        away = distances(found, grid.cell_m)
        more = known & ~found & (away < _GAP_M) & (np.abs(lowest_m - membrane) < _STEP_M + _SLOPE * away)
        if not more.any():
            break
        found |= more
    return np.asarray(found & ~objects(filled(lowest_m, found), grid.cell_m, _STEEPEST, largest_m))


def seeds(lowest_m: Float32, grid: Grid, drive_xyh_m: Float64) -> Bools | None:
    """Cells near the drive (rows, columns) as deep below the sensor as most are; None where there are none."""
    column = np.floor((drive_xyh_m[:, 0] - grid.x_min_m) / grid.cell_m).astype(np.int64)
    row = np.floor((drive_xyh_m[:, 1] - grid.y_min_m) / grid.cell_m).astype(np.int64)
    inside = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.columns)
    if not inside.any():
        return None
    row, column = row[inside], column[inside]
    driven = np.ones(grid.shape, np.uint8)
    driven[row, column] = 0
    away, label = cv2.distanceTransformWithLabels(driven, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    height = np.zeros(int(label.max()) + 1)
    height[label[row, column]] = drive_xyh_m[inside, 2]
    depth = height[label] - lowest_m
    near = np.isfinite(lowest_m) & (away * grid.cell_m < _SEEDS_M)
    if not near.any():
        return None
    return np.asarray(near & (np.abs(depth - np.median(depth[near])) < _SEED_M))


def distances(found: Bools, cell_m: float) -> Float32:
    """Distance (rows, columns) of each cell from the nearest one that was found (m)."""
    away = cv2.distanceTransform((~found).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(away * np.float32(cell_m))
