"""Decks of bridges and other structures over the path of a drive, from cubes above the ground."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.cubes import EDGE_M, Cubes
from roadscan.assets.ground.grid import Grid
from roadscan.assets.kernels import voxels
from roadscan.assets.kernels.corridors import mark_corridor
from roadscan.core.extras import cv2

Bools = npt.NDArray[np.bool_]

_LOWEST_M: Final = 2.5
"""Least height of a structure over the path (m)."""
_CORRIDOR_M: Final = 1.5
"""Half width of the corridor of a drive (m)."""
_LEAST_CELLS: Final = 4
"""Least number of cells of the corridor under a structure."""
_PLANAR: Final = 0.4  # Least planarity of a deck's cube.
_UPRIGHT: Final = 0.25  # Least upward part of its normal.
_BELOW_CUBES, _ABOVE_CUBES = 1, 4
"""Edges and parapets of a deck reach this far below and above its level cubes (cubes)."""
_DECK_CELLS: Final = 7
"""Least extent of a deck's lower face in both directions (cells of 0.3 m): that of a gantry is less."""


def overhead_classes(
    cubes: Cubes, grid: Grid, leafy: Bools, left_out: Bools, drive_xyh_m: npt.NDArray[np.float64]
) -> npt.NDArray[np.uint8]:
    """Returns the class (cubes,) of each cube: bridge deck, overhead structure, or 0 for neither.

    What hangs together 2.5 m above the ground or higher, seen from above, is a structure over the way where a drive
    passes beneath it. It is a bridge deck where it holds a level plane of 2.1 m by 2.1 m above that drive; its edges
    scatter in all directions as leaves do, and belong to it.

    Parameters
    ----------
    leafy : (cubes,) those that scatter as leaves do; left_out : (cubes,) those that are wires or walls.
    drive_xyh_m : (p, 4) x, y and height of the sensor (m) and the pass.
    """
    out = np.zeros(left_out.size, np.uint8)
    high = ~left_out & (cubes.place[:, 2] * EDGE_M >= _LOWEST_M)
    corridor = _corridors(grid, drive_xyh_m)
    row, column, layer = cubes.place.T
    if not (high & corridor[row, column]).any():
        return out
    level = high & (cubes.features[:, voxels.PLANARITY] >= _PLANAR)
    level &= cubes.features[:, voxels.NORMAL_UP] > _UPRIGHT
    hanging = (high & ~leafy) | level
    cells = np.zeros(grid.shape, np.uint8)
    cells[row[hanging], column[hanging]] = 1
    count, label = cv2.connectedComponents(cv2.morphologyEx(cells, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)))
    over = np.bincount(label[corridor & (cells > 0)], minlength=count) >= _LEAST_CELLS
    over[0] = False
    faces = np.zeros(grid.shape, np.uint8)
    faces[row[level], column[level]] = 1
    faces = cv2.morphologyEx(faces, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    wide = cv2.morphologyEx(faces, cv2.MORPH_OPEN, np.ones((_DECK_CELLS, _DECK_CELLS), np.uint8)) > 0
    decks = np.bincount(label[wide & corridor], minlength=count) > 0
    own = label[row, column]
    out[high & ~leafy & over[own]] = classes.OVERHEAD_STRUCTURE
    for number in np.flatnonzero(over & decks).tolist():
        about = cv2.dilate((label == number).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        layers = layer[level & (own == number)]
        near = high & (layer >= layers.min() - _BELOW_CUBES) & (layer <= layers.max() + _ABOVE_CUBES)
        out[near & about[row, column]] = classes.BRIDGE_DECK
    return out


def _corridors(grid: Grid, drive_xyh_m: npt.NDArray[np.float64]) -> Bools:
    """Returns a mask of cells (rows, columns) near the drives."""
    inside = np.zeros(grid.shape, np.bool_)
    for number in np.unique(drive_xyh_m[:, 3]).tolist():
        drive = drive_xyh_m[drive_xyh_m[:, 3] == number]
        x, y = np.ascontiguousarray(drive[:, 0]), np.ascontiguousarray(drive[:, 1])
        mark_corridor(x, y, _CORRIDOR_M, np.array(grid.origin), EDGE_M, inside)
    return inside
