"""Road signs and boards: bright plates, upright, 5 feet above the ground or more (Lin et al. 2016, 4.1.2)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pyarrow as pa

from roadscan.assets import classes
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.scene import Scene
from roadscan.assets.upright.pieces import Place, objects_at_places, pieces_of, schema_of
from roadscan.assets.upright.plates import Plate, SignOptions, plates_of

_LEAST = 0.5
_APART_M = 0.3


class Sign(AssetKind):
    """Plates, from bright returns (:mod:`roadscan.assets.upright.plates`); the place is the middle of the plate."""

    name = "sign"
    title = "Road Signs/Boards"
    curve = "signs"
    options = SignOptions
    piece_schema = schema_of(
        ["width_m", "plate_height_m", "clearance_m", "facing_deg", "tilt_deg"], ["message", "type", "shape", "colour"]
    )

    def evidence(self, scene: Scene, options: SignOptions) -> Evidence:
        """Plates whose middle the tile holds."""
        found = [p for p in plates_of(scene, options) if p.probability >= _LEAST]
        pieces = pieces_of(scene, [_place(p) for p in found], self.piece_schema)
        return Evidence(pieces, tuple(Marked(p.rows, classes.SIGN) for p in found))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """An object a plate."""
        return objects_at_places(pieces, _APART_M)


def _place(plate: Plate) -> Place:
    sigma = max(0.01, plate.outline.misfit_m / 3.0)
    values: dict[str, float | str | None] = {
        "width_m": plate.outline.width_m, "plate_height_m": plate.outline.height_m, "shape": plate.outline.shape,
        "clearance_m": max(plate.clearance_m, 0.0), "facing_deg": plate.facing_deg, "tilt_deg": plate.tilt_deg,
    }  # fmt: skip
    return Place(*plate.middle_m, sigma, sigma, plate.probability, plate.rows, values, plate.outline.sigma_m)
