"""Tilt of the road as a sensor saw it, against the attitude of the poses: wrong signs, mirrored profiles, late poses.

Seen from the vehicle, the road tilts against every sway of it: s = c + φ, with the road's slope c to the right and
the roll φ, right side down; along the travel likewise with the pitch, nose down. Readings are placed by the recorded
roll, so that the placed road tilts by g = s − φ. What of its sway a vehicle does not take from the road is not in c.
So the share 1 + cov(g, φ) / var(φ) of the recorded angle that the sensor confirms is 1 on even roads, less where the
vehicle follows the road, and below 0 only where a sign is wrong. A share of more than 1 says that the recorded angle
sways less than the vehicle did.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, Self

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import scatter_about
from roadscan.core.gpstime import NS_PER_S
from roadscan.poses.trajectory import LevelPoses

Angle = Literal["roll", "pitch"]

_BIN_NS: Final = NS_PER_S // 10
"""A plane (or line) is fitted to the readings of this long (ns): a turn of a lidar, 1 m of a profiler at 36 km/h."""
_SWAY_BINS: Final = 21
"""A mean over this many bins is taken off: vehicles sway within 2 s, and what lasts longer is the road's slope."""
_LEAST_BINS: Final = 30
"""With fewer bins nothing is said."""
_LEAST_READINGS: Final = 60
"""Readings of a bin; with fewer no tilt is fitted."""
_LEAST_REACH_M: Final = 0.4
"""Least standard deviation (m) of the places of a bin's readings, across or along, for a tilt in that direction."""
_NEAR_M: Final = 8.0
"""Readings farther (m) to the side, ahead or behind are not asked: verges, and roads that bend."""
_OFF_LEVEL_M: Final = 1.0  # Readings farther (m) from the median height are not on the road, whatever it tilts.
_OFF_PLANE_M: Final = 0.15
"""Readings farther (m) from the plane of most are kerbs, vehicles, plants."""
_OUTLIER: Final = 5.0
"""Tilts farther than this many robust standard deviations from their median are not the road's."""
_BLOCKS: Final = 6
"""Blocks of bins, each left out in turn: their agreement gives σ."""
_LEAST_SIGMA: Final = 0.02  # No share of an angle is known better.
_RATE_NS: Final = 50_000_000
"""Rates of angles are differences over this long (ns) before and after."""


@dataclass(frozen=True)
class Sway:
    """Places (m, map) and angles (rad) of the body at epochs (p,), ascending."""

    epoch_gps_ns: Int64
    east_m: Float64
    north_m: Float64
    heading_rad: Float64
    """Clockwise from grid north, without leaps of a whole turn."""
    slopes_rad: tuple[Float64, Float64]
    """Roll, right side down; pitch, nose down."""

    @classmethod
    def of(cls, poses: LevelPoses) -> Self:
        """Returns the places and angles of poses."""
        down = poses.level_from_body[:, 2]
        slopes = np.arctan2(down[:, 1], down[:, 2]), np.arcsin(np.clip(down[:, 0], -1.0, 1.0))
        return cls(poses.epoch_gps_ns, poses.body_m[:, 0], poses.body_m[:, 1], np.unwrap(poses.heading_rad), slopes)

    def at(self, epochs_gps_ns: Int64, values: Float64) -> Float64:
        """Returns the values (p,) of the body at epochs (n,)."""
        first = self.epoch_gps_ns[0]
        return np.asarray(np.interp(epochs_gps_ns - first, self.epoch_gps_ns - first, values))

    def seen(self, points_m: Float64, epochs_gps_ns: Int64) -> Float64:
        """Returns how far right and ahead (n, 2: m) of the body points (n, 3) lay at their epochs."""
        east = points_m[:, 0] - self.at(epochs_gps_ns, self.east_m)
        north = points_m[:, 1] - self.at(epochs_gps_ns, self.north_m)
        heading = self.at(epochs_gps_ns, self.heading_rad)
        sine, cosine = np.sin(heading), np.cos(heading)
        return np.stack([east * cosine - north * sine, east * sine + north * cosine], axis=-1)


class Tilt(NamedTuple):
    """How a sensor's readings confirm an angle of the poses on a stretch."""

    angle: Angle
    share: float
    """Of its sway, that the readings confirm."""
    sigma: float
    late_s: float
    """How much later the angle is than the readings: the clock of either may be off."""
    sigma_late_s: float
    sway_deg: float
    """Standard deviation of the sway."""


