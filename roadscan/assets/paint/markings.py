"""Markings: pieces of all tiles joined, and their type by shape."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetObject
from roadscan.assets.paint.contrast import CELL_M
from roadscan.assets.paint.marking_types import type_of

_TOUCHING_M: Final = 0.03  # Pieces this near to one another (m) touch.
_LINE_HALF_M: Final = 0.1  # Half width of lines that are cut off a marking (m).
_BAR_GAP_M: Final = 1.2
"""Greatest gap between bars of a crosswalk (m)."""


def markings(table: pa.Table) -> list[AssetObject]:
    """Markings of the pieces (:data:`~roadscan.assets.paint.patch_pieces.PATCH_PIECES`), by easting and northing."""
    if not table.num_rows:
        return []
    shapes = shapely.from_wkb(table["shape"].to_numpy(zero_copy_only=False))
    order = np.lexsort(shapely.bounds(shapes).T[::-1])
    shapes, table = shapes[order], table.take(pa.array(order))
    in_crosswalk = np.asarray(table["in_crosswalk"].to_numpy(zero_copy_only=False), np.bool_)
    group = _groups(shapes, in_crosswalk)
    found = [_object(shapes[group == g], table.take(pa.array(np.flatnonzero(group == g)))) for g in np.unique(group)]
    return sorted(found, key=lambda one: one.geometry.bounds)


def _groups(shapes: npt.NDArray[Any], in_crosswalk: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Returns the number (n,) of each piece's marking."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    tree = shapely.STRtree(shapes)
    one, other = tree.query(shapes, predicate="dwithin", distance=_BAR_GAP_M)
    together = (in_crosswalk[one] & in_crosswalk[other]) | (
        (shapely.distance(shapes[one], shapes[other]) <= _TOUCHING_M) & (in_crosswalk[one] == in_crosswalk[other])
    )
    links = coo_array((np.ones(int(together.sum())), (one[together], other[together])), shape=(len(shapes),) * 2)
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def _object(shapes: npt.NDArray[Any], table: pa.Table) -> AssetObject:
    """Returns the marking of some pieces."""
    painted = shapely.union_all(shapes)
    crosswalk = bool(np.any(table["in_crosswalk"].to_numpy(zero_copy_only=False)))
    outline = painted.convex_hull if crosswalk else _whole(painted)
    roads = table["road_rad"].to_numpy()
    road = float(roads[np.isfinite(roads)][0]) if np.isfinite(roads).any() else _own_direction(outline)
    bar = _without_lines(outline)
    if not crosswalk and type_of(bar, road) == "stop_bar":
        outline = painted = bar
    along, across = _extent(outline, road)
    returns = np.maximum(table["returns"].to_numpy(), 1)
    return AssetObject(
        geometry=_with_heights(outline, shapes, table),
        sigma_horizontal_m=float(CELL_M / np.sqrt(12.0)),
        sigma_height_m=float(np.average(table["sigma_height_m"].to_numpy(), weights=returns)),
        probability=float(np.average(table["probability"].to_numpy(), weights=returns)),
        returns=int(table["returns"].to_numpy().sum()),
        passes=len({p for row in table["passes"].to_pylist() for p in row}),
        first_epoch_gps_ns=int(table["first_epoch_gps_ns"].to_numpy().min()),
        last_epoch_gps_ns=int(table["last_epoch_gps_ns"].to_numpy().max()),
        attributes={
            "type": "crosswalk" if crosswalk else type_of(outline, road),
            "length_m": along,
            "width_m": across,
            "area_m2": float(painted.area),
            "contrast": 1.0 + float(np.average(table["contrast"].to_numpy(), weights=returns)),
        },
        sigma_size_m=float(CELL_M / np.sqrt(6.0)),
    )


def _whole(painted: shapely.Geometry) -> shapely.Geometry:
    """Returns one polygon; parts that touch at corners are merged."""
    if painted.geom_type == "Polygon":
        return painted
    closed = painted.buffer(_TOUCHING_M, join_style="mitre").buffer(-_TOUCHING_M, join_style="mitre")
    return closed if closed.geom_type == "Polygon" else painted.convex_hull


def _without_lines(outline: shapely.Geometry) -> shapely.Geometry:
    """Returns the thick part of a polygon, without lines that touch it."""
    thick = outline.buffer(-_LINE_HALF_M, join_style="mitre").buffer(_LINE_HALF_M, join_style="mitre")
    return thick if thick.geom_type == "Polygon" and not thick.is_empty else outline


def _own_direction(outline: shapely.Geometry) -> float:
    """Returns the direction (rad) of the longer side of the least rectangle around it."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(outline))
    sides = np.diff(corners[:3], axis=0)
    side = sides[int(np.argmax(np.hypot(*sides.T)))]
    return float(np.arctan2(side[1], side[0]))


def _extent(outline: shapely.Geometry, road_rad: float) -> tuple[float, float]:
    """Returns the extent along and across a direction."""
    xy = shapely.get_coordinates(outline)
    along = xy @ np.array([np.cos(road_rad), np.sin(road_rad)])
    across = xy @ np.array([-np.sin(road_rad), np.cos(road_rad)])
    return float(np.ptp(along)), float(np.ptp(across))


def _with_heights(outline: shapely.Geometry, shapes: npt.NDArray[Any], table: pa.Table) -> shapely.Geometry:
    """Returns the outline with the height of the plane of the nearest piece at each corner."""
    xy = shapely.get_coordinates(outline)
    nearest = shapely.STRtree(shapes).nearest(shapely.points(xy))
    middle = shapely.get_coordinates(shapely.centroid(shapes))[nearest]
    base, east, north = (table[n].to_numpy()[nearest] for n in ("height_m", "slope_east", "slope_north"))
    height = base + (xy[:, 0] - middle[:, 0]) * east + (xy[:, 1] - middle[:, 1]) * north
    return shapely.set_coordinates(shapely.force_3d(outline), np.column_stack([xy, height]))
