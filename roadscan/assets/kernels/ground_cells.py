"""Cells of returns near a first estimate of the ground: their scatter, returns on the ground, and robust heights."""

from __future__ import annotations

import math

import numpy as np

from roadscan.assets.kernels.heights import bilinear
from roadscan.compute.kernel_options import inlined, kernel

NEAR, SUM, SQUARES, CLOSE, CLOSE_SUM = range(5)
"""Sums of a cell: returns near the ground, of their heights, of the squares; returns close to it, of their heights."""


@inlined
def cell_of(x, y, origin, per_m):
    """Returns row and column of a place."""
    return math.floor((y - origin[1]) * per_m), math.floor((x - origin[0]) * per_m)


@kernel
def scatter(x, y, z, origin, coarse_per_m, ground, per_m, limits, above, sums):
    """Compute heights of returns above a first estimate of the ground, and the sums of each cell of a finer raster.

    Parameters
    ----------
    x, y, z : (n,) float64 (m).
    origin : (2,) float64, corner of both rasters (m); coarse_per_m, per_m : cells a metre of the ground and the sums.
    ground : (m, k) float32, provisional heights at the middles of its cells.
    limits : (3,) float64: near are heights from the first to the second, close those within the third (m).
    above : (n,) float32, out.
    sums : (rows, columns, 5) float64, added to.
    """
    rows, columns, _ = sums.shape
    least, most, close = limits[0], limits[1], limits[2]
    for k in range(x.size):
        u, v = (x[k] - origin[0]) * coarse_per_m - 0.5, (y[k] - origin[1]) * coarse_per_m - 0.5
        h = z[k] - bilinear(ground, u, v)
        above[k] = h
        if least <= h <= most:
            i, j = cell_of(x[k], y[k], origin, per_m)
            if 0 <= i < rows and 0 <= j < columns:
                sums[i, j, NEAR] += 1.0
                sums[i, j, SUM] += h
                sums[i, j, SQUARES] += h * h
                if abs(h) <= close:
                    sums[i, j, CLOSE] += 1.0
                    sums[i, j, CLOSE_SUM] += h


@kernel
def on_ground(x, y, above, origin, per_m, rough, tolerance, even, reach, found):
    """Find the returns on the ground: near it in cells that are not rough, or as high as an even cell beside.

    Parameters
    ----------
    x, y : (n,) float64 (m); above : (n,) float32, heights above the provisional ground (m).
    origin : (2,) float64; per_m : cells a metre.
    rough : (rows, columns) bool; tolerance : (rows, columns) float32, of heights in cells that are not (m).
    even : (rows, columns) float32, height of even cells above the provisional ground; NaN for all others.
    reach : how far a return may lie from the height of an even cell (m).
    found : (n,) bool, out.
    """
    rows, columns = rough.shape
    for k in range(x.size):
        h = above[k]
        found[k] = False
        i, j = cell_of(x[k], y[k], origin, per_m)
        if 0 <= i < rows and 0 <= j < columns:
            if not rough[i, j] and abs(h) <= tolerance[i, j]:
                found[k] = True
            elif abs(h) < 1.0:
                for a in range(max(i - 1, 0), min(i + 2, rows)):
                    for b in range(max(j - 1, 0), min(j + 2, columns)):
                        if abs(h - even[a, b]) <= reach:
                            found[k] = True


@kernel
def cell_heights(x, y, above, chosen, origin, per_m, middle, half, sums):
    """Compute number, sum and squares of the heights of chosen returns near the middle height of each cell.

    Parameters
    ----------
    x, y : (n,) float64 (m); above : (n,) float32 (m); chosen : (n,) bool.
    origin : (2,) float64; per_m : cells a metre.
    middle, half : (rows, columns) float32, what heights are taken of and how far they may lie from it (m).
    sums : (rows, columns, 3) float64, added to; sums are of heights less `middle`.
    """
    rows, columns = middle.shape
    for k in range(x.size):
        if chosen[k]:
            i, j = cell_of(x[k], y[k], origin, per_m)
            if 0 <= i < rows and 0 <= j < columns:
                h = np.float64(above[k]) - middle[i, j]
                if abs(h) <= half[i, j]:
                    sums[i, j, 0] += 1.0
                    sums[i, j, 1] += h
                    sums[i, j, 2] += h * h


@kernel
def least_over_disk(z, widths, line, out):
    """Compute the least height within a disk about each cell of a raster.

    Pieces of a row grow cell by cell, and each row of the disk takes the piece of its own width.
    z : (rows, columns) float32, finite. widths : (radius + 1,) int64, half the width of the disk in each of its rows,
    from the middle one on (cells). line : (columns,) float32, working space. out : (rows, columns) float32, infinite
    before.
    """
    rows, columns = z.shape
    radius = widths.size - 1
    for i in range(rows):
        for j in range(columns):
            line[j] = z[i, j]
        up = radius
        for width in range(radius + 1):
            if 0 < width < columns:
                for j in range(columns - width):
                    line[j + width] = z[i, j] if z[i, j] < line[j + width] else line[j + width]
                for j in range(columns - width):
                    line[j] = z[i, j + width] if z[i, j + width] < line[j] else line[j]
            while up >= 0 and widths[up] == width:
                if i + up < rows:
                    for j in range(columns):
                        out[i + up, j] = line[j] if line[j] < out[i + up, j] else out[i + up, j]
                if up > 0 and i >= up:
                    for j in range(columns):
                        out[i - up, j] = line[j] if line[j] < out[i - up, j] else out[i - up, j]
                up -= 1
