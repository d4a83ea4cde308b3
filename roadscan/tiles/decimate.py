"""Reduces a tile's cells to one point per square: the pavement's height without loose stones and cracks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import read_only
from roadscan.core.errors import ConfigError
from roadscan.core.grid import TileGrid
from roadscan.tiles.cells import TileCells

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
    own = kernels.Cells(
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
