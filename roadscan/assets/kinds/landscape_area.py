"""Landscape areas: planted or grown areas beside the road."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.scene import Scene
from roadscan.assets.upright.grown import PIECE_SCHEMA, LandscapeOptions, area_of, components, grown_cells


class LandscapeArea(AssetKind):
    """Areas of cells that are grown over (:mod:`roadscan.assets.upright.grown`), sidewalks left out."""

    name = "landscape_area"
    title = "Landscape Areas"
    options = LandscapeOptions
    after = ("sidewalk",)
    piece_schema = PIECE_SCHEMA

    def evidence(self, scene: Scene, options: LandscapeOptions) -> Evidence:
        """Cells of the tile."""
        return Evidence(grown_cells(scene, options))

    def objects(
        self, pieces: pa.Table, options: LandscapeOptions, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """A polygon an area."""
        columns = {n: np.asarray(pieces[n]) for n in ("column", "row", "height_m", "probability", "returns")}
        first, last = np.asarray(pieces["first_epoch_gps_ns"]), np.asarray(pieces["last_epoch_gps_ns"])
        passes = pieces["passes"].to_pylist()
        walked = shapely.union_all([shapely.force_2d(o.geometry) for o in others.get("sidewalk", ())])
        for cells in components(columns["column"], columns["row"]):
            left = area_of(columns["column"][cells], columns["row"][cells]).difference(walked)
            height = float(np.mean(columns["height_m"][cells]))
            for polygon in getattr(left, "geoms", [left]):
                if polygon.area >= options.least_area_m2:
                    yield AssetObject(
                        shapely.force_3d(polygon.simplify(0.26), height), 0.25, 0.05,
                        float(np.mean(columns["probability"][cells])), int(columns["returns"][cells].sum()),
                        len({p for i in cells.tolist() for p in passes[i]}), int(first[cells].min()),
                        int(last[cells].max()), {"area_m2": float(polygon.area)},
                    )  # fmt: skip
