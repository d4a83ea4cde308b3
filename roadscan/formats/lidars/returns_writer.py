"""Writes lidar returns in arrays as `returns_table`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from roadscan.core.errors import ConfigError
from roadscan.formats.lidars.returns_table import AXES
from roadscan.ingest.array_files import (
    ClockLike,
    WrittenLog,
    epochs_gps_ns,
    float_array,
    parquet_file,
    whole_array,
)
from roadscan.ingest.reading.table_stamps import EPOCH

_FLOAT_M: Final = 1_000.0
"""Farthest position (m) that single precision represents to 0.06 mm."""
_GROUP_ROWS: Final = 1 << 17  # rows of a row group


def write_returns(
    path: str | Path,
    epochs: Any,
    xyz_m: Any,
    *,
    intensity: Any = None,
    laser: Any = None,
    sweep: Any = None,
    clock: ClockLike = None,
) -> WrittenLog:
    """Write lidar returns as a Parquet log that `roadscan` reads as `returns_table`; return what was written.

    Parameters
    ----------
    epochs : (n,) GPS nanoseconds (int64) at which each return was measured, or stamps of `clock`, or calendar times.
    xyz_m : (n, 3) positions in the axes of the sensor, which the rig file states. They are kept in single precision
        (0.03 mm at 500 m). A return with NaN is left out.
    intensity, laser, sweep : (n,) whole numbers: from 0 to 65,535, from 0 to 255, from 0 on.
    clock : time system of the epochs, keys as in the survey file; None for GPS nanoseconds.

    Raises
    ------
    ConfigError, TimeSystemError
        if shapes differ, numbers do not fit, or epochs say no time system.
    """
    target = Path(path)
    epoch_gps_ns = epochs_gps_ns(epochs, clock, "epochs")
    places = float_array(xyz_m, (epoch_gps_ns.size, 3), "xyz_m")
    kept = ~np.isnan(places).any(axis=1)
    if not kept.any():
        raise ConfigError("xyz_m holds no whole return", expected="one or more without NaN")
    if np.abs(places[kept]).max() > _FLOAT_M:
        raise ConfigError(
            f"a return lies {np.abs(places[kept]).max():,.0f} m from the sensor",
            expected=f"positions in the sensor's own axes, within {_FLOAT_M:,.0f} m",
            change="points that are on a map already are a cloud: write them as LAS",
        )
    columns: dict[str, Any] = {EPOCH: epoch_gps_ns[kept]}
    columns |= {axis: places[kept, k].astype(np.float32) for k, axis in enumerate(AXES)}
    for name, values, kind in (
        ("intensity", intensity, np.uint16),
        ("laser", laser, np.uint8),
        ("sweep", sweep, np.int32),
    ):
        if values is not None:
            columns[name] = whole_array(values, epoch_gps_ns.shape, kind, name)[kept]
    table = pa.table(columns)
    with parquet_file(target, table.schema) as writer:
        writer.write_table(table, row_group_size=_GROUP_ROWS)
    return WrittenLog(target, table.num_rows, int(columns[EPOCH].min()), int(columns[EPOCH].max()))
