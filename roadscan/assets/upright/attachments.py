"""Attachments of a shaft: crowns, arms with lamps, heads of signals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.scene import Scene
from roadscan.assets.upright.places import ground_light, places_of
from roadscan.assets.upright.shafts import Shaft
from roadscan.compute.array_types import Float64, Int64

_LEVEL_M: Final = 0.4  # Height of a level of a crown (m).
_SECTORS: Final = 8  # Directions around a shaft.
_CROWN_REACH_M: Final = 4.5  # Returns within this distance of the axis (m) may belong to a crown.
_HEAD_REACH_M: Final = 0.75  # Returns within this distance (m) may belong to a signal's head.
_CROWN_M: Final = 1.5  # Returns within this distance (m) show a crown.
_CROWN_GAP_M: Final = 2.0
"""A crown starts no higher above the shaft's top than this (m)."""
_BEYOND_SHARE: Final = 0.1  # Share of those returns beyond a head, at most.
_ARM_M: Final = 0.2
"""What hangs from an arm lies below its top by more than this (m)."""
_BRIGHT_SHARE: Final = 0.1
"""Heads of signals are dark; of the returns of a sign more than this share are bright."""


@dataclass(frozen=True, eq=False)
class About:
    """Returns about a shaft, but not on it, from 1.2 m above its foot."""

    rows: Int64
    right_m: Float64
    """(n,) to the east of the axis; `ahead_m` is to the north."""
    ahead_m: Float64
    away_m: Float64
    above_m: Float64
    """(n,) above the foot."""


@dataclass(frozen=True)
class Arms:
    """Arms at the upper end of a shaft, in one direction or two opposite ones."""

    reach_m: float
    """Of the longer side."""
    other_m: float
    """Of the other side; 0: none."""
    lamp_above_m: float
    """Height of its outer end above the foot."""
    top_above_m: float
    returns: int
    end_m: tuple[float, float]
    """Outer end of the longer side, to the east and to the north of the axis."""


def about(scene: Scene, shaft: Shaft) -> About:
    """Returns the returns within 4.5 m of a shaft's axis."""
    rows = places_of(scene).within(shaft.axis.x_m, shaft.axis.y_m, _CROWN_REACH_M)
    rows = rows[scene.classes[rows] != classes.BRIDGE_DECK]
    height = scene.returns.height_m[rows]
    x, y = shaft.axis.at(height)
    right, ahead = scene.returns.x_m[rows] - x, scene.returns.y_m[rows] - y
    away, above = np.hypot(right, ahead), height - shaft.ground_m
    kept = (above > 1.2) & (away > shaft.axis.radius_m + 0.12)
    return About(rows[kept], right[kept], ahead[kept], away[kept], above[kept])


def crown_share(near: About, shaft: Shaft) -> float:
    """Returns the share of the eight directions with returns within 1.5 m, mean of the three fullest levels of 0.4 m.

    Crowns fill all directions; plates, arms and façades one to three of them. What begins far above the shaft's top,
    and above all that hangs on it, is no crown of it.
    """
    close = near.away_m < 1.5
    heights = np.sort(near.above_m[close])
    gaps = np.flatnonzero(np.diff(np.maximum(heights, shaft.top_above_m), prepend=shaft.top_above_m) > _CROWN_GAP_M)
    if gaps.size:
        close &= near.above_m < heights[gaps[0]]
    level = np.floor(near.above_m[close] / _LEVEL_M).astype(np.int64)
    if level.size == 0:
        return 0.0
    sector = np.floor(np.arctan2(near.ahead_m[close], near.right_m[close]) / (2 * np.pi / _SECTORS)).astype(np.int64)
    held = np.zeros((int(level.max()) + 1, _SECTORS), np.bool_)
    held[level, sector % _SECTORS] = True
    return float(np.mean(np.sort(held.mean(axis=1))[-3:])) if held.shape[0] >= 3 else float(held.mean())


def crown(near: About, shaft: Shaft, others_xy: Float64) -> tuple[float, float, Int64]:
    """Top above the foot, mean diameter, and returns of a crown; returns nearer to another trunk belong to that.

    others_xy : (k, 2) axes of the other trunks about.
    """
    own = np.ones(near.rows.size, np.bool_)
    for x, y in others_xy.tolist():
        own &= np.hypot(near.right_m - x, near.ahead_m - y) > near.away_m
    close = own & (near.away_m < 1.5)
    low = max(1.5, float(np.quantile(near.above_m[close], 0.05))) if close.any() else 1.5
    own &= near.above_m >= low
    if own.sum() < 10:
        return shaft.top_above_m, float("nan"), near.rows[own]
    sector = np.floor(np.arctan2(near.ahead_m[own], near.right_m[own]) / (np.pi / 8)).astype(np.int64) % 16
    radii = [float(np.quantile(near.away_m[own][sector == k], 0.97)) for k in range(16) if (sector == k).sum() >= 3]
    column = own & (near.away_m < 1.5)
    top = float(np.quantile(near.above_m[column], 0.995)) if column.any() else shaft.top_above_m
    return max(top, shaft.top_above_m), 2.0 * float(np.mean(radii)) if radii else float("nan"), near.rows[own]


