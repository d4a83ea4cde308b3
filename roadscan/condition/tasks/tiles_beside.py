"""Selects tiles beside a piece of a road."""

from __future__ import annotations

import numpy as np
import shapely

from roadscan.condition.road_line import RoadLine
from roadscan.core.grid import Bounds, TileGrid
from roadscan.core.ids import TileId


def tiles_beside(line: RoadLine, from_m: float, to_m: float, away_m: float, grid: TileGrid) -> list[TileId]:
    """Return tiles within a distance of a line between two stations, by row and column."""
    station = np.arange(from_m, to_m + 1.0)
    strip = shapely.LineString(line.places(station, 0.0)[:, :2]).buffer(away_m)
    boxes = [(t, grid.bounds(t)) for t in grid.tiles_in(Bounds(*strip.bounds))]
    shapes = [shapely.box(b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m) for _, b in boxes]
    return [t for (t, _), shape in zip(boxes, shapes, strict=True) if strip.intersects(shape)]
