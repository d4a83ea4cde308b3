"""The reconstructed surface of one tile, as products receive it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.core.errors import ConfigError
from roadscan.core.grid import Bounds, TileId
from roadscan.surface.heights import LowestReadings
from roadscan.surface.regions import NOTHING


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


EMPTY: Final = NOTHING
"""Origin of a cell without a height; the others are 1 measured, 2 interpolated, 3 filled."""


@dataclass(frozen=True)
class NodeColours:
    """Colours of some of a surface's cells, as the survey's pictures show them at their centres."""

    colour: npt.NDArray[np.uint8]
    """(rows, columns, 3) red, green, blue (sRGB) of the requested rows and columns."""
    seen: npt.NDArray[np.bool_]
    """(rows, columns) False where no picture shows a cell, or it has no height: no colour."""


@dataclass(frozen=True)
class SurfaceTile:
    """Heights of a tile's cells and of those around it, before and after smoothing.

    All arrays are (rows, columns): row 0 is the southernmost, column 0 the westernmost. They hold the cells of
    `window`: those of the tile and `halo` more on each side. A cell that several tiles see has the same bits in all
    of them.
    """

    tile: TileId
    window: GridWindow
    """Cells of the arrays on the map; a cell of row r and column c covers eastings from (first_column + c) ·
    cell_east_m and northings from (first_row + r) · cell_north_m."""
    halo: int
    """Cells of neighbours on each of the four sides; they reach 1 m or farther."""
    raw_m: npt.NDArray[np.float64]
    """Heights before smoothing (m, map frame), NaN where there is none: in filled cells as well."""
    height_m: npt.NDArray[np.float64]
    """Heights after smoothing (m, map frame), NaN where there is none; `raw_m` where smoothing is off."""
    origin: npt.NDArray[np.uint8]
    """0 empty, 1 measured, 2 interpolated, 3 filled; not empty where `height_m` is a number."""
    intensity: npt.NDArray[np.float32]
    """Mean intensity of the readings of a cell, of filled cells that of their rims; NaN where there is none."""
    sigma_m: float
    """1 σ of the noise of one cell's height before smoothing (m)."""
    colours: NodeColours | None = None
    """Colours of the cells that a product asked for; None for one that did not."""
    around_m: npt.NDArray[np.float64] | None = None
    """Heights before smoothing of more cells around the tile, as many as products ask for; None: those of `raw_m`."""
    lowest: LowestReadings | None = None
    """Of the same cells, filled ones and others without a height included; None where they are not known, as where the
    surface is made of points or the files of cells lack them."""

    @property
    def around(self) -> tuple[npt.NDArray[np.float64], int]:
        """Returns heights before smoothing (m), and the number of the neighbours' cells in them on each side."""
        wide = self.raw_m if self.around_m is None else self.around_m
        return wide, self.halo + (wide.shape[0] - self.raw_m.shape[0]) // 2

    @property
    def cell_m(self) -> tuple[float, float]:
        """Returns the edges of a cell: east, north (m)."""
        return self.window.cell_east_m, self.window.cell_north_m

    @property
    def corner_m(self) -> tuple[float, float]:
        """Returns easting and northing (m) of the arrays' south-western corner, halo included."""
        return self.window.first_column * self.window.cell_east_m, self.window.first_row * self.window.cell_north_m

    @property
    def inner(self) -> tuple[slice, slice]:
        """Returns row and column slices of the tile itself: the cells whose centre lies in it."""
        rows, columns = self.height_m.shape
        return slice(self.halo, rows - self.halo), slice(self.halo, columns - self.halo)


@dataclass(frozen=True)
class Regions:
    """Regions in which the surface is made: (n,) polygons on the map (m)."""

    shapes: npt.NDArray[Any]

    def near(self, *boxes: Bounds) -> Regions:
        """Returns those that intersect one of some boxes."""
        own = [shapely.box(b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m) for b in boxes]
        touch = shapely.intersects(self.shapes[:, None], np.array(own, object)[None, :])
        return Regions(self.shapes[touch.any(axis=1)])

    def key(self) -> list[str]:
        """Returns a key of their corners, all that affects a surface."""
        return sorted(one.hex() for one in shapely.to_wkb(self.shapes))

    def holds(self, window: GridWindow) -> npt.NDArray[np.bool_]:
        """Returns a mask (rows, columns) of the cells of a window whose centre lies in one of them."""
        easting_m, northing_m = np.meshgrid(*window.nodes_m())
        inside = np.zeros(easting_m.shape, bool)
        for shape in self.shapes:
            shapely.prepare(shape)
            inside |= shapely.intersects_xy(shape, easting_m, northing_m)
        return inside
