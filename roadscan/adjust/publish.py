"""From a solution to the published corrections: those that move no pose stay bit-identical."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from roadscan.adjust.observations import Observations
from roadscan.compute.array_types import Float64
from roadscan.poses.trajectory import Corrections

_SAME_SIGMA: Final = 0.05
"""σ that differ by no more than this share are equal: evidence changes them a little with each new run."""


def published(before: Corrections | None, solved: Corrections, moved_m: float, arm_m: float) -> Corrections:
    """Corrections to publish: knots of the solution where it moves a pose by more than stated, else those before.

    Between knots corrections are linear, so nowhere do they depart from the solution by more than at a knot. Where the
    knots lie at other epochs, all are replaced. σ is always that of the solution, but for a few percent: what is
    doubted anew widens it, though no pose moves.

    Parameters
    ----------
    moved_m : shift and turn together (m).
    arm_m : a turn counts as the movement of a point so far from the body's origin (m).
    """
    if before is None or not np.array_equal(before.epochs_gps_ns, solved.epochs_gps_ns):
        return solved
    shift = np.linalg.norm(solved.north_east_down_m - before.north_east_down_m, axis=1)
    turn = np.linalg.norm(solved.roll_pitch_heading_rad - before.roll_pitch_heading_rad, axis=1)
    moved = shift + arm_m * turn > moved_m
    sigma = solved.sigma
    if sigma is not None and before.sigma is not None:
        same = np.isclose(sigma, before.sigma, rtol=_SAME_SIGMA, atol=0.0, equal_nan=True).all(axis=1)
        if not moved.any() and same.all():
            return before
        sigma = np.where((moved | ~same)[:, None], sigma, before.sigma)
    elif not moved.any() and (sigma is None) == (before.sigma is None):
        return before
    return Corrections(
        solved.epochs_gps_ns,
        np.where(moved[:, None], solved.north_east_down_m, before.north_east_down_m),
        np.where(moved[:, None], solved.roll_pitch_heading_rad, before.roll_pitch_heading_rad),
        sigma,
    )


def left_after(
    observations: Observations,
    corrections: Mapping[str, Corrections],
    runs: Sequence[str],
    mountings: Float64 | None = None,
) -> Float64:
    """Returns the residual (n,) of each observation once poses and mountings are corrected (m).

    runs are counted as in `runs`; mountings : (s, 7) what is added to those that `Observations.sensor` counts.
    """
    left = observations.observed_m.copy()
    for end in (0, 1) if mountings is not None and len(mountings) else ():
        here = np.flatnonzero(observations.sensor[:, end] >= 0)
        own = np.asarray(mountings)[observations.sensor[here, end]]
        left[here] -= np.einsum("ni,ni->n", observations.mount_partials[here, end], own)
    for number, run in enumerate(runs):
        own = corrections.get(run)
        if own is None:
            continue
        for end in (0, 1):
            here = np.flatnonzero(observations.run[:, end] == number)
            moved = np.concatenate(own.at(observations.epoch_gps_ns[here, end]), axis=1)
            left[here] -= np.einsum("ni,ni->n", observations.partials[here, end], moved)
    return left
