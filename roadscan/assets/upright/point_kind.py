"""Base of the kinds of shafts: evidence and objects follow from the uprights of a scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import pyarrow as pa

from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.scene import Scene
from roadscan.assets.upright.axis_sigma import sigma_of
from roadscan.assets.upright.pieces import Place, objects_at_places, pieces_of
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
