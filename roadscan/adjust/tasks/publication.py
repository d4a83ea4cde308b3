"""The table `corrections`: rows of this stage and of other programs, and their update by a new solution."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any, Final

import pyarrow.compute as pc

from roadscan.adjust.observations import COMPONENTS
from roadscan.adjust.publish import published
from roadscan.adjust.settings import AdjustConfig
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
