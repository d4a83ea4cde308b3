"""The statistics of a tile's cells as columns, which kernels write."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare_inlined


class CellColumns(NamedTuple):
    """Columns for c cells with a reading, in order of row and column, of up to p passes each."""

    column: npt.NDArray[np.uint16]
    """(c,) in the tile."""
    row: npt.NDArray[np.uint16]
    """(c,)"""
    readings: npt.NDArray[np.uint32]
    """(c,)"""
    height_mean_m: npt.NDArray[np.float64]
    """(c,)"""
    height_robust_m: npt.NDArray[np.float64]
    """(c,) mean of the heights near the median."""
    height_min_m: npt.NDArray[np.float64]
    """(c,)"""
    height_max_m: npt.NDArray[np.float64]
    """(c,)"""
    height_std_m: npt.NDArray[np.float32]
    """(c,)"""
    intensity_mean: npt.NDArray[np.float32]
    """(c,)"""
    pass_offsets: npt.NDArray[np.int32]
    """(c + 1,) first pass of each cell, and the end."""
    pass_ids: npt.NDArray[np.uint16]
    """(c · p,) ids of each cell's passes, ascending."""


@bare_inlined
def write_statistics(out, lane, cell, columns):
    """Write a lane of `out`, see ``column_statistics.statistics_of``, as the statistics of a cell."""
    columns.height_mean_m[cell], columns.height_robust_m[cell] = out[0, lane], out[1, lane]
    columns.height_min_m[cell], columns.height_max_m[cell] = out[2, lane], out[3, lane]
    columns.height_std_m[cell], columns.intensity_mean[cell] = np.float32(out[4, lane]), np.float32(out[5, lane])
