"""Edges of a road's surface on one side of its lanes, from heights and intensities beside them.

After P. Kumar, C. P. McElhinney, P. Lewis and T. McCarthy, *An automated algorithm for extracting road edges from
terrestrial mobile LiDAR data* (ISPRS Journal 85, 2013): the slope across the road shows its edge, and intensity and
pulse width where the slope does not. They fit a snake to rasters of the three; here each change across
the road is measured in standard deviations, and the best path is found by dynamic programming
(:mod:`roadscan.compute.edges`). Pulse widths are in no table of roadscan. Where neither heights nor intensities
show an edge, the line painted along the border of the lane is used.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.arrays import SIGMA_OF_MAD, runs_of
from roadscan.compute.edges import DEFAULT, PAINT, AcrossSettings, counted, evidence_across, path_along, without_lines
from roadscan.condition.edge_raster import OFFSET_M, SideRaster, TilePoints, ground_points, side_raster
from roadscan.condition.road_line import STATION_M, Lane, RoadLine

KINDS: Final = ("kerb", "drop", "slope", "intensity", "marking", "polygon")
"""Evidence of an edge: a step up, a step down, a change of slope, one of intensity, a painted line, a polygon."""
INNER_M: Final = 1.2
"""The raster begins this far inside the first possible place of an edge."""
NEAREST_M: Final = 0.8
"""Least distance of an edge from a lane's middle."""
_INSIDE_LANE_M: Final = 0.5
"""Largest distance of the road's edge inside a lane's border."""
_SIGMA_HEIGHT_M: Final = 0.005  # Standard deviation of a height.
_SIGMA_GREY: Final = 0.08
"""Standard deviation of an intensity (share of that of the road), without regard to its neighbours."""
_GREY: Final = AcrossSettings(floor_step_m=0.08, floor_bend=1e6)
"""Settings for intensity: a change of less than 8 % does not count, nor does its slope."""
_STEP: Final = 4.0
"""Evidence (σ) of a step beside which a change of slope does not count."""
_TRUST: Final = (1.0, 1.0, 0.95, 0.7)
"""Weights of the evidence of a step up or down, of a slope and of the intensity where several show an edge."""
_AROUND: Final = 3  # Cells on each side of a path from which its position is taken.
_ROUNDS: Final = 3  # Iterations of this position.
_LEAST_EVIDENCE: Final = 0.6  # Least mean evidence (σ) of an edge.
_LINE_INSIDE_M: Final = 0.8  # Largest distance of an edge line inside the lane's border.
_LINE_OUTSIDE_M: Final = 0.8
"""Largest distance of an edge line outside the lane's border."""
_SMOOTHED_M: Final = 3.5  # Length of the smoothing.
_SPREAD_M: Final = 10.0  # Length over which scatter is estimated.
_KIND_M: Final = 10.0
"""Length over which the kind of evidence is determined."""
_STEP_NEAR_M: Final = 0.15  # Heights between this distance …
_STEP_FAR_M: Final = 0.65
"""… and this distance from an edge determine its step."""


@dataclass(frozen=True, eq=False)
class SideEdge:
    """The edge of the road on one side, station by station."""

    away_m: Float64
    """(s,) its distance from the origin line of the raster; NaN where unknown."""
    sigma_m: Float64
    """(s,) standard deviation of the distance."""
    kind: npt.NDArray[np.int8]
    """(s,) kind of evidence: index in :data:`KINDS`; −1 where unknown."""
    evidence: Float64
    """(s,) mean evidence (σ) around the station."""
    drop_m: Float64
    """(s,) height of the road's surface at the edge above the ground beside it; negative where that is higher."""
    sigma_drop_m: Float64
    """(s,)"""


def first_m(lane_width_m: float) -> float:
    """Return the least distance of an edge from the middle of a lane (m)."""
    return max(NEAREST_M, 0.5 * lane_width_m - _INSIDE_LANE_M)


