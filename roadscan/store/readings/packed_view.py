"""Packed returns as rows of ``returns`` in SQL: what `packed_returns` computes, in DuckDB's own arithmetic.

DuckDB's sine and cosine may differ from NumPy's in their last bit of 53, so that single coordinates may differ in their
last bit of 24.
"""

from __future__ import annotations

from typing import Final

from roadscan.store.readings.packed_returns import BEAMS, PACKED
from roadscan.store.schema import table_schema

_KINDS: Final = {"uint8": "UTINYINT", "int64": "BIGINT", "float32": "FLOAT"}  # DuckDB's names for types of `beams`

_HEADS: Final = """
heads AS (
  SELECT r.* RENAME (intensity AS digital), b.* EXCLUDE (slot, log), rate_rad_per_ns * after_ns AS angle,
    sin(radians(head * 0.01::DOUBLE))::FLOAT AS head_sine, cos(radians(head * 0.01::DOUBLE))::FLOAT AS head_cosine
  FROM {packed} AS r JOIN {beams} AS b USING (log, slot)),
ranges AS (
  SELECT *, (angle * (1.0::DOUBLE - angle * angle / 6.0::DOUBLE))::FLOAT AS small_sine,
    (1.0::DOUBLE - angle * angle / 2.0::DOUBLE)::FLOAT AS small_cosine, distance::FLOAT * unit_m + extra_m AS range_m
  FROM heads),
turned AS (
  SELECT *, head_sine * small_cosine + head_cosine * small_sine AS turned_sine,
    head_cosine * small_cosine - head_sine * small_sine AS turned_cosine, range_m * cos_elevation + reach_m AS level_m
  FROM ranges),
aimed AS (
  SELECT *, turned_sine * cos_azimuth + turned_cosine * sin_azimuth AS sine,
    turned_cosine * cos_azimuth - turned_sine * sin_azimuth AS cosine
  FROM turned)"""
_COMPUTED: Final = {
    "pose_epoch_gps_ns": "epoch_gps_ns",
    "x_sensor_m": "level_m * cosine + side_m * sine",
    "y_sensor_m": "level_m * -sine + side_m * cosine",
    "z_sensor_m": "range_m * sin_elevation + rise_m",
    "intensity": "digital::USMALLINT * 257::USMALLINT",
}
"""Columns of ``returns`` that are computed."""
_BETWEEN: Final = (
    "digital", "angle", "head_sine", "head_cosine", "small_sine", "small_cosine", "range_m", "turned_sine",
    "turned_cosine", "level_m", "sine", "cosine",
)  # fmt: skip
"""Columns that only the statement has."""


def beams_query(files: str) -> str:
    """Return the statement that reads the table ``beams`` from the footers of files, one or more of each log.

    files : their names, as SQL.
    """
    kinds = ", ".join(f'"{c.name}": "{_KINDS[c.type]}"' for c in table_schema("beams").columns)
    return (
        "SELECT DISTINCT regexp_extract(file_name, '.*/log=([^/]*)/', 1) AS log,\n"
        f"  unnest(from_json(decode(value), '[{{{kinds}}}]'), recursive := true)\n"
        f"FROM parquet_kv_metadata({files}) WHERE decode(key) = '{BEAMS.decode()}'"
    )


def returns_query(packed: str = PACKED, beams: str = "beams") -> str:
    """Return the statement that makes rows of ``returns`` of the tables ``packed_returns`` and ``beams``.

    packed, beams : what they are called, or statements in brackets that read them.
    """
    own = [c.name for c in table_schema("returns").columns]
    stored = [c.name for c in (*table_schema(PACKED).columns, *table_schema("beams").columns)]
    rest = dict.fromkeys([*(name for name in stored if name != "intensity"), *_BETWEEN])
    columns = ",\n  ".join(f"{_COMPUTED[name]} AS {name}" if name in _COMPUTED else name for name in own)
    heads = _HEADS.strip().format(packed=packed, beams=beams)
    return f"WITH {heads}\nSELECT {columns},\n  * EXCLUDE ({', '.join(rest)})\nFROM aimed"
