"""Outlines of symbols painted on lanes: arrows, a triangle, a diamond, a bicycle."""

from __future__ import annotations

import math

import numpy as np
import shapely
from shapely import Geometry, LineString, Point, Polygon

from roadscan.simulate.scene.road import Symbol

_STRIP_M = 0.02
"""Width of the strips that a symbol is cut into, across the road (m)."""
_HALF_M = 0.075
"""Half width of the lines of a bicycle, a triangle and a diamond (m)."""


def strips(symbol: Symbol) -> list[tuple[float, float, float, float]]:
    """Return rectangles that cover a symbol: station and offset of the middle, half the extent along and across (m)."""
    outline = outline_of(symbol)
    low, _, high, _ = outline.bounds
    count = math.ceil((high - low) / _STRIP_M)
    edges = np.linspace(low, high, count + 1)
    half = float(edges[1] - edges[0]) / 2
    out = []
    for middle in (edges[:-1] + half).tolist():
        cut = outline.intersection(LineString([(middle, -9.0), (middle, 9.0)]))
        for part in shapely.get_parts(cut):
            _, left, _, right = part.bounds
            if right > left:
                at = symbol.station_m + middle, symbol.offset_m + (left + right) / 2
                out.append((*at, half, (right - left) / 2))
    return out


def outline_of(symbol: Symbol) -> Geometry:
    """Return the outline about the symbol's middle: x along the road, y to the right (m)."""
    own = _drawn(symbol)
    return own if symbol.facing == "forward" else shapely.transform(own, lambda xy: -xy)


def _drawn(symbol: Symbol) -> Geometry:
    """Return the symbol as the driver reads it: x ahead, y to the right."""
    length, width, shaft = symbol.length_m, symbol.width_m, symbol.line_m
    if symbol.shape == "bicycle":
        return _bicycle(length, width)
    if symbol.shape == "triangle":
        return _rim([(length / 2, -width / 2), (length / 2, width / 2), (-length / 2, 0.0)])
    if symbol.shape == "diamond":
        return _rim([(-length / 2, 0.0), (0.0, -width / 2), (length / 2, 0.0), (0.0, width / 2)])
    if symbol.shape == "ahead":
        return _head((length / 2, 0.0), (1.0, 0.0), symbol.head_m, width).union(
            _bar((-length / 2, 0.0), (length / 2 - symbol.head_m * 0.9, 0.0), shaft)
        )
    own = _turn(length, width, shaft, symbol.head_m, ahead=symbol.shape.startswith("ahead"))
    return shapely.transform(own, lambda xy: xy * [1.0, -1.0]) if symbol.shape.endswith("right") else own


def _turn(length: float, width: float, shaft: float, head: float, *, ahead: bool) -> Geometry:
    """Return an arrow to the left, with one ahead where wanted: its shaft lies at the right."""
    wide = 0.45 * length if not ahead else 0.3 * length
    at = width / 2 - (wide / 4 if ahead else shaft / 2)
    turns = length / 2 - wide / 2 if not ahead else 0.0
    parts = [
        _bar((-length / 2, at), (turns, at), shaft),
        _bar((turns, at + shaft / 2), (turns, -width / 2 + head * 0.9), shaft),
        _head((turns, -width / 2), (0.0, -1.0), head, wide),
    ]
    if ahead:
        parts += [_bar((turns, at), (length / 2 - 0.3 * length, at), shaft),
                  _head((length / 2, at), (1.0, 0.0), 0.32 * length, wide / 2)]  # fmt: skip
    return shapely.union_all(parts)


def _bar(start: tuple[float, float], end: tuple[float, float], width: float) -> Geometry:
    return LineString([start, end]).buffer(width / 2, cap_style="flat")


def _head(tip: tuple[float, float], to: tuple[float, float], long: float, wide: float) -> Geometry:
    """Return a triangle with its tip at a place, pointing in a direction."""
    (x, y), (u, v) = tip, to
    back = x - u * long, y - v * long
    return Polygon(
        [tip, (back[0] - v * wide / 2, back[1] + u * wide / 2), (back[0] + v * wide / 2, back[1] - u * wide / 2)]
    )


def _rim(corners: list[tuple[float, float]]) -> Geometry:
    whole = Polygon(corners)
    return whole.difference(whole.buffer(-2.0 * _HALF_M, join_style="mitre"))


def _bicycle(length: float, width: float) -> Geometry:
    """Return two wheels, side by side, and a frame above them, stretched along the road."""
    tall = length / (width * 0.62)
    wheel = width / 4
    left, right, line = (0.0, -wheel), (0.0, wheel), 1.6 * _HALF_M / tall
    wheels = [Point(p).buffer(wheel).difference(Point(p).buffer(wheel - line)) for p in (left, right)]
    top = 0.9 * wheel
    saddle, handlebar = (1.25 * top, -0.45 * wheel), (1.4 * top, 0.55 * wheel)
    head, pedals = (top, 0.7 * wheel), (0.0, 0.0)
    frame = [[left, (top, -0.35 * wheel), head, right], [pedals, head], [pedals, saddle], [left, pedals],
             [head, handlebar]]  # fmt: skip
    lines = [LineString(one).buffer(_HALF_M / math.sqrt(tall)) for one in frame]
    drawn = shapely.union_all(wheels + lines)
    low, _, high, _ = drawn.bounds
    scale = length / (high - low)
    return shapely.transform(drawn, lambda xy: np.column_stack([(xy[:, 0] - (low + high) / 2) * scale, xy[:, 1]]))
