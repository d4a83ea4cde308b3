"""Clearance: the lowest structure, wire or branch above the path of each drive."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.scene import Scene
from roadscan.assets.upright.overhead import PIECE_SCHEMA, ClearanceOptions, lowest_places, overhead_cells
from roadscan.assets.upright.probability import logistic


class Clearance(AssetKind):
    """Lowest places above the corridor of each drive (:mod:`roadscan.assets.upright.overhead`)."""

    name = "clearance"
    title = "Clearance"
    curve = "clearances"
    options = ClearanceOptions
    piece_schema = PIECE_SCHEMA

    def evidence(self, scene: Scene, options: ClearanceOptions) -> Evidence:
        """Returns cells of the tile with something above them."""
        return Evidence(overhead_cells(scene, options))

    def objects(
        self, pieces: pa.Table, options: ClearanceOptions, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields the lowest places of each drive, apart from one another."""
        for row in lowest_places(pieces, options.apart_m):
            probability = logistic(-1.0, [(0.3, min(row["returns"], 15)), (0.3, min(row["cells"], 5))])
            yield AssetObject(
                shapely.Point(row["easting_m"], row["northing_m"], row["height_m"]), 0.05, 0.02, probability,
                row["returns"], len(row["passes"]), row["first_epoch_gps_ns"], row["last_epoch_gps_ns"],
                {"clearance_m": row["clearance_m"], "type": row["type"]}, 0.02,
            )  # fmt: skip