def find_edge(raster: SideRaster, lane_width_m: float, largest_sigma_m: float) -> SideEdge:
    """Find the edge on one side; distances count from the middle of the outermost lane."""
    import scipy.ndimage

    spacing = (STATION_M, OFFSET_M)
    step, bend = evidence_across(raster.height_m, np.full(raster.height_m.shape, _SIGMA_HEIGHT_M), spacing)
    grey = _relative(raster)
    surface = without_lines(grey, OFFSET_M)
    change, _ = evidence_across(surface, np.full(grey.shape, _SIGMA_GREY), spacing, _GREY)
    # Slopes also differ on both sides of a step.
    stepped = scipy.ndimage.maximum_filter(np.nan_to_num(np.abs(step)), (1, 2 * round(DEFAULT.across_m / OFFSET_M) + 1))
    bend = np.where(stepped >= _STEP, 0.0, bend)
    up, down = np.where(step > 0.0, step, 0.0), np.where(step < 0.0, step, 0.0)
    change = _lasting(change, surface)
    kinds = np.stack([trust * counted(e) for e, trust in zip((up, down, bend, change), _TRUST, strict=True)])
    begin = int(np.searchsorted(raster.away_m, first_m(lane_width_m) - 1e-9))
    kinds = kinds[:, :, begin:]
    path = path_along(kinds.max(axis=0), spacing)
    told = _judged(kinds, path.cell)
    away = _places(kinds[told, np.arange(told.size)], path.cell, raster.away_m[begin:])
    good = path.evidence >= _LEAST_EVIDENCE
    painted, paint_away, paint_evidence = _edge_line(grey - surface, raster, lane_width_m)
    instead = ~good & painted
    away = np.where(instead, paint_away, away)
    kind = np.where(instead, KINDS.index("marking"), told).astype(np.int8)
    evidence = np.where(instead, paint_evidence, path.evidence)
    away, sigma = smoothed(away, good | painted, kind)
    known = (good | painted) & (sigma <= largest_sigma_m)
    drop, sigma_drop = drops(raster, np.where(known, away, np.nan))
    nan = np.nan
    return SideEdge(
        np.where(known, away, nan), np.where(known, sigma, nan), np.where(known, kind, -1).astype(np.int8),
        np.where(known, evidence, nan), drop, sigma_drop,
    )  # fmt: skip


def _relative(raster: SideRaster) -> Float64:
    """Return intensities (s, o) as shares of the lane's; NaN where there are none."""
    inner = raster.intensity[raster.away_m[None, :].repeat(len(raster.intensity), 0) <= NEAREST_M + INNER_M]
    inner = inner[np.isfinite(inner)]
    level = float(np.median(inner)) if inner.size else 0.0
    return raster.intensity / level if level > 0.0 else np.full(raster.intensity.shape, np.nan)


def _lasting(change: Float64, surface: Float64) -> Float64:
    """Limit changes of intensity (σ) to the difference of the mean intensities of both sides."""
    import scipy.ndimage

    size = (2 * round(DEFAULT.along_m / STATION_M) + 1, round(DEFAULT.across_m / OFFSET_M))
    size = (size[0], size[1] + 1 - size[1] % 2)
    known = np.isfinite(surface)
    share = scipy.ndimage.uniform_filter(known.astype(np.float64), size, mode="constant")
    total = scipy.ndimage.uniform_filter(np.where(known, surface, 0.0), size, mode="constant")
    mean = np.where(share > 0.2, total / np.maximum(share, 1e-9), np.nan)
    away = size[1] // 2 + 1
    padded = np.pad(mean, ((0, 0), (away, away)), constant_values=np.nan)
    levels = (padded[:, 2 * away :] - padded[:, : -2 * away]) / _SIGMA_GREY
    alike = np.sign(change) == np.sign(levels)
    return np.where(alike, np.sign(change) * np.minimum(np.abs(change), np.abs(levels)), np.nan)


def _edge_line(bright: Float64, raster: SideRaster, lane_width_m: float) -> tuple[Bool, Float64, Float64]:
    """Find a line painted along the border of the lane: whether it exists, its distance and its evidence, (s,) each."""
    border = 0.5 * lane_width_m
    near = (raster.away_m >= max(border - _LINE_INSIDE_M, NEAREST_M)) & (raster.away_m <= border + _LINE_OUTSIDE_M)
    columns = np.flatnonzero(near)
    strength = counted(np.maximum(np.nan_to_num(bright[:, columns]), 0.0) * DEFAULT.chance / PAINT)
    path = path_along(strength, (STATION_M, OFFSET_M), DEFAULT)
    away = _places(strength, path.cell, raster.away_m[columns])
    return path.evidence >= _LEAST_EVIDENCE, away, path.evidence


def _places(found: Float64, cell: npt.NDArray[np.int64], away_m: Float64) -> Float64:
    """Return distances (s,) of the middle of evidence (s, o) over three cells on each side of a path."""
    at = away_m[cell]
    for _ in range(_ROUNDS):
        near = np.rint((at - away_m[0]) / OFFSET_M).astype(np.int64)[:, None] + np.arange(-_AROUND, _AROUND + 1)
        inside = (near >= 0) & (near < found.shape[1])
        near = np.clip(near, 0, found.shape[1] - 1)
        weight = np.where(inside, np.maximum(np.take_along_axis(found, near, axis=1), 0.0), 0.0)
        total = weight.sum(axis=1)
        mean = (weight * away_m[near]).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        at = np.where(total > 0.0, mean, at)
    return at


