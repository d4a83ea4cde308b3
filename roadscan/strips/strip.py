"""A strip of road along the way of a vehicle, in cells along and across it, as one sensor saw it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.ways import way_along

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


ALONG_M: Final = 0.1
"""Length of a cell (m): a clock that is 5 ms off moves readings by as much at 20 m/s."""
ACROSS_M: Final = 0.5  # Width of a cell (m).
HALF_WIDTH_M: Final = 5.0
"""The strip ends this far (m) to both sides of the way: the lane driven and half of the next."""
COLUMNS: Final = round(2 * HALF_WIDTH_M / ACROSS_M)  # Cells across the strip.
_VERTEX_M: Final = 0.5
"""Spacing of the way's vertices (m): on a bend of 10 m radius the chord misses the arc by 3 mm."""
_BELOW_M: Final = 5.0  # Readings farther below the body's origin than this (m) are not on the road.
_ABOVE_M: Final = 1.0
"""Readings that lie farther above the body's origin than this (m) are not on the road that the vehicle drives; the
origin may be at the height of the road."""
_LEAST_READINGS: Final = 2
"""Cells with fewer readings are empty."""
ASTRAY_M: Final = 0.1
"""A reading farther (m) from the median height of its cell is an outlier: potholes and kerbs are lower."""
_OWN_LANE_M: Final = 1.75  # The driven lane ends this far (m) to both sides of the way.
_BESIDE_M: Final = 5.0
"""The vehicle fills the way this far (m) to both sides, ahead and behind."""
_LEVEL_STEP_M: Final = 0.1  # Height step (m) of the histogram that finds the level of most readings.


@dataclass(frozen=True)
class Way:
    """The path of the body's origin over a stretch, as evenly spaced vertices (n,)."""

    easting_m: Float64
    northing_m: Float64
    height_m: Float64
    epoch_gps_ns: Float64
    """Time of passage at each vertex."""

    @classmethod
    def of(cls, body_m: Float64, epochs_gps_ns: Int64) -> Self:
        """Returns the way through the body's origins (p, 3), easting, northing, height (m), at ascending epochs."""
        station = way_along(body_m)
        goes_on = np.append(True, np.diff(station) > 0.0)
        at = np.arange(0.0, station[-1], _VERTEX_M)
        return cls(*(np.interp(at, station[goes_on], column[goes_on]) for column in (*body_m.T, epochs_gps_ns)))

    @property
    def length_m(self) -> float:
        """Returns its length (m)."""
        return self.easting_m.size * _VERTEX_M

    @property
    def cells(self) -> int:
        """Returns the number of cells along the whole way."""
        return int(self.easting_m.size * _VERTEX_M / ALONG_M)

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(np.stack([self.easting_m, self.northing_m], axis=-1))

    @cached_property
    def heading_rad(self) -> Float64:
        """Returns headings (n,) clockwise from grid north (rad)."""
        return np.arctan2(np.gradient(self.easting_m), np.gradient(self.northing_m))

    def near(self, points_m: Float64, within_m: float) -> tuple[npt.NDArray[np.bool_], Int64]:
        """Returns a mask of the points (m, ≥ 2) within a distance of the way, and the vertex nearest to each."""
        away, vertex = self._tree.query(points_m[:, :2], distance_upper_bound=within_m)
        found = np.isfinite(away)
        return found, np.where(found, vertex, 0)

    def strip(self, points_m: Float64, intensity: npt.NDArray[np.uint16], epochs_gps_ns: Int64) -> Strip:
        """Returns the strip made of points (m, 3), with intensities (m,) and epochs (m,)."""
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
    """A strip as one sensor saw it; cells are (n, COLUMNS), NaN where it saw nothing."""

    height_m: Float64
    intensity: Float64
    below_m: float
    """Depth below the body's origin at which most readings lie, negative above it; NaN without a reading."""
    level_share: float
    """Share of the readings within the strip at that depth."""
    readings: int
    """Readings on the strip, at heights where a road can be."""
    own_lane: int
    """Those below the vehicle and close to it, taken while it drove the way."""
    astray: int
    """Those far from the other readings of their cell."""


def _level(below_m: Float64) -> tuple[float, float]:
    """Returns the depth near which most readings lie, and their share."""
    if not below_m.size:
        return float("nan"), 0.0
    step = np.floor(below_m / _LEVEL_STEP_M).astype(np.int64)
    most = np.bincount(step - step.min()).argmax() + step.min()
    there = np.abs(step - most) <= 1
    return float(np.median(below_m[there])), float(there.mean())


def _cells(cell: Int64, height_m: Float64, light: Float64, size: int) -> tuple[Float64, Float64, npt.NDArray[np.bool_]]:
    """Returns mean height and intensity of each of `size` cells without outliers, and a mask of the outliers."""
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
