"""Samples a stretch of lane from cells: wheel paths, cross-sections, texture, and lines beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.sampling import CellTable, sample
from roadscan.condition.lane_data import LINE_REACH_M, LaneLines, TextureSquares, lane_lines, texture_squares
from roadscan.condition.road_line import Lane, RoadLine
from roadscan.condition.settings import SectionConfig

SIDES: Final = {"left": -1.0, "right": 1.0}
"""Wheel paths, with the side of the lane's middle on which they lie, in the direction of travel."""
_LEAST_CELLS: Final = 1.5
"""Least number of cells in half of a profile's window, each way."""
_LEAST_CELLS_ACROSS: Final = 2.0
"""The same for a cross-section, whose surface may bend."""
_CROSS_HALF_M: Final = 0.075
"""Half of the length along the road over which a cross-section is smoothed (m)."""


@dataclass(frozen=True, eq=False)
class PathHeights:
    """Heights along a wheel path."""

    station_m: Float64
    """(n,)"""
    offset_m: Float64
    """(n,) from the reference line, positive to the right."""
    places: Float64
    """(n, 4) easting, northing (m), direction."""
    values: Float64
    """(n, 3) height (m), its standard deviation (m), and the share of the window that cells cover."""


@dataclass(frozen=True, eq=False)
class CrossHeights:
    """Heights of cross-sections."""

    station_m: Float64
    """(n,)"""
    middle_offset_m: Float64
    """(n,) offset of the lane's middle from the reference line, positive to the right."""
    places: Float64
    """(n, 4) easting, northing of the lane's middle (m), direction."""
    offset_m: Float64
    """(m,) offset from the lane's middle, positive to the right in the direction of travel."""
    base_m: Float64
    """(n,) height from which the others count."""
    height_m: Float64
    """(n, m)"""
    sigma_m: Float64
    """(n, m)"""


@dataclass(frozen=True, eq=False)
class LaneHeights:
    """Heights and features of a stretch."""

    paths: Mapping[str, PathHeights]
    cross: CrossHeights
    texture: TextureSquares
    lines: LaneLines


def windows_m(config: SectionConfig, cell_m: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return half of the windows' extents along and across (m): of a profile's heights, and of a cross-section's."""
    least, across = _LEAST_CELLS * cell_m, _LEAST_CELLS_ACROSS * cell_m
    profile = max(config.profile_spacing_m, least), max(config.wheel_path_width_m / 2, least)
    cross = max(_CROSS_HALF_M, across), max(1.5 * config.cross_section_step_m, across)
    return profile, cross


def window_m2(config: SectionConfig, cell_m: float) -> float:
    """Return the variance along the road of the window of a profile's height (m²): of its weights, and of its cells."""
    (along, _), _ = windows_m(config, cell_m)
    return along * along / 6.0 + cell_m * cell_m / 12.0


def reach_m(config: SectionConfig, cell_m: float) -> float:
    """Return how far beyond a lane's border, and before and behind a place, results depend on cells (m)."""
    of_heights = max(math.hypot(*half) for half in windows_m(config, cell_m)) + cell_m
    return max(of_heights, LINE_REACH_M + cell_m)


def survey_lane(
    table: CellTable, line: RoadLine, lane: Lane, between_m: tuple[float, float], config: SectionConfig
) -> LaneHeights:
    """Sample heights of a lane's wheel paths and cross-sections at stations in [from, to).

    Parameters
    ----------
    table : cells of all tiles within reach; line, lane : at least as long as the stretch.
    """
    cell_m = float(table.cell[0])
    profile, across = windows_m(config, cell_m)
    station = _multiples(config.profile_spacing_m, between_m)
    paths = {}
    for name, side in SIDES.items():
        offset = lane.offsets(station, side * config.wheel_paths_m)
        places = line.places(station, offset)
        paths[name] = PathHeights(station, offset, places, _heights(table, places, profile, config))
    every = _multiples(config.cross_section_spacing_m, between_m)
    return LaneHeights(
        paths, _cross_heights(table, line, lane, every, config, across), texture_squares(table, line, lane, between_m),
        lane_lines(table, line, lane, between_m),
    )  # fmt: skip


def _cross_heights(
    table: CellTable, line: RoadLine, lane: Lane, station: Float64, config: SectionConfig, half_m: tuple[float, float]
) -> CrossHeights:
    count = 2 * int(lane.width_m / 2 / config.cross_section_step_m + 1e-6) + 1
    own = config.cross_section_step_m * (np.arange(count, dtype=np.float64) - count // 2)
    every = np.repeat(station, count)
    places = line.places(every, lane.offsets(every, np.tile(own, station.size)))
    values = _heights(table, places, half_m, config, bend=True)
    height = values[:, 0].reshape(station.size, count)
    known = ~np.isnan(height)
    first = np.argmax(known, axis=1)
    base = np.where(known.any(axis=1), height[np.arange(station.size), first], 0.0)
    middle = lane.offsets(station)
    return CrossHeights(
        station, middle, line.places(station, middle), own, base, height - base[:, None],
        values[:, 1].reshape(station.size, count),
    )  # fmt: skip


def _heights(
    table: CellTable, places: Float64, half_m: tuple[float, float], config: SectionConfig, *, bend: bool = False
) -> Float64:
    """Return heights (n, 3) at places, see :func:`roadscan.condition.kernels.sampling.sample`.

    Errors of neighbours on a reconstructed surface are correlated, so their scatter does not show the errors.
    """
    values = np.empty((len(places), 3))
    sample(table, places, *half_m, bend, values)
    if config.heights == "surface":
        values[:, 1] = np.nan
    return values


def _multiples(spacing_m: float, between_m: tuple[float, float]) -> Float64:
    """Return multiples of a spacing in [from, to)."""
    first, end = (math.ceil(one / spacing_m - 1e-9) for one in between_m)
    stations: Float64 = spacing_m * np.arange(first, end, dtype=np.float64)
    return stations
