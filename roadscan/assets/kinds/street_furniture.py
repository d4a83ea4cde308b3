"""Street furniture: cabinets, bins, benches, hydrants and bus shelters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa

from roadscan.assets import classes
from roadscan.assets.furniture.compact import Compact, compact_things
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.assets.upright.pieces import Place, objects_at_places, pieces_of, schema_of

JUDGES: Final = {
    "cabinet": Judge("cabinet", "f29535a576659f13"),
    "bin": Judge("bin", "ed8aba39493cdb10"),
    "bench": Judge("bench", "3d81bf431eefd225"),
    "hydrant": Judge("hydrant", "dd52d58273b44ab2"),
    "bus_shelter": Judge("bus_shelter", "aa20f2c467b5fd5f"),
}
"""Who is asked whether a compact thing is of a type."""
_LEAST: Final = 0.5
"""Less probable things are left out."""
_APART_M: Final = 0.5  # Things nearer to one another (m) are one.
_GROUND_SIGMA_M: Final = 0.03  # 1 σ of the height of the ground at a foot (m).
_EDGE_SIGMA_M: Final = 0.05
"""1 σ of where the end of a thing lies beyond its outermost returns (m): a third of the cells that part things."""
_SIZE_SIGMA_M: Final = 0.14
"""1 σ of lengths and widths (m): that of 18 things on three streets that the judges had not seen."""


class StreetFurniture(AssetKind):
    """Street furniture, from compact things (:mod:`roadscan.assets.furniture.compact`)."""

    name = "street_furniture"
    title = "Street furniture"
    piece_schema = schema_of(["asset_height_m", "length_m", "width_m", "heading_deg"], ["type"])

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns what is probably furniture and whose middle lies in the tile."""
        told = _furniture_of(scene)
        pieces = pieces_of(scene, [_place(scene, *one) for one in told], self.piece_schema)
        return Evidence(pieces, tuple(Marked(thing.rows, classes.FURNITURE) for thing, _, _ in told))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns an object for each thing."""
        return objects_at_places(pieces, _APART_M)


@once_a_scene
def _furniture_of(scene: Scene) -> list[tuple[Compact, str, float]]:
    return told_apart(compact_things(scene))


def told_apart(things: list[Compact]) -> list[tuple[Compact, str, float]]:
    """Returns the things that are probably furniture, each with its most probable type and that probability."""
    features = [one.features for one in things]
    stated = np.column_stack([judge.of_each(features) for judge in JUDGES.values()])
    best, types = stated.argmax(axis=1).tolist(), list(JUDGES)
    told = [(one, types[k], float(p[k])) for one, k, p in zip(things, best, stated, strict=True)]
    return [one for one in told if one[2] >= _LEAST]


def _place(scene: Scene, thing: Compact, kind: str, probability: float) -> Place:
    ground = float(scene.ground.height_at(thing.x_m, thing.y_m))
    values: dict[str, float | str | None] = {
        "asset_height_m": thing.height_m, "length_m": thing.length_m, "width_m": thing.width_m,
        "heading_deg": thing.heading_deg, "type": kind,
    }  # fmt: skip
    return Place(
        thing.x_m, thing.y_m, ground, _EDGE_SIGMA_M, _GROUND_SIGMA_M, probability, thing.rows, values,
        _SIZE_SIGMA_M,
    )  # fmt: skip
