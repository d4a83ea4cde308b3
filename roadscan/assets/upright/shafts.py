"""Shafts, thin upright things with free space around them: their axis, diameter and standard deviations."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.shafts import (
    LEAST_RADIUS_M,
    MOST_RADIUS_M,
    fit_cylinder,
    longest_run,
    near_axis,
    returns_about,
    slices_above_one_another,
    widths_of_levels,
)
from roadscan.assets.quantiles import median
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.assets.upright.slices import CELL_M, LOWEST_M, SLICE_M, Slices, around, slices_of
from roadscan.compute.array_types import Bool, Float64, Int64

SECTOR_DEG: Final = 8.0
"""Sight lines within a sector (degrees) count as of one direction."""
_LEAST_SEEN: Final = 8
"""Fewer returns whose sensor's place is known show no width."""
_NOISE_M: Final = 0.02
"""Returns farther from the circle than this (m), the noise of many scanners, weigh less."""
_STIFF_M: Final = 0.05
"""A slope of 1 counts as so great a distance (m) of every return: what shows no lean stands upright."""


@dataclass(frozen=True)
class Axis:
    """A straight, nearly upright axis: x = x_m + slope_x · (height − height_m), y likewise."""

    x_m: float
    y_m: float
    height_m: float
    slope_x: float
    slope_y: float
    radius_m: float
    residual_m: float
    """Root mean square distance of the returns from the cylinder."""

    @property
    def lean_deg(self) -> float:
        """Returns the angle from the vertical (degrees)."""
        return math.degrees(math.atan(math.hypot(self.slope_x, self.slope_y)))

    def at(self, height_m: npt.ArrayLike) -> tuple[Float64, Float64]:
        """Returns x and y of the axis at heights (any shape)."""
        past = np.asarray(height_m, np.float64) - self.height_m
        return self.x_m + self.slope_x * past, self.y_m + self.slope_y * past


def fit_axis(xyh: Float64, sensor_xy: Float64, *, lean: bool = True) -> Axis:
    """Returns the cylinder through returns (n, 3), seen from (n, 2).

    Sight lines meet a cylinder evenly across its width, so the spread of the returns across their sight lines shows the
    radius, and the middle of that spread the axis across them; along them the axis lies where the returns are one
    radius away from it (Gauss–Newton, Huber weights). A circle fit alone shows neither for shafts as thin as the range
    noise; it is what remains where it is not known from where they were seen, as in clouds without a trajectory.

    sensor_xy : NaN where it is not known.
    lean : the axis may lean; otherwise it is upright.
    """
    seen = np.isfinite(sensor_xy[:, 0])
    if np.count_nonzero(seen) < _LEAST_SEEN:
        return _round_axis(xyh, lean)
    xyh, sensor_xy = xyh[seen], sensor_xy[seen]
    middle = median(xyh[:, 2])
    sight = sensor_xy - xyh[:, :2]
    sight /= np.maximum(np.hypot(sight[:, 0], sight[:, 1]), 1e-9)[:, None]
    sector = np.floor(np.degrees(np.arctan2(sight[:, 1], sight[:, 0])) / SECTOR_DEG).astype(np.int64)
    order = np.argsort(sector, kind="stable")
    table = np.ascontiguousarray(np.column_stack([xyh[:, :2], xyh[:, 2] - middle, sight])[order])
    state = np.array([median(xyh[:, 0]), median(xyh[:, 1]), 0.0, 0.0, 0.03])
    residual, _ = fit_cylinder(table, sector[order], lean, state, np.empty((len(table), 3)))
    x, y, slope_x, slope_y, radius = map(float, state)
    return Axis(x, y, middle, slope_x, slope_y, radius, float(residual))


def _round_axis(xyh: Float64, lean: bool) -> Axis:
    """Returns the cylinder that returns (n, 3) lie on: distances from it count by a soft L1 norm."""
    from scipy.optimize import least_squares

    middle = float(np.median(xyh[:, 2]))
    centre = np.median(xyh[:, :2], axis=0)
    past = xyh - [*centre, middle]

    def misses(state: Float64) -> Float64:
        x, y, slope_x, slope_y, radius = state
        away = np.hypot(past[:, 0] - x - slope_x * past[:, 2], past[:, 1] - y - slope_y * past[:, 2])
        return np.asarray(np.append(away - radius, math.sqrt(len(past)) * _STIFF_M * np.array([slope_x, slope_y])))

    most = np.array([1.0, 1.0, *[1.0 if lean else 1e-9] * 2, MOST_RADIUS_M])
    least = np.append(-most[:4], LEAST_RADIUS_M)
    spread = math.sqrt(past[:, :2].var(axis=0).sum())
    begin = [0.0, 0.0, 0.0, 0.0, min(max(spread, 2.0 * LEAST_RADIUS_M), 0.9 * MOST_RADIUS_M)]
    fit = least_squares(misses, begin, loss="soft_l1", f_scale=_NOISE_M, bounds=(least, most))
    x, y, slope_x, slope_y, radius = map(float, fit.x)
    return Axis(float(centre[0]) + x, float(centre[1]) + y, middle, slope_x, slope_y, radius,
                float(np.sqrt(np.mean(np.square(misses(fit.x)[:-2])))))  # fmt: skip


