"""Landscape areas: planted or grown areas beside the road."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.scene import Scene
from roadscan.assets.upright.grown import CELL_M, PIECE_SCHEMA, LandscapeOptions, area_of, components, grown_cells


class LandscapeArea(AssetKind):
    """Areas of cells that are grown over (:mod:`roadscan.assets.upright.grown`); one may lie within a sidewalk's."""

    name = "landscape_area"
    title = "Landscape Areas"
    curve = "areas"
    options = LandscapeOptions
    piece_schema = PIECE_SCHEMA

    def evidence(self, scene: Scene, options: LandscapeOptions) -> Evidence:
        """Returns cells of the tile."""
        return Evidence(grown_cells(scene, options))

    def objects(
        self, pieces: pa.Table, options: LandscapeOptions, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields a polygon for each area."""
        columns = {n: np.asarray(pieces[n]) for n in ("column", "row", "height_m", "probability", "returns")}
        first, last = np.asarray(pieces["first_epoch_gps_ns"]), np.asarray(pieces["last_epoch_gps_ns"])
        passes = pieces["passes"].to_pylist()
        for cells in components(columns["column"], columns["row"]):
            whole = area_of(columns["column"][cells], columns["row"][cells])
            height = float(np.mean(columns["height_m"][cells]))
            for polygon in getattr(whole, "geoms", [whole]):
                if polygon.area >= options.least_area_m2:
                    yield AssetObject(
                        shapely.force_3d(polygon.simplify(1.04 * CELL_M), height), CELL_M, 0.05,
                        float(np.mean(columns["probability"][cells])), int(columns["returns"][cells].sum()),
                        len({p for i in cells.tolist() for p in passes[i]}), int(first[cells].min()),
                        int(last[cells].max()), {"area_m2": float(polygon.area)},
                    )  # fmt: skip
