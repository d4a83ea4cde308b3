"""Ravelling: patches of a lane that have lost stones, by their texture against that of their section.

The texture of a square of 0.2 m is the root mean square of its heights within blocks of 50 mm about their planes
(:mod:`roadscan.condition.kernels.lane_texture`), so that slopes, ruts and wide holes count nothing. It is that of the
median block, so that cracks count little. A patch is coarser than its section by 15 %, and by five times the spread of
its sound squares; a road of another texture measures itself, and a dark or wet place without texture is none. Where
most of a section has lost stones, the lane over its kilometre says what is sound.

Sources, as public descriptions have them; no compliance is claimed. Van Ooijen, van den Bol and Bouman, *High-speed
measurement of ravelling on porous asphalt* (2004): missing stones known by their dimensions in the texture profile.
Laurent, Hébert, Lefebvre and Savard, *Using 3D laser profiling sensors for the automated measurement of road surface
conditions* (2012): ravelling as loss of aggregate, from heights of the whole lane. Here the volume lost is that below
the level under which 85 % of a square's heights lie, less that of the sound road.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData, RavelledSection, TextureSquares
from roadscan.condition.wheel_paths import noisy

_CM3_PER_M2: Final = 1e3
"""Volume per area (cm³/m²) of a mean depth of a millimetre."""


class Ravelling(ConditionIndex):
    """Patches that have lost stones, by section."""

    name: ClassVar[str] = "ravelling"
    title: ClassVar[str] = "patches that have lost stones: share, area, number, volume lost"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("ravelled_percent", "%", "Share of the lane's area in patches that have lost stones"),
        Quantity("ravelled_area_m2", "m²", "Their area"),
        Quantity("ravelling_patches", "number", "Their number"),
        Quantity("ravelling_loss_cm3_per_m2", "cm³/m²", "Volume lost in them over the area of the lane"),
    )
    drawn: ClassVar[tuple[str, ...]] = ("ravelled_percent",)

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return the values of sections."""
        for (from_m, to_m), found in zip(lane.sections_m, looked_through(lane), strict=True):
            for name, value, sigma, share, reason in _of_section(lane, found):
                yield Value(name, "section", from_m, to_m, value, sigma, share, reason)


def looked_through(lane: LaneData) -> list[RavelledSection]:
    """Return each section of a lane with its patches."""
    from roadscan.condition.on_lane.ravelling import lane_levels, ravelled_section  # slow to import

    if lane.config.heights == "surface":
        none = RavelledSection((), 0.0, 0.0, math.nan, "the reconstructed surface has no texture")
        return [none] * len(lane.sections_m)
    sections = [_squares(lane, *ends) for ends in lane.sections_m]
    levels = lane_levels(sections)
    return [ravelled_section(squares, inside, levels) for squares, inside in sections]


def _squares(lane: LaneData, from_m: float, to_m: float) -> tuple[TextureSquares, npt.NDArray[np.bool_]]:
    """Return the squares of a section, and which of them lie on the road; the texture of noisy ones is NaN."""
    squares, c = lane.texture.between(from_m, to_m), lane.cross_sections
    wrong_m, near_m = c.station_m[noisy(c)], lane.config.cross_section_spacing_m
    if wrong_m.size:
        away = np.abs(squares.station_m[:, None] - wrong_m).min(axis=1)
        squares = replace(squares, texture_mm=np.where(away[:, None] <= near_m, np.nan, squares.texture_mm))
    inside: npt.NDArray[np.bool_] = np.ones(squares.texture_mm.shape, bool)
    if lane.edges is not None:
        rows = [lane.edges.inside(np.full(squares.offset_m.size, s), squares.offset_m) for s in squares.station_m]
        inside = np.array(rows, bool).reshape(inside.shape)
    return squares, inside


def _of_section(lane: LaneData, found: RavelledSection) -> Iterator[tuple[str, float, float, float, str]]:
    reason = found.reason
    if not reason and found.share < lane.config.least_share:
        reason = (
            f"the texture of {100 * found.share:.0f} % of the lane was measured; ravelling takes "
            f"{100 * lane.config.least_share:.0f} % (condition.least_share)"
        )
    if reason:
        for one in Ravelling.quantities:
            yield one.name, math.nan, math.nan, found.share, reason
        return
    area = sum(one.area_m2 for one in found.patches)
    sigma = math.sqrt(sum(one.sigma_area_m2**2 for one in found.patches))
    volumes = [(one.loss_mm * one.area_m2, one.loss_mm * one.sigma_area_m2) for one in found.patches]
    lost, sigma_lost = sum(v for v, _ in volumes), math.sqrt(sum(s * s for _, s in volumes))
    m2 = found.measured_m2
    yield "ravelled_percent", 100.0 * area / m2, 100.0 * sigma / m2, found.share, found.remark
    yield "ravelled_area_m2", area, sigma, found.share, ""
    yield "ravelling_patches", float(len(found.patches)), math.nan, found.share, ""
    untold = "" if math.isfinite(lost) else "cells are too coarse to show the depth of what was lost"
    per_m2 = _CM3_PER_M2 / m2
    yield "ravelling_loss_cm3_per_m2", per_m2 * lost, per_m2 * sigma_lost, found.share, untold
