"""Poles: poles and posts that carry neither a lamp nor a signal."""

from __future__ import annotations

from roadscan.assets import classes
from roadscan.assets.upright.pieces import schema_of
from roadscan.assets.upright.point_kind import ShaftKind


class Pole(ShaftKind):
    """Poles, from shafts (:mod:`roadscan.assets.upright.standing`)."""

    name = "pole"
    title = "Pole"
    code = classes.POLE
    piece_schema = schema_of(["asset_height_m", "diameter_m", "lean_deg"])
