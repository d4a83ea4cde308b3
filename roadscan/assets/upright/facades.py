"""Outlines of façades, and the returns that belong to them."""

from __future__ import annotations

import numpy as np

from roadscan.assets.kernels.corridors import mark_strip
from roadscan.assets.scene import Scene
from roadscan.assets.upright.lines import Chain
from roadscan.assets.upright.places import places_of
from roadscan.compute.array_types import Float64, Int64

_BEFORE_M, _BEHIND_M = 0.4, 1.5
"""Balconies stand before the plane of a façade, windows and doors behind it, this far at the most (m)."""


def outline(chain: Chain) -> Float64:
    """Returns the ring (n, 3) of a façade: its lower edge, then its upper edge back; gaps are filled from beside."""
    low, high = _filled(chain.values["low_m"]), _filled(chain.values["high_m"])
    xy = np.repeat(chain.xy_m, 2, axis=0)[1:-1]
    lower, upper = np.column_stack([xy, np.repeat(low, 2)]), np.column_stack([xy, np.repeat(high, 2)])
    ring = np.concatenate([lower, upper[::-1], lower[:1]])
    keep = np.append(True, np.abs(np.diff(ring, axis=0)).max(axis=1) > 1e-6)
    out: Float64 = ring[keep]
    return out


def _filled(values: Float64) -> Float64:
    known = np.isfinite(values)
    return np.interp(np.arange(values.size), np.flatnonzero(known), values[known])


def beside(scene: Scene, rows: Int64, before_m: float = _BEFORE_M, behind_m: float = _BEHIND_M) -> Int64:
    """Returns the returns of a surface (`rows`), and those close before and behind it, by default a façade's."""
    returns = scene.returns
    xy = np.column_stack([returns.x_m[rows], returns.y_m[rows]])
    middle = xy.mean(axis=0)
    some = xy[:: max(1, len(xy) // 20_000)] - middle
    _, _, axes = np.linalg.svd(some, full_matrices=False)
    along, normal = axes[0], axes[1]
    seen = np.array([returns.sensor_x_m[rows].mean(), returns.sensor_y_m[rows].mean()]) - middle
    normal = normal if float(normal @ seen) > 0.0 else -normal
    begin, end = float((some @ along).min()) - 0.3, float((some @ along).max()) + 0.3
    places, inside = places_of(scene), np.zeros(len(returns), np.bool_)
    inside[rows] = True
    box = np.array([begin, end, -behind_m, before_m])
    mark_strip(places.x_m, places.y_m, places.rows, middle, np.stack([along, normal]), box, inside)
    return np.flatnonzero(inside)
