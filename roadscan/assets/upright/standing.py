"""Classification of shafts: poles, lamp posts, signals, trees, delineators; by their attachments and surroundings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.bins import in_bins
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kernels.shafts import RINGS, Part, about_shaft
from roadscan.assets.kernels.sight import Rays, rays_at_shafts
from roadscan.assets.moving import SLOT_NS
from roadscan.assets.probabilities import logistic
from roadscan.assets.quantiles import median
from roadscan.assets.scene import LINES_M, Scene, once_a_scene
from roadscan.assets.upright.regions import Region, regions_of
from roadscan.assets.upright.shafts import ALONE_M, Shaft, shafts_of
from roadscan.assets.upright.slices import SLICE_M, ground_light, places_of
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.kernel_options import read_only

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


def crown_share(scene: Scene, near: About, shaft: Shaft) -> float:
    """Returns the share of the eight directions with returns within 1.5 m, mean of the three fullest levels of 0.4 m.

    Crowns fill all directions; plates and arms one to three of them. Fronts beside a post fill half, and are left out.
    What begins far above the shaft's top, and above all that hangs on it, is no crown of it.
    """
    close = (near.away_m < _CROWN_M) & (scene.classes[near.rows] != classes.BUILDING)
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


def _head(scene: Scene, near: About, close: Bool) -> tuple[float, float] | None:
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


_SKIN_M: Final = 0.1
"""Returns so near to a shaft's surface (m) may lie on it: noise of ranges, bark, and steps of poses."""
_RINGS_M: Final = (0.35, 0.6, 1.2)
"""Outer edges of the rings about a shaft's surface (m); what lies farther off does not tell what it is."""
_COMPANY_M: Final = (1.0, 3.0)
"""Shafts within these distances (m) are company: pieces of façades, hedges and fences stand in rows."""
_LONG_M, _TALL_M, _LOW_M = 2.5, 1.6, 1.35
"""Surfaces longer than the first (m) are walls, façades and hedges above the second, guard rails below the third;
posts up to the third are delineators and bollards."""
_FAR_M: Final = 3.0
"""Surfaces are sought up to this distance (m)."""
_LEAST_OF_SLICE: Final = 4
"""Slices with fewer returns show no middle and no width."""
_MIDDLE: Final = 0.6
"""Lines within this share of the radius meet a shaft: nearer to its rim a beam is met in part."""
_BEFORE_M, _BEHIND_M = 0.15, 0.3
"""A line that ends up to the first before a shaft's surface (m) ends on it, one that ends the second behind passed."""
_STRIP_M: Final = (0.1, 0.4)
"""Edges of the strips on both sides of a shaft, from its surface (m): what stands by itself has them free."""
_LEAST_LINES: Final = 4
"""Fewer lines do not tell what share of them passes."""
_LINES_CELL_M, _LINES_STEP_M = 1.0, 2.0
"""Edge of the cells by which lines find shafts, and the step in which lines are followed (m): small cells list few
shafts that a line does not come near, and long steps are few."""


def features_of(scene: Scene, shafts: list[Shaft]) -> dict[str, Float64]:
    """Returns the features (n,) of shafts by name: heights and distances (m), angles (degrees), shares.

    Numbers of returns enter as logarithms and as shares of those of the shaft, so that scanners and passes may differ.
    """
    long = [r for r in regions_of(scene) if r.length_m > _LONG_M]
    tall = [r for r in long if r.top_above_m > _TALL_M]
    low = [r for r in long if r.top_above_m <= _LOW_M]
    places = np.array([s.foot_xy_m for s in shafts]).reshape(-1, 2)
    rows = [
        _itself(shaft) | _about(scene, shaft) | _company(places, k) | _surfaces(shaft, tall, low)
        for k, shaft in enumerate(shafts)
    ]
    told = {name: np.array([row[name] for row in rows], np.float64) for name in (rows[0] if rows else ())}
    return told | (_sight(scene, shafts) if shafts else {})


def _itself(shaft: Shaft) -> dict[str, float]:
    """Returns features of the shaft itself."""
    axis, seen_m = shaft.axis, max(shaft.top_above_m - shaft.low_above_m, SLICE_M)
    # On a thick shaft, the middle of the visible side varies by half a radius from height to height.
    wander = math.degrees(math.atan2(0.5 * axis.radius_m, seen_m))
    return {
        "slices": shaft.slices, "filled": shaft.filled, "alone": shaft.alone, "free": shaft.free,
        "covered": shaft.covered, "low_m": shaft.low_above_m, "top_m": shaft.top_above_m,
        "slender": seen_m / (2.0 * axis.radius_m), "radius_m": axis.radius_m,
        "more_lean_deg": max(axis.lean_deg - wander, 0.0), "residual_m": axis.residual_m,
        "rough": axis.residual_m / (0.05 + 0.2 * axis.radius_m),
        "returns": math.log(shaft.rows.size), "returns_a_slice": math.log(shaft.rows.size / shaft.slices),
    }  # fmt: skip


