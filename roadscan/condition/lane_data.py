"""Input of the indices of condition: profiles and cross-sections of a lane, and its sections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.cracks_on_lane import CrackOnLane
from roadscan.condition.on_lane.lines import LaneLines
from roadscan.condition.on_lane.squares import TextureSquares
from roadscan.condition.road_edges.on_lane import EdgesOnLane
from roadscan.condition.settings import SectionConfig


@dataclass(frozen=True, eq=False)
class Profile:
    """Heights along a wheel path, in the direction of travel."""

    station_m: Float64
    """(n,) station along the reference line."""
    place_m: Float64
    """(n, 2) easting and northing."""
    height_m: Float64
    """(n,) height, NaN where it is not known."""
    sigma_m: Float64
    """(n,) standard deviation from the noise of the readings, NaN where it is not known."""

    @cached_property
    def distance_m(self) -> Float64:
        """(n,) distance along the path from its first height."""
        steps = np.hypot(*np.diff(self.place_m, axis=0).T)
        way: Float64 = np.concatenate([np.zeros(min(len(self.station_m), 1)), np.cumsum(steps)])
        return way

    @property
    def known_sigma_m(self) -> Float64:
        """(n,) `sigma_m`, and its median where it is not known; NaN where it is known nowhere."""
        known = np.isfinite(self.sigma_m)
        return np.where(known, self.sigma_m, np.median(self.sigma_m[known]) if known.any() else np.nan)

    def between(self, from_m: float, to_m: float) -> Profile:
        """Return heights whose station lies in [from, to]; their distance starts at 0."""
        own = (self.station_m >= from_m - 1e-6) & (self.station_m <= to_m + 1e-6)
        return Profile(self.station_m[own], self.place_m[own], self.height_m[own], self.sigma_m[own])


@dataclass(frozen=True, eq=False)
class CrossSections:
    """Heights across a lane, from left to right in the direction of travel."""

    station_m: Float64
    """(n,) ascending."""
    offset_m: Float64
    """(m,) offset from the lane's middle, positive to the right in the direction of travel."""
    height_m: npt.NDArray[np.float64]
    """(n, m) heights, each cross-section's from its `base_m`; NaN where not known."""
    sigma_m: npt.NDArray[np.float64]
    """(n, m) standard deviations from the noise of the readings, NaN where not known."""
    base_m: Float64
    """(n,) height from which `height_m` counts."""

    def between(self, from_m: float, to_m: float) -> CrossSections:
        """Return cross-sections whose station lies in [from, to)."""
        own = (self.station_m >= from_m - 1e-6) & (self.station_m < to_m - 1e-6)
        return replace(
            self, station_m=self.station_m[own], height_m=self.height_m[own], sigma_m=self.sigma_m[own],
            base_m=self.base_m[own],
        )  # fmt: skip

    @property
    def share(self) -> Float64:
        """(n,) known share of the heights of each."""
        shares: Float64 = np.mean(~np.isnan(self.height_m), axis=1)
        return shares


@dataclass(frozen=True, eq=False)
class LaneData:
    """A lane along some sections, with the parts before and after them."""

    sign: int
    """1 where the lane is driven along the reference line, −1 against it."""
    width_m: float
    width_from: str
    """Origin of the width: stated, or default."""
    cell_m: float
    """Edge of the cells from which the heights come."""
    sections_m: tuple[tuple[float, float], ...]
    """Begin and end station of each section."""
    profiles: Mapping[str, Profile]
    """By wheel path: left and right."""
    cross_sections: CrossSections
    texture: TextureSquares
    lines: LaneLines
    """Painted lines beside it."""
    config: SectionConfig
    curvature_per_m: Float64
    """(n,) curvature of the reference line at the cross-sections (1/m), positive to the right."""
    cracks: tuple[CrackOnLane, ...] | None = None
    """Cracks near the lane; None where the survey has no table of cracks."""
    sigma_roll_rad: float = 0.0
    """Standard deviation of the vehicle's roll as stated with the poses."""
    sigma_pose_height_m: float = 0.0
    """Standard deviation of its height as stated with the poses."""
    wander_m2_per_m: float = 0.0
    """Variance of the random walk of the poses' heights per metre of travel."""
    edges: EdgesOnLane | None = None
    """Edges of the road beside the lane; None where none are requested."""
    window_m2: float = 0.0
    """Variance of the window along the road over which a profile's height is a mean; 0 for heights of points."""

    def paths_share(self, from_m: float, to_m: float) -> float:
        """Return the measured share of the wheel paths between two stations, of the one with less."""
        due = max((to_m - from_m) / self.config.profile_spacing_m, 1.0)
        parts = [profile.between(from_m, to_m) for profile in self.profiles.values()]
        return min(1.0, *(np.count_nonzero(~np.isnan(part.height_m)) / due for part in parts))
