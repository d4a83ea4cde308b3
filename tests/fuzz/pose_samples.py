"""Small trajectories and control points in text and tables, as their files' bytes."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet


def quaternion_table() -> pa.Table:
    zero = np.zeros(6)
    columns = dict.fromkeys(("qx", "qy", "qz", "tx", "ty", "tz"), zero)
    return pa.table({"time_s": 1.4e9 + np.arange(6), "qw": zero + 1, **columns})


def pose_feather() -> bytes:
    sink = pa.BufferOutputStream()
    pa.feather.write_feather(quaternion_table(), sink, compression="uncompressed")
    return bytes(sink.getvalue())


def pose_parquet() -> bytes:
    sink = pa.BufferOutputStream()
    pa.parquet.write_table(quaternion_table(), sink)
    return bytes(sink.getvalue())


def control_csv() -> bytes:
    names = "name,code,role,easting,northing,height_m"
    return "\n".join([names, *(f'"P{i}",X,gcp,571600.{i},5539000.5,300' for i in range(6)), ""]).encode()
