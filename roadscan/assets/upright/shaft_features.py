"""Features of shafts, as their judge asks for them: how they are built, and what is about them."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.moving import SLOT_NS
from roadscan.assets.scene import Scene
from roadscan.assets.upright.places import places_of
from roadscan.assets.upright.regions import Region, regions_of
from roadscan.assets.upright.shafts import Shaft
from roadscan.assets.upright.slices import SLICE_M

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

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
    height = returns.height_m[near]
    above = height - shaft.ground_m
    x, y = axis.at(height)
    right, ahead = returns.x_m[near] - x, returns.y_m[near] - y
    away = np.hypot(right, ahead) - axis.radius_m
    beside = (above >= shaft.low_above_m) & (above <= shaft.top_above_m)
    on_it, others = beside & (away <= _SKIN_M), beside & (away > _SKIN_M)
    many = max(int(np.count_nonzero(on_it)), 1)

    def odds(some: Bools) -> float:
        return math.log((int(np.count_nonzero(some)) + 1.0) / many)

    inner, out = _SKIN_M, {}
    for edge in _RINGS_M:
        out[f"in_{round(edge * 100)}_cm"] = odds(beside & (away > inner) & (away <= edge))
        inner = edge
    close, higher = away <= _RINGS_M[1], above > shaft.top_above_m
    middle = 0.5 * (shaft.low_above_m + shaft.top_above_m)
    for name, part in (("lower", above < middle), ("upper", above >= middle)):
        out[f"alone_{name}"] = _share(on_it & part, (on_it | (others & close)) & part)
    out["below"] = odds((above > 0.1) & (above < shaft.low_above_m) & close)
    out["over"] = odds(higher & close)
    out["goes_on"] = odds(higher & (away <= _SKIN_M) & (above < shaft.top_above_m + 1.0))
    sector = np.floor(np.arctan2(ahead, right) / (2 * math.pi / _SECTORS)).astype(np.int64) % _SECTORS
    taken = np.bincount(sector[others], minlength=_SECTORS) > 0.02 * many
    out["sides_taken"] = float(np.mean(taken))
    out["opposite"] = float(np.max(taken & np.roll(taken, _SECTORS // 2)))
    kind = scene.classes[near]
    leaves = (kind >= classes.LOW_VEGETATION) & (kind <= classes.HIGH_VEGETATION)
    for name, one in (("leaves", leaves), ("building", kind == classes.BUILDING)):
        out[name], out[f"own_{name}"] = _share(beside & one, beside), _share(on_it & one, on_it)
    slots = np.unique(returns.epoch_gps_ns[near[on_it]] // SLOT_NS)
    later = np.setdiff1d(returns.epoch_gps_ns[near[higher | others]] // SLOT_NS, slots)
    out["stays"] = slots.size / max(slots.size + later.size, 1)
    return out | _build(right[on_it], ahead[on_it], above[on_it])


def _share(some: Bools, of: Bools) -> float:
    return float(np.count_nonzero(some)) / max(int(np.count_nonzero(of)), 1)


def _build(right: Float64, ahead: Float64, above: Float64) -> dict[str, float]:
    """Returns features of how the returns of a shaft lie about its axis, height by height."""
    unknown = dict.fromkeys(("straight_m", "widths_m", "width_m", "even", "flat"), math.nan)
    if right.size < _LEAST_OF_SLICE:
        return unknown
    level = np.floor(above / SLICE_M).astype(np.int64)
    count = np.bincount(level - level.min())
    some = count >= _LEAST_OF_SLICE
    small, large = np.linalg.eigvalsh(np.cov(np.stack([right, ahead])))
    known = {"even": float(np.median(count) / count.max()), "flat": float(small / max(large, 1e-9))}
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
