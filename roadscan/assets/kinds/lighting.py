"""Lamp posts: posts with an arm that ends over the road or beside it."""

from __future__ import annotations

from roadscan.assets import classes
from roadscan.assets.upright.pieces import schema_of
from roadscan.assets.upright.point_kind import ShaftKind


class Lighting(ShaftKind):
    """Lamp posts, from shafts (:mod:`roadscan.assets.upright.standing`)."""

    name = "lighting"
    title = "Lighting"
    code = classes.POLE
    piece_schema = schema_of(["asset_height_m", "diameter_m", "lean_deg", "arm_m", "lamp_height_m"], ["type"])
