"""First estimate of the ground and the returns on it: the common output of all filters."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.grid import Grid, grid_over
from roadscan.assets.ground.settings import GroundSettings
from roadscan.assets.kernels.lowest import counts
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box
from roadscan.assets.statistics import Statistics
from roadscan.compute.array_types import Float32
from roadscan.core.extras import cv2

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
    on_ground: npt.NDArray[np.bool_]
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
