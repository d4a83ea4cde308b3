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


def level_table() -> pa.Table:
    zero = np.zeros(6)
    columns = {"latitude_deg": zero + 50, "longitude_deg": zero + 10, "height_m": 100 + zero, "sigma_down_m": zero}
    columns |= {"roll_deg": zero, "pitch_deg": zero, "heading_rad": zero + 1}
    epochs = np.arange(6) * 10**9 + 1_400_000_000_000_000_000
    table = pa.table({"epoch_gps_ns": epochs, **columns})
    return table.replace_schema_metadata({"roadscan.trajectory": '{"crs": "EPSG:4937", "height": "ellipsoidal"}'})


def level_parquet() -> bytes:
    sink = pa.BufferOutputStream()
    pa.parquet.write_table(level_table(), sink, write_page_checksum=True)
    return bytes(sink.getvalue())


def level_feather() -> bytes:
    sink = pa.BufferOutputStream()
    pa.feather.write_feather(level_table(), sink, compression="uncompressed")
    return bytes(sink.getvalue())


def returns_parquet() -> bytes:
    epochs = np.arange(12) * 10**6 + 1_400_000_000_000_000_000
    axes = {f"{axis}_sensor_m": np.linspace(1, 2, 12, dtype=np.float32) for axis in "xyz"}
    whole = {"intensity": np.arange(12, dtype=np.uint16), "laser": np.arange(12, dtype=np.uint8)}
    sink = pa.BufferOutputStream()
    pa.parquet.write_table(pa.table({"epoch_gps_ns": epochs, **axes, **whole}), sink, write_page_checksum=True)
    return bytes(sink.getvalue())


def control_csv() -> bytes:
    names = "name,code,role,easting,northing,height_m"
    return "\n".join([names, *(f'"P{i}",X,gcp,571600.{i},5539000.5,300' for i in range(6)), ""]).encode()
