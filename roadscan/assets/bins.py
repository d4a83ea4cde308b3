"""Sorting of items by their bin, and sums over cells."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.buckets import by_number, raster_cells
from roadscan.assets.kernels.columns import distinct
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.extras import cv2


def in_bins(number: npt.NDArray[np.integer[Any]], bins: int) -> tuple[Int64, Int64]:
    """Returns the beginning of each bin (bins + 1,), and items (k,) by their bin, ascending in each.

    number : (n,) bin of each item; items of a negative bin are left out.
    """
    starts, order = np.zeros(bins + 1, np.int64), np.empty(number.size, np.int64)
    by_number(np.ascontiguousarray(number, np.int32), starts, order)
    return starts, order[: starts[-1]]


def cells_of(
    x_m: Float64, y_m: Float64, grid: tuple[float, float, float], shape: tuple[int, int]
) -> npt.NDArray[np.int32]:
    """Returns the flat number (n,) of the cell of places (n,): row · columns + column; −1 outside.

    grid : x and y of the raster's corner, edge of a cell (m). shape : its rows and columns.
    """
    cell = np.empty(x_m.size, np.int32)
    raster_cells(x_m, y_m, grid, shape, cell)
    return cell


def sums_around(cells: Float64 | Bool, size: int) -> Float64:
    """Returns sums (rows, columns) over the squares of `size` by `size` cells about each cell; outside lies 0."""
    values = np.asarray(cells, np.float64)
    return np.asarray(cv2.boxFilter(values, -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT))


def distinct_steps(epoch_gps_ns: Int64, step_ns: int) -> Int64:
    """Returns the steps of time (k,) that contain one of some epochs (n,), as whole numbers, ascending."""
    found = np.empty(4096, np.int64)
    count = distinct(epoch_gps_ns, step_ns, found)
    if count > found.size:
        found = np.empty(count, np.int64)
        distinct(epoch_gps_ns, step_ns, found)
    return np.unique(found[:count])
