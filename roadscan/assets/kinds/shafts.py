"""Kinds of shafts: poles, delineators, lamp posts, traffic signals and trees."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import pyarrow as pa

from roadscan.assets import classes
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.scene import Scene
from roadscan.assets.upright.pieces import Place, objects_at_places, pieces_of, schema_of
from roadscan.assets.upright.shafts import sigma_of
from roadscan.assets.upright.standing import Upright, uprights_of

_APART_M = 0.4  # Shafts nearer to one another (m) are one.
_GROUND_SIGMA_M = 0.03  # 1 σ of the height of the ground at a foot (m).


class ShaftKind(AssetKind):
    """A kind of shafts."""

    code: ClassVar[int]
    """Class of its returns."""

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns shafts of this kind whose foot lies in the tile."""
        own = [u for u in uprights_of(scene) if u.kind == self.name]
        here = [u for u in own if bool(scene.tile.holds(*u.shaft.foot_xy_m))]
        pieces = pieces_of(scene, [_place(scene, u) for u in here], self.piece_schema)
        return Evidence(pieces, tuple(Marked(rows, code) for u in own for rows, code in self.marks(scene, u)))

    def marks(self, scene: Scene, upright: Upright) -> Iterable[tuple[Any, int]]:
        """Yields the returns of a shaft and their class."""
        yield upright.rows, self.code

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns an object for each shaft."""
        return objects_at_places(pieces, _APART_M)


def _place(scene: Scene, upright: Upright) -> Place:
    shaft, sigma = upright.shaft, sigma_of(scene, upright.shaft)
    x, y = shaft.foot_xy_m
    return Place(
        x, y, shaft.ground_m, sigma.place_m, _GROUND_SIGMA_M, upright.probability, upright.rows, upright.attributes,
        2.0 * sigma.radius_m,
    )  # fmt: skip


class Pole(ShaftKind):
    """Poles, from shafts (:mod:`roadscan.assets.upright.standing`)."""

    name = "pole"
    title = "Pole"
    code = classes.POLE
    piece_schema = schema_of(["asset_height_m", "diameter_m", "lean_deg"])


class Delineator(ShaftKind):
    """Delineators, from shafts (:mod:`roadscan.assets.upright.standing`)."""

    name = "delineator"
    title = "Delineators"
    code = classes.POLE
    piece_schema = schema_of(["asset_height_m"], ["type"])


class Lighting(ShaftKind):
    """Lamp posts, from shafts (:mod:`roadscan.assets.upright.standing`)."""

    name = "lighting"
    title = "Lighting"
    code = classes.POLE
    piece_schema = schema_of(["asset_height_m", "diameter_m", "lean_deg", "arm_m", "lamp_height_m"], ["type"])


class Signal(ShaftKind):
    """Traffic signals, from shafts (:mod:`roadscan.assets.upright.standing`)."""

    name = "signal"
    title = "Signal"
    code = classes.POLE
    piece_schema = schema_of(["asset_height_m", "diameter_m", "lean_deg", "arm_m"])


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
