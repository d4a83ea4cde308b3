"""A strip of road along the way of a vehicle, in cells along and across it, as one sensor saw it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import way_along

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


FARTHEST_M: Final = 15.0
"""Lags are searched this far (m) to both sides: 0.9 s at 60 km/h."""
_SMOOTH_M: Final = 5.0
"""Features longer than this (m) are removed from a strip: grades and bends are alike at every lag."""
_BLOCKS: Final = 6
"""Blocks of the strip, each left out in turn: their agreement gives σ."""
_LEAST_CELLS: Final = 200  # With fewer cells in common (of 0.1 m by 0.5 m) no lag is computed.
_LEAST_LIKENESS: Final = 0.3
"""Strips whose best correlation is lower show no lag."""
_LEAST_SIGMA_M: Final = ALONG_M / 5
"""A peak is located no better than this share of a cell (m)."""
_EQUAL: Final = 0.9
"""Peaks of at least this share of the highest are as good: dashes of paint repeat, and the least shift is taken."""
_SIGMAS: Final = 3.0
"""A lag is reported only if its correlation exceeds that at lag 0 by this many σ."""


class Lag(NamedTuple):
    """One strip lies `lag_m` farther along the way than another."""

    lag_m: float
    sigma_m: float
    likeness: float
    """Correlation at this lag."""
    repeats: bool
    """True where another lag is about as likely: dashes of paint repeat, and the least lag was taken."""


def lag_of(one: Float64, other: Float64) -> Lag | None:
    """Returns how far `other` lies ahead of `one`; both (n, q) cells along and across the way, NaN where unseen.

    The σ is that of the jackknife over six blocks of the strip (Efron and Stein 1981). None where they have too little
    in common, or where their correlation shows no lag.
    """
    width = round(_SMOOTH_M / ALONG_M)
    first, second = _sharp(one, width), _sharp(other, width)
    if (np.isfinite(first) & np.isfinite(second)).sum() < _LEAST_CELLS:
        return None
    steps = np.arange(-round(FARTHEST_M / ALONG_M), round(FARTHEST_M / ALONG_M) + 1)
    sums = np.stack([_sums(first, second, int(step)) for step in steps])
    whole = _likeness(sums.sum(axis=1))
    if not np.isfinite(whole[steps == 0]).all() or np.nanmax(whole) < _LEAST_LIKENESS:
        return None
    without = [_likeness(sums.sum(axis=1) - sums[:, block]) for block in range(_BLOCKS)]
    middle, at = steps.size // 2, _summit(whole)
    places = np.array([_summit(one) for one in without])
    rises = np.array([one[round(at / ALONG_M) + middle] - one[middle] for one in without])
    scale = (_BLOCKS - 1) / np.sqrt(_BLOCKS)
    if abs(at) > ALONG_M and rises.mean() < _SIGMAS * scale * rises.std():
        return None  # the peak is no higher than its surroundings
    sigma_m = float(np.hypot(scale * places.std(), _LEAST_SIGMA_M))
    return Lag(at, sigma_m, float(np.nanmax(whole)), _summits(whole).size > 1)


def _sharp(picture: Float64, width: int) -> Float64:
    """Returns a strip without features longer than so many cells along the way."""
    seen = np.isfinite(picture)
    base = np.nanmean(picture) if seen.any() else 0.0
    sums, counts = (_running(values, width) for values in (np.where(seen, picture - base, 0.0), seen.astype(float)))
    return np.where(seen & (counts > width / 3), picture - base - sums / np.maximum(counts, 1.0), np.nan)


def _running(values: Float64, width: int) -> Float64:
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    number = np.arange(len(values))
    after, before = np.minimum(number + width // 2 + 1, len(values)), np.maximum(number - width // 2, 0)
    return np.asarray(total[after] - total[before])


def _sums(one: Float64, other: Float64, step: int) -> Float64:
    """Returns sums (blocks, 6) over the cells that both strips have, with `other` moved back by so many cells."""
    rows = len(one)
    low, high = max(0, -step), rows - max(0, step)
    a, b = one[low:high], other[low + step : high + step]
    both = np.isfinite(a) & np.isfinite(b)
    a, b = np.where(both, a, 0.0), np.where(both, b, 0.0)
    rowwise = np.stack([both.sum(1), a.sum(1), b.sum(1), (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)], axis=-1)
    block = np.arange(low, high) * _BLOCKS // rows
    found = np.zeros((_BLOCKS, 6))
    np.add.at(found, block, rowwise)
    return found


def _likeness(sums: Float64) -> Float64:
    """Returns correlations (k,) from sums (k, 6); NaN with too few cells."""
    n, a, b, aa, bb, ab = sums.T
    n = np.maximum(n, 1.0)
    spread = np.sqrt(np.maximum((aa - a * a / n) * (bb - b * b / n), 1e-30))
    return np.where(sums[:, 0] >= _LEAST_CELLS, (ab - a * b / n) / spread, np.nan)


def _summits(likeness: Float64) -> npt.NDArray[np.int64]:
    """Returns the indices of the peaks that are about as high as the highest."""
    padded = np.pad(np.nan_to_num(likeness, nan=-1.0), 1, constant_values=-1.0)
    is_top = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    highest = float(padded.max())
    return np.flatnonzero(is_top & (padded[1:-1] >= highest - (1.0 - _EQUAL) * abs(highest)))


def _summit(likeness: Float64) -> float:
    """Returns the least lag (m) of the peaks about as high as the highest, interpolated by a parabola."""
    middle = likeness.size // 2
    k = min(_summits(likeness).tolist(), key=lambda step: abs(step - middle))
    if not 0 < k < likeness.size - 1:
        return float((k - middle) * ALONG_M)
    before, top, after = np.nan_to_num(likeness[k - 1 : k + 2], nan=-1.0)
    bend = before - 2 * top + after
    return float((k - middle + ((before - after) / (2 * bend) if bend < 0.0 else 0.0)) * ALONG_M)
