"""Natural-neighbour interpolation of scattered points onto a raster."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.natural_neighbour import (
    STEP_M,
    circle_centres,
    mesh_of,
    natural_neighbour_raster,
    slopes_of_points,
    triangulate,
)

WIDEST_M: Final = 100.0
"""Greatest extent of the points: positions are integers whose products have to fit 128 bits."""
_IN_BIN: Final = 3.0
"""Width of a row of the insertion order, in mean distances of points."""


def interpolate(
    x_m: Float64,
    y_m: Float64,
    value: Float64,
    west_south_m: tuple[float, float],
    cell_m: float,
    shape: tuple[int, int],
    *,
    smooth: bool = False,
) -> Float64:
    """Return (rows, columns) natural-neighbour values (Sibson 1981) at cell centres; NaN outside the points' hull.

    The values are exact on linear fields, and equal those of the points at their places. In flat triangles at the hull,
    where the areas lose their digits, the linear value is taken.

    Parameters
    ----------
    x_m, y_m, value : (n,) points, at most 100 m apart; of several at one place (2⁻³⁶ m) the first counts.
    west_south_m : corner of the first cell; rows go north, columns east.
    cell_m : edge of a cell; shape : rows and columns.
    smooth : the slope is continuous, too (Sibson's C1). It is nearer to a smooth field, and carries more noise: it
        weighs the planes at the points with their values, so values may lie beyond those of the points.

    Raises
    ------
    ValueError
        where points or cells lie more than 100 m apart, or a number is not finite.
    """
    rows, columns = shape
    ends = np.array([west_south_m, (west_south_m[0] + columns * cell_m, west_south_m[1] + rows * cell_m)])
    origin = ends[0]
    reach = max((float(np.abs(v - o).max()) for v, o in ((x_m, origin[0]), (y_m, origin[1])) if v.size), default=0.0)
    reach = max(reach, columns * cell_m, rows * cell_m)
    if not (reach <= WIDEST_M and np.isfinite(value).all()):
        raise ValueError(f"points or cells {reach:g} m from the raster's corner, or values that are not finite")
    x, y = (np.rint((v - o) / STEP_M).astype(np.int64) for v, o in ((x_m, origin[0]), (y_m, origin[1])))
    mesh = mesh_of(x, y)
    count = triangulate(mesh, insertion_order(x, y))
    centres = np.empty((len(mesh.triangles), 2))
    circle_centres(mesh, count, centres)
    held = np.ascontiguousarray(value, np.float64)
    slopes = np.empty((x.size if smooth else 0, 2))
    slopes_of_points(mesh, count if smooth else 0, centres, held, slopes)
    step, out = cell_m / STEP_M, np.empty(shape)
    natural_neighbour_raster(mesh, count, centres, held, slopes, np.full(2, 0.5 * step), step, out)
    return out


def insertion_order(x: npt.NDArray[np.int64], y: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return an order (n,) of points in which each lies near the one before: rows to and fro."""
    if x.size < 3:
        return np.arange(x.size)
    wide, high = float(np.ptp(x)) + 1.0, float(np.ptp(y)) + 1.0
    row_height = _IN_BIN * np.sqrt(wide * high / x.size) + 1.0
    row = ((y - y.min()) / row_height).astype(np.int64)
    along = np.where(row % 2 == 0, x, -x)
    return np.lexsort((y, along, row))
