"""Where the benchmarks' vehicle drives: a road oblique to the grid, gently curved and graded; every kilometre alike."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyproj

Float64 = npt.NDArray[np.float64]

CRS = "EPSG:25832"
GEODETIC = "EPSG:4258"
"""Latitude and longitude in the datum of the map, so that no change of datum adds an error."""
WEEK = 2405
DATE = "2026-02-09"
START_S = 100_000.0
"""Second of the GPS week at station 0: 03:46:22 UTC on :data:`DATE`."""
HOUR_UTC = 3
START_GPS_NS = int((WEEK * 604_800 + START_S) * 1e9)
LEAP_S = 18
IMU_HEIGHT_M = 1.4
CROSSFALL = 0.025

_LEAD_S = 1.0
_ORIGIN_M = (563_210.0, 5_934_870.0)
_HEIGHT_M = 87.0
_HEADING = math.radians(37.0)
_TURN = math.radians(6.0)
_PERIOD_M = 500.0
"""Divides a kilometre: each has the same curves, and about as many tiles."""
_GRADE = 0.02
_HEAVE_M = 0.004
_HEAVE_PER_S = 1.5
_STEPS = 8
"""Of the integration, between two poses."""


@dataclass(frozen=True)
class Course:
    """A drive at even speed."""

    speed_m_per_s: float
    length_m: float
    start_s: float = START_S
    """Second of the GPS week at station 0."""
    poses_per_s: int = 200

    def write_sbet(self, file: Path) -> None:
        """Write exact poses, from a second before station 0 to a second after the end."""
        poses = round((self.length_m / self.speed_m_per_s + 2 * _LEAD_S) * self.poses_per_s) + 1
        since_start_s = np.arange(poses) / self.poses_per_s - _LEAD_S
        station_m = since_start_s * self.speed_m_per_s
        easting, northing = self._places(poses)
        to_geodetic = pyproj.Transformer.from_crs(CRS, GEODETIC, always_xy=True)
        longitude, latitude = to_geodetic.transform(easting, northing)
        convergence = pyproj.Proj(CRS).get_factors(longitude, latitude).meridian_convergence
        phase = 2 * math.pi * station_m / _PERIOD_M
        climb_m = _GRADE * _PERIOD_M / (2 * math.pi) * (1 - np.cos(phase))
        rows = np.zeros((poses, 17))
        rows[:, 0] = self.start_s + since_start_s
        rows[:, 1], rows[:, 2] = np.radians(latitude), np.radians(longitude)
        rows[:, 3] = _HEIGHT_M + climb_m + IMU_HEIGHT_M + heave_m(since_start_s)
        rows[:, 7] = math.atan(CROSSFALL)
        rows[:, 8] = np.arctan(_GRADE * np.sin(phase))
        rows[:, 9] = _heading(station_m) + np.radians(convergence)
        rows.astype("<f8").tofile(file)

    def _places(self, poses: int) -> tuple[Float64, Float64]:
        """Easting and northing of the poses: the heading's integral by Simpson's rule."""
        ends = np.arange((poses - 1) * _STEPS + 1) / (self.poses_per_s * _STEPS) - _LEAD_S
        step_m = self.speed_m_per_s / (self.poses_per_s * _STEPS)
        middles = ends[:-1] * self.speed_m_per_s + step_m / 2
        at_ends, at_middles = _heading(ends * self.speed_m_per_s), _heading(middles)
        out = []
        for along, origin in zip((np.sin, np.cos), _ORIGIN_M, strict=True):
            ends_part = along(at_ends)
            way = step_m / 6 * (ends_part[:-1] + 4 * along(at_middles) + ends_part[1:])
            out.append(origin + np.concatenate([[0.0], np.cumsum(way)])[::_STEPS])
        return out[0], out[1]


def heave_m(since_start_s: Float64) -> Float64:
    """How much higher the body rides than at rest (n,): profiles see it as longer ranges."""
    out: Float64 = _HEAVE_M * np.sin(2 * math.pi * _HEAVE_PER_S * since_start_s)
    return out


def _heading(station_m: Float64) -> Float64:
    """Grid heading (rad)."""
    out: Float64 = _HEADING + _TURN * np.sin(2 * math.pi * station_m / _PERIOD_M)
    return out
