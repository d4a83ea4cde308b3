"""Widths of the lane and of the road.

Width of a lane: between its painted lines, else between the road's edges, else as it is stated.

A line is that of the middles found along 15 m before and behind a place, their median; width is the distance of the
lines' middles. Where a side has no line, the edge of the road's surface stands for it if no other lane lies between.

Width of the road's surface and of the shoulders beside a lane, and drops at its edges.

A shoulder reaches from the border of the lane to the edge of the road's surface, where no other lane lies between. The
drop is the height of the road's surface at its edge above the ground beside it; a kerb that rises gives a negative one.
Source: edge drop-off as public descriptions of the LTPP distress identification manual (FHWA-HRT-13-092) have it, the
difference between the surface and the ground beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import ClassVar, Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about
from roadscan.condition.index import ConditionIndex, How, PerCrossSection, Quantity, Value, by_section
from roadscan.condition.lane_data import SPACING_M, LaneData, LaneLines
from roadscan.condition.road_line import STATION_M

_AROUND_M: Final = 15.0  # Length before and behind a place over which middles of a line are used.
_LEAST_PLACES: Final = 5  # Least number of these middles.
_ALIKE_M: Final = 0.15
"""Middles farther than this from their median belong to other paint."""
_SIGMA_LINE_M: Final = 0.005
"""Least standard deviation of a line's middle: its paint is worn, and the road's axis was smoothed."""


class _Side(NamedTuple):
    own_m: Float64
    """(n,) offset of the border from the lane's middle; NaN where it is not known."""
    sigma_m: Float64


class LaneWidth(ConditionIndex):
    """Width of the lane."""

    name: ClassVar[str] = "lane_width"
    title: ClassVar[str] = "width of the lane between its lines, else between the road's edges, else as stated"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("lane_width_m", "m", "Width of the lane, mean; its remark says what it was taken from"),
        Quantity("lane_lines_percent", "%", "Share of the section where both lines are known"),
    )
    drawn: ClassVar[tuple[str, ...]] = ("lane_width_m",)
    lead_m: ClassVar[float] = 20.0

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return the values of sections."""
        for from_m, to_m in lane.sections_m:
            first, end = (math.ceil(one / SPACING_M) for one in (from_m, to_m))
            station: Float64 = SPACING_M * np.arange(first, end, dtype=np.float64)
            sides = {side: _line(lane.lines, side, station) for side in ("left", "right")}
            painted = float(np.mean(np.isfinite(sides["left"].own_m + sides["right"].own_m))) if station.size else 0.0
            yield Value("lane_lines_percent", "section", from_m, to_m, 100.0 * painted, math.nan, 1.0)
            width, sigma, share = _width(sides)
            source = "markings"
            if share < 0.5:
                source = "edges"
                width, sigma, share = _width({name: _edge(lane, name, side, station) for name, side in sides.items()})
            if share < 0.5:
                source, width, sigma, share = lane.width_from, lane.width_m, math.nan, 1.0
            yield Value("lane_width_m", "section", from_m, to_m, width, sigma, share, source)


def _line(lines: LaneLines, side: str, station: Float64) -> _Side:
    """Return the line on one side at stations."""
    own = np.array([one == side for one in lines.side], bool)
    at, middle = lines.station_m[own], lines.own_m[own]
    place, sigma = np.full(station.size, np.nan), np.full(station.size, np.nan)
    first = np.searchsorted(at, station - _AROUND_M)
    end = np.searchsorted(at, station + _AROUND_M)
    for k, (a, b) in enumerate(zip(first.tolist(), end.tolist(), strict=True)):
        near = middle[a:b]
        if near.size >= _LEAST_PLACES:
            near = near[np.abs(near - np.median(near)) <= _ALIKE_M]
        if near.size >= _LEAST_PLACES:
            spread = scatter_about(near, float(np.median(near)))
            place[k] = np.median(near)
            sigma[k] = math.hypot(spread * math.sqrt(math.pi / 2.0 / near.size), _SIGMA_LINE_M)
    return _Side(place, sigma)


def _edge(lane: LaneData, name: str, line: _Side, station: Float64) -> _Side:
    """Return the line, or where it is not known the edge of the road's surface."""
    if lane.edges is None or not lane.edges.sides[name].beside:
        return line
    edge, sign = lane.edges.sides[name], 1.0 if name == "right" else -1.0
    at = np.clip(np.searchsorted(lane.edges.station_m, station - 1e-6), 0, lane.edges.station_m.size - 1)
    known = np.isfinite(line.own_m)
    return _Side(
        np.where(known, line.own_m, sign * edge.away_m[at]), np.where(known, line.sigma_m, edge.sigma_m[at])
    )  # fmt: skip


