"""Horizontal ties: shift of the relief or the paint of one traverse against that of another."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from roadscan.adjust.patches import Patch, level_from_map, map_from_axes
from roadscan.adjust.pictures import Picture, pictures_of
from roadscan.adjust.registration import Shift, disagree, shift_of
from roadscan.adjust.tie_settings import TieSettings
from roadscan.adjust.ties.tie import SHIFT, End, Tie

DISAGREE: Final = "relief and paint disagree"
_DISAGREE_SIGMA: Final = 5.0  # Relief and paint contradict one another from this many σ on.


KINDS_OF_PICTURES: Final = 2
"""Number of kinds: relief and paint."""


@dataclass
class Pictures:
    """Images of the patches of a place, each made on first use."""

    patches: list[Patch]
    settings: TieSettings
    _made: dict[int, tuple[Picture, Picture]] = field(default_factory=dict)

    def of(self, number: int) -> tuple[Picture, Picture]:
        """Returns relief and paint of a patch."""
        if number not in self._made:
            self._made[number] = pictures_of(self.patches[number], self.settings.shift_cell_m)
        return self._made[number]


def shift_ties(pictures: Pictures, first: int, second: int) -> list[Tie]:
    """Returns ties of two patches of one place: of relief and of paint none, one or two directions each.

    Where an image makes no tie, one row states why.
    """
    settings = pictures.settings
    pairs = zip(pictures.of(first), pictures.of(second), strict=True)
    shifts = [shift_of(one, other, settings) for one, other in pairs]
    relief, paint = shifts
    if not relief.why_not and not paint.why_not and disagree(relief, paint, _DISAGREE_SIGMA):
        shifts = [replace(s, why_not=DISAGREE) for s in shifts]
    ends = pictures.patches[first], pictures.patches[second]
    return [tie for group, shift in enumerate(shifts) for tie in _ties(*ends, shift, group + 1)]


def _ties(first: Patch, second: Patch, shift: Shift, group: int) -> list[Tie]:
    """Returns a tie for each direction that is known, or one that states why there is none."""
    place = first.place
    felt = shift.felt_m
    there = felt + np.nan_to_num(shift.value_m)
    heights = float(np.nanmedian(first.height_m)), float(np.nanmedian(second.height_m))
    ends = (
        End(first.readings, first.pose, map_from_axes(place, felt[:1], felt[1:], np.array(heights[:1]))[0]),
        End(second.readings, second.pose, map_from_axes(place, there[:1], there[1:], np.array(heights[1:]))[0]),
    )
    if not len(shift.directions):
        flat = np.array([1.0, 0.0, 0.0])
        return [Tie(SHIFT, ends, flat, math.nan, math.inf, shift.count, shift.correlation, shift.why_not, group)]
    out = []
    for unit, sigma in zip(shift.directions, shift.sigma_m, strict=True):
        on_map = map_from_axes(place, unit[:1], unit[1:], np.zeros(1)) - [place.easting_m, place.northing_m, 0.0]
        direction = level_from_map(on_map, first.readings.convergence_rad)[0]
        value = float(unit @ shift.value_m)
        out.append(
            Tie(SHIFT, ends, direction, value, float(sigma), shift.count, shift.correlation, shift.why_not, group)
        )
    return out
