"""Pieces of markings that are no lines: polygons cut at the tile's border."""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets.paint.detection import Paint, Patch
from roadscan.assets.paint.line_pieces import height_sigma
from roadscan.assets.scene import Scene

PATCH_PIECES: Final = pa.schema(
    [
        pa.field("shape", pa.binary()),
        pa.field("in_crosswalk", pa.bool_()),
        pa.field("road_rad", pa.float64()),
        pa.field("height_m", pa.float64()),
        pa.field("slope_east", pa.float64()),
        pa.field("slope_north", pa.float64()),
        pa.field("contrast", pa.float64()),
        pa.field("sigma_height_m", pa.float64()),
        pa.field("probability", pa.float64()),
        pa.field("returns", pa.int64()),
        pa.field("passes", pa.list_(pa.uint16())),
        pa.field("first_epoch_gps_ns", pa.int64()),
        pa.field("last_epoch_gps_ns", pa.int64()),
    ]
)
"""A polygon in the map (WKB), the plane of the ground at its middle, and the direction of the road there."""


def patch_pieces(scene: Scene, paint: Paint) -> pa.Table:
    """Returns pieces of patches within the scene's tile, in the order of the paint's patches."""
    tile = shapely.box(scene.tile.x_min_m, scene.tile.y_min_m, scene.tile.x_max_m, scene.tile.y_max_m)
    rows = []
    for patch in paint.patches:
        shape = shapely.intersection(patch.shape, tile)
        if shape.area > 0.0:
            rows.append(_piece(scene, paint, patch, shape))
    return pa.Table.from_pylist(rows, schema=PATCH_PIECES)


def _piece(scene: Scene, paint: Paint, patch: Patch, shape: shapely.Geometry) -> dict[str, object]:
    seen = scene.returns.at(paint.contrast.rows[patch.returns])
    inside = scene.tile.holds(seen.x_m, seen.y_m)
    own = seen.at(inside) if inside.any() else seen
    middle = shape.centroid
    east, north = scene.returns.corner_m
    ground, step = scene.ground, scene.ground.cell_m
    heights = ground.height_at(
        middle.x + step * np.array([0.0, 1.0, -1.0, 0.0, 0.0]), middle.y + step * np.array([0.0, 0.0, 0.0, 1.0, -1.0])
    )
    moved = shapely.transform(shape, lambda xy: xy + np.array([east, north]))
    return {
        "shape": shapely.to_wkb(moved),
        "in_crosswalk": patch.in_crosswalk,
        "road_rad": patch.road_rad,
        "height_m": float(heights[0]),
        "slope_east": float((heights[1] - heights[2]) / (2 * step)),
        "slope_north": float((heights[3] - heights[4]) / (2 * step)),
        "contrast": patch.contrast,
        "sigma_height_m": height_sigma(own.height_m - ground.height_at(own.x_m, own.y_m)),
        "probability": patch.probability,
        "returns": int(np.count_nonzero(inside)),
        "passes": [int(p) for p in np.unique(own.pass_id)],
        "first_epoch_gps_ns": int(own.epoch_gps_ns.min()),
        "last_epoch_gps_ns": int(own.epoch_gps_ns.max()),
    }
