"""Features of shafts, as their judge asks for them: how they are built, and what is about them."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from roadscan.assets.moving import SLOT_NS
from roadscan.assets.quantiles import median
from roadscan.assets.scene import Scene
from roadscan.assets.upright.kernels.about_shaft import RINGS, Part, about_shaft
from roadscan.assets.upright.places import places_of
from roadscan.assets.upright.regions import Region, regions_of
from roadscan.assets.upright.shafts import Shaft
from roadscan.assets.upright.slices import SLICE_M
from roadscan.compute.array_types import Float64
from roadscan.compute.kernel_options import read_only

_SKIN_M: Final = 0.1
"""Returns so near to a shaft's surface (m) may lie on it: noise of ranges, bark, and steps of poses."""
_RINGS_M: Final = (0.35, 0.6, 1.2)
"""Outer edges of the rings about a shaft's surface (m); what lies farther off does not tell what it is."""
_COMPANY_M: Final = (1.0, 3.0)
"""Shafts within these distances (m) are company: pieces of façades, hedges and fences stand in rows."""
_LONG_M, _TALL_M, _LOW_M = 2.5, 1.6, 1.35
"""Surfaces longer than the first (m) are walls, façades and hedges above the second, guard rails below the third."""
_FAR_M: Final = 3.0
"""Surfaces are sought up to this distance (m)."""
_SECTORS: Final = 8
"""Directions about a shaft."""
_LEAST_OF_SLICE: Final = 4
"""Slices with fewer returns show no middle and no width."""


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
    return {name: np.array([row[name] for row in rows], np.float64) for name in (rows[0] if rows else ())}


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
