"""What an adjustment adds to a camera's lens, clock and row time (table `camera_corrections`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.camera import Interior
from roadscan.core.gpstime import NS_PER_S
from roadscan.pictures.lens import PARAMETERS
from roadscan.store.small_tables import read_small
from roadscan.store.store import Store

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

TABLE: Final = "camera_corrections"
COLUMNS: Final = (*PARAMETERS, "clock_s", "line_time_s")
"""Columns of the table, in the order of the values."""


JOINT_TABLE: Final = "camera_covariances"
JOINT: Final = 21
"""Errors of a picture that are known jointly: 6 of its pose, 6 of the mounting, 9 of the lens (`PARAMETERS`)."""


def load_joint_covariances(store: Store, run: str, sensor: str) -> tuple[Int64, Float64] | None:
    """Returns epochs (k,) and covariances (k, 21, 21) that an adjustment found for a camera in a run; None without."""
    table = read_small(store, JOINT_TABLE)
    rows = [] if table is None else [r for r in table.to_pylist() if (r["run"], r["sensor"]) == (run, sensor)]
    if not rows:
        return None
    upper = np.triu_indices(JOINT)
    found = np.zeros((len(rows), JOINT, JOINT))
    found[:, upper[0], upper[1]] = found[:, upper[1], upper[0]] = [row["covariance"] for row in rows]
    return np.array([row["epoch_gps_ns"] for row in rows], np.int64), found


def load_camera_changes(store: Store) -> Mapping[str, Float64]:
    """Returns what is added to the cameras (11,), `COLUMNS`, by sensor."""
    table = read_small(store, TABLE)
    rows = [] if table is None else table.to_pylist()
    return {row["sensor"]: np.array([float(row[name]) for name in COLUMNS]) for row in rows}


def changed(interior: Interior, change: Float64 | None) -> Interior:
    """Returns an interior orientation with a change (11,) of its lens; clock and row time are applied to epochs."""
    if change is None or not np.any(change):
        return interior
    stated = [*interior.focal_px, *interior.principal_px, *interior.distortion]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (np.array(stated) + change[: len(PARAMETERS)]).tolist()
    update = {"focal_px": (fx, fy), "principal_px": (cx, cy), "distortion": (k1, k2, p1, p2, k3)}
    return interior.model_copy(update=update)


def row_ns(interior: Interior, change: Float64 | None) -> float:
    """Returns the time (ns) from the exposure of a row to that of the row below; 0 of a global shutter."""
    found = 0.0 if change is None else float(change[COLUMNS.index("line_time_s")])
    return 1e3 * interior.line_time_us + found * NS_PER_S


def clock_ns(change: Float64 | None) -> int:
    """Returns what is added to the stamps of a camera's pictures (ns)."""
    return 0 if change is None else round(float(change[COLUMNS.index("clock_s")]) * NS_PER_S)