_LEAST_SLICES: Final = 3
"""Least number of slices of 0.2 m in which a shaft shows."""
_REACH_M: Final = 0.25  # Components within this distance (m) may belong to one shaft.
_MOST_LEAN: Final = 0.2
"""Greatest lean: horizontal extent of an axis per metre of height (11°)."""
_GAP_SLICES: Final = 4
"""Slices that may be missing between two of a shaft: scanners see some heights only."""
_LEAST_RETURNS: Final = 8  # Least number of returns of a shaft.
_HIGHEST_FOOT_M: Final = 2.0
"""Greatest height of a hidden foot (m): parked cars and hedges hide no more."""
_FOOT_SLICES: Final = round((_HIGHEST_FOOT_M - LOWEST_M) / SLICE_M) + 1  # Slices in which the foot of a shaft may lie.
LEANING_M: Final = 0.8  # Returns over less of the height (m) than this show no lean.
_MOST_FITTED: Final = 3000  # Returns used for the axis, at most.
_RING_M: Final = 0.6  # Outer radius of the ring that must be free (m).
_AROUND_TILE_M: Final = 6.0
"""Shafts farther from the tile (m) are not measured: no crown, arm or plate of it reaches them."""
ALONE_M: Final = 0.6  # Radius of the space about a shaft (m).
_LEAST_ALONE: Final = 0.25
"""Least share of the returns around that belong to a shaft: clumps of leaves and pieces of façades have less."""


@dataclass(frozen=True, eq=False)
class Shaft:
    """A shaft, measured. Heights named `…_above_m` count from the ground at its foot."""

    axis: Axis
    ground_m: float
    """Height of the ground at the foot, in the map frame."""
    low_above_m: float
    """Lowest slice in which it shows."""
    top_above_m: float
    """Highest return of it."""
    rows: Int64
    """Returns of the scene that lie on it."""
    slices: int
    """Slices in which it shows, of 0.2 m each."""
    filled: float
    """Share of the slices between its lowest and its highest in which it shows."""
    free: float
    """Share of its slices with nothing else within 0.6 m."""
    alone: float
    """Share of the returns within 0.35 m about it, in its slices, that lie on it."""
    covered: float
    """Share of the eight directions about its top with returns, in the 1.6 m above, within 0.7 m."""
    foot_xy_m: tuple[float, float]
    """Where the axis meets the ground."""


@once_a_scene
def shafts_of(scene: Scene) -> list[Shaft]:
    """Returns all shafts in and near a scene's tile, those with most slices first."""
    slices = slices_of(scene)
    if slices.level.size == 0:
        return []
    order, starts = slices.members()
    grid = _Neighbours(slices)
    used = np.zeros(slices.level.size, np.bool_)
    found = []
    scores = _scores(slices)
    for seed in np.lexsort((slices.y_m, slices.x_m, -scores)).tolist():
        if scores[seed] < _LEAST_SLICES:
            break
        if used[seed]:
            continue
        members = _members(slices, grid.near(seed, 0.35), seed, used)
        if members.size == 0:
            continue
        used[members] = True
        if not _reads(scene, slices, members):
            continue
        if LOWEST_M + SLICE_M * float(slices.level[members].min()) > _HIGHEST_FOOT_M:
            continue
        rows = np.sort(np.concatenate([order[starts[m] : starts[m + 1]] for m in members.tolist()]))
        alone = _alone(slices, members, rows.size)
        if rows.size >= _LEAST_RETURNS and alone >= _LEAST_ALONE:
            found.append(_measured(scene, slices, members, rows, alone))
    return [shaft for shaft in found if shaft is not None]


def _reads(scene: Scene, slices: Slices, members: Int64) -> bool:
    """Returns whether what stands in the tile may be judged by a shaft."""
    return scene.tile.comes_near(np.column_stack([slices.x_m[members], slices.y_m[members]]), _AROUND_TILE_M)


def _alone(slices: Slices, members: Int64, returns: int) -> float:
    """Returns the share of the returns about some components, in their slices, that belong to them."""
    x, y = median(slices.x_m[members]), median(slices.y_m[members])
    total = int(returns_about(around(slices, x, y, ALONE_M), slices.level[members], CELL_M, ALONE_M))
    return min(returns / max(total, 1), 1.0)


class _Neighbours:
    """Index of compact components by their place, seen from above."""

    def __init__(self, slices: Slices) -> None:
        self._slices = slices
        self._column = np.floor((slices.x_m - slices.corner_m[0]) / 0.5).astype(np.int64)
        self._row = np.floor((slices.y_m - slices.corner_m[1]) / 0.5).astype(np.int64)
        self._width = int(self._column.max()) + 3
        flat = self._row * self._width + self._column
        self._order = np.argsort(flat, kind="stable")
        self._flat = flat[self._order]

    def near(self, i: int, reach_m: float) -> Int64:
        """Returns components within reach (at most 0.5 m) of component `i`, in order of their number."""
        row, column = int(self._row[i]), int(self._column[i])
        parts = []
        for r in (row - 1, row, row + 1):
            first, last = np.searchsorted(self._flat, [r * self._width + column - 1, r * self._width + column + 2])
            parts.append(self._order[first:last])
        near = np.sort(np.concatenate(parts))
        away = np.hypot(self._slices.x_m[near] - self._slices.x_m[i], self._slices.y_m[near] - self._slices.y_m[i])
        out: Int64 = near[away <= reach_m]
        return out


