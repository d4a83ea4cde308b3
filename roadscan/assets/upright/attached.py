"""What is about a shaft: its arms, its crown, a box at the height of a head; and the measures that tell its type."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.assets import classes
from roadscan.assets.quantiles import quantiles
from roadscan.assets.scene import Scene
from roadscan.assets.upright.shafts import Shaft
from roadscan.assets.upright.slices import ground_light, places_of
from roadscan.compute.array_types import Bool, Float64, Int64

_LEVEL_M: Final = 0.4  # Height of a level of a crown (m).
_SECTORS: Final = 8  # Directions around a shaft.
_CROWN_REACH_M: Final = 4.5  # Returns within this distance of the axis (m) may belong to a crown.
_HEAD_REACH_M: Final = 0.75  # Returns within this distance (m) may belong to a signal's head.
_CROWN_M: Final = 1.5  # Returns within this distance (m) show a crown.
_RINGS_M: Final = (0.4, 0.75, 1.5, 3.0)
"""Edges of the rings about a shaft in which returns are counted (m)."""
_HEAD_FROM_M: Final = 1.8
"""A head is higher above the foot than this (m)."""
_ARM_M: Final = 0.2
"""What hangs from an arm lies below its top by more than this (m)."""
_LEAST: Final = 8
"""Fewer returns show no form."""


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


def crown(near: About, shaft: Shaft, others_xy: Float64) -> tuple[float, float, Int64]:
    """Top above the foot, mean diameter, and returns of a crown; returns nearer to another trunk belong to that.

    others_xy : (k, 2) axes of the other trunks about.
    """
    own = _nearest(near, others_xy)
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


def _nearest(near: About, others_xy: Float64) -> Bool:
    """Returns which returns (n,) are nearer to a shaft than to others, whose axes (k, 2) count from its axis."""
    nearest = np.ones(near.rows.size, np.bool_)
    for x, y in others_xy.tolist():
        nearest &= np.hypot(near.right_m - x, near.ahead_m - y) > near.away_m
    return nearest


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


def attached(scene: Scene, shaft: Shaft, near: About, others_xy: Float64) -> dict[str, float]:
    """Returns the features of what is about a shaft that tell what type it is: shares, heights and widths (m).

    others_xy : (k, 2) axes of the other shafts about, from its own. NaN where too few returns tell a feature.
    """
    out = arms(near, shaft)
    own = _nearest(near, others_xy)
    reach_m = out.reach_m if out else 0.0
    at_end = near.away_m < 0.0
    if out is not None:
        at_end = np.hypot(near.right_m - out.end_m[0], near.ahead_m - out.end_m[1]) < _HEAD_REACH_M
        at_end &= near.above_m < out.top_above_m - _ARM_M
    returns = scene.returns
    sight = np.hypot(returns.sensor_x_m[shaft.rows] - shaft.axis.x_m, returns.sensor_y_m[shaft.rows] - shaft.axis.y_m)
    range_m = float(np.median(sight))
    sensor = float(np.median(returns.sensor_height_m[shaft.rows])) - shaft.ground_m
    return {
        **_rings(scene, near, shaft, own), **_levels(scene, near, shaft, own),
        **_box(scene, near, near.away_m < _HEAD_REACH_M, shaft, "head"), **_box(scene, near, at_end, shaft, "end"),
        "arm_m": reach_m, "arm_returns": math.log1p(out.returns if out else 0),
        "other_arm_m": out.other_m if out else 0.0,
        "arm_over_top_m": out.top_above_m - shaft.top_above_m if out else math.nan,
        "arm_falls_m": out.top_above_m - out.lamp_above_m if out else math.nan,
        "range_m": range_m, "rise_of_top": (shaft.top_above_m - sensor) / max(range_m, 1.0),
        "bright": float(np.mean(returns.intensity[shaft.rows] >= 2.0 * ground_light(scene))),
        "others": float(len(others_xy)),
    }  # fmt: skip


def _rings(scene: Scene, near: About, shaft: Shaft, own: Bool) -> dict[str, float]:
    """Returns how many returns lie in rings about a shaft, below its top and above it, and what they are."""
    many = float(shaft.rows.size)
    upper = near.above_m > shaft.top_above_m
    told: dict[str, float] = {}
    for name, some in (("beside", ~upper), ("over", upper)):
        count = np.histogram(near.away_m[some], [0.0, *_RINGS_M, _CROWN_REACH_M])[0]
        for k, number in enumerate(count.tolist()):
            told[f"{name}_ring_{k}"] = math.log((number + 1.0) / many)
    kind, close = scene.classes[near.rows], near.away_m < _CROWN_M
    green = np.isin(kind, classes.VEGETATION)
    for name, some in (("green", green), ("front", kind == classes.BUILDING), ("own", own)):
        told[f"{name}_close"] = _share(some, close)
        told[f"{name}_far"] = _share(some, ~close)
    return told


def _share(some: Bool, of: Bool) -> float:
    return float(np.mean(some[of])) if of.any() else math.nan


def _levels(scene: Scene, near: About, shaft: Shaft, own: Bool) -> dict[str, float]:
    """Returns in how many directions something is, level by level, and how high and how flat that is.

    Crowns fill all directions; plates and arms one to three of them; fronts and balconies up to half.
    """
    front = scene.classes[near.rows] == classes.BUILDING
    told: dict[str, float] = {}
    for name, some in (
        ("close", (near.away_m < _CROWN_M) & ~front), ("own", (near.away_m < _CROWN_M) & own),
        ("inner", near.away_m < _HEAD_REACH_M), ("outer", (near.away_m >= _CROWN_M) & ~front & own),
    ):  # fmt: skip
        share = _directions(near, some)
        told |= {f"full_{name}": float(share[-3:].mean()), f"fullest_{name}": float(share[-1]),
                 f"levels_{name}": float(np.count_nonzero(share >= 0.5)) * _LEVEL_M}  # fmt: skip
    column = (near.away_m < _CROWN_M) & own
    unknown = dict.fromkeys(("column_low_m", "column_mid_m", "column_top_m", "gap_m", "flat", "thin"), math.nan)
    if np.count_nonzero(column) < _LEAST:
        return told | unknown
    above = near.above_m[column]
    low, middle, high = (q - shaft.top_above_m for q in quantiles(above, [0.05, 0.5, 0.98]))
    heights = np.sort(np.append(above[above > shaft.top_above_m], shaft.top_above_m))
    gap = float(np.diff(heights).max()) if heights.size > 1 else 0.0
    place = np.column_stack([near.right_m[column], near.ahead_m[column], above])
    place -= place.mean(axis=0)
    small, mean, large = np.linalg.eigvalsh(place.T @ place).tolist()
    return told | {
        "column_low_m": low, "column_mid_m": middle, "column_top_m": high, "gap_m": gap,
        "flat": small / max(large, 1e-9), "thin": mean / max(large, 1e-9),
    }  # fmt: skip


def _directions(near: About, some: Bool) -> Float64:
    """Returns the share of the eight directions with returns in levels of 0.4 m (k,), ascending; k is 3 or more."""
    level = np.floor(near.above_m[some] / _LEVEL_M).astype(np.int64)
    turn = np.arctan2(near.ahead_m[some], near.right_m[some]) / (2.0 * np.pi / _SECTORS)
    held = np.zeros((int(level.max(initial=0)) + 3, _SECTORS), np.bool_)
    held[level, np.floor(turn).astype(np.int64) % _SECTORS] = True
    return np.sort(held.mean(axis=1))


def _box(scene: Scene, near: About, close: Bool, shaft: Shaft, name: str) -> dict[str, float]:
    """Returns where a box about a shaft or at the end of its arm is, how large, and how bright: heads are dark."""
    close = close & (near.above_m > _HEAD_FROM_M)
    unknown = dict.fromkeys(("high_m", "wide_m", "deep_m", "middle_m", "over_top_m", "bright"), math.nan)
    number = {f"{name}_returns": math.log((int(close.sum()) + 1.0) / shaft.rows.size)}
    if np.count_nonzero(close) < _LEAST:
        return number | {f"{name}_{key}": value for key, value in unknown.items()}
    low, high = quantiles(near.above_m[close], [0.02, 0.98])
    plan = np.column_stack([near.right_m[close], near.ahead_m[close]])
    plan -= plan.mean(axis=0)
    _, axes = np.linalg.eigh(plan.T @ plan)
    deep, wide = (high_end - low_end for low_end, high_end in (quantiles(c, [0.03, 0.97]) for c in (plan @ axes).T))
    values = {
        "high_m": high - low, "wide_m": wide, "deep_m": deep, "middle_m": (low + high) / 2.0,
        "over_top_m": high - shaft.top_above_m,
        "bright": float(np.mean(scene.returns.intensity[near.rows[close]] >= 2.0 * ground_light(scene))),
    }  # fmt: skip
    return number | {f"{name}_{key}": value for key, value in values.items()}
