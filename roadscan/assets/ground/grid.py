"""The raster in which ground is sought."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.scene import Box


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
