"""Edges of a stretch of road on both sides of its lanes, and the road's surface between them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Float64
from roadscan.compute.flags import runs_of
from roadscan.condition.road_edges.find import INNER_M, KINDS, SideEdge, drops, find_edge, first_m
from roadscan.condition.road_edges.raster import OFFSET_M, STATION_M, TilePoints, ground_points, side_raster
from roadscan.condition.road_line import Lane, RoadLine

SIDES: Final = {"left": -1.0, "right": 1.0}
"""Sides of the reference line, with the sign of offsets there."""
LEAD_M: Final = 15.0
"""Length of road before and behind edges on which they depend."""
_LEAST_STATIONS: Final = 5  # Least length of a run with one outermost lane.


@dataclass(frozen=True, eq=False)
class RoadStretch:
    """A piece of a road."""

    line: RoadLine
    lanes: tuple[Lane, ...]
    from_m: float
    to_m: float


@dataclass(frozen=True, eq=False)
class EdgeOfSide:
    """The edge on one side of the reference line, a value a station; NaN where unknown."""

    start_m: Float64
    """(s,) offset of the middle of the outermost lane on this side from the reference line, positive to the right."""
    offset_m: Float64
    """(s,) offset of the edge."""
    found: SideEdge


@dataclass(frozen=True, eq=False)
class RoadEdges:
    """Edges of a stretch at multiples of :data:`STATION_M`, including the last one."""

    station_m: Float64
    """(s,)"""
    sides: Mapping[str, EdgeOfSide]
    """By side: left and right of the reference line."""


@dataclass(frozen=True, eq=False)
class RoadSurface:
    """The road's surface between its edges, where both are known."""

    outline: shapely.Polygon
    from_m: float
    to_m: float
    width_m: float
    """Mean width."""
    sigma_width_m: float
    """Standard deviation of the mean width; errors of one side are taken as fully correlated."""


def reach_m(lanes: Sequence[Lane], reach_beyond_m: float) -> float:
    """Return how far from the reference line an edge of these lanes may lie (m)."""
    away = [float(np.abs(lane.offset_m).max(initial=0.0)) + 0.5 * lane.width_m for lane in lanes]
    return max(away, default=0.0) + reach_beyond_m + 1.0


def road_edges(
    points: Sequence[TilePoints],
    piece: RoadStretch,
    reach_beyond_m: float,
    largest_sigma_m: float,
    polygons: shapely.Geometry | None = None,
) -> RoadEdges:
    """Find the edges of a stretch of road.

    Parameters
    ----------
    points : of the tiles on its way, on the map; piece : the stretch, its line and lanes longer by :data:`LEAD_M`.
    reach_beyond_m : how far beyond the outermost lane's border an edge is sought; largest_sigma_m : edges with a larger
        standard deviation are left out.
    polygons : the road's surface on the map, where it is stated: its borders are the edges.
    """
    between = (piece.from_m - LEAD_M, piece.to_m + LEAD_M)
    ground = ground_points(points, piece.line, (between[0] - 1.0, between[1] + 1.0))
    station: Float64 = STATION_M * np.arange(round(between[0] / STATION_M), round(between[1] / STATION_M) + 1.0)
    own = (station >= piece.from_m - 1e-6) & (station <= piece.to_m + 1e-6)
    sides = {}
    for name, side in SIDES.items():
        start, lane_of = _outermost(piece.lanes, station, side)
        held = _no_edge(station.size)
        for first, end in _runs(lane_of):
            lane = piece.lanes[lane_of[first]]
            run = slice(first, end)
            within = (first_m(lane.width_m) - INNER_M, 0.5 * lane.width_m + reach_beyond_m)
            raster = side_raster(ground, side, station[run], start[run], within)
            if polygons is None:
                found = find_edge(raster, lane.width_m, largest_sigma_m)
            else:
                away = _borders(polygons, piece.line, station[run], start[run], side * within[1])
                found = _stated(away, *drops(raster, away))
            for one in fields(SideEdge):
                getattr(held, one.name)[run] = getattr(found, one.name)
        kept = SideEdge(*(getattr(held, one.name)[own] for one in fields(SideEdge)))
        sides[name] = EdgeOfSide(start[own], start[own] + side * kept.away_m, kept)
    return RoadEdges(station[own], sides)


