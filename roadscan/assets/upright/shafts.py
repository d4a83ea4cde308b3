"""Shafts: thin, upright things that stand on the ground with free space around them, as poles and trunks do."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.slices import slices_above_one_another
from roadscan.assets.memory import once_a_scene
from roadscan.assets.quantiles import median
from roadscan.assets.scene import Scene
from roadscan.assets.upright.axis import Axis, fit_axis
from roadscan.assets.upright.kernels.shafts import longest_run, near_axis, returns_about, widths_of_levels
from roadscan.assets.upright.slices import CELL_M, LOWEST_M, SLICE_M, Slices, around, slices_of
from roadscan.compute.array_types import Float64, Int64

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


def _members(slices: Slices, near: Int64, seed: int, used: npt.NDArray[np.bool_]) -> Int64:
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


def _narrow(xyh: Float64) -> npt.NDArray[np.bool_]:
    """Returns a mask (n,) of the slices' returns where the shaft is narrow: plates, lamps and crowns are wider."""
    level = np.floor(xyh[:, 2] / SLICE_M).astype(np.int64)
    level -= int(level.min())
    widths = np.full(int(level.max()) + 1, np.nan)
    widths_of_levels(xyh, level, 4, (0.05, 0.95), widths)
    if np.isfinite(widths).sum() < 3:
        return np.ones(len(xyh), np.bool_)
    limit = 1.4 * float(np.nanquantile(widths, 0.3)) + 0.06
    narrow: npt.NDArray[np.bool_] = ~(widths[level] > limit)
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
