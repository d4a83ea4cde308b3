"""Poses for an adjustment: map positions, attitudes relative to the local level, and meridian convergence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import MapFrame
from roadscan.poses.trajectory import Poses, Trajectory, world_from_ned

_STEP_M = 10.0  # Length (m) of the line to true north whose map direction gives the convergence.


@dataclass(frozen=True)
class LevelPoses:
    """Poses at p epochs."""

    epoch_gps_ns: Int64
    """(p,)"""
    body_m: Float64
    """(p, 3) easting, northing and height of the body's origin."""
    level_from_body: Float64
    """(p, 3, 3) north, east, down from body axes."""
    convergence_rad: Float64
    """(p,) grid north is this far clockwise from true north."""

    @property
    def heading_rad(self) -> Float64:
        """(p,) of the vehicle, clockwise from grid north."""
        return np.asarray(
            np.arctan2(self.level_from_body[:, 1, 0], self.level_from_body[:, 0, 0]) - self.convergence_rad
        )


def level_poses(trajectory: Trajectory, frame: MapFrame, epochs_gps_ns: Int64) -> LevelPoses:
    """Return the poses of those of the epochs (n,) that have one, in their order."""
    found = trajectory.poses(epochs_gps_ns)
    keep = found.found
    poses = Poses(epochs_gps_ns[keep], found.position_world_m[keep], found.world_from_body[keep], keep[keep])
    axes = world_from_ned(trajectory.world, poses.position_world_m)
    body = frame.map_from_world(trajectory.world, poses.position_world_m)
    north = frame.map_from_world(trajectory.world, poses.position_world_m + _STEP_M * axes[:, :, 0])
    away = north[:, :2] - body[:, :2]
    return LevelPoses(
        poses.epochs_gps_ns,
        body,
        np.einsum("nji,njk->nik", axes, poses.world_from_body),
        np.asarray(-np.arctan2(away[:, 0], away[:, 1])),
    )
