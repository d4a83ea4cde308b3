"""Finds painted lines along the borders of a lane, from the intensities of cells across them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.compute.edges.painted_line import painted_line, without_lines
from roadscan.condition.kernels.sampling import CellTable, mean_intensities
from roadscan.condition.road_line import Lane, RoadLine

SPACING_M: Final = 0.5
"""Distance between the places along the lane at which lines are sought; intensities are means over it."""
LINE_REACH_M: Final = 1.2
"""Distance beyond the border of a lane up to which intensities are used."""
_STEP_M: Final = 0.025  # Spacing of intensities across the lane.
_BESIDE_M: Final = 0.8
"""Largest distance of a line from the border, inside and outside."""
_SIDES: Final = {"left": -1.0, "right": 1.0}  # Signs of offsets.


@dataclass(frozen=True, eq=False)
class LaneLines:
    """Painted lines beside a lane, one row for each place where one was seen."""

    station_m: Float64
    """(n,)"""
    side: tuple[str, ...]
    """(n,) left or right in the direction of travel."""
    own_m: Float64
    """(n,) offset of the line's middle from the lane's middle, positive to the right in the direction of travel."""
    width_m: Float64
    """(n,) of the line."""
    contrast: Float64
    """(n,) by how much it is brighter than the road beside it (share of its intensity)."""


def lane_lines(table: CellTable, line: RoadLine, lane: Lane, between_m: tuple[float, float]) -> LaneLines:
    """Return painted lines beside a lane at multiples of 0.5 m of station in [from, to)."""
    first, end = (math.ceil(one / SPACING_M - 1e-9) for one in between_m)
    station: Float64 = SPACING_M * np.arange(first, end, dtype=np.float64)
    half = 0.5 * lane.width_m
    away: Float64 = np.arange(max(half - LINE_REACH_M, 0.1), half + LINE_REACH_M, _STEP_M)
    half_across = 0.5 * max(_STEP_M, float(table.cell.max()))
    rows: list[tuple[float, str, float, float, float]] = []
    for name, side in _SIDES.items():
        every = np.repeat(station, away.size)
        places = line.places(every, lane.offsets(every, np.tile(side * away, station.size)))
        grey = np.empty(every.size)
        mean_intensities(table, places, 0.5 * SPACING_M, half_across, grey)
        across = grey.reshape(station.size, away.size)
        surface = without_lines(across, _STEP_M)
        for at, own, under in zip(station.tolist(), across, surface, strict=True):
            found = painted_line(own, under, away)
            if found is not None and abs(found.middle_m - half) <= _BESIDE_M:
                rows.append((at, name, side * found.middle_m, found.width_m, found.contrast))
    rows.sort()
    held = [np.array([row[k] for row in rows], np.float64) for k in (0, 2, 3, 4)]
    return LaneLines(held[0], tuple(row[1] for row in rows), *held[1:])
