"""Road: even ground of the bare earth that the drive reaches without a step."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.filling import distances
from roadscan.assets.scene import GroundModel
from roadscan.core.extras import cv2

Bools = npt.NDArray[np.bool_]

_REACH_M: Final = 8.0
"""Road reaches this far to both sides of the drive (m)."""
_DRIVEN_M: Final = 1.25
"""Ground this near to the drive (m) was driven on."""
_STEEPEST: Final = 0.08
"""Slope between neighbouring cells that is no kerb: 20 mm over a quarter of a metre (m/m)."""
_APART_M: Final = 10.0
"""Poses farther apart (m) are not joined to a path."""
_PLUS: Final = np.ones((3, 3), np.uint8)  # The eight neighbours of a cell, and itself.


def road_cells(ground: GroundModel, drive_xyh_m: npt.NDArray[np.float64]) -> Bools:
    """Returns a mask (rows, columns) of the cells of bare earth that are road; they were seen.

    drive_xyh_m : (p, 4) x, y, height and pass.
    """
    driven = driven_cells(ground, drive_xyh_m)
    if not driven.any():
        return driven
    away = distances(driven, ground.cell_m)
    even = (steps(ground.height_m) <= _STEEPEST * ground.cell_m) & (away < _REACH_M)
    inner = cv2.erode(even.view(np.uint8), _PLUS)
    count, label = cv2.connectedComponents(inner, connectivity=4)
    reached = np.zeros(count, np.bool_)
    reached[label[(away <= _DRIVEN_M) & (inner > 0)]] = True
    reached[0] = False
    wider = cv2.dilate(reached[label].view(np.uint8), _PLUS) > 0
    return np.asarray(wider & ground.seen)


def driven_cells(ground: GroundModel, drive_xyh_m: npt.NDArray[np.float64]) -> Bools:
    """Returns a mask (rows, columns) of the cells on the paths of the drives."""
    cells = np.zeros(ground.height_m.shape, np.uint8)
    place = np.floor((drive_xyh_m[:, :2] - [ground.x_min_m, ground.y_min_m]) / ground.cell_m).astype(np.int32)
    joined = np.hypot(*np.diff(drive_xyh_m[:, :2], axis=0).T) < _APART_M
    joined &= drive_xyh_m[1:, 3] == drive_xyh_m[:-1, 3]
    for k in np.flatnonzero(joined):
        cv2.line(cells, place[k].tolist(), place[k + 1].tolist(), 1)
    return cells > 0


def steps(height_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Returns the greatest difference (rows, columns) between each cell's height and those of its four neighbours (m).

    It is infinite beside cells whose height is not known.
    """
    out = np.zeros(height_m.shape, np.float32)
    for axis in (0, 1):
        step = np.abs(np.diff(height_m, axis=axis))
        step[np.isnan(step)] = np.inf
        before = np.insert(step, 0, 0.0, axis=axis)
        after = np.insert(step, step.shape[axis], 0.0, axis=axis)
        out = np.maximum(out, np.maximum(before, after))
    return out
