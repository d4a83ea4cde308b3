"""Attenuators: low boxes at the ends of guardrails and barriers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.scene import Scene
from roadscan.assets.upright.cushions import PIECE_SCHEMA, boxes_of
from roadscan.assets.upright.probability import logistic

_NEAR_END_M: Final = 2.0  # Greatest distance of a box to the end of a line (m).
_LEAST_LINE_M: Final = 4.0
"""Least length of a shielded line (m)."""


class Attenuator(AssetKind):
    """Boxes (:mod:`roadscan.assets.upright.cushions`) within 2 m of an end of a guardrail or a barrier."""

    name = "attenuator"
    title = "Attenuator"
    curve = "surfaces"
    after = ("guardrail", "barrier")
    piece_schema = PIECE_SCHEMA

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns boxes of the tile."""
        return Evidence(boxes_of(scene))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields boxes at the end of a line that they shield."""
        lines = [o.geometry for kind in self.after for o in others.get(kind, ()) if o.geometry.length > _LEAST_LINE_M]
        if not lines:
            return
        ends = shapely.multipoints([end for line in lines for end in (line.coords[0][:2], line.coords[-1][:2])])
        for row in pieces.to_pylist():
            box = shapely.Polygon([(*p, row["ground_m"]) for p in row["ring"]])
            away = float(shapely.distance(shapely.force_2d(box), ends))
            if away > _NEAR_END_M:
                continue
            probability = logistic(0.0, [(-1.0, away), (0.02, min(row["returns"], 100))])
            values = {name: row[name] for name in ("asset_height_m", "length_m", "width_m")}
            yield AssetObject(
                box, 0.05, 0.03, probability, row["returns"], len(row["passes"]), row["first_epoch_gps_ns"],
                row["last_epoch_gps_ns"], values, 0.05,
            )  # fmt: skip