def _judged(kinds: Float64, cell: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return (s,) the kind of evidence (kinds, s, o) that is strongest beside a path around each station."""
    import scipy.ndimage

    near = np.clip(cell[:, None] + np.arange(-_AROUND, _AROUND + 1), 0, kinds.shape[2] - 1)
    beside = np.take_along_axis(kinds, np.broadcast_to(near, (len(kinds), *near.shape)), axis=2).max(axis=2)
    around = scipy.ndimage.uniform_filter1d(beside, _cells(_KIND_M), axis=1, mode="nearest")
    strongest: npt.NDArray[np.int64] = np.argmax(around, axis=0)
    return strongest


def smoothed(away_m: Float64, known: Bool, kind: npt.NDArray[np.int8]) -> tuple[Float64, Float64]:
    """Return distances (s,) smoothed along runs of one kind of edge, and their standard deviations.

    The standard deviation combines that of the single places about the smooth line, from their median difference
    within 10 m, and that of a cell's width.
    """
    import scipy.ndimage

    out, sigma = np.array(away_m), np.full(away_m.size, np.nan)
    group = np.where(known, kind.astype(np.int64) + 1, 0)
    ends = np.flatnonzero(np.diff(group, prepend=-1, append=-1))
    for first, end in itertools.pairwise(ends):
        if group[first] == 0:
            continue
        own = away_m[first:end]
        middle = scipy.ndimage.median_filter(own, min(_cells(_SMOOTHED_M), _odd(own.size)), mode="nearest")
        smooth = scipy.ndimage.uniform_filter1d(middle, min(_cells(_SMOOTHED_M), _odd(own.size)), mode="nearest")
        width = min(_cells(_SPREAD_M), _odd(own.size))
        spread = SIGMA_OF_MAD * scipy.ndimage.median_filter(np.abs(own - smooth), width, mode="nearest")
        out[first:end], sigma[first:end] = smooth, np.hypot(spread, OFFSET_M / np.sqrt(12.0))
    return out, sigma


def _cells(length_m: float) -> int:
    return _odd(round(length_m / STATION_M))


def _odd(count: int) -> int:
    return max(count - 1 + count % 2, 1)


def drops(raster: SideRaster, away_m: Float64) -> tuple[Float64, Float64]:
    """Return the height (s,) of the road's surface above the ground beside its edge (m), and its standard deviation.

    Straight lines are fitted to the heights from 0.15 to 0.65 m inside and outside the edge; NaN where either side has
    fewer than three. The median of five stations is taken, so that single things beside the road do not count.
    """
    reach = np.arange(-round(_STEP_FAR_M / OFFSET_M) - 1, round(_STEP_FAR_M / OFFSET_M) + 2)
    known = np.isfinite(away_m)
    cell = np.round((np.where(known, away_m, 0.0) - raster.away_m[0]) / OFFSET_M).astype(np.int64)
    near = cell[:, None] + reach
    inside = (near >= 0) & (near < raster.away_m.size) & known[:, None]
    near = np.clip(near, 0, raster.away_m.size - 1)
    height = np.where(inside, np.take_along_axis(raster.height_m, near, axis=1), np.nan)
    beyond = raster.away_m[near] - away_m[:, None]
    wanted = (np.abs(beyond) >= _STEP_NEAR_M) & (np.abs(beyond) <= _STEP_FAR_M)
    height = np.where(wanted, height, np.nan)
    ends = [_line_at_edge(np.where(side * beyond > 0.0, height, np.nan), beyond) for side in (-1.0, 1.0)]
    drop, variance = ends[0][0] - ends[1][0], ends[0][1] + ends[1][1]
    return _median_of_five(drop), _median_of_five(np.sqrt(variance))


def _line_at_edge(height: Float64, beyond: Float64) -> tuple[Float64, Float64]:
    """Return heights (s,) at the edge of straight lines through heights (s, k) beside it, and their variances."""
    good = np.isfinite(height)
    n = good.sum(axis=1)
    enough = n >= 3
    count = np.where(enough, n, 1)
    x, h = np.where(good, beyond, 0.0), np.where(good, height, 0.0)
    mean_x, mean_h = x.sum(axis=1) / count, h.sum(axis=1) / count
    dx, dh = np.where(good, x - mean_x[:, None], 0.0), np.where(good, h - mean_h[:, None], 0.0)
    square = np.where(enough, (dx * dx).sum(axis=1), 1.0)
    slope = (dx * dh).sum(axis=1) / square
    rest = ((dh - slope[:, None] * dx) ** 2).sum(axis=1) / np.maximum(count - 2, 1)
    variance = np.maximum(rest, 1e-6) * (1.0 / count + mean_x**2 / square)
    return np.where(enough, mean_h - slope * mean_x, np.nan), np.where(enough, variance, np.nan)


def _median_of_five(value: Float64) -> Float64:
    """Return (s,) medians of known values of five stations; NaN where the middle one is unknown."""
    padded = np.pad(value, 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 5)
    known = np.isfinite(value)
    out = np.full(value.size, np.nan)
    if known.any():
        out[known] = np.nanmedian(windows[known], axis=1)
    return out


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
