"""The intensity raster of a section: interpolated, scaled to 8 bits, closed."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about
from roadscan.condition.kernels.natural_neighbour import (
    STEP_M,
    circle_centres,
    mesh_of,
    natural_neighbour_raster,
    slopes_of_points,
    triangulate,
)
from roadscan.core.errors import ProfileError
from roadscan.core.extras import cv2


@dataclass(frozen=True, eq=False)
class RoadPoints:
    """Points (n,) of a section of road: readings, or cells that stand for several readings."""

    x_m: Float64
    """Easting, or way along the road where the points are rotated."""
    y_m: Float64
    """Northing, or way to the left."""
    height_m: Float64
    intensity: Float64
    """On any scale that begins at 0."""
    readings: Float64
    """Number of readings for which a point stands."""

    def __len__(self) -> int:
        return int(self.x_m.size)

    @classmethod
    def of(
        cls,
        easting_m: npt.ArrayLike,
        northing_m: npt.ArrayLike,
        height_m: npt.ArrayLike,
        intensity: npt.ArrayLike,
        readings: npt.ArrayLike = 1.0,
    ) -> RoadPoints:
        """Return the points in canonical order (northing, easting, height, intensity).

        Parameters
        ----------
        easting_m, northing_m, height_m, intensity : (n,); readings : (n,) or one number.

        Raises
        ------
        ProfileError
            where the arrays differ in size, or a number is not finite.
        """
        size = np.size(easting_m)
        given = (easting_m, northing_m, height_m, intensity, np.broadcast_to(readings, (size,)))
        columns = [np.asarray(one, np.float64).ravel() for one in given]
        if {c.size for c in columns} != {size}:
            raise ProfileError(
                f"points with {', '.join(str(c.size) for c in columns)} values", expected="arrays of one size"
            )
        if not all(np.isfinite(c).all() for c in columns):
            raise ProfileError("points with numbers that are not finite", expected="finite coordinates and intensities")
        order = np.lexsort((columns[4], columns[3], columns[2], columns[0], columns[1]))
        return cls(*(c[order] for c in columns))

    def take(self, rows: npt.NDArray[np.generic]) -> RoadPoints:
        """Return the points at `rows`: indices or a mask."""
        return RoadPoints(*(getattr(self, f.name)[rows] for f in fields(self)))

    def rotated(self, origin_m: tuple[float, float], heading_rad: float) -> RoadPoints:
        """Return the points about an origin, turned about the vertical so that the heading points along x.

        heading_rad : mean heading of the vehicle, clockwise from north.
        """
        e, n = self.x_m - origin_m[0], self.y_m - origin_m[1]
        sin, cos = math.sin(heading_rad), math.cos(heading_rad)
        return RoadPoints(e * sin + n * cos, n * sin - e * cos, self.height_m, self.intensity, self.readings)


def rotated_back(xy_m: Float64, origin_m: tuple[float, float], heading_rad: float) -> Float64:
    """Return easting and northing (n, 2) of places along and to the left (n, 2); undoes :meth:`RoadPoints.rotated`."""
    sin, cos = math.sin(heading_rad), math.cos(heading_rad)
    x, y = xy_m[:, 0], xy_m[:, 1]
    return np.column_stack([origin_m[0] + x * sin - y * cos, origin_m[1] + x * cos + y * sin])


def pyramid(points: RoadPoints, cell_m: float, levels: int) -> list[RoadPoints]:
    """Return the points, and as many increasingly thinned levels (Crawford 2009, window-size filter).

    The windows of the first level are two cells wide, those of each further level twice as wide as before. Of each
    window the point is kept whose intensity is nearest to the window's mean, of equals the first; a level is thinned
    from the one before. A kept point stands for all readings of its window.
    """
    found = [points]
    for level in range(1, levels + 1):
        found.append(_thinned(found[-1], cell_m * 2.0**level))
    return found


def _thinned(points: RoadPoints, window_m: float) -> RoadPoints:
    if not len(points):
        return points
    column, row = (np.floor(v / window_m).astype(np.int64) for v in (points.x_m, points.y_m))
    window = (row - row.min()) * (int(np.ptp(column)) + 1) + column - column.min()
    order = np.argsort(window, kind="stable")
    window = window[order]
    starts = np.flatnonzero(np.diff(window, prepend=window[0] - 1))
    number = np.cumsum(np.diff(window, prepend=window[0]) != 0)
    readings, intensity = points.readings[order], points.intensity[order]
    many = np.add.reduceat(readings, starts)
    mean = np.add.reduceat(readings * intensity, starts) / many
    away = np.abs(intensity - mean[number])
    nearest = np.lexsort((np.arange(away.size), away, number))[starts]
    kept = points.take(order[nearest])
    return RoadPoints(kept.x_m, kept.y_m, kept.height_m, kept.intensity, many)


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


_STEEPEST_RAD: Final = np.radians(80.0)
"""Largest angle of incidence that is corrected: beyond it, the cosine is constant, lest glancing returns dominate."""


def normalised_intensity(
    intensity: Float64, range_m: Float64, incidence_rad: Float64, reference_range_m: float
) -> Float64:
    """Return (n,) intensities as from `reference_range_m` at right angles: I · (R / R₀)² / cos θ.

    The lidar equation of an extended Lambertian target (Höfle & Pfeifer 2007, equation 6, without the atmosphere). For
    sensors whose intensity is the received power; one that has already been corrected for range stays as it is.

    Parameters
    ----------
    intensity, range_m : (n,); incidence_rad : (n,) angle between the beam and the surface's normal, held at 80°.
    """
    cosine = np.cos(np.minimum(np.abs(incidence_rad), _STEEPEST_RAD))
    normalised: Float64 = intensity * (range_m / reference_range_m) ** 2 / cosine
    return normalised


def three_classes(values: npt.NDArray[np.uint8]) -> tuple[int, int] | None:
    """Return two thresholds t₁ < t₂ that divide 8-bit values into ≤ t₁, ≤ t₂ and above (Otsu 1979, three classes).

    Of all pairs, the one with the greatest variance between the classes, of equals the first; None with fewer than
    three different values.
    """
    counts = np.bincount(values.ravel(), minlength=256).astype(np.float64)
    if np.count_nonzero(counts) < 3:
        return None
    weight, moment = np.cumsum(counts), np.cumsum(counts * np.arange(256))

    def between(q: Float64, m: Float64) -> Float64:
        """Weight times squared mean: a class's contribution to the variance between classes, up to a constant."""
        return np.divide(m * m, q, out=np.zeros_like(m), where=q > 0.0)

    first, second = weight[:, None], weight[None, :]
    middle = between(second - first, moment[None, :] - moment[:, None])
    total = between(weight, moment)[:, None] + middle + between(weight[-1] - weight, moment[-1] - moment)[None, :]
    allowed = (first > 0) & (second > first) & (second < weight[-1])
    best = int(np.argmax(np.where(allowed, total, -1.0)))
    return best // 256, best % 256


