"""The part of the road that a picture shows: the rays of its border on the surveyed ground, or on a plane."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Float64
from roadscan.measuring.ground import Ground
from roadscan.measuring.measure import ground_hits
from roadscan.measuring.poses import PicturePoses
from roadscan.pictures.lens import rays_of
from roadscan.pictures.views import HEIGHT, WIDTH, Lens

_A_SIDE: Final = 8
"""Rays along each side of a picture."""
_AROUND: Final = 32
"""Corners of the circle that a picture of 360° shows."""
_BELOW_M: Final = (3.0, 10.0)
"""The road's height is that of the ground within the first of these radii below the camera that holds any (m)."""
_BOTTOM_SHARE: Final = 1.02
"""The circle's radius over the reach, so that its sides touch it."""


class Footprint(NamedTuple):
    """The ground that a picture shows."""

    polygon_m: Any
    """Polygon on the map with heights, counter-clockwise; None where the picture shows no ground."""
    on_ground: float
    """Share of its border's rays that meet surveyed ground; NaN without a polygon."""
    without: str = ""
    """Why there is no polygon."""


_NONE: Final = Footprint(None, math.nan, "the picture shows no ground")
_NO_ROAD: Final = Footprint(
    None, math.nan, "no ground is surveyed below the camera, and the rig file states no above_road_m of it"
)
_BELOW: Final = Footprint(None, math.nan, "the camera lies below the surveyed ground")


def footprint(
    poses: PicturePoses, ground: Ground, number: int, reach_m: float, above_road_m: float | None = None
) -> Footprint:
    """Return what a picture shows of the ground within a reach of the camera, on the map.

    Rays that meet no surveyed ground are compared with a level plane at the height of the road below the camera; those
    that rise or go farther end at the reach. Where no ground is surveyed there, that plane lies `above_road_m` below.
    """
    place = poses.place_m[number]
    heights = (ground.height_m(float(place[0]), float(place[1]), radius) for radius in _BELOW_M)
    known_m = next((h for h in heights if math.isfinite(h)), None)
    if known_m is None and above_road_m is None:
        return _NO_ROAD
    road_m = float(place[2]) - (above_road_m or 0.0) if known_m is None else known_m
    if road_m >= place[2]:
        return _BELOW
    lens = poses.pictures.views.lens_of(number)
    if lens.is_around:
        turn = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
        circle = place[:2] + _BOTTOM_SHARE * reach_m * np.column_stack([np.cos(turn), np.sin(turn)])
        return Footprint(shapely.Polygon(np.column_stack([circle, np.full(_AROUND, road_m)])), 0.0)
    ray = rays_of(lens, border_pixels(lens))
    ray = ray[np.isfinite(ray).all(axis=1)]
    if len(ray) < 3:
        return _NONE
    way = ray @ (poses.map_from_ned[number] @ poses.ned_from_camera[number]).T
    if not (way[:, 2] < 0.0).any():
        return _NONE
    corners, level = _on_level(place, way, road_m, reach_m)
    hits = ground_hits(poses, ground, number, ray, 1.5 * reach_m)
    met = place + hits[:, None] * way
    far = np.hypot(*(met[:, :2] - place[:2]).T)
    on_ground = (hits >= 0.0) & (far <= reach_m) & level
    exact = np.where(on_ground[:, None], met, corners)
    for ring in (exact, corners):
        polygon = shapely.Polygon(ring)
        if polygon.is_valid and polygon.area > 0.0:
            return Footprint(shapely.orient_polygons(polygon), float(on_ground.mean()) if ring is exact else 0.0)
    parts = shapely.get_parts(shapely.make_valid(shapely.Polygon(corners)))
    parts = [one for one in parts if one.geom_type == "Polygon"]
    if not parts:
        return _NONE
    return Footprint(shapely.orient_polygons(max(parts, key=lambda one: one.area)), 0.0)


def border_pixels(lens: Lens) -> Float64:
    """Return pixels (32, 2) along the border of a picture, clockwise from the upper left."""
    right, bottom = lens.parameters[WIDTH] - 0.5, lens.parameters[HEIGHT] - 0.5
    corner = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
    share = np.arange(_A_SIDE) / _A_SIDE
    sides = corner[:-1, None] + share[None, :, None] * (corner[1:] - corner[:-1])[:, None]
    return np.asarray(sides.reshape(-1, 2))


def _on_level(place: Float64, way: Float64, road_m: float, reach_m: float) -> tuple[Float64, npt.NDArray[np.bool_]]:
    """Return where rays (m, 3) meet a level plane, at most at the reach, and which of them meet it within."""
    level = np.hypot(way[:, 0], way[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.where(way[:, 2] < 0.0, (road_m - place[2]) / way[:, 2], np.inf)
        within = along * level <= reach_m
        along = np.where(within, along, reach_m / level)
    corners = place + along[:, None] * way
    corners[:, 2] = road_m
    return corners, within
