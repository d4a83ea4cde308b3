"""Fences: surfaces that let sight lines through."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from roadscan.assets import classes
from roadscan.assets.scene import Scene
from roadscan.assets.upright.facades import beside
from roadscan.assets.upright.surfaces import SurfaceKind

_BESIDE_M: Final = 0.15  # Posts, foot and rails lie so near to the surface of a fence (m).
_FOOT_M: Final = 0.05  # Below this height above bare earth (m) the foot is not told from the ground.


class Fence(SurfaceKind):
    """Fences, from upright surfaces (:mod:`roadscan.assets.upright.surfaces`)."""

    name = "fence"
    title = "Fencing"
    curve = "surfaces"
    code = classes.FENCE

    def marks(self, scene: Scene, rows: Any) -> Any:
        """Returns the returns on the surface, on its posts and on the wall at its foot."""
        near, above = beside(scene, rows, _BESIDE_M, _BESIDE_M), scene.above_ground_m
        return near[(above[near] > _FOOT_M) & (above[near] <= np.max(above[rows]) + _BESIDE_M)]
