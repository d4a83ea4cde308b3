"""Type of a marking, by its shape and its direction relative to the road."""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely

from roadscan.compute.array_types import Float64

_MARKER_M: Final = 0.30  # Largest marker (m).
_BAR_ALONG_M: Final = (0.15, 1.0)  # Extent of a bar along the road (m).
_BAR_ACROSS_M: Final = 1.0  # Least extent of a bar across the road (m).
_BAR_FILLED: Final = 0.7  # Least share of its rectangle that a bar covers.
_ARROW_ALONG_M: Final = (1.2, 8.0)  # Extent of an arrow along the road (m).
_ARROW_ACROSS_M: Final = (0.25, 2.5)  # Extent of an arrow across the road (m).
_HEAD_TO_SHAFT: Final = 1.6  # Least ratio of an arrow's head to its shaft.
_SLICES: Final = 12  # Slices along a shape whose widths are compared.
_SYMBOL_M: Final = 6.0
"""Larger shapes (m) are areas."""


def type_of(outline: shapely.Geometry, road_rad: float) -> str:
    """Returns the type of a polygon in the map, where the road runs in a direction (rad, anticlockwise from east)."""
    turned = _turned(outline, road_rad)
    along_min, across_min, along_max, across_max = turned.bounds
    along, across = along_max - along_min, across_max - across_min
    if max(along, across) <= _MARKER_M:
        return "raised_marker"
    filled = outline.area / max(shapely.minimum_rotated_rectangle(outline).area, 1e-9)
    if (
        _BAR_ALONG_M[0] <= along <= _BAR_ALONG_M[1]
        and across >= max(_BAR_ACROSS_M, 2.0 * along)
        and filled >= _BAR_FILLED
    ):
        return "stop_bar"
    if _is_arrow(turned):
        return "arrow"
    return "symbol" if max(along, across) <= _SYMBOL_M else "area"


def _is_arrow(turned: shapely.Geometry) -> bool:
    """Returns True for a slim shaft along x with one wide end."""
    x_min, y_min, x_max, y_max = turned.bounds
    along, across = x_max - x_min, y_max - y_min
    slim = _ARROW_ALONG_M[0] <= along <= _ARROW_ALONG_M[1] and _ARROW_ACROSS_M[0] <= across <= _ARROW_ACROSS_M[1]
    if not slim or along < 1.2 * across:
        return False
    widths = _widths(turned)
    half = _SLICES // 2
    ends = float(widths[:half].max()), float(widths[half:].max())
    shaft = float(np.median(widths))
    other = float(np.median(widths[half:] if ends[0] > ends[1] else widths[:half]))
    return shaft > 0.0 and max(ends) >= _HEAD_TO_SHAFT * shaft and min(ends) <= 1.35 * max(other, 0.05)


def _widths(turned: shapely.Geometry) -> Float64:
    """Returns the painted width of slices along x."""
    x_min, y_min, x_max, y_max = turned.bounds
    edges = np.linspace(x_min, x_max, _SLICES + 1)
    slices = shapely.box(edges[:-1], y_min, edges[1:], y_max)
    return np.asarray(shapely.area(shapely.intersection(slices, turned)) / np.diff(edges))


def _turned(outline: shapely.Geometry, road_rad: float) -> shapely.Geometry:
    """Returns the outline with the road's direction along x."""
    cos, sin = np.cos(road_rad), np.sin(road_rad)
    turn = np.array([[cos, -sin], [sin, cos]])
    middle = shapely.get_coordinates(outline.centroid)
    return shapely.transform(shapely.force_2d(outline), lambda xy: (xy - middle) @ turn)