def _width(sides: dict[str, _Side]) -> tuple[float, float, float]:
    """Mean width, standard deviation (errors along the section are taken as fully correlated), and known share."""
    left, right = sides["left"], sides["right"]
    width = right.own_m - left.own_m
    known = np.isfinite(width) & (width > 0.0)
    if not known.any():
        return math.nan, math.nan, 0.0
    sigma = np.hypot(left.sigma_m, right.sigma_m)[known]
    return float(width[known].mean()), float(np.sqrt(np.mean(sigma**2))), float(known.mean())


_MM: Final = 1e3  # Millimetres in a metre.


def _of_side(side: str) -> tuple[Quantity, ...]:
    return (
        Quantity(f"shoulder_{side}_m", "m", f"Width between the lane's {side} border and the road's edge"),
        Quantity(f"shoulder_mean_{side}_m", "m", "The same, mean over the section"),
        Quantity(f"edge_drop_{side}_mm", "mm", f"Height of the road's {side} edge above the ground beside it"),
        Quantity(f"edge_drop_mean_{side}_mm", "mm", "The same, mean over the section"),
        Quantity(f"edge_drop_max_{side}_mm", "mm", "The same, greatest of the section"),
    )


class RoadWidth(ConditionIndex):
    """Width of road and shoulders, and edge drop-off."""

    name: ClassVar[str] = "road_width"
    title: ClassVar[str] = "width of the road's surface and of shoulders, drops at its edges"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("road_width_m", "m", "Width of the road's surface from edge to edge"),
        Quantity("road_width_mean_m", "m", "The same, mean over the section"),
        *_of_side("left"),
        *_of_side("right"),
    )

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return values each half metre, and of sections; none where no edges are requested."""
        if lane.edges is None:
            return
        left, right = (lane.edges.sides[side] for side in ("left", "right"))
        station = lane.edges.station_m
        width = _held("road_width_m", station, left.away_m + right.away_m, np.hypot(left.sigma_m, right.sigma_m))
        yield from _both(width, lane, (("road_width_mean_m", "mean"),))
        for name, side in lane.edges.sides.items():
            if not side.beside:
                continue
            shoulder = _held(f"shoulder_{name}_m", station, side.away_m - 0.5 * lane.width_m, side.sigma_m)
            yield from _both(shoulder, lane, ((f"shoulder_mean_{name}_m", "mean"),))
            drop = _held(f"edge_drop_{name}_mm", station, _MM * side.drop_m, _MM * side.sigma_drop_m)
            yield from _both(drop, lane, ((f"edge_drop_mean_{name}_mm", "mean"), (f"edge_drop_max_{name}_mm", "max")))


def _held(quantity: str, station: Float64, value: Float64, sigma: Float64) -> PerCrossSection:
    known = np.isfinite(value)
    return PerCrossSection(quantity, station, value, np.where(known, sigma, np.nan), known.astype(np.float64))


def _both(held: PerCrossSection, lane: LaneData, wanted: Sequence[tuple[str, How]]) -> Iterator[Value]:
    """Return values of the places where there is one, and of sections."""
    yield from (one for one in held.values() if math.isfinite(one.value))
    yield from by_section(held, lane, wanted, STATION_M)
