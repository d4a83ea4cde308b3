"""A window of a grid of the map, whose cells need not be square nor divide a tile."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError
from roadscan.core.grid import Bounds


@dataclass(frozen=True)
class GridWindow:
    """Cells of the grid that starts at the map's origin; heights are evaluated at their centres, the nodes.

    A node's place follows from its number alone, so windows that share nodes ask at the same floats.
    """

    first_column: int
    """From the map's origin eastwards."""
    first_row: int
    """From the map's origin northwards."""
    columns: int
    rows: int
    cell_east_m: float
    cell_north_m: float

    def __post_init__(self) -> None:
        for name in ("cell_east_m", "cell_north_m"):
            edge = getattr(self, name)
            if not (math.isfinite(edge) and edge > 0.0):
                raise ConfigError(f"{name} {edge}", expected="a length in metres above 0")
        if self.columns < 0 or self.rows < 0:
            raise ConfigError(f"a window of {self.columns} × {self.rows} cells", expected="numbers from 0")

    @classmethod
    def over(cls, box: Bounds, cell_east_m: float, cell_north_m: float) -> Self:
        """Cells whose centre lies in a box (lower edges inclusive): adjacent boxes neither share nor omit any."""
        spans = (
            (box.easting_min_m, box.easting_max_m, cell_east_m),
            (box.northing_min_m, box.northing_max_m, cell_north_m),
        )
        (column, end_column), (row, end_row) = ((_first(low, edge), _first(high, edge)) for low, high, edge in spans)
        return cls(column, row, end_column - column, end_row - row, cell_east_m, cell_north_m)

    def grown(self, cells: int) -> GridWindow:
        """Returns the window with `cells` more on each of the four sides."""
        return GridWindow(
            self.first_column - cells, self.first_row - cells, self.columns + 2 * cells, self.rows + 2 * cells,
            self.cell_east_m, self.cell_north_m,
        )  # fmt: skip

    def bounds(self) -> Bounds:
        """Returns the box of the cells on the map (m)."""
        east, north = self.cell_east_m, self.cell_north_m
        return Bounds(
            self.first_column * east, self.first_row * north,
            (self.first_column + self.columns) * east, (self.first_row + self.rows) * north,
        )  # fmt: skip

    def nodes_m(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Returns eastings (columns,) and northings (rows,) of the nodes (m)."""
        return (
            _centres(self.first_column, self.columns, self.cell_east_m),
            _centres(self.first_row, self.rows, self.cell_north_m),
        )


def _centres(first: int, count: int, edge_m: float) -> npt.NDArray[np.float64]:
    return (np.arange(first, first + count, dtype=np.float64) + 0.5) * edge_m


def _first(at_least_m: float, edge_m: float) -> int:
    """Returns the first cell whose centre is not below a coordinate."""
    guess = math.ceil(at_least_m / edge_m - 0.5)
    while (guess + 0.5) * edge_m < at_least_m:
        guess += 1
    while (guess - 0.5) * edge_m >= at_least_m:
        guess -= 1
    return guess
