"""Where a sensor stood on the map when it measured: of many readings, by way of a few poses."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.model.crs import MapFrame
from roadscan.model.rig import Mountings
from roadscan.navigation.trajectory import Trajectory

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

_TICK_NS: Final = 20_000_000
"""Places are computed at multiples of this and are linear between: at 10 m/s² that errs by 0.5 mm."""
_MOST_TICKS: Final = 20_000_000


def sensor_places(trajectory: Trajectory, frame: MapFrame, mountings: Mountings, epochs_gps_ns: Int64) -> Float64:
    """(n, 3) easting, northing and height (m) of a sensor's origin at epochs (n,); NaN where there is no pose.

    A place depends on its own epoch alone, not on the others that are asked for.
    """
    if not epochs_gps_ns.size:
        return np.zeros((0, 3))
    tick = epochs_gps_ns // _TICK_NS
    ticks, before, after = _used(tick)
    at = _exact(trajectory, frame, mountings, ticks * _TICK_NS)
    share = ((epochs_gps_ns - tick * _TICK_NS) / _TICK_NS)[:, None]
    found = at[before] * (1.0 - share) + at[after] * share
    unknown = np.isnan(found[:, 0])
    if unknown.any():  # beside a gap, or at an end of the trajectory
        found[unknown] = _exact(trajectory, frame, mountings, epochs_gps_ns[unknown])
    return found


def _used(tick: Int64) -> tuple[Int64, Int64, Int64]:
    """Ticks (k,) that are needed, and the place among them of each reading's tick and of the next (n,)."""
    first = int(tick.min())
    span = int(tick.max()) - first + 2
    if span > _MOST_TICKS:
        ticks = np.unique(np.concatenate([tick, tick + 1]))
        return ticks, np.searchsorted(ticks, tick), np.searchsorted(ticks, tick + 1)
    own = tick - first
    is_used = np.zeros(span, bool)
    is_used[own] = True
    is_used[own + 1] = True
    number = np.cumsum(is_used) - 1
    return np.flatnonzero(is_used) + first, number[own], number[own + 1]


def _exact(trajectory: Trajectory, frame: MapFrame, mountings: Mountings, epochs_gps_ns: Int64) -> Float64:
    """The same by a pose for each epoch."""
    poses = trajectory.poses(epochs_gps_ns)
    lever = np.empty((epochs_gps_ns.size, 3))
    for rows, mounting in mountings.pieces(epochs_gps_ns):
        lever[rows] = mounting.lever_arm_body_m
    place = np.full((epochs_gps_ns.size, 3), np.nan)
    held = np.flatnonzero(poses.found)
    if held.size:
        turned = np.einsum("nij,nj->ni", poses.world_from_body[held], lever[held])
        place[held] = frame.map_from_world(trajectory.world, poses.position_world_m[held] + turned)
    return place
