"""Camera axes on the map, with which a page projects a map point into a picture."""

from __future__ import annotations

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.crs import MapFrame
from roadscan.poses.trajectory import world_from_ned


def camera_from_map(
    frame: MapFrame, world: str, eye_world_m: Float64, opencv_from_world: Float64
) -> tuple[Float64, Float64]:
    """Return map positions (n, 3; m) of cameras, and matrices (n, 3, 3) from map differences to camera axes.

    The matrix is the rotation from world to camera times the inverse of the map's derivative at the camera, taken
    over a metre; so it includes convergence and scale of the map. The effect of the map's curvature stays below 1 mm
    within 100 m.

    Parameters
    ----------
    world : frame of the poses.
    eye_world_m : (n, 3) projection centres; opencv_from_world : (n, 3, 3) camera axes (x right, y down, z ahead).
    """
    axes = world_from_ned(world, eye_world_m)
    place = frame.map_from_world(world, eye_world_m)
    return place, opencv_from_world @ axes @ np.linalg.inv(map_from_ned(frame, world, eye_world_m))


def map_from_ned(frame: MapFrame, world: str, position_world_m: Float64) -> Float64:
    """Return derivatives (n, 3, 3) of the map (easting, northing, height) by north, east, down at positions (n, 3; m).

    They are taken over a metre and include convergence and scale of the map.
    """
    axes = world_from_ned(world, position_world_m)
    ends = [
        frame.map_from_world(world, position_world_m + sign * axes[:, :, k]) for k in range(3) for sign in (0.5, -0.5)
    ]
    return np.stack([ends[2 * k] - ends[2 * k + 1] for k in range(3)], axis=-1)
