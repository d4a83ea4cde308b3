"""The intensity raster of a section: interpolated, scaled to 8 bits, closed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.natural_neighbour import interpolate
from roadscan.condition.roughness_regions.points import RoadPoints
from roadscan.core.extras import cv2

_BRIGHTEST: Final = 255  # Largest 8-bit value.


@dataclass(frozen=True, eq=False)
class IntensityRaster:
    """Intensities of the cells of a rotated section, rows to the left and columns along the road."""

    values: npt.NDArray[np.uint8]
    """(rows, columns) 8-bit intensities, closed; 0 where not measured."""
    local_mean: Float64
    """(rows, columns) mean intensity of all points, thinned or not, of the 3 × 3 cells around; NaN without any."""
    measured: npt.NDArray[np.bool_]
    """(rows, columns)"""
    corner_m: tuple[float, float]
    """x and y of the first cell's outer corner."""
    cell_m: float
    dimmest: float
    """Intensity that 0 stands for."""
    brightest: float
    """Intensity that 255 stands for."""

    def cells_at(self, x_m: Float64, y_m: Float64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return rows and columns (n,) of the cells at places, clipped to the raster."""
        rows, columns = self.values.shape
        column, row = (
            np.floor(v / self.cell_m).astype(np.int64) - round(c / self.cell_m)
            for v, c in zip((x_m, y_m), self.corner_m, strict=True)
        )
        return np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)

    def intensity(self, value: float) -> float:
        """Return the intensity of an 8-bit value."""
        return self.dimmest + (self.brightest - self.dimmest) * value / _BRIGHTEST


def intensity_raster(
    points: RoadPoints, thinned: RoadPoints, cell_m: float, largest_gap_m: float, clip_share: float
) -> IntensityRaster | None:
    """Return the 8-bit raster of thinned points by natural neighbours; None where no cell has a value.

    Parameters
    ----------
    points : rotated, all; thinned : first level of their pyramid; cell_m : edge of a cell.
    largest_gap_m : cells farther from every point are not measured.
    clip_share : share of the cells that the scale clips at each end.
    """
    import scipy.ndimage

    if len(thinned) < 3:
        return None
    first = [int(np.floor(v.min() / cell_m)) for v in (thinned.x_m, thinned.y_m)]
    columns, rows = (
        int(np.floor(v.max() / cell_m)) - k + 1 for v, k in zip((thinned.x_m, thinned.y_m), first, strict=True)
    )
    corner = (first[0] * cell_m, first[1] * cell_m)
    found = interpolate(thinned.x_m, thinned.y_m, thinned.intensity, corner, cell_m, (rows, columns))
    empty = np.ones((rows, columns), bool)
    at = [np.floor(v / cell_m).astype(np.int64) - k for v, k in zip((thinned.x_m, thinned.y_m), first, strict=True)]
    empty[at[1], at[0]] = False
    far = scipy.ndimage.distance_transform_edt(empty, sampling=cell_m) > largest_gap_m + 0.5 * cell_m
    measured = ~far & ~np.isnan(found)
    if not measured.any():
        return None
    known = np.sort(found[measured])
    clipped = int(clip_share * (known.size - 1))
    dimmest, brightest = float(known[clipped]), float(known[known.size - 1 - clipped])
    # Interpolated equal intensities differ by rounding.
    scale = _BRIGHTEST / (brightest - dimmest) if brightest - dimmest > 1e-9 * abs(brightest) else 0.0
    grey = np.clip(np.rint((np.where(measured, found, dimmest) - dimmest) * scale), 0, _BRIGHTEST).astype(np.uint8)
    return IntensityRaster(
        grey, _local_mean(points, corner, cell_m, (rows, columns)), measured, corner, cell_m, dimmest, brightest
    )


def _local_mean(points: RoadPoints, corner_m: tuple[float, float], cell_m: float, shape: tuple[int, int]) -> Float64:
    """Return (rows, columns) means of the points of 3 × 3 cells."""
    at = [np.floor((v - c) / cell_m).astype(np.int64) for v, c in zip((points.x_m, points.y_m), corner_m, strict=True)]
    cell = np.clip(at[1], 0, shape[0] - 1) * shape[1] + np.clip(at[0], 0, shape[1] - 1)
    sums = [
        cv2.boxFilter(
            np.bincount(cell, weights, shape[0] * shape[1]).reshape(shape),
            -1,
            (3, 3),
            None,
            (-1, -1),
            False,
            cv2.BORDER_CONSTANT,
        )
        for weights in (points.readings * points.intensity, points.readings)
    ]
    means: Float64 = np.divide(sums[0], sums[1], out=np.full(shape, np.nan), where=sums[1] > 0.5)
    return means


def closed(grey: npt.NDArray[np.uint8], measured: npt.NDArray[np.bool_], edge_cells: int) -> npt.NDArray[np.uint8]:
    """Return the raster after dilation and erosion by a square; unmeasured cells are excluded."""
    square = np.ones((edge_cells, edge_cells), np.uint8)
    wide = cv2.dilate(
        np.where(measured, grey, 0).astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    wide[~measured] = _BRIGHTEST
    narrow = cv2.erode(wide, square, borderType=cv2.BORDER_CONSTANT, borderValue=_BRIGHTEST)
    return np.where(measured, narrow, 0).astype(np.uint8)
