"""Road markings in pictures: the colour of the paint."""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely

from roadscan.assets.kind import AssetObject
from roadscan.assets.pictures.paint_colours import PaintReader
from roadscan.assets.pictures.reader import ColourPlaces
from roadscan.compute.array_types import Float64

_INSIDE_M: Final = 0.05  # Places lie this far within the outline (m).
_BESIDE_M: Final = 0.3  # Distance from the outline to the places on the surface (m).
_MOST_PLACES: Final = 200  # Places of a marking, at most.


class RoadMarkingReader(PaintReader):
    """Road markings: places within the outline, and around it."""

    name = "road_marking"

    def places(self, one: AssetObject) -> ColourPlaces:
        """Returns a grid of 0.1 m or more within the outline, and places around it."""
        flat = shapely.force_2d(one.geometry)
        inner = flat.buffer(-_INSIDE_M)
        inner = flat if inner.is_empty else inner
        step = max(0.1, float(np.sqrt(inner.area / _MOST_PLACES)))
        west, south, east, north = inner.bounds
        grid = np.stack(np.meshgrid(np.arange(west + step / 2, east, step), np.arange(south + step / 2, north, step)))
        places = grid.reshape(2, -1).T
        own = places[shapely.contains_xy(inner, places)]
        ring = flat.buffer(_BESIDE_M).exterior
        count = min(max(int(ring.length / 0.2), 8), _MOST_PLACES)
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
