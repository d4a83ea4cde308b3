"""Wheel paths of a section as indices of roughness take them: with a lead, gaps bridged, and draws of their noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.condition.lane_data import LaneData, Profile
from roadscan.condition.quarter_car import RULES
from roadscan.condition.segments import Segments

Float64 = npt.NDArray[np.float64]

LEAD_M: Final = 100.0
"""A quarter car begins so far before a section, or where the profile begins."""
NOISES: Final = 12
"""Profiles with added noise, from whose spread a standard deviation is told."""
LEAST_M: Final = 20.0
"""Sections that are shorter, and shorter than sections shall be, have no roughness: lanes begin and end in them."""


@dataclass(frozen=True, eq=False)
class WheelPath:
    """A wheel path along a section and before it."""

    profile: Profile
    """With its short gaps bridged."""
    ends: Segments
    """The section's ends along the path."""
    inside: npt.NDArray[np.bool_]
    """(n,) heights that lie in the section."""
    share: float
    """Share of the section that was measured."""
    reason: str
    """Why it has no roughness; empty where it has one."""
    spacing_m: float
    cell_m: float

    def with_noise(self, first_stream: int = 0) -> Float64:
        """(1 + 12, n) heights, and the same with noise added."""
        height = self.profile.height_m[None]
        return np.concatenate([height, height + noise(self.profile, self.spacing_m, self.cell_m, first_stream)])


def wheel_paths(lane: LaneData, from_m: float, to_m: float) -> dict[str, WheelPath]:
    """Both wheel paths of a section, by side."""
    before, after = (LEAD_M, 10.0) if lane.sign > 0 else (10.0, LEAD_M)
    spacing = lane.config.profile_spacing_m
    found = {}
    for side, whole in lane.profiles.items():
        part = bridged(whole.between(from_m - before, to_m + after), lane.config.largest_gap_m)
        inside = (part.station_m >= from_m - 1e-6) & (part.station_m <= to_m + 1e-6)
        share, reason = _judged(part, inside, (from_m, to_m), lane)
        ends = _ends(part, from_m, to_m) if not reason else Segments(np.zeros(0), np.zeros(0))
        found[side] = WheelPath(part, ends, inside, share, reason, spacing, lane.cell_m)
    return found


def spread_of(tried: Float64) -> float:
    """Standard deviation of a value (1 + draws,): the first is that without noise."""
    return float(np.sqrt(np.mean((tried[1:] - tried[0]) ** 2)))


def bridged(profile: Profile, largest_gap_m: float) -> Profile:
    """The profile with its short gaps bridged by straight lines."""
    known = np.flatnonzero(~np.isnan(profile.height_m))
    if known.size < 2:
        return profile
    height = np.interp(profile.distance_m, profile.distance_m[known], profile.height_m[known])
    behind = np.searchsorted(known, np.arange(height.size), side="right")
    last, after = known[np.maximum(behind - 1, 0)], known[np.minimum(behind, known.size - 1)]
    wide = profile.distance_m[after] - profile.distance_m[last] > largest_gap_m + 1e-9
    outside = (behind == 0) | ((behind == known.size) & (np.arange(height.size) > known[-1]))
    gap = np.isnan(profile.height_m) & (wide | outside)
    return Profile(profile.station_m, profile.place_m, np.where(gap, np.nan, height), profile.sigma_m)


def _judged(
    part: Profile, inside: npt.NDArray[np.bool_], between_m: tuple[float, float], lane: LaneData
) -> tuple[float, str]:
    """Share of a section that was measured, and why it can have no roughness."""
    length, spacing, limit = between_m[1] - between_m[0], lane.config.profile_spacing_m, RULES.envelope_m
    due, measured = length / spacing, float(np.count_nonzero(~np.isnan(part.height_m[inside])))
    share = min(1.0, measured / max(due, 1.0))
    least = min(LEAST_M, lane.config.section_m)
    if length < least - 1e-6:
        return share, f"the section is {length:.1f} m long; roughness takes {least:g} m or more"
    if lane.cell_m > limit:
        return share, f"cells of {lane.cell_m:g} m are too coarse: {limit:g} m or less are needed"
    if measured < 0.5 * due:
        return share, f"{100 * share:.0f} % of the wheel path were measured"
    missing = (due - measured) * spacing
    if missing > lane.config.largest_gap_m + spacing:
        return share, f"gaps wider than {lane.config.largest_gap_m:g} m, {missing:.1f} m in all"
    return share, ""


def _ends(part: Profile, from_m: float, to_m: float) -> Segments:
    order = np.argsort(part.station_m, kind="stable")
    ends = np.sort(np.interp([from_m, to_m], part.station_m[order], part.distance_m[order]))
    return Segments(ends[:1], ends[1:])


def noise(part: Profile, spacing_m: float, cell_m: float, first_stream: int = 0) -> Float64:
    """(k, n) errors as the noise of the readings makes them: those of neighbours are alike, for they share cells.

    They are drawn from counters of the place, so a section has the same ones in every run.
    """
    number = np.rint(part.station_m / spacing_m).astype(np.int64)
    low, high = int(number.min()) - 64, int(number.max()) + 65
    half = max(1, round(max(spacing_m, 1.5 * cell_m) / spacing_m))
    window = 1.0 - np.abs(np.arange(-half, half + 1)) / (half + 1.0)
    window /= np.sqrt(np.sum(window * window))
    sigma = np.where(np.isnan(part.sigma_m), 0.0, part.sigma_m)
    out = np.empty((NOISES, number.size))
    for k in range(NOISES):
        drawn = np.concatenate([_normal(first_stream + k, block) for block in range(low // 1024, high // 1024 + 1)])
        alike = np.convolve(drawn, window, mode="same")
        out[k] = sigma * alike[number - low // 1024 * 1024]
    return out


def _normal(stream: int, block: int) -> Float64:
    """1024 normal numbers of a block of places."""
    return np.random.Generator(np.random.Philox(key=[stream, block & 0xFFFFFFFF])).standard_normal(1024)
