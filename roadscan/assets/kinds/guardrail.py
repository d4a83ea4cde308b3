"""Guard rails: rails with free space below."""

from __future__ import annotations

from roadscan.assets import classes
from roadscan.assets.upright.surfaces import SurfaceKind


class Guardrail(SurfaceKind):
    """Guard rails, from upright surfaces (:mod:`roadscan.assets.upright.surfaces`)."""

    name = "guardrail"
    title = "Guard Rail"
    curve = "surfaces"
    code = classes.BARRIER
