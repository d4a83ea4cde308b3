"""Trees: shafts whose upper part has returns in all directions about it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from roadscan.assets import classes
from roadscan.assets.scene import Scene
from roadscan.assets.upright.pieces import schema_of
from roadscan.assets.upright.point_kind import ShaftKind
from roadscan.assets.upright.standing import Upright


class Tree(ShaftKind):
    """Trees, from shafts (:mod:`roadscan.assets.upright.standing`)."""

    name = "tree"
    title = "Tree"
    code = classes.HIGH_VEGETATION
    piece_schema = schema_of(["asset_height_m", "trunk_diameter_m", "crown_diameter_m", "lean_deg"])

    def marks(self, scene: Scene, upright: Upright) -> Iterable[tuple[Any, int]]:
        """Trunk and crown by height above the ground, as ASPRS classes vegetation: up to 0.5 m, up to 2 m, higher."""
        above = scene.above_ground_m[upright.rows]
        yield upright.rows[above > 2.0], classes.HIGH_VEGETATION
        yield upright.rows[(above > 0.5) & (above <= 2.0)], classes.MEDIUM_VEGETATION
        yield upright.rows[above <= 0.5], classes.LOW_VEGETATION
