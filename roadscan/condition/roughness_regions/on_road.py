"""Sections of a road for roughness regions: points from cells on the lanes between two stations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.condition.road_line import Lane, RoadLine
from roadscan.condition.roughness_regions.intensity import normalised_intensity
from roadscan.condition.roughness_regions.points import RoadPoints
from roadscan.condition.roughness_regions.regions import SectionRegions, find_regions
from roadscan.condition.roughness_regions.settings import RoughnessRegionsConfig
from roadscan.tiles.cells import TileCells

Float64 = npt.NDArray[np.float64]

_FINER: Final = 4.0
"""Survey cells are joined to blocks of at most this fraction of a raster cell: closer points add no information."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """A piece of a road."""

    line: RoadLine
    lanes: tuple[Lane, ...]
    from_m: float
    to_m: float


def points_of(
    cells: TileCells, corner_m: tuple[float, float], survey_cell_m: float, raster_cell_m: float
) -> RoadPoints:
    """Return the cells of a tile as points: blocks of cells, each with the means of its readings.

    corner_m : easting and northing of the tile's south-west corner.
    """
    wide = max(1, int(raster_cell_m / _FINER / survey_cell_m + 1e-9))
    across = -(-cells.cells_per_edge // wide)
    block = (cells.row.astype(np.int64) // wide) * across + cells.column.astype(np.int64) // wide
    number, inverse = np.unique(block, return_inverse=True)
    count = cells.count.astype(np.float64)
    readings = np.bincount(inverse, count, number.size)

    def mean(values: npt.NDArray[np.generic]) -> Float64:
        found: Float64 = np.bincount(inverse, count * values.astype(np.float64), number.size) / readings
        return found

    easting = corner_m[0] + survey_cell_m * (mean(cells.column) + 0.5)
    northing = corner_m[1] + survey_cell_m * (mean(cells.row) + 0.5)
    base = float(cells.height_robust_m[0]) if len(cells) else 0.0
    height = base + mean(cells.height_robust_m - base)
    return RoadPoints.of(easting, northing, height, mean(cells.intensity_mean), readings)


def section_regions(points: Sequence[RoadPoints], piece: Stretch, settings: RoughnessRegionsConfig) -> SectionRegions:
    """Find the roughness regions of one section of a road.

    Parameters
    ----------
    points : of the tiles on its way, on the map; piece : the section, with its line and lanes a little longer.
    """
    middle = piece.line.places(np.array([0.5 * (piece.from_m + piece.to_m)]), 0.0)[0]
    origin = (float(middle[0]), float(middle[1]))
    heading = float(np.arctan2(middle[2], middle[3]))
    joined = RoadPoints.of(*(np.concatenate([getattr(p, n) for p in points] or [np.empty(0)]) for n in _COLUMNS))
    reach = np.hypot(piece.to_m - piece.from_m, settings.width_m)
    joined = joined.take(np.hypot(joined.x_m - origin[0], joined.y_m - origin[1]) <= reach)
    station, offset = piece.line.along(np.column_stack([joined.x_m, joined.y_m]), 0.5 * (piece.from_m + piece.to_m))
    own = (station >= piece.from_m) & (station < piece.to_m) & (np.abs(offset) <= settings.width_m / 2)
    from_lane = np.full(station.size, np.inf)
    on_lane = np.zeros(station.size, bool)
    for lane in piece.lanes:
        away = np.abs(offset - lane.offsets(station))
        from_lane = np.minimum(from_lane, away)
        on_lane |= (away <= lane.width_m / 2) & (station >= lane.first_m) & (station <= lane.last_m + 1.0)
    own &= on_lane if settings.road == "lanes" else True
    kept = joined.take(own)
    if settings.sensor_height_m is not None:
        height = settings.sensor_height_m
        reach_m, incidence = np.hypot(from_lane[own], height), np.arctan2(from_lane[own], height)
        level = normalised_intensity(kept.intensity, reach_m, incidence, height)
        kept = RoadPoints(kept.x_m, kept.y_m, kept.height_m, level, kept.readings)
    return find_regions(kept, origin, heading, settings)


_COLUMNS: Final = ("x_m", "y_m", "height_m", "intensity", "readings")


def station_and_offset(line: RoadLine, place_m: tuple[float, float], guess_m: float) -> tuple[float, float]:
    """Return station and offset of a place near a station."""
    station, offset = line.along(np.array([place_m]), guess_m)
    return float(station[0]), float(offset[0])
