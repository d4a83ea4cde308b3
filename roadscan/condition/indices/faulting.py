"""Faulting: steps in the wheel paths, as at joints and transverse cracks.

A step is looked for at each height of a profile: straight lines are fitted to the heights from 0.1 to 0.5 m before and
behind it, and its height is their difference there, positive where the road rises in the direction of travel. It counts
where it is the greatest within half a metre, at least 3 mm high and three times its standard deviation, most of it
happens within 0.2 m, and the other wheel path has one of more than half its height within 0.3 m: a joint crosses the
lane, and unevenness of a metre does not.

Source: the idea of AASHTO R 36 as public descriptions have it, a difference of heights on both sides of the joint (the
text was not at hand, no compliance is claimed). Joints that are level are not found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData, Profile
from roadscan.condition.of_sections.wheel_paths import bridged
from roadscan.kernels.condition.steps import step_heights

Float64 = npt.NDArray[np.float64]

_NEAR_M: Final = 0.1
_FAR_M: Final = 0.5
_APART_M: Final = 0.5
_LEAST_M: Final = 0.003
_SUDDEN: Final = 0.75
_BESIDE_M: Final = 0.3
_HALF: Final = 0.6
_LEAD_M: Final = 2.0
_MM: Final = 1e3


class Faulting(ConditionIndex):
    """Steps in the wheel paths."""

    name: ClassVar[str] = "faulting"
    title: ClassVar[str] = "height of steps in the wheel paths, as at joints"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("step_left_mm", "mm", "Height of a step in the left wheel path, positive where the road rises"),
        Quantity("step_right_mm", "mm", "The same of the right wheel path"),
        Quantity("faulting_mean_mm", "mm", "Mean height of the steps of a section, without sign"),
        Quantity("faulting_max_mm", "mm", "Greatest height of a step of a section, without sign"),
        Quantity("joints", "number", "Steps of a section, counted once where both wheel paths have one"),
    )
    lead_m: ClassVar[float] = _LEAD_M

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Steps one by one, and values of sections."""
        for from_m, to_m in lane.sections_m:
            sides = {side: _Side.of(profile, from_m, to_m, lane) for side, profile in lane.profiles.items()}
            found: list[tuple[float, float, float]] = []
            for side, other in (("left", "right"), ("right", "left")):
                for at, height, sigma in sides[side].steps(sides[other]):
                    found.append((at, abs(height), sigma))
                    yield Value(f"step_{side}_mm", "cross_section", at, at, height, sigma, 1.0)
            yield from self._section(from_m, to_m, sorted(found), min(s.share for s in sides.values()), lane)

    def _section(
        self, from_m: float, to_m: float, found: list[tuple[float, float, float]], share: float, lane: LaneData
    ) -> Iterator[Value]:
        names = ("faulting_mean_mm", "faulting_max_mm", "joints")
        if share < lane.config.least_share:
            reason = f"{100 * share:.0f} % of the wheel paths were measured"
            yield from (Value(name, "section", from_m, to_m, np.nan, np.nan, share, reason) for name in names)
            return
        heights = np.array([height for _, height, _ in found])
        sigma = np.array([one for _, _, one in found])
        at = np.array([one for one, _, _ in found])
        joints = 1 + int((np.diff(at) > _APART_M).sum()) if at.size else 0
        yield Value("joints", "section", from_m, to_m, float(joints), np.nan, share)
        if not heights.size:
            yield from (Value(name, "section", from_m, to_m, 0.0, np.nan, share) for name in names[:2])
            return
        k = int(np.argmax(heights))
        spread = float(np.sqrt(np.mean(sigma**2)))
        yield Value("faulting_mean_mm", "section", from_m, to_m, float(heights.mean()), spread, share)
        yield Value("faulting_max_mm", "section", from_m, to_m, float(heights[k]), float(sigma[k]), share)


@dataclass(frozen=True, eq=False)
class _Side:
    """What may be steps of a wheel path."""

    profile: Profile
    inside: npt.NDArray[np.bool_]
    """(n,) places of the section itself."""
    found: Float64
    """(n, 3) height of a step, its standard deviation, and how much of it happens at once (m)."""
    share: float

    @classmethod
    def of(cls, profile: Profile, from_m: float, to_m: float, lane: LaneData) -> _Side:
        part = bridged(profile.between(from_m - _LEAD_M, to_m + _LEAD_M), lane.config.largest_gap_m)
        inside = (part.station_m >= from_m - 1e-6) & (part.station_m < to_m - 1e-6)
        due = max((to_m - from_m) / lane.config.profile_spacing_m, 1.0)
        found = np.full((part.height_m.size, 3), np.nan)
        if part.height_m.size > 2:
            step_heights(part.distance_m, part.height_m, part.known_sigma_m, (_NEAR_M, _FAR_M), found)
        share = min(1.0, float((~np.isnan(part.height_m[inside])).sum()) / due)
        return cls(part, inside, found, share)

    def steps(self, other: _Side) -> Iterator[tuple[float, float, float]]:
        """Station (m), height and standard deviation (mm) of each step that the other wheel path has as well."""
        height, sigma, sudden = self.found.T
        size, station = np.abs(height), self.profile.station_m
        fits = (
            (size >= _LEAST_M)
            & (size >= 3.0 * np.nan_to_num(sigma))
            & (sudden * height >= _SUDDEN * size * size)
            & self.inside
        )
        for k in np.flatnonzero(fits).tolist():
            near = np.abs(station - station[k]) <= _APART_M
            beside = other.found[np.abs(other.profile.station_m - station[k]) <= _BESIDE_M, 0]
            same = np.nan_to_num(beside * np.sign(height[k])).max(initial=0.0)
            if size[k] >= np.nan_to_num(size[near]).max() and same >= _HALF * size[k]:
                yield float(station[k]), _MM * float(height[k]), _MM * float(sigma[k])