def _about(scene: Scene, shaft: Shaft) -> dict[str, float]:
    """Returns features of what is about a shaft: beside, below and above it."""
    axis, returns = shaft.axis, scene.returns
    near = places_of(scene).within(axis.x_m, axis.y_m, _RINGS_M[-1] + axis.radius_m)
    number, sectors = np.zeros(len(Part), np.int64), np.zeros(_SECTORS, np.int64)
    on_it, slots = np.empty((near.size, 3)), np.zeros(2, np.int64)
    about_shaft(
        (returns.x_m, returns.y_m, returns.height_m, scene.classes, read_only(returns.epoch_gps_ns)), near,
        (axis.x_m, axis.y_m, axis.height_m, axis.slope_x, axis.slope_y, axis.radius_m),
        (shaft.ground_m, shaft.low_above_m, shaft.top_above_m), (_SKIN_M, *_RINGS_M), SLOT_NS,
        number, sectors, on_it, slots,
    )  # fmt: skip
    on_it, many = on_it[: number[Part.ON_IT]], max(int(number[Part.ON_IT]), 1)

    def odds(part: Part) -> float:
        return math.log((int(number[part]) + 1.0) / many)

    def share(part: Part, of: Part) -> float:
        return float(number[part]) / max(int(number[of]), 1)

    taken = sectors > 0.02 * many
    return {
        **{f"in_{round(edge * 100)}_cm": odds(ring) for edge, ring in zip(_RINGS_M, RINGS, strict=True)},
        "alone_lower": share(Part.ON_LOWER, Part.NEAR_LOWER), "alone_upper": share(Part.ON_UPPER, Part.NEAR_UPPER),
        "below": odds(Part.BELOW), "over": odds(Part.OVER), "goes_on": odds(Part.GOES_ON),
        "sides_taken": float(np.mean(taken)), "opposite": float(np.max(taken & np.roll(taken, _SECTORS // 2))),
        "leaves": share(Part.LEAVES, Part.BESIDE), "own_leaves": share(Part.OWN_LEAVES, Part.ON_IT),
        "building": share(Part.BUILDING, Part.BESIDE), "own_building": share(Part.OWN_BUILDING, Part.ON_IT),
        "stays": int(slots[0]) / max(int(slots.sum()), 1),
    } | _build(*on_it.T)  # fmt: skip


def _build(right: Float64, ahead: Float64, above: Float64) -> dict[str, float]:
    """Returns features of how the returns of a shaft lie about its axis, height by height."""
    unknown = dict.fromkeys(("straight_m", "widths_m", "width_m", "even", "flat"), math.nan)
    if right.size < _LEAST_OF_SLICE:
        return unknown
    level = np.floor(above / SLICE_M).astype(np.int64)
    count = np.bincount(level - level.min())
    some = count >= _LEAST_OF_SLICE
    past = np.stack([right - right.mean(), ahead - ahead.mean()])
    small, large = np.linalg.eigvalsh(past @ past.T * (1.0 / (right.size - 1)))
    known = {"even": median(count) / float(count.max()), "flat": float(small / max(large, 1e-9))}
    if not some.any():
        return unknown | known
    mean, square = (
        [np.bincount(level - level.min(), weights=v)[some] / count[some] for v in pair]
        for pair in ((right, ahead), (right**2, ahead**2))
    )
    spread = np.sqrt(np.maximum(square[0] - mean[0] ** 2 + square[1] - mean[1] ** 2, 0.0))
    return unknown | known | {
        "straight_m": float(np.hypot(np.std(mean[0]), np.std(mean[1]))),
        "widths_m": float(np.std(spread)), "width_m": float(np.mean(spread)),
    }  # fmt: skip


def _company(places: Float64, k: int) -> dict[str, float]:
    away = np.hypot(*(places - places[k]).T)
    return {f"company_{reach:.0f}_m": float(np.count_nonzero(away < reach) - 1) for reach in _COMPANY_M}


def _surfaces(shaft: Shaft, tall: list[Region], low: list[Region]) -> dict[str, float]:
    """Returns the distances to the nearest tall surface that reaches down to the shaft, and to the nearest low one."""
    x, y = shaft.axis.x_m, shaft.axis.y_m
    reaching = [r for r in tall if r.low_above_m <= shaft.top_above_m]
    return {
        name: min([_FAR_M, *(r.distance_m(x, y, 0.5) for r in some)])
        for name, some in (("to_surface_m", reaching), ("to_low_surface_m", low))
    }


def _sight(scene: Scene, shafts: list[Shaft]) -> dict[str, Float64]:
    """Returns the shares (n,) of the sight lines at shafts that go through, and that pass beside them.

    Posts and trunks stop each line and stand free: lines pass on both sides. Leaves and twigs let some through, and
    edges of walls, hedges and cars stop those on one side. NaN where too few lines tell it.
    """
    returns = scene.returns
    ends = returns.sensor_x_m, returns.sensor_y_m, returns.sensor_height_m, returns.x_m, returns.y_m, returns.height_m
    table = np.array([
        [s.axis.x_m, s.axis.y_m, s.axis.height_m, s.axis.slope_x, s.axis.slope_y, s.axis.radius_m,
         s.ground_m + s.low_above_m, s.ground_m + s.top_above_m] for s in shafts
    ])  # fmt: skip
    past = np.abs(table[:, 6:8] - table[:, 2:3]).max(axis=1)
    near = table[:, 5] + _STRIP_M[1] + np.hypot(table[:, 3], table[:, 4]) * past + 1e-3
    reach = np.hypot(near, _LINES_STEP_M / 2.0) + _LINES_CELL_M * math.sqrt(0.5) + 1e-3
    most = math.ceil(float(reach.max()) / _LINES_CELL_M) + 1
    corner = table[:, :2].min(axis=0) - (most + 1) * _LINES_CELL_M
    own = (table[:, :2] - corner) / _LINES_CELL_M
    columns, rows = (np.floor(own.max(axis=0)).astype(np.int64) + most + 2).tolist()
    around = np.arange(-most, most + 1)
    cell = np.floor(own).astype(np.int64)[:, None] + np.stack(np.meshgrid(around, around), axis=-1).reshape(-1, 2)
    away = np.linalg.norm(cell + 0.5 - own[:, None], axis=2) * _LINES_CELL_M
    listed = away <= reach[:, None]
    starts, order = in_bins(np.where(listed, cell[..., 1] * columns + cell[..., 0], -1).ravel(), rows * columns)
    counts = np.zeros((len(shafts), 3, 2), np.int64)
    limits = (_MIDDLE, _BEFORE_M, _BEHIND_M, *_STRIP_M)
    cells = starts, order // len(around) ** 2, rows, columns
    table = np.column_stack([table, near])
    for lines in (ends, scene.beyond_m):
        rays = Rays(*map(read_only, lines))
        rays_at_shafts(rays, table, cells, corner, _LINES_CELL_M, _LINES_STEP_M, LINES_M, limits, counts)

    def passing(some: Int64) -> Float64:
        """Returns the share of some lines (n, 2) that pass; half a line more for either keeps it off 0 and 1."""
        return np.where(some.sum(axis=-1) >= _LEAST_LINES, (some[..., 1] + 0.5) / (some.sum(axis=-1) + 1.0), np.nan)

    sides = passing(counts[:, 1:])
    return {
        "goes_through": passing(counts[:, 0]), "open_more": np.fmax(*sides.T), "open_less": np.minimum(*sides.T),
        "open_both": passing(counts[:, 1:].sum(axis=1)),
    }  # fmt: skip


Standing = Literal["pole", "lighting", "signal", "tree", "delineator"]

POST: Final = Judge("post", "f06eb8d459251758")
"""Does a shaft stand by itself, as poles, posts and trunks do?"""
LEAST: Final = 0.5
"""Less probable shafts are left out."""
_BOLLARD_M: Final = 0.08  # Least diameter of a bollard (m).
_SIGNAL_M: Final = 8.0  # Signals are lower than this (m).
_LAMP_M: Final = 3.5
"""Least height of a lamp post (m)."""
_IN_PLANE_M: Final = 0.35  # A shaft nearer to a surface (m) lies in it.
_BESIDE_M: Final = 0.9  # Surfaces up to this distance (m) are beside a shaft.
_APART_M: Final = 0.45  # Shafts nearer to one another (m) are one.


@dataclass(frozen=True, eq=False)
class Upright:
    """A shaft with its kind and attachments."""

    kind: Standing
    shaft: Shaft
    probability: float
    rows: Int64
    """Returns of the shaft and of its attachments."""
    attributes: Mapping[str, float | str | None]


@once_a_scene
def uprights_of(scene: Scene) -> list[Upright]:
    """Returns all thin uprights in a scene with its halo that have a probability of 0.5 or more."""
    shafts = candidates_of(scene)
    stated = POST.probability(features_of(scene, shafts)).tolist() if shafts else []
    probable = _apart([(s, p) for s, p in zip(shafts, stated, strict=True) if p >= LEAST])
    near = [about(scene, shaft) for shaft, _ in probable]
    crowns = [
        0.0 if is_head_alone(scene, a) else tree_probability(shaft, crown_share(scene, a, shaft))
        for (shaft, _), a in zip(probable, near, strict=True)
    ]
    trunks = np.array([[s.axis.x_m, s.axis.y_m] for (s, _), c in zip(probable, crowns, strict=True) if c >= 0.5])
    return [
        _told(scene, shaft, probability, a, c, trunks.reshape(-1, 2))
        for (shaft, probability), a, c in zip(probable, near, crowns, strict=True)
    ]


def candidates_of(scene: Scene) -> list[Shaft]:
    """Returns the shafts of a scene; long low surfaces beside low ones, such as guard rails, are not about these."""
    surfaces = [r for r in regions_of(scene) if r.length_m > _LONG_M and r.top_above_m <= _LOW_M]
    on_surface = np.zeros(len(scene.returns), np.bool_)
    for one in surfaces:
        on_surface[one.rows] = True
    out = []
    for shaft in shafts_of(scene):
        x, y = shaft.axis.x_m, shaft.axis.y_m
        away = [one.distance_m(x, y, 0.5) for one in surfaces] if shaft.top_above_m <= _LOW_M else []
        if any(_IN_PLANE_M <= a <= _BESIDE_M for a in away) and not any(a < _IN_PLANE_M for a in away):
            near = places_of(scene).within(x, y, ALONE_M)
            above = scene.above_ground_m[near]
            near = near[(above >= shaft.low_above_m) & (above <= shaft.top_above_m) & ~on_surface[near]]
            alone = min(shaft.rows.size / max(np.union1d(near, shaft.rows).size, 1), 1.0)
            out.append(replace(shaft, alone=max(alone, shaft.alone)))
        else:
            out.append(shaft)
    return out


def tree_probability(shaft: Shaft, filled_directions: float) -> float:
    """Probability that a shaft is a trunk: returns in all directions about its upper part, and its thickness."""
    return logistic(-5.0, [(11.0, filled_directions), (10.0, min(shaft.axis.radius_m, 0.25) - 0.08)])


def _apart(judged: list[tuple[Shaft, float]]) -> list[tuple[Shaft, float]]:
    """Returns the shafts without those close to a more probable one."""
    kept: list[tuple[Shaft, float]] = []
    order = sorted(judged, key=lambda one: (-one[1] * one[0].slices, one[0].foot_xy_m))
    for shaft, probability in order:
        x, y = shaft.axis.at(shaft.axis.height_m)
        reach = _APART_M
        if all(
            np.hypot(*np.subtract(other.axis.at(shaft.axis.height_m), (x, y))) > reach + other.axis.radius_m
            for other, _ in kept
        ):
            kept.append((shaft, probability))
    return kept


def _told(
    scene: Scene, shaft: Shaft, probability: float, near: About, tree: float, trunks: npt.NDArray[np.float64]
) -> Upright:
    """Returns the kind of a shaft, with the values of its kind."""
    diameter, lean = round(2.0 * shaft.axis.radius_m, 4), round(shaft.axis.lean_deg, 3)
    values: dict[str, float | str | None] = {"asset_height_m": shaft.top_above_m, "diameter_m": diameter}
    if tree >= 0.5:
        return _tree(shaft, probability, near, trunks)
    if shaft.top_above_m <= _LOW_M:
        values["type"] = "bollard" if diameter > _BOLLARD_M else "post"
        return Upright("delineator", shaft, probability, shaft.rows, values)
    values["lean_deg"] = lean
    out = arms(near, shaft)
    if signal_head(scene, near, out) is not None and shaft.top_above_m < _SIGNAL_M:
        values["arm_m"] = out.reach_m if out else None
        return Upright("signal", shaft, probability, shaft.rows, values)
    if out is not None and shaft.top_above_m >= _LAMP_M:
        values |= {
            "asset_height_m": max(shaft.top_above_m, out.top_above_m), "arm_m": out.reach_m,
            "type": "double_arm" if out.other_m else "arm", "lamp_height_m": out.lamp_above_m,
        }  # fmt: skip
        return Upright("lighting", shaft, probability, shaft.rows, values)
    return Upright("pole", shaft, probability, shaft.rows, values)


def _tree(shaft: Shaft, probability: float, near: About, trunks: npt.NDArray[np.float64]) -> Upright:
    """Returns a tree with its crown; returns nearer to another trunk belong to that."""
    here = np.array([shaft.axis.x_m, shaft.axis.y_m])
    others = trunks[np.hypot(*(trunks - here).T) > 0.2] - here
    top, wide, rows = crown(near, shaft, others)
    values: dict[str, float | str | None] = {
        "asset_height_m": top, "trunk_diameter_m": round(2.0 * shaft.axis.radius_m, 4),
        "crown_diameter_m": wide if np.isfinite(wide) else None, "lean_deg": round(shaft.axis.lean_deg, 3),
    }  # fmt: skip
    return Upright("tree", shaft, probability, np.union1d(shaft.rows, rows), values)
