"""Standard deviations of the place and the radius of a shaft: what its slices and its sweeps say differently."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from roadscan.assets.scene import Scene
from roadscan.assets.upright.axis import fit_axis
from roadscan.assets.upright.shafts import LEANING_M, Shaft
from roadscan.assets.upright.slices import SLICE_M
from roadscan.compute.array_types import Float64, Int64

_SWEEP_NS: Final = 100_000_000
"""Returns within this time (ns) share the error of their pose."""
_SKIN_M: Final = 0.1
"""Returns so near to a shaft's surface (m) tell of its axis."""
_POSE_M, _POSE_SWEEPS = 0.015, 2.0
"""1 σ of the place of one sweep against another (m) after registration or adjustment, and the number of sweeps that it
counts as: one sweep alone cannot show its own error."""
_ROUND: Final = 0.1
"""1 σ of a trunk's or post's radius over directions, as a share of it: stems are out of round, and bark
and twigs add to them."""
_PARTS: Final = 6
"""Parts of a shaft, one above the other, that are left out in turn where nothing else tells its σ."""
_UNSEEN: Final = 0.25
"""1 σ of a radius by its circle alone, as a share of it: on the labelled street, diameters from a cloud without a
trajectory differ so much (RMS) from those with it."""
_LEAST_M: Final = 0.003
"""Least σ (m): coordinates are millimetres, ranges are stated in steps of 2 mm or more."""
_LEAST_OF_SLICE: Final = 3
"""Slices with fewer returns tell of no middle and no width."""


class Sigma(NamedTuple):
    """1 σ (m)."""

    place_m: float
    """Of the foot, east and north, each."""
    radius_m: float


def sigma_of(scene: Scene, shaft: Shaft) -> Sigma:
    """Returns the standard deviations of the foot and the radius of a shaft.

    Variances add up of: the mean of the sweeps, from their scatter; the mean of the slices, as bark, branches and the
    noise of ranges move them, carried down to the foot with the error of the lean; and along the sight lines that of
    the radius, by which the axis lies behind the surface that was seen. Where it is not known from where it was seen,
    the fits without one part in six each tell both (jackknife: Tukey 1958).
    """
    returns, axis = scene.returns, shaft.axis
    height = returns.height_m[shaft.rows]
    x, y = axis.at(height)
    past = np.stack([returns.x_m[shaft.rows] - x, returns.y_m[shaft.rows] - y])
    rows = shaft.rows[np.hypot(*past) < axis.radius_m + _SKIN_M]
    if rows.size < _LEAST_OF_SLICE:
        return Sigma(_POSE_M + axis.radius_m, max(axis.radius_m, _LEAST_M))
    if not np.isfinite(returns.sensor_x_m[rows]).all():
        return _of_parts(np.column_stack([returns.x_m[rows], returns.y_m[rows], returns.height_m[rows]]), shaft)
    height = returns.height_m[rows]
    x, y = axis.at(height)
    past = np.stack([returns.x_m[rows] - x, returns.y_m[rows] - y])
    sight = np.stack([returns.sensor_x_m[rows] - x, returns.sensor_y_m[rows] - y])
    sight /= np.maximum(np.hypot(*sight), 1e-9)
    along = past[0] * sight[0] + past[1] * sight[1]
    across = past[1] * sight[0] - past[0] * sight[1]
    along -= np.sqrt(np.maximum(axis.radius_m**2 - across**2, 0.04 * axis.radius_m**2))
    off = np.stack([along * sight[0] - across * sight[1], along * sight[1] + across * sight[0]])
    sweeps, pose = _of_sweeps(off, returns.epoch_gps_ns[rows] // _SWEEP_NS)
    mean, foot = _of_slices(off, height, axis.height_m, shaft.ground_m)
    radius = _of_radius(across, height, axis.radius_m, pose, sweeps)
    behind = float(np.hypot(*sight.mean(axis=1)))  # 1: seen from one side, 0: from all
    place = pose**2 / sweeps + mean**2 + foot**2 + 0.5 * (behind * radius) ** 2
    return Sigma(max(math.sqrt(place), _LEAST_M), max(radius, _LEAST_M))


def _of_parts(xyh: Float64, shaft: Shaft) -> Sigma:
    """Returns the standard deviations of a shaft from fits to all parts of its returns (n, 3) but one each."""
    xyh = xyh[np.argsort(xyh[:, 2], kind="stable")]
    part = np.arange(len(xyh)) * _PARTS // len(xyh)
    fits = [fit_axis(held, np.full((len(held), 2), np.nan), lean=float(np.ptp(held[:, 2])) > LEANING_M)
            for k in range(_PARTS) if len(held := xyh[part != k]) > _LEAST_OF_SLICE]  # fmt: skip
    of_each = np.array([[*map(float, fit.at(shaft.ground_m)), fit.radius_m] for fit in fits])
    spread = np.sqrt((len(fits) - 1) * of_each.var(axis=0))
    radius = math.hypot(spread[2], _UNSEEN * shaft.axis.radius_m)
    return Sigma(max(math.hypot(spread[0], spread[1], radius, _POSE_M) / math.sqrt(2.0), _LEAST_M), radius)


def _of_sweeps(off: Float64, sweep: Int64) -> tuple[int, float]:
    """Returns how many sweeps saw a shaft, and 1 σ of the place of one of them."""
    _, number = np.unique(sweep, return_inverse=True)
    count = np.bincount(number)
    square = sum((np.bincount(number, weights=v) ** 2 / count).sum() for v in off) / (2.0 * sweep.size)
    known = count.size - 1.0
    total = square * count.size + _POSE_SWEEPS * _POSE_M**2
    return count.size, math.sqrt(total / (known + _POSE_SWEEPS))


def _of_slices(off: Float64, height: Float64, middle_m: float, ground_m: float) -> tuple[float, float]:
    """Returns 1 σ of the axis at its middle height, and of its way down to the ground, from the scatter of slices."""
    level = np.floor((height - height.min()) / SLICE_M).astype(np.int64)
    count = np.bincount(level)
    some = count >= _LEAST_OF_SLICE
    slices = int(np.count_nonzero(some))
    if slices < 3:
        scatter = float(np.sqrt((off**2).mean()))
        return scatter / math.sqrt(max(slices, 1)), 0.5 * scatter
    means = [np.bincount(level, weights=v)[some] / count[some] for v in off]
    scatter = math.sqrt(sum(float(np.square(v).sum()) for v in means) / (2.0 * (slices - 2)))
    heights = height.min() + (np.flatnonzero(some) + 0.5) * SLICE_M
    lever = (heights.mean() - ground_m) / math.sqrt(float(np.square(heights - heights.mean()).sum()))
    return scatter / math.sqrt(slices), scatter * lever


def _of_radius(across: Float64, height: Float64, radius_m: float, pose_m: float, sweeps: int) -> float:
    """Returns 1 σ of the radius, from the widths that slices show."""
    level = np.floor((height - height.min()) / SLICE_M).astype(np.int64)
    halves = [0.5 * float(np.ptp(across[level == k])) for k in np.unique(level).tolist()
              if np.count_nonzero(level == k) >= _LEAST_OF_SLICE]  # fmt: skip
    scatter = float(np.std(halves)) / math.sqrt(len(halves)) if len(halves) >= 3 else 0.5 * radius_m
    return math.sqrt(scatter**2 + (_ROUND * radius_m) ** 2 + 0.5 * pose_m**2 / sweeps)
