"""First estimate of the ground: its raster, the opening of the lowest returns, and the returns on it.

The surface of the lowest returns is opened with growing windows, after Pingel, Clarke, McBride (2013), "An improved
simple morphological filter for the terrain classification of airborne LIDAR data", ISPRS Journal 77: 21–30.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.ground import begin, halved, least_over_disk, relax
from roadscan.assets.kernels.low_returns import counts
from roadscan.assets.scene import Box, Returns, Statistics
from roadscan.assets.settings import GroundSettings
from roadscan.compute.array_types import Bool, Float32
from roadscan.core.extras import cv2

_COARSEST_M, _COARSEST = 8.0, 16
"""Holes are filled from cells of this edge (m) on, or of so many cells where that is more: 16 m for returns from the
air, between which whole buildings lie."""


def distances(found: Bool, cell_m: float) -> Float32:
    """Returns the distance (rows, columns) of each cell from the nearest one that is True (m)."""
    away = cv2.distanceTransform((~found).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(away * np.float32(cell_m))


class Grid(NamedTuple):
    """Square cells from a corner: row 0 is the southern one, column 0 the western one."""

    x_min_m: float
    y_min_m: float
    cell_m: float
    rows: int
    columns: int

    @property
    def origin(self) -> npt.NDArray[np.float64]:
        """Returns (2,) x and y of the corner (m)."""
        return np.array([self.x_min_m, self.y_min_m])

    @property
    def shape(self) -> tuple[int, int]:
        """Returns rows and columns."""
        return self.rows, self.columns

    @property
    def corner(self) -> tuple[int, int]:
        """Returns row and column of the first cell, counted from the place from which coordinates count."""
        return round(self.y_min_m / self.cell_m), round(self.x_min_m / self.cell_m)

    @property
    def middles_m(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Returns the middles of the columns (x) and of the rows (y) (m)."""
        x = self.x_min_m + (np.arange(self.columns, dtype=np.float64) + 0.5) * self.cell_m
        return x, self.y_min_m + (np.arange(self.rows, dtype=np.float64) + 0.5) * self.cell_m


def grid_over(window: Box, cell_m: float) -> Grid:
    """Returns cells that cover the window from its south-western corner."""
    columns = max(math.ceil((window.x_max_m - window.x_min_m) / cell_m - 1e-9), 1)
    rows = max(math.ceil((window.y_max_m - window.y_min_m) / cell_m - 1e-9), 1)
    return Grid(window.x_min_m, window.y_min_m, cell_m, rows, columns)


def filled(height_m: Float32, known: Bool, grid: Grid) -> Float32:
    """Returns heights (rows, columns), the unknown ones on a membrane through the known ones; 0 if none is known.

    Cells are halved on one lattice of the map, up to an edge of 8 m or 16 cells. In larger holes the heights around go
    on, ring by ring. So a height depends on what lies up to about twice as far away as the nearest known one, however
    much of the map is filled at once.

    height_m : (rows, columns), read where `known` is True.
    """
    z = np.where(known, height_m, np.float32(0.0)).astype(np.float32)
    return (
        z
        if known.all() or not known.any()
        else _filled(z, known, grid.corner, max(_COARSEST, round(_COARSEST_M / grid.cell_m)))
    )


