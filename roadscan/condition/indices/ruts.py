"""Depth of the ruts of a lane, under a straightedge and under a wire.

Rut depth below straightedges of usual lengths, laid across the lane wherever they find room.

Source: the straightedge of EN 13036-7 and ASTM E1703 as public descriptions have it (the texts were not at hand, no
compliance is claimed). The edge rests on the two points that carry its middle.

Rut depth below a stretched wire, with its width and area, and the depth of standing water.

The wire is stretched over the cross-section from edge to edge of the lane, the upper convex hull of its heights. Left
and right are the halves of the lane in the direction of travel. Source: the wire method as public descriptions of
AASHTO R 48 and PP 69 have it (the texts were not at hand, no compliance is claimed).

Standard deviations follow from those of the heights, of which one in three is a separate measurement, since
neighbours share cells. That of an area holds the heights' and those of the two places that carry the wire. That of a
width holds those of wire and height over the slope at the rut's ends, for which the depth over the width is taken (half
of the mean slope of its sides), and the step of the heights.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.condition.index import ConditionIndex, How, PerCrossSection, Quantity, Value, by_section
from roadscan.condition.kernels.ruts import straightedge, stretched_wire, water
from roadscan.condition.lane_data import LaneData
from roadscan.condition.wheel_paths import WholeSections

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


_WATER: Final = (
    Quantity("water_depth_mm", "mm", "Greatest depth of water that stands in a cross-section"),
    Quantity("water_depth_max_mm", "mm", "The same, greatest of the section"),
)


def _of_side(side: str) -> tuple[Quantity, ...]:
    half = f"of the {side} half of the lane"
    return (
        Quantity(f"rut_depth_{side}_mm", "mm", f"Greatest depth below the wire {half}"),
        Quantity(f"rut_depth_mean_{side}_mm", "mm", f"The same {half}, mean over the section"),
        Quantity(f"rut_depth_max_{side}_mm", "mm", f"The same {half}, greatest of the section"),
        Quantity(f"rut_width_{side}_m", "m", f"Width over which the depth is more than a tenth of the greatest {half}"),
        Quantity(f"rut_area_{side}_m2", "m²", f"Area between wire and road {half}"),
    )


class RutWire(ConditionIndex):
    """Ruts below a wire over the whole lane."""

    name: ClassVar[str] = "rut_wire"
    title: ClassVar[str] = "rut depth below a stretched wire, rut width and area, water depth"
    quantities: ClassVar[tuple[Quantity, ...]] = (*_of_side("left"), *_of_side("right"), *_WATER)
    drawn: ClassVar[tuple[str, ...]] = ("rut_depth_mean_left_mm", "rut_depth_mean_right_mm")

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return values of each cross-section, and means and greatest values of sections."""
        c, whole = lane.cross_sections, WholeSections.of(lane)
        found = np.zeros((whole.rows.size, 2, 5))
        stretched_wire(c.offset_m, whole.height_m, found)
        n = c.station_m.size
        step, half_m = lane.config.cross_section_step_m, 0.5 * lane.width_m
        sigma_area = whole.sigma_m * np.sqrt(3.0 * half_m * step + 0.5 * half_m**2)

        def held(name: str, values: Float64, sigma: Float64) -> PerCrossSection:
            return PerCrossSection(name, c.station_m, whole.spread(values, n), sigma, c.share, whole.noisy)

        for half, side in enumerate(("left", "right")):
            sigma = whole.spread(_MM * whole.sigma_m * np.sqrt(found[:, half, 4]), n)
            depth = held(f"rut_depth_{side}_mm", _MM * found[:, half, 0], sigma)
            yield from depth.values()
            wanted: tuple[tuple[str, How], ...] = (
                (f"rut_depth_mean_{side}_mm", "mean"),
                (f"rut_depth_max_{side}_mm", "max"),
            )
            yield from by_section(depth, lane, wanted)
            steep = found[:, half, 0] / np.maximum(found[:, half, 1], step)
            sigma = whole.sigma_m * np.sqrt(2.0 * found[:, half, 4]) / np.maximum(steep, 1e-6)
            sigma_width = np.minimum(np.hypot(sigma, step / np.sqrt(6.0)), half_m)
            yield from held(f"rut_width_{side}_m", found[:, half, 1], whole.spread(sigma_width, n)).values()
            yield from held(f"rut_area_{side}_m2", found[:, half, 2], whole.spread(sigma_area, n)).values()
        standing = np.zeros_like(whole.height_m)
        water(whole.height_m, standing)
        sigma = whole.spread(_MM * whole.sigma_m * np.sqrt(2.0), n)
        deepest = held("water_depth_mm", _MM * standing.max(axis=1, initial=0.0), sigma)
        yield from deepest.values()
        yield from by_section(deepest, lane, (("water_depth_max_mm", "max"),))
