"""Classification of shafts: poles, lamp posts, signals, trees, delineators; by their attachments and surroundings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from roadscan.assets.bins import in_bins
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kernels.shafts import RINGS, Part, about_shaft
from roadscan.assets.kernels.sight import Rays, rays_at_shafts
from roadscan.assets.moving import SLOT_NS
from roadscan.assets.quantiles import median
from roadscan.assets.scene import LINES_M, Scene, once_a_scene
from roadscan.assets.upright.attached import About, about, arms, attached, crown
from roadscan.assets.upright.regions import Region, regions_of
from roadscan.assets.upright.shafts import ALONE_M, Shaft, shafts_of
from roadscan.assets.upright.slices import SLICE_M, places_of
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.kernel_options import read_only

_SECTORS: Final = 8  # Directions around a shaft.
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
TYPES: Final[Mapping[Standing, Judge]] = {
    "pole": Judge("pole", "837869d07fd8ebd3"),
    "lighting": Judge("lighting", "422a31d1e657475f"),
    "signal": Judge("signal", "221322fb6805dd82"),
    "tree": Judge("tree", "006c3493c58479a9"),
    "delineator": Judge("delineator", "32609797be980855"),
}
"""Who is asked whether a shaft that stands is of a type."""
LEAST: Final = 0.5
"""Less probable shafts are left out."""
_BOLLARD_M: Final = 0.08  # Least diameter of a bollard (m).
_IN_PLANE_M: Final = 0.35  # A shaft nearer to a surface (m) lies in it.
_BESIDE_M: Final = 0.9  # Surfaces up to this distance (m) are beside a shaft.
_APART_M: Final = 0.45  # Shafts nearer to one another (m) are one.
_SAME_M, _ABOUT_M = 0.2, 6.0
"""Axes farther off than the first and nearer than the second (m) are those of other shafts about."""


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
    """Returns all thin uprights in a scene with its halo that stand with a probability of 0.5 or more."""
    standing = standing_of(scene)
    if not standing.shafts:
        return []
    features = features_of_types(scene, standing)
    stated = np.column_stack([judge.probability(features) for judge in TYPES.values()])
    stated /= stated.sum(axis=1, keepdims=True)
    types = [list(TYPES)[k] for k in stated.argmax(axis=1).tolist()]
    probability = standing.probability * stated.max(axis=1)
    axes = standing.axes_xy_m
    trunks = axes[[one == "tree" for one in types]]
    return [
        _told(shaft, kind, p, near, trunks)
        for shaft, kind, p, near in zip(standing.shafts, types, probability.tolist(), standing.near, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class Probable:
    """Shafts (n) that probably stand by themselves."""

    shafts: list[Shaft]
    features: dict[str, Float64]
    """(n,) by name, as :func:`features_of` tells them."""
    probability: Float64
    """(n,) of standing."""
    near: list[About]

    @property
    def axes_xy_m(self) -> Float64:
        """Returns the axes (n, 2) at the middle of what is seen."""
        return np.array([[s.axis.x_m, s.axis.y_m] for s in self.shafts]).reshape(-1, 2)


def standing_of(scene: Scene) -> Probable:
    """Returns the shafts that stand by themselves with a probability of 0.5 or more."""
    shafts = candidates_of(scene)
    features = features_of(scene, shafts)
    stated = POST.probability(features) if shafts else np.zeros(0)
    kept = _apart(shafts, stated)
    some = [shafts[k] for k in kept]
    own = {name: values[kept] for name, values in features.items()}
    return Probable(some, own, stated[kept], [about(scene, one) for one in some])


def features_of_types(scene: Scene, standing: Probable) -> dict[str, Float64]:
    """Returns the features (n,) of standing shafts by name that tell their types: their own, and of what is about."""
    axes = standing.axes_xy_m
    rows = []
    for k, (shaft, near) in enumerate(zip(standing.shafts, standing.near, strict=True)):
        past = axes - axes[k]
        away = np.hypot(*past.T)
        rows.append(attached(scene, shaft, near, past[(away > _SAME_M) & (away < _ABOUT_M)]))
    told = {name: np.array([row[name] for row in rows], np.float64) for name in (rows[0] if rows else ())}
    return standing.features | told


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


def _apart(shafts: list[Shaft], stated: Float64) -> Int64:
    """Returns the numbers of the probable shafts without those close to a more probable one."""
    kept: list[int] = []
    order = sorted(
        np.flatnonzero(stated >= LEAST).tolist(), key=lambda k: (-stated[k] * shafts[k].slices, shafts[k].foot_xy_m)
    )
    for k in order:
        height_m = shafts[k].axis.height_m
        place = shafts[k].axis.at(height_m)
        if all(
            np.hypot(*np.subtract(shafts[other].axis.at(height_m), place)) > _APART_M + shafts[other].axis.radius_m
            for other in kept
        ):
            kept.append(k)
    return np.array(kept, np.int64)


def _told(shaft: Shaft, kind: Standing, probability: float, near: About, trunks: Float64) -> Upright:
    """Returns a shaft of a type, with the values of its type."""
    diameter, lean = round(2.0 * shaft.axis.radius_m, 4), round(shaft.axis.lean_deg, 3)
    values: dict[str, float | str | None] = {"asset_height_m": shaft.top_above_m, "diameter_m": diameter}
    if kind == "tree":
        return _tree(shaft, probability, near, trunks)
    if kind == "delineator":
        values["type"] = "bollard" if diameter > _BOLLARD_M else "post"
        return Upright(kind, shaft, probability, shaft.rows, values)
    values["lean_deg"] = lean
    out = arms(near, shaft) if kind in ("signal", "lighting") else None
    if kind == "signal":
        values["arm_m"] = out.reach_m if out else None
    if kind == "lighting" and out is not None:
        values |= {
            "asset_height_m": max(shaft.top_above_m, out.top_above_m), "arm_m": out.reach_m,
            "type": "double_arm" if out.other_m else "arm", "lamp_height_m": out.lamp_above_m,
        }  # fmt: skip
    return Upright(kind, shaft, probability, shaft.rows, values)


def _tree(shaft: Shaft, probability: float, near: About, trunks: Float64) -> Upright:
    """Returns a tree with its crown; returns nearer to another trunk belong to that."""
    here = np.array([shaft.axis.x_m, shaft.axis.y_m])
    others = trunks[np.hypot(*(trunks - here).T) > 0.2] - here
    top, wide, rows = crown(near, shaft, others)
    values: dict[str, float | str | None] = {
        "asset_height_m": top, "trunk_diameter_m": round(2.0 * shaft.axis.radius_m, 4),
        "crown_diameter_m": wide if np.isfinite(wide) else None, "lean_deg": round(shaft.axis.lean_deg, 3),
    }  # fmt: skip
    return Upright("tree", shaft, probability, np.union1d(shaft.rows, rows), values)
