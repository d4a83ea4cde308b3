"""Lane lines in pictures: the colour of the paint."""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely

from roadscan.assets.kind import AssetObject
from roadscan.assets.pictures.paint_colours import PaintReader
from roadscan.assets.pictures.reader import ColourPlaces
from roadscan.compute.array_types import Float64

_STEP_M: Final = 0.5  # Distance of places along a line (m).
_MOST_PLACES: Final = 400  # Places of a line, at most.
_BESIDE_M: Final = 0.35
"""Distance from the edge of the paint to the places on the surface (m)."""


class LaneLineReader(PaintReader):
    """Lane lines: places along the line, and beside it on both sides."""

    name = "lane_line"

    def places(self, one: AssetObject) -> ColourPlaces:
        """Returns a place each half metre of the line; of a long line 400 places."""
        length = float(shapely.length(one.geometry))
        count = min(max(int(length / _STEP_M), 1), _MOST_PLACES)
        at = (np.arange(count) + 0.5) * length / count
        own = _along(one.geometry, at)
        way = _along(one.geometry, np.minimum(at + 0.1, length)) - _along(one.geometry, np.maximum(at - 0.1, 0.0))
        across = np.column_stack([way[:, 1], -way[:, 0]])
        across /= np.maximum(np.hypot(*across.T), 1e-9)[:, None]
        width = one.attributes.get("width_m") or 0.12
        aside = np.column_stack([across * (width / 2 + _BESIDE_M), np.zeros(count)])
        if str(one.attributes.get("type", "")).startswith(("double", "solid_")):
            apart = np.column_stack([across * width, np.zeros(count)])  # the line is midway between two
            return ColourPlaces(np.vstack([own + apart, own - apart]), np.vstack([own + 2 * aside, own - 2 * aside]))
        return ColourPlaces(own, np.vstack([own + aside, own - aside]))


def _along(line: shapely.LineString, at_m: Float64) -> Float64:
    points = shapely.line_interpolate_point(line, at_m)
    return np.asarray(shapely.get_coordinates(points, include_z=True))
