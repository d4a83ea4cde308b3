"""Width of the road's surface and of the shoulders beside a lane, and drops at its edges.

A shoulder reaches from the border of the lane to the edge of the road's surface, where no other lane lies between. The
drop is the height of the road's surface at its edge above the ground beside it; a kerb that rises gives a negative one.
Source: edge drop-off as public descriptions of the LTPP distress identification manual (FHWA-HRT-13-092) have it, the
difference between the surface and the ground beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import ClassVar, Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.condition.index import ConditionIndex, How, PerCrossSection, Quantity, Value, by_section
from roadscan.condition.lane_data import LaneData
from roadscan.condition.road_edges.raster import STATION_M

_MM: Final = 1e3  # Millimetres in a metre.


def _of_side(side: str) -> tuple[Quantity, ...]:
    return (
        Quantity(f"shoulder_{side}_m", "m", f"Width between the lane's {side} border and the road's edge"),
        Quantity(f"shoulder_mean_{side}_m", "m", "The same, mean over the section"),
        Quantity(f"edge_drop_{side}_mm", "mm", f"Height of the road's {side} edge above the ground beside it"),
        Quantity(f"edge_drop_mean_{side}_mm", "mm", "The same, mean over the section"),
        Quantity(f"edge_drop_max_{side}_mm", "mm", "The same, greatest of the section"),
    )


class RoadWidth(ConditionIndex):
    """Width of road and shoulders, and edge drop-off."""

    name: ClassVar[str] = "road_width"
    title: ClassVar[str] = "width of the road's surface and of shoulders, drops at its edges"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("road_width_m", "m", "Width of the road's surface from edge to edge"),
        Quantity("road_width_mean_m", "m", "The same, mean over the section"),
        *_of_side("left"),
        *_of_side("right"),
    )

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return values each half metre, and of sections; none where no edges are requested."""
        if lane.edges is None:
            return
        left, right = (lane.edges.sides[side] for side in ("left", "right"))
        station = lane.edges.station_m
        width = _held("road_width_m", station, left.away_m + right.away_m, np.hypot(left.sigma_m, right.sigma_m))
        yield from _both(width, lane, (("road_width_mean_m", "mean"),))
        for name, side in lane.edges.sides.items():
            if not side.beside:
                continue
            shoulder = _held(f"shoulder_{name}_m", station, side.away_m - 0.5 * lane.width_m, side.sigma_m)
            yield from _both(shoulder, lane, ((f"shoulder_mean_{name}_m", "mean"),))
            drop = _held(f"edge_drop_{name}_mm", station, _MM * side.drop_m, _MM * side.sigma_drop_m)
            yield from _both(drop, lane, ((f"edge_drop_mean_{name}_mm", "mean"), (f"edge_drop_max_{name}_mm", "max")))


def _held(quantity: str, station: Float64, value: Float64, sigma: Float64) -> PerCrossSection:
    known = np.isfinite(value)
    return PerCrossSection(quantity, station, value, np.where(known, sigma, np.nan), known.astype(np.float64))


def _both(held: PerCrossSection, lane: LaneData, wanted: Sequence[tuple[str, How]]) -> Iterator[Value]:
    """Return values of the places where there is one, and of sections."""
    yield from (one for one in held.values() if math.isfinite(one.value))
    yield from by_section(held, lane, wanted, STATION_M)
