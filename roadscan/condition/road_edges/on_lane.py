"""Edges of the road in lane coordinates: left and right in the direction of travel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.road_edges.raster import STATION_M
from roadscan.condition.road_line import Lane


@dataclass(frozen=True, eq=False)
class LaneEdge:
    """The edge of the road on one side of a lane, a value a station; NaN where unknown."""

    away_m: Float64
    """(n,) distance from the lane's middle, positive outward."""
    sigma_m: Float64
    """(n,)"""
    drop_m: Float64
    """(n,) height of the road's surface at the edge above the ground beside it; negative where a kerb rises."""
    sigma_drop_m: Float64
    """(n,)"""
    beside: bool
    """True where no other lane lies between."""


@dataclass(frozen=True, eq=False)
class EdgesOnLane:
    """Both edges beside a lane."""

    station_m: Float64
    """(n,) ascending, :data:`STATION_M` apart."""
    sides: Mapping[str, LaneEdge]
    """By side in the direction of travel: left and right."""

    def inside(self, station_m: Float64, own_m: Float64) -> npt.NDArray[np.bool_]:
        """Return whether places (n,) lie between the edges, by station and offset from the lane's middle.

        Offsets are positive to the right in the direction of travel. Where an edge is not known, it bounds nothing.
        """
        at = np.rint((station_m - self.station_m[0]) / STATION_M).astype(np.int64)
        at = np.clip(at, 0, self.station_m.size - 1)
        left, right = (self.sides[side].away_m[at] for side in ("left", "right"))
        found: npt.NDArray[np.bool_] = ~(own_m < -left) & ~(own_m > right)
        return found


@dataclass(frozen=True, eq=False)
class EdgeRows:
    """Rows of the table of edges on one side of a reference line."""

    station_m: Float64
    offset_m: Float64
    sigma_m: Float64
    drop_m: Float64
    sigma_drop_m: Float64


def edges_on_lane(
    rows: Mapping[str, EdgeRows], lane: Lane, between_m: tuple[float, float], beside: Mapping[str, bool]
) -> EdgesOnLane:
    """Return the edges beside a lane between two stations.

    Parameters
    ----------
    rows : by side of the reference line.
    beside : by side in the direction of travel, whether no other lane lies between.
    """
    first, last = (round(end / STATION_M) for end in between_m)
    station: Float64 = STATION_M * np.arange(first, last + 1, dtype=np.float64)
    sides = {}
    for name, sign in (("left", -1.0), ("right", 1.0)):
        own = rows[name if lane.sign > 0 else ("right" if name == "left" else "left")]
        at = np.rint(own.station_m / STATION_M).astype(np.int64) - first
        good = (at >= 0) & (at < station.size)
        away = sign * lane.sign * (own.offset_m - lane.offsets(own.station_m))
        columns = np.full((4, station.size), np.nan)
        columns[:, at[good]] = np.stack([away, own.sigma_m, own.drop_m, own.sigma_drop_m])[:, good]
        sides[name] = LaneEdge(columns[0], columns[1], columns[2], columns[3], beside[name])
    return EdgesOnLane(station, sides)
