"""Delineators: posts up to 1.35 m."""

from __future__ import annotations

from roadscan.assets import classes
from roadscan.assets.upright.pieces import schema_of
from roadscan.assets.upright.point_kind import ShaftKind


class Delineator(ShaftKind):
    """Delineators, from shafts (:mod:`roadscan.assets.upright.standing`)."""

    name = "delineator"
    title = "Delineators"
    code = classes.POLE
    piece_schema = schema_of(["asset_height_m"], ["type"])
