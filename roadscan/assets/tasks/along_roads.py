"""Position of assets along the roads: road, station, offset and lane of their reference points."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.condition.road_line import Lane
from roadscan.condition.tasks.lines import Roads

_BESIDE_M: Final = 50.0
"""Assets farther from all lines (m) have no road."""
_BEYOND_M: Final = 1.0
"""Stations count this far beyond a line's ends (m)."""


class Along(NamedTuple):
    """Positions of n places along the roads; None and NaN where there is none."""

    road: list[str | None]
    station_m: npt.NDArray[np.float64]
    offset_m: npt.NDArray[np.float64]
    lane: list[int | None]


def along_roads(places_m: npt.NDArray[np.float64], roads: Roads) -> Along:
    """Road, station, offset and lane of places (n, 2) on the map (m), relative to the nearest reference line."""
    count = len(places_m)
    road: list[str | None] = [None] * count
    lane: list[int | None] = [None] * count
    station, offset = np.full(count, np.nan), np.full(count, np.nan)
    lines = [line for _, line in sorted(roads.lines.items())]
    if not (count and lines):
        return Along(road, station, offset, lane)
    drawn = [shapely.LineString(line.nodes_m) for line in lines]
    points = shapely.points(places_m)
    away = np.stack([shapely.distance(one, points) for one in drawn])
    nearest = np.argmin(away, axis=0)
    for number, line in enumerate(lines):
        own = np.flatnonzero((nearest == number) & (away[number] <= _BESIDE_M))
        guess = line.first_m + shapely.line_locate_point(drawn[number], points[own])
        at, beside = line.along(places_m[own], guess)
        held = (at >= line.first_m - _BEYOND_M) & (at <= line.first_m + line.length_m + _BEYOND_M)
        held &= np.abs(np.abs(beside) - away[number][own]) < _BEYOND_M
        own, at, beside = own[held], at[held], beside[held]
        station[own], offset[own] = at, beside
        lanes = [one for one in roads.lanes if one.road == line.road]
        for row, s, o in zip(own.tolist(), at, beside, strict=True):
            road[row], lane[row] = line.road, _lane(lanes, float(s), float(o))
    return Along(road, station, offset, lane)


def _lane(lanes: list[Lane], station_m: float, offset_m: float) -> int | None:
    """Returns the number of a place's lane: its name where that is a number, else counted from the left."""
    for number, one in enumerate(lanes, 1):
        if one.first_m <= station_m <= one.last_m:
            middle = float(one.offsets(np.array([station_m]))[0])
            if abs(offset_m - middle) <= one.width_m / 2:
                return int(one.name) if one.name.isdecimal() else number
    return None
