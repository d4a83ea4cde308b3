"""Map positions of a sensor at many epochs, interpolated between a few poses."""

from __future__ import annotations

from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.kernel_options import read_only
from roadscan.core.crs import MapFrame
from roadscan.core.rig import Mountings
from roadscan.georeference.kernels.timed_readings import between_ticks
from roadscan.poses.trajectory import Trajectory

_TICK_NS: Final = 20_000_000
"""Positions are computed at multiples of this and are linear between: at 10 m/s² the error is 0.5 mm."""
_MOST_TICKS: Final = 20_000_000
"""Over a longer time (4 days), a pose is computed for each epoch."""


def sensor_places(trajectory: Trajectory, frame: MapFrame, mountings: Mountings, epochs_gps_ns: Int64) -> Float64:
    """Return (n, 3) easting, northing and height (m) of a sensor's origin at epochs (n,); NaN without a pose.

    A position depends on its epoch alone, not on the other epochs.
    """
    if not epochs_gps_ns.size:
        return np.zeros((0, 3))
    epochs = np.ascontiguousarray(epochs_gps_ns)
    first = int(epochs.min()) // _TICK_NS
    if int(epochs.max()) // _TICK_NS - first > _MOST_TICKS:
        return _exact(trajectory, frame, mountings, epochs)
    ticks, number = _used(epochs // _TICK_NS - first)
    columns = np.empty((3, epochs.size))
    at = _exact(trajectory, frame, mountings, (ticks + first) * _TICK_NS)
    between_ticks(read_only(epochs), _TICK_NS, first, number, at, columns)
    found = columns.T
    unknown = np.isnan(found[:, 0])
    if unknown.any():  # beside a gap, or at an end of the trajectory
        found[unknown] = _exact(trajectory, frame, mountings, epochs[unknown])
    return found


def _used(tick: Int64) -> tuple[Int64, Int64]:
    """Return the ticks (k,) at which positions are needed, from 0 on, and the row among them of each tick (t,)."""
    is_used = np.zeros(int(tick.max()) + 2, bool)
    is_used[tick] = True
    is_used[1:] |= is_used[:-1].copy()
    return np.flatnonzero(is_used), np.cumsum(is_used) - 1


def _exact(trajectory: Trajectory, frame: MapFrame, mountings: Mountings, epochs_gps_ns: Int64) -> Float64:
    """Return the same positions from a pose for each epoch."""
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
