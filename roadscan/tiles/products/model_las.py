"""``model_las``, ``model_las_fine``: the pavement's surface as few, even points, for CAD and paver guidance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.compute.kernel_options import read_only
from roadscan.core.errors import ConfigError
from roadscan.core.grid import QUANTA_PER_M, TileGrid
from roadscan.core.strict import Strict
from roadscan.store.codecs.las import ONE_OF_ONE, Layout, check_points, write_points
from roadscan.tiles.cells import TileCells
from roadscan.tiles.product import Cells, ProductContext, Tile, TileProduct
from roadscan.tiles.products.las import Axes, axis, rounding_errors, set_coordinates

_UNCLASSIFIED = 1  # ASPRS class.
_WITHHELD = np.uint8(4)
"""Flag of a withheld point."""
_FURTHER = (("cells", "u2", "cells that count"), ("points", "u2", "readings in them"))
_MOST = 65_535  # Largest number of the dimensions ``cells`` and ``points``.


class ModelLasOptions(Strict):
    """Settings of the pavement model."""

    spacing_m: float = Field(default=0.1, ge=1e-3)
    """Distance of the points (m): a whole number of cells that divides the tile's edge."""
    min_cover: float = Field(default=0.25, ge=0, le=1)
    """Share of a square's cells that its height has to come from; points of less (at the edge of what was seen, beside
    gaps) are written withheld."""
    compress: bool = True
    """Write LAZ; otherwise LAS."""
    scale_m: float = Field(default=1e-4, ge=1e-5, le=0.1)
    """Step of the stored coordinates (m). In a CRS in feet the next finer of 1, 2 or 5 × 10ⁿ feet is taken."""


class ModelLasFineOptions(ModelLasOptions):
    """Settings of the fine pavement model."""

    spacing_m: float = Field(default=0.02, ge=1e-3)
    """Distance of the points (m): a whole number of cells that divides the tile's edge."""


