"""Walls: free-standing and retaining walls, taller than 1.25 m."""

from __future__ import annotations

from roadscan.assets import classes
from roadscan.assets.upright.surfaces import SurfaceKind


class Wall(SurfaceKind):
    """Walls, from upright surfaces (:mod:`roadscan.assets.upright.surfaces`)."""

    name = "wall"
    title = "Wall"
    curve = "surfaces"
    code = classes.BARRIER