def _filled(z: Float32, known: Bool, corner: tuple[int, int], cells: int) -> Float32:
    if cells <= 1:
        return _continued(z, known)
    odd = corner[0] % 2, corner[1] % 2
    shape = (z.shape[0] + odd[0] + 1) // 2, (z.shape[1] + odd[1] + 1) // 2
    coarse, coarse_known = np.empty(shape, np.float32), np.empty(shape, np.bool_)
    halved(z, known, odd, coarse, coarse_known)
    begin(_filled(coarse, coarse_known, (corner[0] // 2, corner[1] // 2), cells // 2), known, odd, z)
    relax(z, known)
    return z


def _continued(z: Float32, known: Bool) -> Float32:
    """Returns heights (rows, columns): ring by ring, each unknown one is the mean of those known beside it."""
    rows, columns = z.shape
    while not known.all():
        sums, number = np.zeros(z.shape), np.zeros(z.shape)
        wide, held = np.pad(np.where(known, z, 0.0), 1), np.pad(known, 1)
        for r, c in np.ndindex(3, 3):
            sums += wide[r : r + rows, c : c + columns]
            number += held[r : r + rows, c : c + columns]
        z = np.where(known, z, sums / np.maximum(number, 1.0)).astype(np.float32)
        known = number > 0
    return z


DENSE_PER_M2: Final = 4
"""Median number of returns of the non-empty square metres from which the data are those of a scanner on the road:
scanners from the air give about one."""


@dataclass(frozen=True, eq=False)
class Place:
    """Input of a filter: the returns of a window, and the settings."""

    returns: Returns
    window: Box
    settings: GroundSettings
    statistics: Statistics = field(default_factory=Statistics)


class Surface(NamedTuple):
    """Whole heights (rows, columns) at the middles of a grid's cells (m)."""

    grid: Grid
    height_m: Float32

    def at(self, grid: Grid) -> Float32:
        """Returns heights at the middles of another grid's cells, bilinear."""
        return sampled(self.height_m, self.grid, grid)

    def slope(self) -> Float32:
        """Returns the slope (rows, columns) of the surface (m/m)."""
        if min(self.height_m.shape) < 2:
            return np.zeros(self.height_m.shape, np.float32)
        north, east = np.gradient(self.height_m, self.grid.cell_m)
        return np.asarray(np.hypot(north, east), np.float32)


class Found(NamedTuple):
    """The returns on the ground."""

    base: Surface
    """A first estimate of the ground, near to it."""
    above_m: Float32
    """(n,) heights of returns above that estimate (m)."""
    on_ground: Bool
    """(n,)."""


def sampled(z: Float32, grid: Grid, other: Grid) -> Float32:
    """Returns raster z of a grid (rows, columns), bilinear at the middles of another grid's cells."""
    x_m, y_m = other.middles_m
    u = np.clip((x_m - grid.x_min_m) / grid.cell_m - 0.5, 0, grid.columns - 1).astype(np.float32)
    v = np.clip((y_m - grid.y_min_m) / grid.cell_m - 0.5, 0, grid.rows - 1).astype(np.float32)
    return np.asarray(cv2.remap(z, *np.meshgrid(u, v), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def is_dense(place: Place) -> bool:
    """Returns whether the returns of the survey are as dense as those of a scanner on the road."""

    def held() -> npt.NDArray[np.float64]:
        grid = grid_over(place.window, 1.0)
        found = np.zeros(grid.shape, np.int32)
        counts(place.returns.x_m, place.returns.y_m, grid.origin, 1.0, found)
        return found[found > 0].astype(np.float64)

    return (place.statistics.of("returns_per_m2", 0.5, held) or 0.0) >= DENSE_PER_M2


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


def objects(surface: Float32, cell_m: float, steepest: float, largest_m: float) -> Bool:
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


def without_pits(lowest_m: Float32, pit_m: float, grid: Grid) -> tuple[Float32, Bool]:
    """Returns the whole surface of the lowest returns without those in pits, and a mask of the cells that it has.

    lowest_m : (rows, columns), inf where a cell has no return.
    pit_m : a lowest return is noise where it lies below the surface around by more.
    """
    known = np.isfinite(lowest_m)
    surface = filled(lowest_m, known, grid)
    pits = -surface - opened(-surface, 1) > pit_m
    if (pits & known).any():
        known &= ~pits
        surface = filled(lowest_m, known, grid)
    return surface, known


def bare_cells(surface: Float32, cell_m: float, settings: GroundSettings) -> Bool:
    """Returns a mask of the cells of a whole surface (rows, columns) that do not stand on the ground."""
    return ~objects(surface, cell_m, settings.steepest, settings.largest_object_m)