_ROUNDS: Final = 12  # Iterations of a robust fit.
_TUKEY: Final = 4.685
"""Residuals beyond this many standard deviations have no weight (Tukey's biweight, 95 % efficient)."""
_LEAST_SPREAD_M: Final = 1e-4  # Least spread of residuals that is assumed.
_LOWEST_M: Final = 1.0
"""Edge of the squares whose low points show the road beside and below vehicles (m)."""
_LOW_SHARE: Final = 0.2  # Quantile of the low points of a square.


@dataclass(frozen=True, eq=False)
class RoadSurface:
    """A surface of the second degree over the plane."""

    middle_m: tuple[float, float, float]
    scale_m: float
    terms: Float64
    """(6,) of 1, x, y, x², x y, y², with x and y from the middle in units of the scale."""

    def residuals_m(self, x_m: Float64, y_m: Float64, height_m: Float64) -> Float64:
        """Return (n,) heights above the surface."""
        x, y = (x_m - self.middle_m[0]) / self.scale_m, (y_m - self.middle_m[1]) / self.scale_m
        above: Float64 = height_m - self.middle_m[2] - np.sum(_powers(x, y) * self.terms, axis=1)
        return above


def fit(x_m: Float64, y_m: Float64, height_m: Float64) -> RoadSurface | None:
    """Fit the surface of second degree through points (n,), by reweighted least squares (Tukey's biweight).

    None with fewer than twelve points, or points on a line.
    """
    if x_m.size < 12:
        return None
    middle = (float(np.median(x_m)), float(np.median(y_m)), float(np.median(height_m)))
    x, y, h = x_m - middle[0], y_m - middle[1], height_m - middle[2]
    scale = max(float(np.abs(x).max()), float(np.abs(y).max()), 1e-6)
    powers, weight = _powers(x / scale, y / scale), np.ones(x.size)
    terms = np.zeros(6)
    for _ in range(_ROUNDS):
        weighed = powers * weight[:, None]
        # Sums without BLAS, so that the bits do not depend on its number of threads.
        normal = np.array([[np.sum(weighed[:, a] * powers[:, b]) for b in range(6)] for a in range(6)])
        if np.linalg.matrix_rank(normal, tol=1e-9 * float(normal[0, 0])) < 6:
            return None
        terms = np.linalg.solve(normal, np.sum(weighed * h[:, None], axis=0))
        residual = h - np.sum(powers * terms, axis=1)
        spread = max(scatter_about(residual, 0.0), _LEAST_SPREAD_M)
        weight = np.square(np.maximum(1.0 - np.square(residual / (_TUKEY * spread)), 0.0))
    return RoadSurface(middle, scale, terms)


def road_below(x_m: Float64, y_m: Float64, height_m: Float64) -> RoadSurface | None:
    """Fit the road's surface of a section, with or without vehicles, through the low points of each square metre."""
    if not x_m.size:
        return None
    column, row = (np.floor(v / _LOWEST_M).astype(np.int64) for v in (x_m, y_m))
    square = (row - row.min()) * (int(np.ptp(column)) + 1) + column - column.min()
    order = np.lexsort((height_m, square))
    starts = np.flatnonzero(np.diff(square[order], prepend=square[order[0]] - 1))
    many = np.diff(starts, append=order.size)
    low = order[starts + (_LOW_SHARE * (many - 1)).astype(np.int64)]
    return fit(x_m[low], y_m[low], height_m[low])


def _powers(x: Float64, y: Float64) -> Float64:
    return np.column_stack([np.ones(x.size), x, y, x * x, x * y, y * y])
