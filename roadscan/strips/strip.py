"""A strip of road along the way of a vehicle, in cells along and across it, as one sensor saw it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from roadscan.compute.ways import way_along

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

ALONG_M: Final = 0.1
"""Length of a cell: a clock that is 5 ms off moves readings by as much at 20 m/s."""
ACROSS_M: Final = 0.5
HALF_WIDTH_M: Final = 5.0
"""The strip ends so far to both sides of the way: the lane driven and half of the next."""
COLUMNS: Final = round(2 * HALF_WIDTH_M / ACROSS_M)
_VERTEX_M: Final = 0.5
"""Vertices of the way: within them a bend of 10 m leaves the chord by 3 mm."""
_BELOW_M: Final = 5.0
_ABOVE_M: Final = 1.0
"""Readings that lie farther below the body's origin, or above it, are of no road on which the vehicle drives; the
origin may be at the height of the road."""
_LEAST_READINGS: Final = 2
"""Fewer make no cell."""
ASTRAY_M: Final = 0.1
"""A reading that lies farther from the median height of its cell is astray: potholes and kerbs are lower."""
_OWN_LANE_M: Final = 1.75
_BESIDE_M: Final = 5.0
"""So far to both sides of the way, and so far ahead and behind, there is the vehicle itself and nothing else."""
_LEVEL_STEP_M: Final = 0.1


@dataclass(frozen=True)
class Way:
    """Where the body's origin went over a stretch, as even vertices (n,)."""

    easting_m: Float64
    northing_m: Float64
    height_m: Float64
    epoch_gps_ns: Float64
    """When it was there."""

    @classmethod
    def of(cls, body_m: Float64, epochs_gps_ns: Int64) -> Self:
        """The way through places (p, 3) of the body's origin, easting, northing, height, at ascending epochs (p,)."""
        station = way_along(body_m)
        goes_on = np.append(True, np.diff(station) > 0.0)
        at = np.arange(0.0, station[-1], _VERTEX_M)
        return cls(*(np.interp(at, station[goes_on], column[goes_on]) for column in (*body_m.T, epochs_gps_ns)))

    @property
    def length_m(self) -> float:
        """Length."""
        return self.easting_m.size * _VERTEX_M

    @property
    def cells(self) -> int:
        """Cells along the whole way."""
        return int(self.easting_m.size * _VERTEX_M / ALONG_M)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(np.stack([self.easting_m, self.northing_m], axis=-1))

    @cached_property
    def heading_rad(self) -> Float64:
        """(n,) clockwise from grid north."""
        return np.arctan2(np.gradient(self.easting_m), np.gradient(self.northing_m))

    def near(self, points_m: Float64, within_m: float) -> tuple[npt.NDArray[np.bool_], Int64]:
        """Points (m, ≥ 2) within a distance of the way, and the vertex nearest to each."""
        away, vertex = self._tree.query(points_m[:, :2], distance_upper_bound=within_m)
        found = np.isfinite(away)
        return found, np.where(found, vertex, 0)

    def strip(self, points_m: Float64, intensity: npt.NDArray[np.uint16], epochs_gps_ns: Int64) -> Strip:
        """What readings at points (m, 3), of intensities (m,) and at epochs (m,), say of the strip."""
        found, vertex = self.near(points_m, HALF_WIDTH_M + _VERTEX_M)
        points, vertex, light = points_m[found], vertex[found], intensity[found].astype(np.float64)
        east, north = points[:, 0] - self.easting_m[vertex], points[:, 1] - self.northing_m[vertex]
        sine, cosine = np.sin(self.heading_rad)[vertex], np.cos(self.heading_rad)[vertex]
        row = np.floor((vertex * _VERTEX_M + east * sine + north * cosine) / ALONG_M).astype(np.int64)
        right = east * cosine - north * sine
        column = np.floor((right + HALF_WIDTH_M) / ACROSS_M).astype(np.int64)
        inside = (row >= 0) & (row < self.cells) & (column >= 0) & (column < COLUMNS)
        below = self.height_m[vertex] - points[:, 2]
        level, share = _level(below[inside])
        inside &= (below > -_ABOVE_M) & (below < _BELOW_M)
        cell, height = (row * COLUMNS + column)[inside], points[inside, 2]
        ahead = vertex * _VERTEX_M - np.interp(
            epochs_gps_ns[found].astype(np.float64), self.epoch_gps_ns, _VERTEX_M * np.arange(self.epoch_gps_ns.size),
            left=np.inf, right=np.inf,
        )  # fmt: skip
        own = ((np.abs(right) < _OWN_LANE_M) & (np.abs(ahead) < _BESIDE_M))[inside]
        heights, lights, astray = _cells(cell, height, light[inside], self.cells * COLUMNS)
        shape = self.cells, COLUMNS
        return Strip(
            heights.reshape(shape), lights.reshape(shape), level, share, int(inside.sum()), int(own.sum()),
            int((astray & own).sum()),
        )  # fmt: skip


@dataclass(frozen=True)
class Strip:
    """What one sensor saw of a strip; cells are (n, COLUMNS), NaN where it saw nothing."""

    height_m: Float64
    intensity: Float64
    below_m: float
    """Depth below the body's origin at which most readings lie, negative above it; NaN without a reading."""
    level_share: float
    """Share of the readings within the strip that lie there."""
    readings: int
    """Readings on the strip, at heights where a road can be."""
    own_lane: int
    """Those of them below the vehicle and close to it, as it drove the way itself."""
    astray: int
    """Those that lie far from the others of their cell there."""


def _level(below_m: Float64) -> tuple[float, float]:
    """The depth near which most readings lie, and the share of them that do."""
    if not below_m.size:
        return float("nan"), 0.0
    step = np.floor(below_m / _LEVEL_STEP_M).astype(np.int64)
    most = np.bincount(step - step.min()).argmax() + step.min()
    there = np.abs(step - most) <= 1
    return float(np.median(below_m[there])), float(there.mean())


def _cells(cell: Int64, height_m: Float64, light: Float64, size: int) -> tuple[Float64, Float64, npt.NDArray[np.bool_]]:
    """Mean height and intensity of each of `size` cells, without readings that lie astray, and which these are."""
    order = np.lexsort((height_m, cell))
    count = np.bincount(cell, minlength=size)
    first = np.cumsum(count) - count
    middle = np.full(size, np.nan)
    filled = count > 0
    middle[filled] = height_m[order][(first + count // 2)[filled]]
    astray = np.abs(height_m - middle[cell]) > ASTRAY_M
    kept = ~astray
    count = np.bincount(cell[kept], minlength=size)
    known = count >= _LEAST_READINGS
    base = float(height_m[0]) if height_m.size else 0.0
    sums = (np.bincount(cell[kept], values[kept], minlength=size) for values in (height_m - base, light))
    height, mean = (np.where(known, total / np.maximum(count, 1), np.nan) for total in sums)
    return height + base, mean, astray
