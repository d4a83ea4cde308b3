"""Fences: surfaces that let sight lines through."""

from __future__ import annotations

from roadscan.assets import classes
from roadscan.assets.upright.surfaces import SurfaceKind


class Fence(SurfaceKind):
    """Fences, from upright surfaces (:mod:`roadscan.assets.upright.surfaces`)."""

    name = "fence"
    title = "Fencing"
    curve = "surfaces"
    code = classes.FENCE