def _outermost(lanes: Sequence[Lane], station: Float64, side: float) -> tuple[Float64, npt.NDArray[np.int64]]:
    """Return the offset (s,) of the middle of the outermost lane on a side, and its index in `lanes`; −1 for none."""
    start, which = np.full(station.size, np.nan), np.full(station.size, -1)
    for number, lane in enumerate(lanes):
        offset = lane.offsets(station)
        on = (station >= lane.first_m - 1e-6) & (station <= lane.last_m + 1e-6)
        on &= np.isnan(start) | (side * offset > side * start)
        start, which = np.where(on, offset, start), np.where(on, number, which)
    return start, which


def _runs(lane_of: npt.NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Return first and end of runs of stations with one outermost lane."""
    ends = np.flatnonzero(np.diff(lane_of, prepend=-2, append=-2))
    for first, end in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        if lane_of[first] >= 0 and end - first >= _LEAST_STATIONS:
            yield first, end


def _no_edge(count: int) -> SideEdge:
    away, sigma, evidence, drop, sigma_drop = (np.full(count, np.nan) for _ in range(5))
    return SideEdge(away, sigma, np.full(count, -1, np.int8), evidence, drop, sigma_drop)


def _stated(away: Float64, drop: Float64, sigma_drop: Float64) -> SideEdge:
    known, nan = np.isfinite(away), np.full(away.size, np.nan)
    kind = np.where(known, KINDS.index("polygon"), -1).astype(np.int8)
    return SideEdge(away, nan, kind, nan.copy(), drop, sigma_drop)


def _borders(polygons: shapely.Geometry, line: RoadLine, station: Float64, start: Float64, out_m: float) -> Float64:
    """Return (s,) distance from a lane outward to the border of the polygons; NaN where there is none."""
    inner, outer = line.places(station, start)[:, :2], line.places(station, start + out_m)[:, :2]
    ways = shapely.linestrings(np.stack([inner, outer], axis=1))
    shapely.prepare(polygons)
    left = shapely.intersection(ways, polygons)
    away = np.full(station.size, np.nan)
    for k, piece in enumerate(left):
        parts = shapely.get_parts(piece)
        at = shapely.Point(inner[k])
        first = next((p for p in parts if p.length > 0.0 and p.distance(at) < 1e-6), None)
        if first is not None and first.length < abs(out_m) - OFFSET_M:
            away[k] = first.length
    return away


def road_surfaces(edges: RoadEdges, line: RoadLine) -> Iterator[RoadSurface]:
    """Return the road's surface, a polygon for each run of stations with both edges."""
    left, right = edges.sides["left"], edges.sides["right"]
    both = np.isfinite(left.offset_m) & np.isfinite(right.offset_m)
    for first, end in runs_of(both).tolist():
        run = slice(first, end)
        station = edges.station_m[run]
        if end - first < 2:
            continue
        border = [line.places(station, side.offset_m[run])[:, :2] for side in (left, right)]
        whole: Any = shapely.make_valid(shapely.Polygon(np.concatenate([border[1], border[0][::-1]])))
        parts = [p for p in shapely.get_parts(whole) if p.geom_type == "Polygon"]
        if not parts:
            continue
        sigma = [float(np.sqrt(np.mean(side.found.sigma_m[run] ** 2))) for side in (left, right)]
        width = float(np.mean(right.offset_m[run] - left.offset_m[run]))
        outline = shapely.orient_polygons(max(parts, key=lambda p: p.area))
        yield RoadSurface(outline, float(station[0]), float(station[-1]), width, math.hypot(*sigma))
