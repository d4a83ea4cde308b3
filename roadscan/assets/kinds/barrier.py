"""Barriers: solid surfaces from the ground to 0.5–1.25 m."""

from __future__ import annotations

from roadscan.assets import classes
from roadscan.assets.upright.surfaces import SurfaceKind


class Barrier(SurfaceKind):
    """Barriers, from upright surfaces (:mod:`roadscan.assets.upright.surfaces`)."""

    name = "barrier"
    title = "Barrier"
    curve = "surfaces"
    code = classes.BARRIER
