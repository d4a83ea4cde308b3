"""Loads trajectories of runs and their corrections from the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.core.gpstime import NS_PER_S
from roadscan.poses.trajectory import STENCIL_KNOTS, Corrections, Trajectory
from roadscan.store.logs import DataFile
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.small_tables import read_small
from roadscan.store.store import Store

_SIGMA_COLUMNS = ["sigma_north_m", "sigma_east_m", "sigma_down_m"]

CORRECTION_SIGMAS: Final = tuple(
    f"sigma_{name}" for name in ("north_m", "east_m", "down_m", "roll_rad", "pitch_rad", "heading_rad")
)
"""Columns of the table `corrections`."""

_POSE_COLUMNS = ["epoch_gps_ns", "x_world_m", "y_world_m", "z_world_m", "qw", "qx", "qy", "qz", *_SIGMA_COLUMNS]


@dataclass(frozen=True)
class TrajectorySource:
    """Location of the poses of a run."""

    run: str
    world: str
    files: tuple[DataFile, ...]


def load_trajectory(
    store: Store, source: TrajectorySource, spans: Sequence[tuple[int, int]], max_gap_s: float
) -> Trajectory:
    """Load poses of a run around spans of time, with corrections.

    Poses beyond each span are read as far as interpolation uses them, so the result does not depend on the spans.
    """
    return load_recorded(store, source, spans, max_gap_s).corrected(load_corrections(store, source.run))


def load_recorded(
    store: Store, source: TrajectorySource, spans: Sequence[tuple[int, int]], max_gap_s: float
) -> Trajectory:
    """Load the same poses as recorded."""
    pad = round(STENCIL_KNOTS * max_gap_s * NS_PER_S)
    wanted = np.array(spans, dtype=np.int64).reshape(-1, 2) + np.array([-pad, pad])
    parts: list[pa.Table] = []
    for file in source.files:
        held = np.array(file.group_spans, dtype=np.int64).reshape(-1, 1, 2)
        is_near = (held[:, :, 0] <= wanted[:, 1]) & (held[:, :, 1] >= wanted[:, 0])
        groups = np.flatnonzero(is_near.any(axis=1)).tolist()
        if groups:
            parts.append(read_groups(store, file.path, groups, _POSE_COLUMNS))
    if not parts:
        empty = np.zeros(0, np.int64)
        return Trajectory(source.world, empty, np.zeros((0, 3)), np.zeros((0, 4)), max_gap_s)
    rows = pa.concat_tables(parts)
    epochs = rows.column("epoch_gps_ns").to_numpy()
    rows = rows.filter((epochs >= wanted[:, 0].min()) & (epochs <= wanted[:, 1].max()))  # row groups hold minutes
    column = {name: rows.column(name).to_numpy() for name in _POSE_COLUMNS}
    return Trajectory.of(
        source.world,
        column["epoch_gps_ns"],
        np.stack([column[f"{a}_world_m"] for a in "xyz"], axis=-1),
        np.stack([column[a] for a in ("qw", "qx", "qy", "qz")], axis=-1),
        max_gap_s,
        np.stack([column[a] for a in _SIGMA_COLUMNS], axis=-1).astype(np.float64),
    )


def load_corrections(store: Store, run: str) -> Corrections | None:
    """Load corrections of a run's trajectory, None where no adjustment wrote any."""
    rows = read_small(store, "corrections")
    return None if rows is None else _corrections(rows, run)


def load_all_corrections(store: Store) -> dict[str, Corrections]:
    """Load corrections of the trajectories of all runs that have any."""
    rows = read_small(store, "corrections")
    runs = [] if rows is None else sorted(pc.unique(rows.column("run")).to_pylist())
    return {run: found for run in runs if (found := _corrections(rows, run)) is not None}


def _corrections(rows: pa.Table, run: str) -> Corrections | None:
    rows = rows.filter(pc.equal(rows.column("run"), run))
    if rows.num_rows == 0:
        return None
    return Corrections(
        rows.column("epoch_gps_ns").to_numpy(),
        np.stack([rows.column(c).to_numpy() for c in ("north_m", "east_m", "down_m")], axis=-1),
        np.stack([rows.column(c).to_numpy() for c in ("roll_rad", "pitch_rad", "heading_rad")], axis=-1),
        _sigma(rows),
    )


def _sigma(rows: pa.Table) -> npt.NDArray[np.float64] | None:
    """Return 1 σ (k, 6) of corrected poses; None in tables that state none."""
    if any(name not in rows.column_names for name in CORRECTION_SIGMAS):
        return None
    return np.stack([pc.fill_null(rows.column(c), np.nan).to_numpy() for c in CORRECTION_SIGMAS], axis=-1)