def _scores(slices: Slices) -> Int64:
    """Returns the number of slices with a compact component above or below each (k,)."""
    column = ((slices.x_m - slices.corner_m[0]) / CELL_M).astype(np.int64)
    row = ((slices.y_m - slices.corner_m[1]) / CELL_M).astype(np.int64)
    scores = np.zeros(slices.level.size, np.int64)
    masks = np.zeros(slices.counts.shape[1:], np.int64)
    slices_above_one_another(row, column, slices.level, round(_REACH_M / CELL_M), _FOOT_SLICES, masks, scores)
    return scores


def _members(slices: Slices, near: Int64, seed: int, used: Bool) -> Int64:
    """Components of a shaft about a seed: near a straight axis, in slices without long gaps; none if too few."""
    near = near[~used[near]]
    kept = np.empty(near.size, np.bool_)
    place = float(slices.x_m[seed]), float(slices.y_m[seed])
    near_axis(slices.x_m[near], slices.y_m[near], slices.level[near], place, _MOST_LEAN * SLICE_M, kept)
    longest_run(slices.level[near], _GAP_SLICES + 1, _LEAST_SLICES, kept)
    return near[kept]


def _measured(scene: Scene, slices: Slices, members: Int64, rows: Int64, alone: float) -> Shaft | None:
    """Returns the shaft of some components; None where the ground under it is not known."""
    returns = scene.returns
    xyh = np.column_stack([returns.x_m[rows], returns.y_m[rows], returns.height_m[rows]])
    seen_from = np.column_stack([returns.sensor_x_m[rows], returns.sensor_y_m[rows]])
    core = np.flatnonzero(_narrow(xyh))
    core = core[:: -(-core.size // _MOST_FITTED)]
    axis = fit_axis(xyh[core], seen_from[core], lean=float(np.ptp(xyh[core, 2])) > LEANING_M)
    ground = float(scene.ground.height_at(*axis.at(axis.height_m - 1.0)))
    if not np.isfinite(ground):
        return None
    foot = axis.at(ground)
    ground = float(scene.ground.height_at(*foot))
    levels = np.unique(slices.level[members])
    free, covered = _space(slices, axis, levels, foot)
    return Shaft(
        axis, ground, LOWEST_M + SLICE_M * float(levels[0]), float(xyh[:, 2].max()) - ground, rows, levels.size,
        levels.size / float(levels[-1] - levels[0] + 1), free, alone, covered, (float(foot[0]), float(foot[1])),
    )  # fmt: skip


def _narrow(xyh: Float64) -> Bool:
    """Returns a mask (n,) of the slices' returns where the shaft is narrow: plates, lamps and crowns are wider."""
    level = np.floor(xyh[:, 2] / SLICE_M).astype(np.int64)
    level -= int(level.min())
    widths = np.full(int(level.max()) + 1, np.nan)
    widths_of_levels(xyh, level, 4, (0.05, 0.95), widths)
    if np.isfinite(widths).sum() < 3:
        return np.ones(len(xyh), np.bool_)
    limit = 1.4 * float(np.nanquantile(widths, 0.3)) + 0.06
    narrow: Bool = ~(widths[level] > limit)
    return narrow


def _space(slices: Slices, axis: Axis, levels: Int64, foot: tuple[Float64, Float64]) -> tuple[float, float]:
    """Returns the share of slices with nothing about the shaft, and of the directions about its top with returns."""
    near = around(slices, axis.x_m, axis.y_m, 1.0)
    if near.shape[1] < 21 or near.shape[2] < 21:
        near = np.zeros((near.shape[0], 21, 21), near.dtype)
    away, sector = _surroundings()
    inner = axis.radius_m + 0.16
    ring = (away > inner) & (away <= max(_RING_M, inner + 0.25))
    free = float(np.mean((near[levels][:, ring] > 0).sum(axis=1) == 0))
    top = near[int(levels[-1]) - 2 : int(levels[-1]) + 8].sum(axis=0)
    held = [bool((top[(sector == s) & (away > inner) & (away <= 0.7)] > 0).any()) for s in range(8)]
    return free, float(np.mean(held))


@functools.cache
def _surroundings() -> tuple[Float64, Int64]:
    """Returns the distance (21, 21) of cells from the middle one (m), up to a metre, and their direction of eight."""
    dy, dx = np.mgrid[-10:11, -10:11] * CELL_M
    return np.hypot(dx, dy), (np.floor(np.arctan2(dy, dx) / (np.pi / 4)).astype(np.int64) + 8) % 8


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
