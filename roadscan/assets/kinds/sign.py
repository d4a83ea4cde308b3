"""Road signs and boards: bright plates, upright, 5 feet above the ground or more (Lin et al. 2016, 4.1.2)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa

from roadscan.assets import classes
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.object_table import object_names
from roadscan.assets.scene import Scene
from roadscan.assets.upright.pieces import Place, objects_at_places, pieces_of, schema_of
from roadscan.assets.upright.plates import Plate, SignOptions, plates_of

_LEAST = 0.5  # Least probability of a plate.
_APART_M = 0.3  # Plates nearer to one another (m) are one.
_BESIDE_POST_M = 0.4
"""Distance of a plate's middle before the axis of its post (m); the two posts of a board stand within its width."""
_BELOW_M = 0.3
"""A post reaches to the plate's lower edge, or appears to end this far below it (m)."""


class Sign(AssetKind):
    """Plates, from bright returns (:mod:`roadscan.assets.upright.plates`); the place is the middle of the plate."""

    name = "sign"
    title = "Road Signs/Boards"
    curve = "products"
    options = SignOptions
    after: ClassVar[Sequence[str]] = ("pole", "lighting", "signal")
    piece_schema = schema_of(
        ["width_m", "plate_height_m", "clearance_m", "facing_deg", "tilt_deg"], ["message", "type", "shape", "colour"]
    )

    def evidence(self, scene: Scene, options: SignOptions) -> Evidence:
        """Returns plates whose middle lies in the tile."""
        found = [p for p in plates_of(scene, options) if p.probability >= _LEAST]
        pieces = pieces_of(scene, [_place(p) for p in found], self.piece_schema)
        return Evidence(pieces, tuple(Marked(p.rows, classes.SIGN) for p in found))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields an object for each plate, with the post that carries it."""
        posts = [(kind, one) for kind in self.after for one in others.get(kind, ())]
        for sign in objects_at_places(pieces, _APART_M):
            yield replace(sign, attributes={**sign.attributes, "post": _post_of(sign, posts)})


def _post_of(sign: AssetObject, posts: Iterable[tuple[str, AssetObject]]) -> str | None:
    """Returns the name of the nearest post at a sign; None where none stands at it."""
    plate, values = sign.geometry, sign.attributes
    near: list[tuple[float, str]] = []
    for kind, post in posts:
        foot = post.geometry
        away = math.hypot(foot.x - plate.x, foot.y - plate.y)
        lean = math.tan(math.radians(post.attributes.get("lean_deg") or 0.0)) * (plate.z - foot.z)
        reaches = (post.attributes.get("asset_height_m") or 0.0) >= values["clearance_m"] - _BELOW_M
        if reaches and away <= max(_BESIDE_POST_M, values["width_m"] / 2) + lean:
            near.append((away, object_names(kind, np.array([[foot.x, foot.y]]))[0]))
    return min(near, default=(0.0, None))[1]


def _place(plate: Plate) -> Place:
    sigma = max(0.01, plate.outline.misfit_m / 3.0)
    values: dict[str, float | str | None] = {
        "width_m": plate.outline.width_m, "plate_height_m": plate.outline.height_m, "shape": plate.outline.shape,
        "clearance_m": max(plate.clearance_m, 0.0), "facing_deg": plate.facing_deg, "tilt_deg": plate.tilt_deg,
    }  # fmt: skip
    return Place(*plate.middle_m, sigma, sigma, plate.probability, plate.rows, values, plate.outline.sigma_m)
