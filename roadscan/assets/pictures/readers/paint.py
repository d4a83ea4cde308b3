"""Lane lines and road markings in pictures: the colour of the paint, white or yellow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import shapely

from roadscan.assets.kind import AssetObject
from roadscan.assets.pictures.reader import ColourPlaces, ColourReader
from roadscan.compute.array_types import Float64, UInt8
from roadscan.compute.robust import scatter_about

_LEAST_PLACES: Final = 5  # Least number of places of paint, and of surface.
_BRIGHTER: Final = 1.15
"""Paint no brighter than this multiple of the surface beside it is worn, or was missed."""
_BETWEEN: Final = 0.82
"""Blue over the mean of red and green, of paint relative to the surface: white paint is near 1, yellow below 0.65."""
_SPREAD: Final = 0.10  # Systematic 1 σ of that ratio.


class PaintReader(ColourReader):
    """A reader of the colour of paint; each kind chooses its places."""

    def read(self, own: UInt8, beside: UInt8) -> Mapping[str, Any]:
        """Columns colour and colour_probability."""
        return paint_colour(own, beside)


def paint_colour(own: UInt8, beside: UInt8) -> Mapping[str, Any]:
    """Columns `colour` and `colour_probability` from colours (n, 3) of paint and (m, 3) of the surface beside it.

    Asphalt and concrete are grey, so dividing by the surface's colour removes the light and the camera's white
    balance. Blue against red and green then distinguishes white from yellow, by the median over the places. There is no
    colour if fewer than five places are brighter than the surface, or if the picture has no colours.
    """
    if len(own) < _LEAST_PLACES or len(beside) < _LEAST_PLACES or _is_grey(own, beside):
        return {}
    surface = np.maximum(np.median(_linear(beside), axis=0), 1e-4)
    relative = _linear(own) / surface
    bright = relative[:, :2].mean(axis=1) >= _BRIGHTER
    if np.count_nonzero(bright) < _LEAST_PLACES:
        return {}
    blue = relative[bright, 2] / relative[bright, :2].mean(axis=1)
    middle = float(np.median(blue))
    sigma = np.hypot(_SPREAD, scatter_about(blue, middle) / np.sqrt(len(blue)))
    yellow = 1.0 / (1.0 + np.exp(2.0 * (middle - _BETWEEN) / sigma))
    name, share = ("yellow", yellow) if yellow > 0.5 else ("white", 1.0 - yellow)
    return {"colour": name, "colour_probability": float(share)}


def _linear(colours: UInt8) -> Float64:
    """Returns linear light (IEC 61966-2-1) of colours (n, 3)."""
    c = colours.astype(np.float64) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _is_grey(own: UInt8, beside: UInt8) -> bool:
    both = np.concatenate([own, beside])
    return bool((np.ptp(both, axis=1) <= 1).all())


_STEP_M: Final = 0.5  # Distance of places along a line (m).
_MOST_PLACES_OF_LINE: Final = 400  # Places of a line, at most.
_BESIDE_LINE_M: Final = 0.35
"""Distance from the edge of the paint to the places on the surface (m)."""


class LaneLineReader(PaintReader):
    """Lane lines: places along the line, and beside it on both sides."""

    name = "lane_line"

    def places(self, one: AssetObject) -> ColourPlaces:
        """Returns a place each half metre of the line; of a long line 400 places."""
        length = float(shapely.length(one.geometry))
        count = min(max(int(length / _STEP_M), 1), _MOST_PLACES_OF_LINE)
        at = (np.arange(count) + 0.5) * length / count
        own = _along(one.geometry, at)
        way = _along(one.geometry, np.minimum(at + 0.1, length)) - _along(one.geometry, np.maximum(at - 0.1, 0.0))
        across = np.column_stack([way[:, 1], -way[:, 0]])
        across /= np.maximum(np.hypot(*across.T), 1e-9)[:, None]
        width = one.attributes.get("width_m") or 0.12
        aside = np.column_stack([across * (width / 2 + _BESIDE_LINE_M), np.zeros(count)])
        if str(one.attributes.get("type", "")).startswith(("double", "solid_")):
            apart = np.column_stack([across * width, np.zeros(count)])  # the line is midway between two
            return ColourPlaces(np.vstack([own + apart, own - apart]), np.vstack([own + 2 * aside, own - 2 * aside]))
        return ColourPlaces(own, np.vstack([own + aside, own - aside]))


def _along(line: shapely.LineString, at_m: Float64) -> Float64:
    points = shapely.line_interpolate_point(line, at_m)
    return np.asarray(shapely.get_coordinates(points, include_z=True))


_INSIDE_M: Final = 0.05  # Places lie this far within the outline (m).
_BESIDE_MARKING_M: Final = 0.3  # Distance from the outline to the places on the surface (m).
_MOST_PLACES_OF_MARKING: Final = 200  # Places of a marking, at most.


class RoadMarkingReader(PaintReader):
    """Road markings: places within the outline, and around it."""

    name = "road_marking"

    def places(self, one: AssetObject) -> ColourPlaces:
        """Returns a grid of 0.1 m or more within the outline, and places around it."""
        flat = shapely.force_2d(one.geometry)
        inner = flat.buffer(-_INSIDE_M)
        inner = flat if inner.is_empty else inner
        step = max(0.1, float(np.sqrt(inner.area / _MOST_PLACES_OF_MARKING)))
        west, south, east, north = inner.bounds
        grid = np.stack(np.meshgrid(np.arange(west + step / 2, east, step), np.arange(south + step / 2, north, step)))
        places = grid.reshape(2, -1).T
        own = places[shapely.contains_xy(inner, places)]
        ring = flat.buffer(_BESIDE_MARKING_M).exterior
        count = min(max(int(ring.length / 0.2), 8), _MOST_PLACES_OF_MARKING)
        around = shapely.get_coordinates(
            shapely.line_interpolate_point(ring, np.arange(count) / count, normalized=True)
        )
        return ColourPlaces(_with_heights(own, one), _with_heights(around, one))


def _with_heights(places_m: Float64, one: AssetObject) -> Float64:
    """Returns places (n, 3) with the height of the plane through the outline's corners."""
    corners = shapely.get_coordinates(one.geometry, include_z=True)
    middle = corners.mean(axis=0)
    plane = np.linalg.lstsq(corners[:, :2] - middle[:2], corners[:, 2] - middle[2], rcond=None)[0]
    return np.column_stack([places_m, middle[2] + (places_m - middle[:2]) @ plane])
