"""Brightness of returns: the light that came back, as a multiple of what upright diffuse things at that range send.

Gains of the intensity (:mod:`roadscan.assets.intensity`) are those of the ground: range and incidence change together
there, so one of them alone says little of things that stand upright. Here these things are their own reference.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.intensity import RANGE_NODES_M
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.assets.upright.slices import usable
from roadscan.compute.array_types import Float64

_MIDDLES_M: Final = np.concatenate([[0.5], (RANGE_NODES_M[1:] + RANGE_NODES_M[:-1]) / 2.0, [110.0]])
"""Middles of the steps of ranges (m)."""
_SHARE: Final = 0.02
"""Where upright things make less than this share of a scene's returns, as where nothing but signs stands, the ground
counts as much as they do."""
_NEAR_M: Final = 15.0
"""Ground nearer than this (m) is lit steeply enough."""
_LOW_M: Final = 0.5
"""Diffuse things are sought above this height (m): below are kerbs and grass."""


@once_a_scene
def brightness(scene: Scene) -> npt.NDArray[np.float32]:
    """Returns the brightness (n,) of each return; 1 is the median of upright things at its range."""
    returns = scene.returns
    light, range_m = returns.light.astype(np.float64), returns.range_m
    lit = (light > 0.0) & np.isfinite(range_m)
    upright = usable(scene) & (scene.above_ground_m > _LOW_M) & lit
    ground = np.isin(scene.classes, (classes.GROUND, classes.ROAD)) & lit
    out = np.zeros(len(returns), np.float32)
    for sensor in np.unique(returns.sensor).tolist():
        own = returns.sensor == sensor
        near = own & ground & (range_m < _NEAR_M)
        some = next((one for one in (near, own & ground, own & lit) if one.any()), own)
        weight = _SHARE * float(own.sum()) + 1.0
        curve = _medians(range_m[own & upright], light[own & upright], float(np.median(light[some])), weight)
        out[own] = light[own] / np.interp(range_m[own], _MIDDLES_M, curve)
    return out


def _medians(range_m: Float64, light: Float64, ground: float, weight: float) -> Float64:
    """Returns the median light of each step of ranges, of upright things and of ground that counts as `weight` of them.

    Steps with fewer than a tenth of that weight have what those beside them have.
    """
    steps = RANGE_NODES_M.size + 1
    step = np.searchsorted(RANGE_NODES_M, range_m)
    known = np.flatnonzero(np.bincount(step, minlength=steps) >= 0.1 * weight)
    if not known.size:
        return np.full(steps, max(ground, 1.0))
    medians = [_median_with(np.sort(light[step == k]), ground, weight) for k in known.tolist()]
    return np.interp(np.arange(steps), known, medians)


def _median_with(ascending: Float64, value: float, weight: float) -> float:
    """Returns the median of numbers and of one more that counts as many times."""
    half, below = (ascending.size + weight) / 2.0, int(np.searchsorted(ascending, value))
    if below > half:
        return float(ascending[int(half)])
    return value if below + weight >= half else float(ascending[min(int(half - weight), ascending.size - 1)])
