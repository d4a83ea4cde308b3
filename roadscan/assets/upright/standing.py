"""Classification of shafts: poles, lamp posts, signals, trees, delineators, and what is none of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.assets.judgement.judge import Judge
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.assets.upright.attachments import About, about, arms, crown, crown_share, is_head_alone, signal_head
from roadscan.assets.upright.places import places_of
from roadscan.assets.upright.probability import logistic
from roadscan.assets.upright.regions import regions_of
from roadscan.assets.upright.shaft_features import features_of
from roadscan.assets.upright.shafts import ALONE_M, Shaft, shafts_of
from roadscan.compute.array_types import Int64

Standing = Literal["pole", "lighting", "signal", "tree", "delineator"]

POST: Final = Judge("post", "feb5bafecf6e42d0")
"""Does a shaft stand by itself, as poles, posts and trunks do?"""
LEAST: Final = 0.5
"""Less probable shafts are left out."""
_LOW_M: Final = 1.35
"""Posts up to this height (m) are delineators and bollards."""
_BOLLARD_M: Final = 0.08  # Least diameter of a bollard (m).
_SIGNAL_M: Final = 8.0  # Signals are lower than this (m).
_LAMP_M: Final = 3.5
"""Least height of a lamp post (m)."""
_IN_PLANE_M: Final = 0.35  # A shaft nearer to a surface (m) lies in it.
_BESIDE_M: Final = 0.9  # Surfaces up to this distance (m) are beside a shaft.
_LONG_M: Final = 2.5  # Surfaces longer than this (m) count as beside a shaft.
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
        0.0 if is_head_alone(scene, a) else tree_probability(shaft, crown_share(a, shaft))
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
