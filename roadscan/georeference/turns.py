"""Crossings of successive profiles in turns of a trajectory (Yu et al. 2007, eq. 3; see ``georeference.range_filter``).

The trajectory is sampled at whole multiples of :data:`TICK_NS`. From tick to tick, Δs is the distance of the
sensor along the body's x axis, and Δθ the rotation of the body about its z axis: the planes of two profiles
that lie across the body cross at Δs / sin Δθ beside the sensor, on the right where the vehicle turns right (and on the
left where it turns right backwards). A profile has the limits of the tick nearest to it, from the ticks around it over
`base_m` of path, at most :data:`WINDOW_NS` before and after. A vehicle that does not go half as far in that time
stands: it is not turning. Steps are summed as whole nanometres and nanoradians, so that limits have the same bits
wherever the trajectory that is at hand begins.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.settings.segmentation import RangeFilter
from roadscan.georeference.range_filter import limits_of_turns
from roadscan.poses.trajectory import Poses, Trajectory

TICK_NS: Final = 10_000_000  # Interval at which the trajectory is sampled.
WINDOW_NS: Final = 200 * TICK_NS
"""Limits depend on poses within this time of a profile's epoch, and half a tick."""

_WINDOW: Final = WINDOW_NS // TICK_NS
_NANO: Final = 1e-9  # Steps are summed as whole nanometres and nanoradians.


def turn_limits(
    trajectory: Trajectory, lever_arm_body_m: tuple[float, float, float], epochs_gps_ns: Int64, settings: RangeFilter
) -> Float64:
    """Return how far (n, 2) left and right of the sensor readings of profiles are kept (m); infinite outside turns.

    Parameters
    ----------
    lever_arm_body_m : of the sensor (forward, right, down).
    epochs_gps_ns : (n,) of profiles, any order.
    """
    limits = np.full((epochs_gps_ns.size, 2), np.inf)
    if epochs_gps_ns.size == 0:
        return limits
    ticks, own = np.unique((epochs_gps_ns + TICK_NS // 2) // TICK_NS, return_inverse=True)
    cuts = np.flatnonzero(np.diff(ticks) > 2 * _WINDOW) + 1
    parts = [_limits(trajectory, lever_arm_body_m, part, settings) for part in np.split(ticks, cuts)]
    return np.concatenate(parts)[own]


def _limits(
    trajectory: Trajectory, lever_arm_body_m: tuple[float, float, float], ticks: Int64, settings: RangeFilter
) -> Float64:
    """Return limits (k, 2) at ticks (k,), ascending."""
    begin = int(ticks[0]) - _WINDOW
    poses = trajectory.poses(np.arange(begin, int(ticks[-1]) + _WINDOW + 1) * TICK_NS)
    step_nm, turn_nrad = _steps(poses, lever_arm_body_m)
    path, way, heading = (_summed(steps) for steps in (np.abs(step_nm), step_nm, turn_nrad))
    at = ticks - begin
    half = round(settings.base_m / 2 / _NANO)
    piece_first, piece_last = _pieces(poses.found)
    first = np.searchsorted(path, path[at] - half, side="right") - 1
    first = np.maximum.reduce([first, at - _WINDOW, piece_first[at]])
    last = np.minimum.reduce([np.searchsorted(path, path[at] + half), at + _WINDOW, piece_last[at]])
    arc_nm, turned_nrad = way[last] - way[first], heading[last] - heading[first]
    limits = limits_of_turns(_from_nano(arc_nm), _from_nano(turned_nrad), settings)
    limits[np.abs(arc_nm) < half] = np.inf
    return limits


def _steps(poses: Poses, lever_arm_body_m: tuple[float, float, float]) -> tuple[Int64, Int64]:
    """Return steps (k − 1,) of a sensor along the body (nm) and turns to the right (nrad), 0 beside no pose.

    Written out by element: sums of a library may depend on how many there are.
    """
    r, p, (a, b, c) = poses.world_from_body, poses.position_world_m, lever_arm_body_m
    place = [p[:, i] + (r[:, i, 0] * a + r[:, i, 1] * b + r[:, i, 2] * c) for i in range(3)]
    step = sum((r[:-1, i, 0] * (place[i][1:] - place[i][:-1]) for i in range(3)), np.zeros(len(p) - 1))
    sine = sum((r[:-1, i, 1] * r[1:, i, 0] for i in range(3)), np.zeros(len(p) - 1))
    turn = sine * (1.0 + sine * sine / 6.0 + 0.075 * (sine * sine) ** 2)  # arcsine, to 2e-9 up to 5° in a tick
    known = poses.found[:-1] & poses.found[1:]
    return _whole(np.where(known, step, 0.0)), _whole(np.where(known, turn, 0.0))


def _whole(values: Float64) -> Int64:
    return np.rint(values / _NANO).astype(np.int64)


def _from_nano(values: Int64) -> Float64:
    return values.astype(np.float64) * _NANO


def _summed(steps: Int64) -> Int64:
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(steps)])


def _pieces(found: npt.NDArray[np.bool_]) -> tuple[Int64, Int64]:
    """Return first and last tick (k,) of the unbroken piece of poses that contains each tick."""
    number = np.arange(found.size)
    breaks = ~(found[:-1] & found[1:])
    first = np.maximum.accumulate(np.where(np.concatenate([[True], breaks]), number, 0))
    last = np.minimum.accumulate(np.where(np.concatenate([breaks, [True]]), number, found.size)[::-1])[::-1]
    return first, last
