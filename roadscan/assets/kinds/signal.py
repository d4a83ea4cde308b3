"""Traffic signals: posts with a box at the height of a signal."""

from __future__ import annotations

from roadscan.assets import classes
from roadscan.assets.upright.pieces import schema_of
from roadscan.assets.upright.point_kind import ShaftKind


class Signal(ShaftKind):
    """Traffic signals, from shafts (:mod:`roadscan.assets.upright.standing`)."""

    name = "signal"
    title = "Signal"
    code = classes.POLE
    piece_schema = schema_of(["asset_height_m", "diameter_m", "lean_deg", "arm_m"])
