"""Cracks in lane coordinates: stations and offsets of the pieces of their lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.condition.road_line import Lane, RoadLine

PIECE_M: Final = 0.05
"""Cracks are divided into pieces of at most this length (m)."""
_ROUNDS: Final = 4  # Newton steps to a station.


@dataclass(frozen=True, eq=False)
class CrackOnLane:
    """A crack near a lane, divided into short pieces."""

    kind: str
    """Longitudinal, transverse, diagonal, alligator or unknown."""
    width_m: float
    """Mean width."""
    station_m: Float64
    """(k,) of the pieces' middles."""
    own_m: Float64
    """(k,) their offset from the lane's middle, positive to the right in the direction of travel."""
    length_m: Float64
    """(k,) lengths of the pieces."""


def located(line: RoadLine, lane: Lane, places_m: Float64, guess_m: float) -> tuple[Float64, Float64]:
    """Return stations, and offsets from the lane's middle (n,), of places (n, 2), from a station near all of them."""
    station = np.full(len(places_m), guess_m)
    for _ in range(_ROUNDS):
        at = line.places(station, 0.0)
        station = station + np.einsum("na,na->n", places_m - at[:, :2], at[:, 2:])
    at = line.places(station, 0.0)
    beside = places_m - at[:, :2]
    offset = beside[:, 0] * at[:, 3] - beside[:, 1] * at[:, 2]
    return station, lane.sign * (offset - lane.offsets(station))
