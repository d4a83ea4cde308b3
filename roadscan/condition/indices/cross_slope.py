"""Cross-slope and crown of the lane, grade and curvature of the road.

Cross-slope is that of the straight line that fits a cross-section best; crown is how far the middle of the parabola
that fits it best lies above the line through its ends. The standard deviation of the cross-slope holds the noise of the
readings and the roll of the poses, that of the grade the heights of the poses at both ends of the section, taken as
independent, as their logs state them. The curvature of the reference line has none.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from roadscan.condition.index import ConditionIndex, PerCrossSection, Quantity, Value, by_section
from roadscan.condition.lane_data import LaneData


class CrossSlope(ConditionIndex):
    """Cross-slope, crown, grade and curvature."""

    name: ClassVar[str] = "cross_slope"
    title: ClassVar[str] = "cross-slope and crown of the lane, grade and curvature"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("cross_slope_percent", "%", "Fall to the right in the direction of travel"),
        Quantity("cross_slope_mean_percent", "%", "The same, mean over the section"),
        Quantity("crown_mm", "mm", "Height of the lane's middle above the line through its edges"),
        Quantity("crown_mean_mm", "mm", "The same, mean over the section"),
        Quantity("grade_percent", "%", "Rise in the direction of travel: the straight line that fits a section best"),
        Quantity("curvature_per_km", "1/km", "Mean curvature of the reference line, positive where it turns right"),
    )
    drawn: ClassVar[tuple[str, ...]] = ("cross_slope_mean_percent",)

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return values of each cross-section and of sections."""
        c = lane.cross_sections
        slope, crown = self._slopes(lane)
        for held, name in ((slope, "cross_slope_mean_percent"), (crown, "crown_mean_mm")):
            yield from held.values()
            yield from by_section(held, lane, ((name, "mean"),))
        for from_m, to_m in lane.sections_m:
            own = (c.station_m >= from_m - 1e-6) & (c.station_m < to_m - 1e-6)
            if own.any():
                curvature = 1e3 * float(lane.curvature_per_m[own].mean())
                yield Value("curvature_per_km", "section", from_m, to_m, curvature, np.nan, 1.0)
            yield self._grade(lane, from_m, to_m)

    def _slopes(self, lane: LaneData) -> tuple[PerCrossSection, PerCrossSection]:
        """Return slopes by least squares over the known heights."""
        c = lane.cross_sections
        n, x = c.station_m.size, c.offset_m
        slope, crown, sigma_slope, sigma_crown = (np.full(n, np.nan) for _ in range(4))
        half = lane.width_m / 2
        for k in np.flatnonzero(c.share >= lane.config.least_share).tolist():
            own = ~np.isnan(c.height_m[k])
            line = np.polynomial.polynomial.polyfit(x[own], c.height_m[k, own], 1)
            bend = np.polynomial.polynomial.polyfit(x[own], c.height_m[k, own], 2)
            slope[k], crown[k] = -100.0 * line[1], -1e3 * bend[2] * half * half
            noise = float(np.nanmedian(c.sigma_m[k])) if not np.isnan(c.sigma_m[k]).all() else np.nan
            about = x[own] - x[own].mean()
            square = about * about - np.mean(about * about)
            # Neighbouring heights share cells: about one in three is independent.
            roll = np.tan(lane.sigma_roll_rad)
            sigma_slope[k] = 100.0 * np.hypot(noise * np.sqrt(3.0 / np.sum(about * about)), roll)
            sigma_crown[k] = 1e3 * noise * np.sqrt(3.0 / np.sum(square * square)) * half * half
        return (
            PerCrossSection("cross_slope_percent", c.station_m, slope, sigma_slope, c.share),
            PerCrossSection("crown_mm", c.station_m, crown, sigma_crown, c.share),
        )

    def _grade(self, lane: LaneData, from_m: float, to_m: float) -> Value:
        """Return the grade from the heights of both wheel paths over their length."""
        slopes: list[float] = []
        shares: list[float] = []
        for profile in lane.profiles.values():
            part = profile.between(from_m, to_m)
            known = ~np.isnan(part.height_m)
            shares.append(float(known.mean()) if known.size else 0.0)
            if known.sum() >= 2:
                slopes.append(
                    float(np.polynomial.polynomial.polyfit(part.distance_m[known], part.height_m[known], 1)[1])
                )
        share = min(shares, default=0.0)
        if len(slopes) < len(lane.profiles) or share < lane.config.least_share:
            reason = f"{100 * share:.0f} % of the wheel paths were measured"
            return Value("grade_percent", "section", from_m, to_m, np.nan, np.nan, share, reason)
        sigma = 100.0 * np.sqrt(2.0) * lane.sigma_pose_height_m / max(to_m - from_m, 1.0)
        return Value("grade_percent", "section", from_m, to_m, 100.0 * float(np.mean(slopes)), float(sigma), share)
