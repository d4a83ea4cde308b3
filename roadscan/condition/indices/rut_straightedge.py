"""Rut depth below straightedges of usual lengths, laid across the lane wherever they find room.

Source: the straightedge of EN 13036-7 and ASTM E1703 as public descriptions have it (the texts were not at hand, no
compliance is claimed). The edge rests on the two points that carry its middle.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from roadscan.condition.index import ConditionIndex, PerCrossSection, Quantity, Value, by_section
from roadscan.condition.kernels.ruts import straightedge
from roadscan.condition.lane_data import LaneData
from roadscan.condition.of_sections.whole_sections import WholeSections

_MM = 1e3  # Millimetres in a metre.
LENGTHS_M: Final = (1.2, 1.8, 2.0, 3.0)  # Lengths of the straightedges.


def _name(side: str, length_m: float, how: str = "") -> str:
    return f"rut_depth_{round(10 * length_m)}dm{how}_{side}_mm"


class RutStraightedge(ConditionIndex):
    """Ruts below straightedges."""

    name: ClassVar[str] = "rut_straightedge"
    title: ClassVar[str] = "rut depth below straightedges of 1.2, 1.8, 2 and 3 m"
    quantities: ClassVar[tuple[Quantity, ...]] = tuple(
        Quantity(
            _name(side, length, how), "mm",
            f"Greatest depth below a straightedge of {length:g} m in the {side} half of the lane{of}",
        )
        for side in ("left", "right")
        for length in LENGTHS_M
        for how, of in (("", ""), ("_mean", ", mean over the section"))
    )  # fmt: skip

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return values of each cross-section, and means of sections."""
        c, whole = lane.cross_sections, WholeSections.of(lane)
        n = c.station_m.size
        sigma = whole.spread(_MM * whole.sigma_m * np.sqrt(1.5), n)
        for length in LENGTHS_M:
            found = np.zeros((whole.rows.size, 2))
            straightedge(c.offset_m, whole.height_m, length, found)
            for half, side in enumerate(("left", "right")):
                depth = PerCrossSection(
                    _name(side, length), c.station_m, whole.spread(_MM * found[:, half], n), sigma, c.share, whole.noisy
                )
                yield from depth.values()
                yield from by_section(depth, lane, ((_name(side, length, "_mean"), "mean"),))
