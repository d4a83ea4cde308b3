"""Bare earth by opening the surface of lowest returns with growing windows.

After Pingel, Clarke, McBride (2013), "An improved simple morphological filter for the terrain classification of
airborne LIDAR data", ISPRS Journal 77: 21–30.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.filling import filled
from roadscan.assets.ground.grid import Grid
from roadscan.assets.ground.settings import GroundSettings
from roadscan.assets.kernels.ground_cells import least_over_disk
from roadscan.compute.array_types import Float32

Bools = npt.NDArray[np.bool_]

_GROWTH: Final = 1.15
"""Each window is wider than the one before by this factor, and by at least one cell."""


def opened(z: Float32, radius: int) -> Float32:
    """Returns the opening of a surface (rows, columns) by a disk of so many cells; cells outside do not count."""
    return -_least_over_disk(-_least_over_disk(z, radius), radius)


def _least_over_disk(z: Float32, radius: int) -> Float32:
    """Returns the least height within a disk about each cell: of the cells whose middles lie within `radius` cells."""
    widths = np.array([math.isqrt(radius * radius - up * up) for up in range(radius + 1)])
    out = np.full(z.shape, np.inf, np.float32)
    least_over_disk(np.ascontiguousarray(z, np.float32), widths, np.empty(z.shape[1], np.float32), out)
    return out


def windows(largest_m: float, cell_m: float) -> list[int]:
    """Returns radii (cells), growing to the largest."""
    last, found, radius = max(round(largest_m / cell_m), 1), [], 1
    while radius < last:
        found.append(radius)
        radius = max(radius + 1, math.floor(radius * _GROWTH))
    return [*found, last]


def objects(surface: Float32, cell_m: float, steepest: float, largest_m: float) -> Bools:
    """Returns a mask of the cells of a whole surface (rows, columns) that stand on the ground (section 2.2).

    Beyond its edges the surface continues as its reflection, so that a slope stays one: opened alone, its
    upper edge would be cut.
    """
    margin = min(max(round(largest_m / cell_m), 1), *(side - 1 for side in surface.shape))
    if margin < 1:
        return np.zeros(surface.shape, np.bool_)
    before = np.pad(surface, margin, mode="reflect", reflect_type="odd")
    found = np.zeros(before.shape, np.bool_)
    for radius in windows(largest_m, cell_m):
        after = opened(before, radius)
        found |= before - after > steepest * radius * cell_m
        before = after
    return found[margin:-margin, margin:-margin]


def without_pits(lowest_m: Float32, pit_m: float, grid: Grid) -> tuple[Float32, Bools]:
    """Returns the whole surface of the lowest returns without those in pits, and a mask of the cells that it has.

    lowest_m : (rows, columns), inf where a cell has no return.
    pit_m : a lowest return is noise where it lies below the surface around by more.
    """
    known = np.isfinite(lowest_m)
    surface = filled(lowest_m, known, grid.corner, grid.cell_m)
    pits = -surface - opened(-surface, 1) > pit_m
    if (pits & known).any():
        known &= ~pits
        surface = filled(lowest_m, known, grid.corner, grid.cell_m)
    return surface, known


def bare_cells(surface: Float32, cell_m: float, settings: GroundSettings) -> Bools:
    """Returns a mask of the cells of a whole surface (rows, columns) that do not stand on the ground."""
    return ~objects(surface, cell_m, settings.steepest, settings.largest_object_m)
