"""Draws pictures of computed trajectories from the store, without solving again."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.core.extras import can_draw
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.grid import of_run
from roadscan.core.survey import Survey
from roadscan.navigation.inertial.motion import ned_from_world
from roadscan.navigation.inertial.readings import Innovations, Solution
from roadscan.navigation.picture import NavigationPicture, draw_navigation
from roadscan.navigation.tasks.navigation_logs import gnss_solutions
from roadscan.navigation.tasks.recorded_pictures import NAVIGATION_PICTURE, keep_file, picture_key, remove_others
from roadscan.navigation.tasks.solve_trajectory import SMOOTHER, on_time
from roadscan.navigation.tasks.trajectories import load_clocks
from roadscan.store.logs import LogRecord, read_log_records
from roadscan.store.manifest import Manifest
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

_FOLDER: Final = "products/navigation"
_VALUE: Final = ("value", "sigma")


def picture_path(run: str) -> str:
    """Return the path of the picture of a run's trajectory, relative to the survey's root."""
    return f"{_FOLDER}/{run}.png"


def draw_trajectories(
    survey: Survey,
    store: Store,
    records: Sequence[LogRecord],
    runs: Collection[str],
    report: Callable[[str], None] = lambda _: None,
) -> None:
    """Draw pictures of computed trajectories that are missing, damaged or stale; remove those without a run.

    Without Matplotlib there are none.

    Parameters
    ----------
    records : of the computed trajectories that hold.
    runs : those that shall have one.
    """
    if not can_draw():
        runs, records = (), ()
    if not runs and not store.files(_FOLDER):
        return
    manifest = Manifest(store)
    remove_others(manifest, NAVIGATION_PICTURE, runs)
    for record in records:
        title = f"{survey.config.id}, run {record.run}"
        key = picture_key(title, record.key)
        if record.format != SMOOTHER or manifest.is_current(NAVIGATION_PICTURE, record.run, key):
            continue
        picture, target = _picture(survey, store, record, title), picture_path(record.run)

        def write(path: Path, picture: NavigationPicture = picture) -> None:
            draw_navigation(path, picture)

        keep_file(store, manifest, (NAVIGATION_PICTURE, record.run), key, target, write)
        report(f"drawn: {target}")


def _picture(survey: Survey, store: Store, record: LogRecord, title: str) -> NavigationPicture:
    logs = read_log_records(store, record.attributes["logs"])
    receiver = [log for log in logs if log.tables.get("gnss")]
    clock = of_run(load_clocks(store), record.run, receiver[0].sensor)
    arm = survey.rig.sensors[receiver[0].sensor].lever_arm_body_m
    return NavigationPicture(
        title, stored_solution(store, record), on_time(gnss_solutions(store, receiver), clock), np.array(arm)
    )


def stored_solution(store: Store, record: LogRecord) -> Solution:
    """Return a computed trajectory from its tables.

    Covariances are those of their diagonals, velocities differences of positions; attitude and velocity have no
    covariance.
    """
    rows = _columns(store, record, "trajectory")
    epochs, world = rows["epoch_gps_ns"], str(record.attributes["world_frame"])
    position = np.stack([rows[f"{a}_world_m"] for a in "xyz"], axis=-1)
    sigma = np.stack([rows[f"sigma_{a}_m"].astype(np.float64) for a in ("north", "east", "down")], axis=-1)
    angles = np.stack([rows[f"sigma_{a}_deg"].astype(np.float64) for a in ("roll", "pitch", "heading")], axis=-1)
    since = (epochs - epochs[0]).astype(np.float64) / NS_PER_S
    velocity = np.gradient(position - position[0], since, axis=0) @ ned_from_world(world, position[0]).T
    unknown = np.full((epochs.size, 3, 3), np.nan)
    at, states = _states(_columns(store, record, "navigation_states"))
    return Solution(
        world=world,
        epochs_gps_ns=epochs,
        position_world_m=position,
        quaternion_world_from_body=np.stack([rows[q] for q in ("qw", "qx", "qy", "qz")], axis=-1),
        velocity_ned_m_per_s=velocity,
        covariance_position_ned_m2=sigma[:, :, None] ** 2 * np.eye(3),
        covariance_attitude_rad2=unknown,
        covariance_velocity_ned=unknown,
        sigma_rph_rad=np.radians(angles),
        states=states,
        state_epochs_gps_ns=at,
        innovations=_innovations(_columns(store, record, "innovations")),
        pieces=tuple((int(a), int(b)) for a, b in record.attributes["pieces"]),
    )


def _columns(store: Store, record: LogRecord, table: str) -> dict[str, npt.NDArray[Any]]:
    """Return columns of a record's rows in a table; empty where it has none."""
    parts = [read_groups(store, f.path, range(len(f.group_rows))) for f in record.tables.get(table, ())]
    rows = pa.concat_tables(parts) if parts else pa.table({})
    return {name: rows.column(name).to_numpy() for name in rows.column_names}


def _states(rows: dict[str, npt.NDArray[Any]]) -> tuple[npt.NDArray[np.int64], dict[str, tuple[Float64, Float64]]]:
    """Return epochs (j,) and states by name, (j,) or (j, axes) with their σ."""
    if not rows:
        return np.zeros(0, np.int64), {}
    found: dict[str, tuple[Float64, Float64]] = {}
    names = rows["state"].astype(np.str_)
    for name in np.unique(names).tolist():
        axes = [(names == name) & (rows["axis"] == axis) for axis in np.unique(rows["axis"][names == name])]
        value, sigma = (np.stack([rows[c][own].astype(np.float64) for own in axes], axis=-1) for c in _VALUE)
        found[name] = (value[:, 0], sigma[:, 0]) if len(axes) == 1 else (value, sigma)
    return np.unique(rows["epoch_gps_ns"]), found


def _innovations(rows: dict[str, npt.NDArray[Any]]) -> Innovations | None:
    if not rows:
        return None
    residual = np.stack([rows[f"residual_{i}"].astype(np.float64) for i in (1, 2, 3)], axis=-1)
    return Innovations(
        rows["epoch_gps_ns"], rows["kind"].astype(np.str_), residual, rows["normalised"].astype(np.float64),
        rows["weight"],
    )  # fmt: skip
