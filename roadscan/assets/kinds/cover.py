"""Covers and drains in the road: manholes' lids and grates, by their form and how bright they are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import pyarrow as pa

from roadscan.assets.covers.spots import Spot, spots_of
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.assets.upright.pieces import Place, objects_at_places, pieces_of, schema_of

COVER, DRAIN = Judge("cover", "ca6cde9aee6bf58d"), Judge("drain", "fa919facd8bfe194")
"""Who is asked whether a spot is a cover or a drain, and which of these it is."""
_LEAST: Final = 0.9
"""Less probable spots are left out: on a street of a sort that the judge has not seen, worn asphalt reaches 0.8."""
_LEAST_DRAIN: Final = 0.5  # More probable ones are drains.
_APART_M: Final = 0.4  # Spots nearer to one another (m) are one.
_PLACE_SIGMA_M: Final = 0.05  # 1 σ of the middle of a spot (m), half the distance of scan lines.
_GROUND_SIGMA_M: Final = 0.01  # 1 σ of the height of the ground there (m).
_SIZE_SIGMA_M: Final = 0.08
"""1 σ of diameters, lengths and widths (m): returns at an edge are of both."""


class Cover(AssetKind):
    """Covers and drains, from spots on the ground (:mod:`roadscan.assets.covers.spots`)."""

    name = "cover"
    title = "Covers and drains"
    piece_schema = schema_of(["diameter_m", "length_m", "width_m", "heading_deg"], ["type"])

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns spots that are probably a cover or a drain and whose middle lies in the tile."""
        return Evidence(pieces_of(scene, [_place(scene, *one) for one in _covers_of(scene)], self.piece_schema))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns an object for each spot."""
        return objects_at_places(pieces, _APART_M)


@once_a_scene
def _covers_of(scene: Scene) -> list[tuple[Spot, str, float]]:
    return told_apart(spots_of(scene))


def told_apart(spots: list[Spot]) -> list[tuple[Spot, str, float]]:
    """Returns the spots that are probably a cover or a drain, each with its type and that probability."""
    told = [one.features for one in spots]
    either, drain = COVER.of_each(told).tolist(), DRAIN.of_each(told).tolist()
    types = ["drain" if p >= _LEAST_DRAIN else "cover" for p in drain]
    return [one for one in zip(spots, types, either, strict=True) if one[2] >= _LEAST]


def _place(scene: Scene, spot: Spot, kind: str, probability: float) -> Place:
    values: dict[str, float | str | None] = {"type": kind}
    if kind == "cover":
        values["diameter_m"] = spot.diameter_m
    else:
        values |= {"length_m": spot.length_m, "width_m": spot.width_m, "heading_deg": spot.heading_deg}
    ground = float(scene.ground.height_at(spot.x_m, spot.y_m))
    return Place(
        spot.x_m, spot.y_m, ground, _PLACE_SIGMA_M, _GROUND_SIGMA_M, probability, spot.rows, values, _SIZE_SIGMA_M
    )
