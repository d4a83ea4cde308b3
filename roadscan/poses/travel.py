"""Distance travelled along a trajectory, and position and heading as the header of a log states them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, geodetic_from_world
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned, rph_from_rotation
from roadscan.poses.trajectory import Trajectory


@dataclass(frozen=True)
class Fix:
    """Position and heading of the vehicle at one epoch."""

    longitude_deg: float
    """NaN where the trajectory lives in a local frame."""
    latitude_deg: float
    heading_deg: float
    """Clockwise from true north (local frame: from its y axis), 0–360."""


@dataclass(frozen=True)
class Travel:
    """Cumulative distances at a trajectory's knots."""

    trajectory: Trajectory

    @cached_property
    def _knots_m(self) -> Float64:
        steps = np.linalg.norm(np.diff(self.trajectory.position_world_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def distance_m(self, epochs_gps_ns: Int64) -> Float64:
        """Return (n,) metres travelled since the trajectory's first knot; beyond its ends, those of the ends."""
        knots = self.trajectory.epochs_gps_ns
        since = (epochs_gps_ns - knots[0]).astype(np.float64)
        travelled: Float64 = np.interp(since, (knots - knots[0]).astype(np.float64), self._knots_m)
        return travelled

    def fix(self, epoch_gps_ns: int) -> Fix:
        """Position and heading at an epoch.

        Raises
        ------
        NavigationError
            where there is no pose.
        """
        pose = self.trajectory.poses(np.array([epoch_gps_ns]), strict=True)
        if self.trajectory.world == LOCAL_WORLD:
            longitude = latitude = math.nan
            world_from_ned = ENU_FROM_NED
        else:
            longitude, latitude = geodetic_from_world(self.trajectory.world, pose.position_world_m)[0, :2].tolist()
            world_from_ned = ecef_from_ned(math.radians(latitude), math.radians(longitude))
        _, _, heading = rph_from_rotation(world_from_ned.T @ pose.world_from_body[0])
        return Fix(longitude, latitude, math.degrees(float(heading)) % 360.0)
