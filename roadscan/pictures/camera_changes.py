"""What an adjustment adds to a camera's lens, clock and row time (table `camera_corrections`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.camera import Interior
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import Sensor
from roadscan.pictures.lens import PARAMETERS, parameters, with_parameters
from roadscan.store.small_tables import read_small
from roadscan.store.store import Store

Float64 = npt.NDArray[np.float64]

TABLE: Final = "camera_corrections"
LENS: Final = PARAMETERS
COLUMNS: Final = (*PARAMETERS, "clock_s", "line_time_s")
"""Columns of the table, in the order of the values."""


def load_camera_changes(store: Store) -> Mapping[str, Float64]:
    """Returns what is added to the cameras (11,), `COLUMNS`, by sensor."""
    table = read_small(store, TABLE)
    rows = [] if table is None else table.to_pylist()
    return {row["sensor"]: np.array([float(row[name]) for name in COLUMNS]) for row in rows}


def interior_of(camera: Sensor, change: Float64 | None) -> Interior:
    """Returns the interior orientation of a camera with a change (11,) of its lens and row time.

    Raises
    ------
    ConfigError
        where the rig file states none.
    """
    if camera.interior is None:
        raise ConfigError("a camera has no interior orientation")
    if change is None or not np.any(change):
        return camera.interior
    return with_parameters(camera.interior, parameters(camera.interior) + change[: len(LENS)])


def clock_ns(change: Float64 | None) -> int:
    """Returns what is added to the stamps of a camera's pictures (ns)."""
    return 0 if change is None else round(float(change[COLUMNS.index("clock_s")]) * NS_PER_S)