def arms(near: About, shaft: Shaft) -> Arms | None:
    """Returns arms near the top of a shaft 3 m high or higher, in one or two directions; None where there are none.

    Of 24 directions those count whose strip, 0.5 m wide, holds returns from the shaft outwards without a gap. Where
    more than a third of them do, a crown or a roof is about.
    """
    if shaft.top_above_m < 3.0:
        return None
    upper = (near.above_m > max(2.7, shaft.top_above_m - 0.9)) & (near.above_m < shaft.top_above_m + 1.5)
    right, ahead, above = near.right_m[upper], near.ahead_m[upper], near.above_m[upper]
    if right.size < 8:
        return None
    reaches = []
    for k in range(24):
        sine, cosine = math.sin(k * math.pi / 12), math.cos(k * math.pi / 12)
        strip = np.abs(-right * sine + ahead * cosine) <= 0.25
        reaches.append(_reach((right * cosine + ahead * sine)[strip], above[strip]))
    length = np.array([r for r, _ in reaches])
    if length.max() < 0.5 or (length > 0.5).mean() > 0.34:
        return None
    best = int(np.argmax(length))
    across = length[[(best + 11) % 24, (best + 12) % 24, (best + 13) % 24]]
    sine, cosine = math.sin(best * math.pi / 12), math.cos(best * math.pi / 12)
    held = (np.abs(-right * sine + ahead * cosine) <= 0.25) & (np.abs(right * cosine + ahead * sine) <= length[best])
    other = float(across.max()) if across.max() >= 0.5 else 0.0
    reach, lamp_above_m = reaches[best]
    top, end = float(np.quantile(above[held], 0.98)), (reach * cosine, reach * sine)
    return Arms(reach, other, lamp_above_m, top, int(held.sum()), end)


def _reach(along: Float64, above: Float64) -> tuple[float, float]:
    """Returns how far returns extend outwards without a gap of more than 0.6 m, and the height of the end.

    The end are the returns from 0.4 m before it to 0.1 m beyond it, or the nearest one where a gap lies there.
    """
    order = np.argsort(along, kind="stable")
    out = along[order][along[order] > 0.0]
    if out.size < 5:
        return 0.0, 0.0
    steps = np.diff(np.concatenate([[0.0], out]))
    gap = np.flatnonzero(steps > 0.6)
    out = out[: gap[0]] if gap.size else out
    if out.size < 5:
        return 0.0, 0.0
    reach = float(np.quantile(out, 0.98))
    away = np.abs(along - (reach - 0.15))
    return reach, float(np.median(above[away <= max(0.25, away.min())]))


def signal_head(scene: Scene, near: About, out: Arms | None) -> tuple[float, float] | None:
    """Returns height of the middle above the foot, and height of a box like that of a signal; None where there is none.

    A shaft carries it directly, or at the end of its arm. It is 0.15–0.6 m wide and deep, 0.55–1.5 m high, 1.8 m above
    the foot or more; plates are thinner, and bright.
    """
    held = _head(scene, near, near.away_m < _HEAD_REACH_M)
    if held is None and out is not None:
        at_end = np.hypot(near.right_m - out.end_m[0], near.ahead_m - out.end_m[1]) < _HEAD_REACH_M
        held = _head(scene, near, at_end & (near.above_m < out.top_above_m - _ARM_M))
    return held


def is_head_alone(scene: Scene, near: About) -> bool:
    """Returns whether a shaft carries a signal's head, and nothing about it reaches as far as a crown."""
    crown = (near.away_m < _CROWN_M) & (near.above_m > 1.8)
    beyond = crown & (near.away_m >= _HEAD_REACH_M)
    return int(beyond.sum()) <= _BEYOND_SHARE * int(crown.sum()) and signal_head(scene, near, None) is not None


def _head(scene: Scene, near: About, close: npt.NDArray[np.bool_]) -> tuple[float, float] | None:
    close = close & (near.above_m > 1.8)
    bright = scene.returns.intensity[near.rows[close]] >= 2.0 * ground_light(scene)
    if close.sum() < 15 or bright.mean() > _BRIGHT_SHARE:
        return None
    right, ahead, above = near.right_m[close], near.ahead_m[close], near.above_m[close]
    low, high = np.quantile(above, [0.02, 0.98])
    plan = np.column_stack([right, ahead])
    _, _, axes = np.linalg.svd(plan - plan.mean(axis=0), full_matrices=False)
    sizes = np.ptp(np.quantile((plan - plan.mean(axis=0)) @ axes.T, [0.03, 0.97], axis=0), axis=0)
    boxy = float(sizes[1]) >= 0.15 and float(sizes[0]) <= 0.75 and 0.55 <= high - low <= 1.5
    return (float(low + high) / 2, float(high - low)) if boxy else None
