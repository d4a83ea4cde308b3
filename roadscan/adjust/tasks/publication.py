"""The table `corrections`: from a solution to its rows; those that move no pose stay bit-identical."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow.compute as pc

from roadscan.adjust.observations import COMPONENTS, Observations
from roadscan.adjust.settings import AdjustConfig
from roadscan.compute.array_types import Float64
from roadscan.navigation.tasks.trajectories import CORRECTION_SIGMAS, load_all_corrections
from roadscan.poses.trajectory import Corrections
from roadscan.store.small_tables import read_small, small_path, write_small
from roadscan.store.store import Store

_WRITER: Final = "adjust"


def foreign_runs(store: Store) -> set[str]:
    """Returns runs whose corrections another program wrote."""
    table = read_small(store, "corrections")
    if table is None:
        return set()
    if "written_by" not in table.column_names:
        return set(table.column("run").to_pylist())
    own = pc.fill_null(pc.equal(table.column("written_by"), _WRITER), False)
    return set(table.filter(pc.invert(own)).column("run").to_pylist())


def publish(store: Store, solved: Mapping[str, Corrections], config: AdjustConfig) -> dict[str, Corrections]:
    """Update the table with a solution; returns the current corrections of its runs.

    Runs that have no solution any more lose their corrections, those of other programs stay.
    """
    before, foreign = load_all_corrections(store), foreign_runs(store)
    after = {
        run: published(before.get(run), own, config.moved_m, config.moved_arm_m)
        for run, own in solved.items()
        if run not in foreign
    }
    kept = {run: own for run, own in before.items() if run in foreign}
    if not (after or kept):
        if store.exists(small_path("corrections")):
            store.remove(small_path("corrections"))
        return after
    same = after.keys() | kept.keys() == before.keys() and all(own is before.get(run) for run, own in after.items())
    if not same:
        rows = [row for run, own in sorted(after.items()) for row in _rows(run, own, _WRITER)]
        rows += [row for run, own in sorted(kept.items()) for row in _rows(run, own, None)]
        write_small(store, "corrections", rows)
    return after


def digests_of(store: Store) -> list[str]:
    """Returns digests of the tables `corrections` and `mounting_corrections` as they are; "" without one."""
    paths = [small_path(name) for name in ("corrections", "mounting_corrections")]
    return [hashlib.blake2b(store.read_bytes(p), digest_size=8).hexdigest() if store.exists(p) else "" for p in paths]


def _rows(run: str, own: Corrections, writer: str | None) -> list[dict[str, Any]]:
    columns: dict[str, list[Any]] = {"epoch_gps_ns": own.epochs_gps_ns.tolist()}
    columns |= dict(zip(COMPONENTS[:3], own.north_east_down_m.T.tolist(), strict=True))
    columns |= dict(zip(COMPONENTS[3:], own.roll_pitch_heading_rad.T.tolist(), strict=True))
    if own.sigma is not None:
        columns |= dict(zip(CORRECTION_SIGMAS, own.sigma.T.tolist(), strict=True))
    names = list(columns)
    return [
        {"run": run, "written_by": writer, **dict(zip(names, row, strict=True))}
        for row in zip(*columns.values(), strict=True)
    ]


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
