"""Puts the returns of a lidar together as a batch of the table `returns`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

Numbers = npt.NDArray[Any]


def returns_batch(
    epoch_gps_ns: Numbers,
    xyz_sensor_m: Sequence[Numbers],
    intensity: Numbers,
    laser: Numbers,
    sweep: Numbers,
    pose_epoch_gps_ns: Numbers | None = None,
) -> pa.RecordBatch:
    """Return a batch of n returns from arrays (n,), of the types of the table.

    Parameters
    ----------
    xyz_sensor_m : x, y and z in the sensor's axes.
    pose_epoch_gps_ns : epochs of the poses that place them; None: a return's own.
    """
    x, y, z = (np.ascontiguousarray(one) for one in xyz_sensor_m)
    columns = {
        "epoch_gps_ns": epoch_gps_ns,
        "pose_epoch_gps_ns": epoch_gps_ns if pose_epoch_gps_ns is None else pose_epoch_gps_ns,
        "x_sensor_m": x,
        "y_sensor_m": y,
        "z_sensor_m": z,
        "intensity": intensity,
        "laser": laser,
        "sweep": sweep,
    }
    return pa.RecordBatch.from_pydict({name: pa.array(values) for name, values in columns.items()})