class ModelLas(TileProduct):
    """LAS 1.4 (point format 6), one point at the centre of each square of 0.1 m, made from the tile's cells alone.

    The height is filtered so that it is neither that of loose aggregate nor that of a crack (Laurent, Petitclerc
    and Fox-Ivey, *3D laser road profiling*: "points are decimated to fixed resolutions, and the vertical
    position is filtered"): with the slope of the patch taken off, the cells within 3 · 1.4826 · MAD (at least
    1 mm) of the median count, and their mean is the height at the centre. Slopes are medians as well, so neither
    cross-fall nor gradient lets a stone pass (`decimate` in `roadscan/tiles/products/model_las.py` states the rule).
    What covers more than half of a square, as a wide pothole, is surface.

    Intensity is the mean of the cells that count; the extra dimensions ``cells`` and ``points`` say how many they
    are, and how many readings lie in them (65,535 stands for more). All points are unclassified (1), first of one
    return, and of the source 0; a model has no time, so gps_time is 0. Points of squares that are hardly covered, or
    where too few cells lie to tell the slope, are withheld.
    """

    name: ClassVar[str] = "model_las"
    title: ClassVar[str] = "pavement surface every 100 mm, without stones and cracks (LAS 1.4 or LAZ), for CAD"
    suffix: ClassVar[str] = ".laz"
    version: ClassVar[int] = 3
    options: ClassVar[type[Strict]] = ModelLasOptions
    default_cells: ClassVar[Cells] = "fine"

    def suffix_for(self, options: Strict) -> str:
        """``.laz`` or ``.las``."""
        return ".laz" if cast(ModelLasOptions, options).compress else ".las"

    def check_options(self, options: Strict, context: ProductContext) -> None:
        """Raise an error for a spacing that is no whole number of cells."""
        self._side(cast(ModelLasOptions, options), context)

    def write(self, tile: Tile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the tile's model."""
        settings = cast(ModelLasOptions, options)
        side = self._side(settings, context)
        squares = decimate(tile.cells, side, context.grid.cell_m)
        axes = self._axes(squares, tile, side, settings, context)
        layout = Layout(6, _FURTHER, tuple(one.scale for one in axes), context.map, self.name)
        records = _records(squares, axes, layout, settings.min_cover * side * side)
        facts = {
            "survey": context.survey_id,
            "tile": str(tile.cells.tile),
            "height": context.map.height,
            "spacing_m": settings.spacing_m,
            "min_cover": settings.min_cover,
            "rounding_error_max_m": rounding_errors(axes),
        }
        write_points(path, layout, [one.offset for one in axes], records, facts, context.date, settings.compress)

    def check(self, path: Path) -> None:
        """Decode every point and compare number, box and digest with what the header states."""
        check_points(path)

    def _side(self, options: ModelLasOptions, context: ProductContext) -> int:
        return cells_per_square(options.spacing_m, context.grid, f"{self.name}.spacing_m")

    def _axes(self, squares: Squares, tile: Tile, side: int, options: ModelLasOptions, context: ProductContext) -> Axes:
        size, frame, place = context.grid.size_quanta, context.map, tile.cells.tile
        edge_quanta = side * context.grid.cell_quanta
        scale_m = options.scale_m
        return (
            axis(
                (squares.column + 0.5) * edge_quanta, place.column * size, scale_m, frame.horizontal_unit_m, self.name
            ),
            axis((squares.row + 0.5) * edge_quanta, place.row * size, scale_m, frame.horizontal_unit_m, self.name),
            axis(squares.height_m * QUANTA_PER_M, 0, scale_m, frame.vertical_unit_m, self.name),
        )


class ModelLasFine(ModelLas):
    """As [`model_las`](#model_las), a point each 20 mm."""

    name: ClassVar[str] = "model_las_fine"
    title: ClassVar[str] = "pavement surface every 20 mm, without stones and cracks (LAS 1.4 or LAZ), for CAD"
    options: ClassVar[type[Strict]] = ModelLasFineOptions
    default: ClassVar[bool] = False


def _records(squares: Squares, axes: Axes, layout: Layout, enough_cells: float) -> npt.NDArray[np.void]:
    records = np.zeros(len(squares), layout.records)
    set_coordinates(records, axes)
    records["intensity"] = np.clip(np.rint(squares.intensity), 0, 65_535).astype(np.uint16)
    records["classification"] = _UNCLASSIFIED
    records["bit_fields"] = ONE_OF_ONE
    records["classification_flags"] = _WITHHELD * ((squares.cells < enough_cells) | ~squares.sloped)
    records["cells"], records["points"] = np.minimum(squares.cells, _MOST), np.minimum(squares.points, _MOST)
    return records


PATCH_M: Final = 0.1
"""A slope is computed from at least this length of road; from fewer cells, a few stones would make one."""

FLOOR_UM: Final = 1000
"""Residuals within 1 mm of the median always count."""

_SAMPLE: Final = 1001  # About this many cells give the base from which heights are counted.


@dataclass(frozen=True)
class Squares:
    """Squares of a tile with at least one cell, in order of row and column; all arrays are (s,)."""

    column: npt.NDArray[np.uint16]
    """Column of the square in its tile, from the west edge."""
    row: npt.NDArray[np.uint16]
    """Row of the square in its tile, from the south edge."""
    height_m: npt.NDArray[np.float64]
    """Height at the square's centre, in the map frame."""
    intensity: npt.NDArray[np.float32]
    """Mean intensity of the cells that count."""
    cells: npt.NDArray[np.uint32]
    """Number of cells that count."""
    points: npt.NDArray[np.uint32]
    """Number of points in those cells."""
    sloped: npt.NDArray[np.bool_]
    """False where too few cells around the square determine a slope: the height is that of its cells' middle."""

    def __len__(self) -> int:
        return int(self.column.size)


def cells_per_square(spacing_m: float, grid: TileGrid, setting: str) -> int:
    """Number of cells along a square's edge; raises :class:`ConfigError` where squares do not fit cells and tile."""
    side = round(spacing_m / grid.cell_m)
    if side < 1 or abs(side * grid.cell_m - spacing_m) > 1e-9 or grid.cells_per_edge % side:
        raise ConfigError(
            f"{setting} = {spacing_m:g}",
            expected=f"whole cells of {grid.cell_m:g} m that divide the tile's edge of {grid.size_m:g} m",
            change=f"choose for example {20 * grid.cell_m:g}, or smaller cells (tiles.cell_m)",
        )
    return side


def decimate(cells: TileCells, side: int, cell_m: float) -> Squares:
    """Return the robust height of every square of `side`² cells.

    Let z be the robust heights of a square's cells and (x, y) their centres, counted from the square's centre.

    1. A slope towards east (north) is the lower median of the steps between two cells of a row (column) that lie
       half a patch apart, divided by that distance. A patch is the square itself, or as many squares as make
       0.1 m. Without such pairs over an eighth of the patch, a quarter of it is taken, and so on; without any
       the slope is 0 and the square is marked (`sloped`).
    2. r = z − slope · (x, y); m is the lower median of r.
    3. Cells within 3 · 1.4826 · MAD (at least 1 mm) of m count. The height is m + mean(r − m) over them.

    The median step holds while fewer than 29 % of the cells lie off the surface (then most pairs are clean), the
    median height up to half of them; both do so on any cross-fall. Heights are rounded to 1 µm before, and cut off
    268 m above and below the middle of the tile's. Equal to the bit whatever else is computed.

    Parameters
    ----------
    side : cells along an edge of a square, a divisor of the tile's.
    cell_m : edge of a cell (m).
    """
    from roadscan.tiles.kernels import decimate as kernels
    from roadscan.tiles.kernels.decimate_2x2 import decimate_2x2
    from roadscan.tiles.kernels.pyramid import Cells

    edge = cells.cells_per_edge
    patch = patch_cells(side, edge, cell_m)
    room = min(len(cells), (edge // side) ** 2)
    out = kernels.Squares(
        column=np.empty(room, np.uint16), row=np.empty(room, np.uint16), height_m=np.empty(room, np.float64),
        intensity=np.empty(room, np.float32), cells=np.empty(room, np.uint32), points=np.empty(room, np.uint32),
        sloped=np.empty(room, np.bool_),
    )  # fmt: skip
    some = cells.height_robust_m[:: max(len(cells) // _SAMPLE, 1)]
    base = float(np.floor(np.median(some))) if len(cells) else 0.0
    own = Cells(
        cells.column, cells.row, read_only(cells.height_robust_m), cells.intensity_mean, cells.count
    )  # fmt: skip
    if patch == side == 2:
        starts = np.searchsorted(cells.row, np.arange(edge + 1))
        written = int(decimate_2x2(own, starts, base, FLOOR_UM, out))
    else:
        written = int(kernels.decimate_cells(own, base, edge, patch, side, FLOOR_UM, out))
    return Squares(**{name: values[:written] for name, values in out._asdict().items()})


def patch_cells(side: int, edge: int, cell_m: float) -> int:
    """Return the edge of a patch in cells: the fewest squares that make 0.1 m and divide the tile."""
    squares = edge // side
    enough = max(1, math.ceil(PATCH_M / (side * cell_m) - 1e-9))
    return side * next(n for n in range(min(enough, squares), squares + 1) if squares % n == 0)
