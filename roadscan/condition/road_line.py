"""Reference lines of roads and the lanes along them: stations, offsets and map positions.

Station counts metres along the reference line from its start; offset is positive to the right of it. A lane also has
a frame: left and right are those of its direction of travel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.road_frame import place

STATION_M: Final = 0.5  # step along the road of what is known by station: edges, cells that show them (m)
NODE_M: Final = 1.0
"""Distance between the nodes of a line, and between those of a lane's middle (m)."""
_ROUNDS: Final = 4
"""Newton steps to the station beside a place."""
_AROUND: Final = 4
"""Nodes beyond a stretch on which its places depend."""


@dataclass(frozen=True, eq=False)
class RoadLine:
    """A road's reference line."""

    road: str
    """Id of the road."""
    nodes_m: Float64
    """(k, 2) easting and northing of the line at whole metres of station."""
    first_m: int = 0
    """Station of the first node (m)."""
    name: str | None = None
    """Name of the route, where the layer has one."""
    measure_from: float | None = None
    """The layer's measure (milepost) at station 0, in its unit."""
    measure_per_m: float | None = None
    """Its change per metre of station."""

    @property
    def length_m(self) -> float:
        """Length from the first to the last node."""
        return NODE_M * (len(self.nodes_m) - 1)

    def stretch(self, from_m: float, to_m: float) -> RoadLine:
        """Return the part of the line on which places between two stations depend."""
        first = max(int(np.floor(from_m)) - _AROUND - self.first_m, 0)
        end = min(int(np.ceil(to_m)) + _AROUND + 1 - self.first_m, len(self.nodes_m))
        first = max(min(first, end - 2), 0)
        return RoadLine(
            self.road, self.nodes_m[first:end], self.first_m + first, self.name, self.measure_from, self.measure_per_m
        )

    def places(self, station_m: npt.ArrayLike, offset_m: npt.ArrayLike) -> Float64:
        """(n, 4) easting, northing (m), and the direction of the line (east, north) at stations and offsets (n,)."""
        station, offset = np.broadcast_arrays(np.asarray(station_m, np.float64), np.asarray(offset_m, np.float64))
        out = np.empty((station.size, 4))
        place(self.nodes_m, self.first_m, station.flatten(), offset.flatten(), out)
        return out

    def along(self, places_m: Float64, guess_m: npt.ArrayLike) -> tuple[Float64, Float64]:
        """Return stations and offsets (n,) of places (n, 2), from a station near each of them."""
        station = np.array(np.broadcast_to(np.asarray(guess_m, np.float64), len(places_m)))
        at = self.places(station, 0.0)
        for _ in range(_ROUNDS):
            station = station + np.sum((places_m - at[:, :2]) * at[:, 2:], axis=1)
            at = self.places(station, 0.0)
        beside = places_m - at[:, :2]
        return station, beside[:, 0] * at[:, 3] - beside[:, 1] * at[:, 2]

    def curvature_per_m(self, station_m: Float64, half_m: float = 10.0) -> Float64:
        """Return (n,) curvature of the line (1/m), positive to the right: change of direction over 2 · `half_m`."""
        before, after = self.places(station_m - half_m, 0.0), self.places(station_m + half_m, 0.0)
        cross = before[:, 3] * after[:, 2] - before[:, 2] * after[:, 3]
        dot = before[:, 2] * after[:, 2] + before[:, 3] * after[:, 3]
        turned: Float64 = np.arctan2(cross, dot) / (2.0 * half_m)
        return turned

    def measures(self, station_m: Float64) -> Float64:
        """Return (n,) the layer's measure at stations; NaN where it has none."""
        if self.measure_from is None or self.measure_per_m is None:
            return np.full(np.shape(station_m), np.nan)
        return self.measure_from + self.measure_per_m * np.asarray(station_m, np.float64)


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane along a reference line."""

    road: str
    name: str
    sign: int
    """1 where it is driven along the line, −1 against it."""
    first_m: int
    """Station of the first value of `offset_m` (m)."""
    offset_m: Float64
    """(k,) offset of the lane's middle from the reference line at whole metres of station, positive to the right."""
    width_m: float
    width_from: str
    """Origin of the width: stated, or default."""
    passes: tuple[int, ...]
    """Passes along it."""
    sigma_roll_deg: float = 0.0
    """Standard deviation of the roll of its drives' poses, as stated in the log; the greatest of all."""
    sigma_height_m: float = 0.0
    """Standard deviation of their heights, likewise."""
    wander_m2_per_m: float = 0.0
    """Variance of the random walk of these poses' heights per metre of travel, the greatest of all."""

    @property
    def last_m(self) -> int:
        """Station of the last value of `offset_m` (m)."""
        return self.first_m + len(self.offset_m) - 1

    @property
    def direction(self) -> str:
        """Direction of travel: forward along the reference line, or backward."""
        return "forward" if self.sign > 0 else "backward"

    @cached_property
    def _nodes(self) -> Float64:
        return self.first_m + NODE_M * np.arange(len(self.offset_m), dtype=np.float64)

    def offsets(self, station_m: Float64, own_m: npt.ArrayLike = 0.0) -> Float64:
        """Return offsets from the reference line of places `own_m` to the right of the lane's middle as driven."""
        found: Float64 = np.interp(station_m, self._nodes, self.offset_m) + self.sign * np.asarray(own_m, np.float64)
        return found

    def stretch(self, from_m: float, to_m: float) -> Lane:
        """Return the lane between two stations, with one more node on each side."""
        first = max(int(np.floor(from_m)) - 1 - self.first_m, 0)
        end = min(int(np.ceil(to_m)) + 2 - self.first_m, len(self.offset_m))
        return Lane(
            self.road, self.name, self.sign, self.first_m + first, self.offset_m[first:end], self.width_m,
            self.width_from, self.passes, self.sigma_roll_deg, self.sigma_height_m, self.wander_m2_per_m,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Roads:
    """Lines and lanes from the store."""

    lines: dict[str, RoadLine]
    """Lines by road."""
    lanes: tuple[Lane, ...]
