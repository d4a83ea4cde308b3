"""Road markings that are no lane lines: stop bars, crosswalks, arrows, symbols, and their types by shape."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.classes import MARKING
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.paint.components import CELL_M
from roadscan.assets.paint.detection import (
    SYMBOL_M,
    Paint,
    Patch,
    covers,
    height_sigma,
    line_outlines,
    paint_of,
    rows_of_paint,
    shown_pieces,
)
from roadscan.assets.paint.symbols import ARROWS, symbol_of, turned
from roadscan.assets.scene import Scene
from roadscan.assets.upright.slices import places_of
from roadscan.compute.array_types import Bool

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


def with_pictured(pieces: pa.Table, shown: pa.Table) -> pa.Table:
    """Returns pieces of markings with those that pictures show, in place of the parts of them that the lidar found.

    A line of which few returns tell consists of spots, which look like markings to the lidar.
    """
    lines = line_outlines(row for row in shown["line"].to_pylist() if row is not None)
    added = shown_pieces(shown, "patch", PATCH_PIECES)
    wholes = np.array([*lines, *shapely.from_wkb(added["shape"].to_numpy(zero_copy_only=False))], dtype=object)
    tree, parts = shapely.STRtree(wholes), shapely.from_wkb(pieces["shape"].to_numpy(zero_copy_only=False))
    kept = [not (near := tree.query(part)).size or not covers(wholes[near], part) for part in parts]
    return pa.concat_tables([pieces.filter(pa.array(kept, pa.bool_())), added])


_MARKER_M: Final = 0.30  # Largest marker (m).
_BAR_ALONG_M: Final = (0.15, 1.0)  # Extent of a bar along the road (m).
_BAR_ACROSS_M: Final = 1.0  # Least extent of a bar across the road (m).
_BAR_FILLED: Final = 0.7  # Least share of its rectangle that a bar covers.
_ARROW_ALONG_M: Final = 1.2  # Least extent of an arrow along the road (m).


def type_and_symbol(outline: shapely.Geometry, painted: shapely.Geometry, road_rad: float) -> tuple[str, str | None]:
    """Returns the type of a polygon in the map with its paint, and what an arrow or a symbol shows.

    road_rad : direction of the road (rad, anticlockwise from east).
    """
    flat = turned(painted, road_rad)
    along, across = _sides(flat)
    if max(along, across) <= _MARKER_M:
        return "raised_marker", None
    if is_stop_bar(outline, along, across):
        return "stop_bar", None
    shows = symbol_of(flat)
    if shows in ARROWS and along >= _ARROW_ALONG_M:
        return "arrow", shows
    return ("symbol", shows) if max(along, across) <= SYMBOL_M else ("area", None)


def is_stop_bar(outline: shapely.Geometry, along_m: float, across_m: float) -> bool:
    """Returns whether a polygon is a bar across the road, by its extent along the road and across it."""
    filled = outline.area / max(shapely.minimum_rotated_rectangle(outline).area, 1e-9)
    return bool(
        max(along_m, across_m) > _MARKER_M
        and _BAR_ALONG_M[0] <= along_m <= _BAR_ALONG_M[1]
        and across_m >= max(_BAR_ACROSS_M, 2.0 * along_m)
        and filled >= _BAR_FILLED
    )


def _sides(outline: shapely.Geometry) -> tuple[float, float]:
    """Returns the extent of an outline along x and y."""
    x_min, y_min, x_max, y_max = outline.bounds
    return x_max - x_min, y_max - y_min


_TOUCHING_M: Final = 0.03  # Pieces this near to one another (m) touch.
_WORN_M: Final = 0.3
"""Paint that is worn across a symbol leaves parts this near to one another (m)."""
_LINE_HALF_M: Final = 0.1  # Half width of lines that are cut off a marking (m).
_BAR_GAP_M: Final = 1.2
"""Greatest gap between bars of a crosswalk (m)."""


def markings(table: pa.Table) -> list[AssetObject]:
    """Markings of the pieces (:data:`~roadscan.assets.kinds.road_marking.PATCH_PIECES`), by easting and northing."""
    if not table.num_rows:
        return []
    shapes = shapely.from_wkb(table["shape"].to_numpy(zero_copy_only=False))
    order = np.lexsort(shapely.bounds(shapes).T[::-1])
    shapes, table = shapes[order], table.take(pa.array(order))
    in_crosswalk = np.asarray(table["in_crosswalk"].to_numpy(zero_copy_only=False), np.bool_)
    group = _groups(shapes, in_crosswalk)
    found = [_object(shapes[group == g], table.take(pa.array(np.flatnonzero(group == g)))) for g in np.unique(group)]
    return sorted(found, key=lambda one: one.geometry.bounds)


def _groups(shapes: npt.NDArray[Any], in_crosswalk: Bool) -> npt.NDArray[np.int64]:
    """Returns the number (n,) of each piece's marking."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    tree = shapely.STRtree(shapes)
    one, other = tree.query(shapes, predicate="dwithin", distance=_BAR_GAP_M)
    together = (in_crosswalk[one] & in_crosswalk[other]) | (
        (shapely.distance(shapes[one], shapes[other]) <= _WORN_M) & (in_crosswalk[one] == in_crosswalk[other])
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
    if not crosswalk and is_stop_bar(bar, *_sides(turned(bar, road))):
        outline = painted = bar
    kind, shows = ("crosswalk", None) if crosswalk else type_and_symbol(outline, painted, road)
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
            "type": kind,
            "symbol": shows,
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


_LARGE_M2: Final = 0.5  # Larger patches are not tested for a post (m²).
_STANDS_M: Final = (0.3, 1.5)  # Heights above the ground (m) between which a post is seen.
_LEAST_STANDING: Final = 5  # Least number of returns of a post.


def _at_foot(scene: Scene, patch: Patch) -> bool:
    """Returns whether a small patch is the foot of a post: something stands on it."""
    if patch.shape.area > _LARGE_M2:
        return False
    west, south, east, north = patch.shape.bounds
    reach = math.hypot(east - west, north - south) / 2
    rows = places_of(scene).within((west + east) / 2, (south + north) / 2, reach)
    above = scene.above_ground_m[rows]
    return int(np.count_nonzero((above > _STANDS_M[0]) & (above < _STANDS_M[1]))) >= _LEAST_STANDING


class RoadMarking(AssetKind):
    """A row for each marking: what it is, its size, and its contrast to the surface."""

    name = "road_marking"
    title = "road markings"
    curve = "products"
    piece_schema: ClassVar[pa.Schema] = PATCH_PIECES
    sees_paint: ClassVar[bool] = True

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns polygons of markings in the tile."""
        paint = paint_of(scene)
        paint = replace(paint, patches=tuple(p for p in paint.patches if not _at_foot(scene, p)))
        return Evidence(patch_pieces(scene, paint), (Marked(rows_of_paint(paint.contrast, paint.patches), MARKING),))

    def with_pictures(self, pieces: pa.Table, shown: pa.Table) -> pa.Table:
        """Returns pieces without those that are parts of paint in pictures, and those that pictures show."""
        return with_pictured(pieces, shown)

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns markings of the pieces of all tiles."""
        return markings(pieces)