def tilts_of(points_m: Float64, epochs_gps_ns: Int64, sway: Sway) -> list[Tilt]:
    """Returns the tilts of a sensor's placed readings (n, 3) across and, where they reach ahead, along the travel."""
    inside = (epochs_gps_ns >= sway.epoch_gps_ns[0]) & (epochs_gps_ns <= sway.epoch_gps_ns[-1])
    places = sway.seen(points_m[inside], epochs_gps_ns[inside])
    near = np.all(np.abs(places) < _NEAR_M, axis=-1)
    places, heights, epochs = places[near], points_m[inside][near, 2], epochs_gps_ns[inside][near]
    if not epochs.size:
        return []
    number = (epochs - epochs.min()) // _BIN_NS
    size = int(number.max()) + 1
    slope, middle = np.full((2, size), np.nan), np.zeros(size, np.int64)
    order = np.argsort(number, kind="stable")
    cuts = np.searchsorted(number[order], np.arange(size + 1))
    for k in range(size):
        own = order[cuts[k] : cuts[k + 1]]
        if own.size >= _LEAST_READINGS:
            slope[:, k] = _slopes(places[own], heights[own])
            middle[k] = int(epochs[own].mean(dtype=np.float64))
    names: tuple[Angle, Angle] = "roll", "pitch"
    found = (_tilt(name, slope[axis], middle, sway, sway.slopes_rad[axis]) for axis, name in enumerate(names))
    return [one for one in found if one is not None]


def _slopes(places_m: Float64, height_m: Float64) -> Float64:
    """Returns the slopes to the right and ahead (2,) of the plane through most readings, NaN without reach."""
    reach, out = places_m.std(axis=0) > _LEAST_REACH_M, np.full(2, np.nan)
    design = np.column_stack([np.ones(height_m.size), (places_m - places_m.mean(axis=0))[:, reach]])
    kept = np.abs(height_m - np.median(height_m)) < _OFF_LEVEL_M
    for _ in range(3):
        if kept.sum() < _LEAST_READINGS:
            return out
        plane = np.linalg.lstsq(design[kept], height_m[kept], rcond=None)[0]
        kept = np.abs(height_m - design @ plane) < _OFF_PLANE_M
    out[reach] = plane[1:]
    return out


def _tilt(angle: Angle, slope: Float64, middle: Int64, sway: Sway, recorded: Float64) -> Tilt | None:
    known = np.isfinite(slope)
    if known.sum() < _LEAST_BINS:
        return None
    at = np.where(known, middle, sway.epoch_gps_ns[0])
    angles = sway.at(at, recorded)
    rate = (sway.at(at + _RATE_NS, recorded) - sway.at(at - _RATE_NS, recorded)) * (NS_PER_S / (2 * _RATE_NS))
    y, x, v = (_swayed(np.where(known, values, np.nan)) for values in (slope, angles, rate))
    kept = np.isfinite(y) & np.isfinite(x)
    if kept.sum() < _LEAST_BINS:
        return None
    kept &= np.abs(y - np.nanmedian(y)) <= _OUTLIER * scatter_about(y[kept], float(np.nanmedian(y))) + 1e-9
    y, design = y[kept], np.stack([x[kept], v[kept]], axis=-1)
    if kept.sum() < _LEAST_BINS or not np.all(design.std(axis=0) > 0.0):
        return None
    whole = np.linalg.lstsq(design, y, rcond=None)[0]
    block = np.arange(y.size) * _BLOCKS // y.size
    without = np.array([np.linalg.lstsq(design[block != k], y[block != k], rcond=None)[0] for k in range(_BLOCKS)])
    spread = np.sqrt((_BLOCKS - 1) / _BLOCKS * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    sigma, swayed = max(float(spread[0]), _LEAST_SIGMA), float(np.degrees(design[:, 0].std()))
    return Tilt(angle, 1.0 + float(whole[0]), sigma, float(whole[1]), float(spread[1]), swayed)


def _swayed(values: Float64) -> Float64:
    """Returns values (n,) without what lasts longer than a vehicle's sway; NaN stays."""
    ones, known = np.ones(_SWAY_BINS), np.isfinite(values)
    total, count = np.convolve(np.where(known, values, 0.0), ones, "same"), np.convolve(known, ones, "same")
    return np.asarray(values - total / np.maximum(count, 1.0))
