"""Rasters of heights and intensities beside a road's lanes, by station and distance from a line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.road_line import STATION_M, RoadLine
from roadscan.tiles.cells import TileCells

OFFSET_M: Final = 0.1
"""Extent of a cell across the road."""
TALLEST_M: Final = 0.5
"""Higher points than this above the road beside them are no ground."""


@dataclass(frozen=True, eq=False)
class TilePoints:
    """Blocks of a tile's cells, at most half a raster cell wide, each with the means of its readings."""

    place_m: Float64
    """(n, 2) easting and northing."""
    height_m: Float64
    """(n,)"""
    intensity: Float64
    """(n,) NaN where none was recorded."""
    readings: Float64
    """(n,)"""


@dataclass(frozen=True, eq=False)
class GroundPoints:
    """Points of some tiles in coordinates along a road."""

    station_m: Float64
    """(n,)"""
    offset_m: Float64
    """(n,) from the reference line, positive to the right."""
    height_m: Float64
    """(n,)"""
    intensity: Float64
    """(n,) NaN where none was recorded."""
    readings: Float64
    """(n,)"""


@dataclass(frozen=True, eq=False)
class SideRaster:
    """One side of a road, from a line in its lane outward."""

    station_m: Float64
    """(s,) :data:`STATION_M` apart."""
    start_m: Float64
    """(s,) offset of the line from the reference line, positive to the right."""
    away_m: Float64
    """(o,) distance from that line, :data:`OFFSET_M` apart, ascending outward."""
    height_m: Float64
    """(s, o) NaN where there is no ground."""
    intensity: Float64
    """(s, o) NaN where there is none."""


def tile_points(cells: TileCells, corner_m: tuple[float, float], cell_m: float) -> TilePoints:
    """Return blocks of a tile's cells.

    corner_m : easting and northing of the tile's south-west corner; cell_m : edge of its cells.
    """
    wide = max(1, int(0.5 * OFFSET_M / cell_m + 1e-9))
    across = -(-cells.cells_per_edge // wide)
    block = (cells.row.astype(np.int64) // wide) * across + cells.column.astype(np.int64) // wide
    count = cells.count.astype(np.float64)
    readings: Float64 = np.bincount(block, count, across * across).astype(np.float64)
    held = np.flatnonzero(readings)
    base = float(cells.height_robust_m[0]) if len(cells) else 0.0

    def mean(values: npt.NDArray[np.generic]) -> Float64:
        found: Float64 = np.bincount(block, count * values.astype(np.float64), across * across)[held] / readings[held]
        return found

    place = np.column_stack([mean(cells.column) + 0.5, mean(cells.row) + 0.5]) * cell_m + np.asarray(corner_m)
    return TilePoints(place, base + mean(cells.height_robust_m - base), mean(cells.intensity_mean), readings[held])


def ground_points(points: Sequence[TilePoints], line: RoadLine, between_m: tuple[float, float]) -> GroundPoints:
    """Return the points of tiles whose station lies between two, tile after tile."""
    from scipy.spatial import cKDTree  # slow to import

    place = np.concatenate([np.empty((0, 2)), *(p.place_m for p in points)])
    height, grey, readings = (
        np.concatenate([np.empty(0), *(getattr(p, name) for p in points)])
        for name in ("height_m", "intensity", "readings")
    )
    nodes = line.places(np.arange(between_m[0], between_m[1] + 1.0), 0.0)
    _, at = cKDTree(nodes[:, :2]).query(place)
    station, offset = line.along(place, between_m[0] + np.asarray(at, np.float64))
    own = (station >= between_m[0]) & (station < between_m[1])
    return GroundPoints(station[own], offset[own], height[own], grey[own], readings[own])


def side_raster(
    points: GroundPoints, side: float, station_m: Float64, start_m: Float64, between_m: tuple[float, float]
) -> SideRaster:
    """Return the raster of one side.

    Parameters
    ----------
    side : 1 for the right of the reference line, −1 for its left.
    station_m : (s,) stations, :data:`STATION_M` apart; start_m : (s,) offset of the line that distances count from.
    between_m : least and greatest distance from it (m).
    """
    row = np.floor((points.station_m - station_m[0]) / STATION_M + 0.5).astype(np.int64)
    inside = (row >= 0) & (row < station_m.size)
    start = np.interp(points.station_m, station_m, start_m)
    away = side * (points.offset_m - start)
    first = round(between_m[0] / OFFSET_M)
    count = round(between_m[1] / OFFSET_M) - first + 1
    column = np.floor(away / OFFSET_M + 0.5).astype(np.int64) - first
    inside &= (column >= 0) & (column < count)
    shape = (station_m.size, count)
    cell, weight = (row * count + column)[inside], points.readings[inside]
    height = _mean(cell, points.height_m[inside], weight, shape)
    # Heights of objects on or above the ground are not those of the ground.
    inner = height[:, : round(1.0 / OFFSET_M)]
    known = np.isfinite(inner).any(axis=1)
    if known.any():
        level = np.interp(np.arange(len(inner)), np.flatnonzero(known), np.nanmedian(inner[known], axis=1))
        height = np.where(np.abs(height - level[:, None]) <= _fall(first, count), height, np.nan)
    grey = _mean(cell, points.intensity[inside], weight, shape)
    beside: Float64 = OFFSET_M * (first + np.arange(count, dtype=np.float64))
    return SideRaster(station_m, start_m, beside, height, grey)


def _fall(first: int, count: int) -> Float64:
    """Return (o,) greatest height difference between road and ground: some steps, and slopes of a third."""
    most: Float64 = TALLEST_M + np.maximum(OFFSET_M * (first + np.arange(count)), 0.0) / 3.0
    return most


def _mean(cell: npt.NDArray[np.int64], value: Float64, weight: Float64, shape: tuple[int, int]) -> Float64:
    """Return weighted means (s, o) of values by cell, NaN where there is none."""
    good = np.isfinite(value)
    size = shape[0] * shape[1]
    base = float(np.median(value[good])) if good.any() else 0.0
    total = np.bincount(cell[good], weight[good] * (value[good] - base), size)
    count = np.bincount(cell[good], weight[good], size)
    with np.errstate(invalid="ignore"):
        found: Float64 = (base + total / np.where(count > 0.0, count, np.nan)).reshape(shape)
    return found
