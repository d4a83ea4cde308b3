"""Packed returns: what a lidar wrote of each return, and the rows of ``returns`` of it, in Python and in SQL.

The positions are computed as the reader of the format computed them before such files were there, to the last bit.

Packed returns as rows of ``returns`` in SQL: what `packed_returns` computes, in DuckDB's arithmetic.

DuckDB's sine and cosine may differ from NumPy's in their last bit of 53, so that single coordinates may differ in their
last bit of 24.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float32
from roadscan.compute.kernel_options import read_only
from roadscan.store.readings.kernels.firings import SLOTS, BeamTable, Packed, Turned, positions
from roadscan.store.schema import TableSchema, table_schema

PACKED: Final = "packed_returns"
"""Name of the stored table."""
BEAMS: Final = b"roadscan.beams"
"""Key of the sensor's beams in the footer."""
_BOXES: Final = b"roadscan.boxes"
"""Key of the least and the greatest x, y, z of each row group, which statistics of other columns do not hold."""
EIGHT_TO_SIXTEEN_BITS: Final = np.uint16(257)
"""Scales 255 to 65,535: intensities of 8 bits have the range of the table's."""
_AXES: Final = ("x_sensor_m", "y_sensor_m", "z_sensor_m")
_EPOCHS: Final = ("epoch_gps_ns", "pose_epoch_gps_ns")
_POLAR: Final = ("head", "rate_rad_per_ns", "distance", "slot")
"""Columns that state the place of a return."""
_STORED: Final = dict.fromkeys(_AXES, _POLAR) | dict.fromkeys(_EPOCHS, ("epoch_gps_ns",)) | {"laser": ("slot",)}
"""Stored columns of which a column of ``returns`` is made, where it is not stored itself."""
_CENTIDEG: Final = 0.01
"""What an azimuth counts (°)."""

Numbers = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Beams:
    """Beams of a sensor by slot: the columns of the table ``beams``."""

    columns: Mapping[str, Numbers]

    @classmethod
    def of(cls, metadata: Mapping[bytes, bytes] | None) -> Beams:
        """Return the beams that stand in the metadata of a file or batch; ValueError where they do not."""
        return _beams(bytes((metadata or {}).get(BEAMS, b"")))

    def encoded(self) -> bytes:
        """Return them as the footer holds them: numbers of 32 bits as those of 64 bits that are equal to them."""
        rows = zip(*(values.tolist() for values in self.columns.values()), strict=True)
        return json.dumps([dict(zip(self.columns, row, strict=True)) for row in rows], separators=(",", ":")).encode()

    @functools.cached_property
    def lasers(self) -> Numbers:
        """Return the laser (256,) of each slot."""
        return _padded(self.columns["laser"])

    @functools.cached_property
    def table(self) -> BeamTable:
        """Return the tables of the kernel."""
        c = {name: _padded(values) for name, values in self.columns.items()}
        offsets, azimuths = ("extra_m", "reach_m", "side_m"), ("cos_azimuth", "sin_azimuth")
        none = [name for group in (offsets, azimuths[1:]) if not any(c[n].any() for n in group) for name in group]
        none += azimuths[:1] * ("sin_azimuth" in none)
        c |= {name: c[name][:0] for name in none}
        c |= {"after_ns": self.columns["after_ns"].astype(np.float64), "unit_m": self.columns["unit_m"][:1]}
        return BeamTable(*(c[name] for name in BeamTable._fields))

    def places(self, packed: Packed, xyz_m: Sequence[Float32]) -> None:
        """Write the positions (n,) of returns in the sensor's axes."""
        turned = Turned(*np.zeros((len(Turned._fields), SLOTS), np.float32))
        positions(Packed(*(read_only(one) for one in packed)), self.table, _heads(), turned, *xyz_m)


def packed_of(rows: pa.Table | pa.RecordBatch) -> Packed:
    """Return what the kernel takes of packed rows."""
    head, rate, distance, slot = (rows.column(name).to_numpy() for name in _POLAR)
    return Packed(*_runs(head), *_runs(rate), distance, slot)


def _runs(values: Numbers) -> tuple[Numbers, Numbers]:
    """Return the value of each run of equal values (n,), and the row after it."""
    ends = np.append(np.flatnonzero(values[1:] != values[:-1]) + 1, values.size)[: values.size]
    return values[ends - 1], ends


def is_packed(names: Sequence[str]) -> bool:
    """Return True for the columns of packed returns."""
    return "slot" in names and "x_sensor_m" not in names


def stored_schema(table: str, names: Sequence[str]) -> TableSchema:
    """Return the schema of a file or batch of rows of a table, by its columns."""
    return table_schema(PACKED if table == "returns" and is_packed(names) else table)


def stored_columns(names: Sequence[str] | None, held: Sequence[str]) -> list[str] | None:
    """Return the columns that a file with the columns `held` has to give for columns of ``returns``; None is all."""
    if names is None or not is_packed(held):
        return None if names is None else list(names)
    return list(dict.fromkeys(own for name in names for own in _STORED.get(name, (name,))))


def as_returns(rows: pa.Table, names: Sequence[str] | None = None) -> pa.Table:
    """Return the columns of ``returns``, all or those of `names`, of packed rows; other rows unchanged."""
    if BEAMS not in (rows.schema.metadata or {}):
        return rows
    batch = rows.combine_chunks().to_batches()
    schema = pa.schema([f for f in table_schema("returns").arrow() if names is None or f.name in names])
    return pa.Table.from_batches([returns_of(one, schema.names) for one in batch], schema)


def returns_of(batch: pa.RecordBatch, names: Sequence[str] | None = None) -> pa.RecordBatch:
    """Return the columns of ``returns``, all or those of `names`, of a batch of packed rows."""
    beams = Beams.of(batch.schema.metadata)
    schema = pa.schema([f for f in table_schema("returns").arrow() if names is None or f.name in names])
    columns: dict[str, pa.Array] = {}
    if set(_AXES) & set(schema.names):
        xyz = [np.empty(batch.num_rows, np.float32) for _ in _AXES]
        beams.places(packed_of(batch), xyz)
        columns |= {name: pa.array(values) for name, values in zip(_AXES, xyz, strict=True)}
    for name in schema.names:
        if name in _EPOCHS:
            columns[name] = batch.column("epoch_gps_ns")
        elif name == "intensity":
            columns[name] = pa.array(batch.column(name).to_numpy() * EIGHT_TO_SIXTEEN_BITS)
        elif name == "laser":
            columns[name] = pa.array(beams.lasers[batch.column("slot").to_numpy()])
        elif name not in _AXES:
            columns[name] = batch.column(name)
    return pa.RecordBatch.from_arrays([columns[name] for name in schema.names], schema=schema)


def farthest_m(batch: pa.RecordBatch) -> float:
    """Return a bound on the distances (m) from the sensor of a batch, n > 0, of packed rows."""
    c = Beams.of(batch.schema.metadata).columns
    offsets_m = sum(float(np.abs(c[name]).max()) for name in ("extra_m", "reach_m", "side_m", "rise_m"))
    return float(batch.column("distance").to_numpy().max() * c["unit_m"][0]) + offsets_m


def write_packed_returns(path: Path, rows: pa.Table, group_rows: int) -> None:
    """Write packed rows with their beams, and the box of the places of each row group, in the footer."""
    beams = Beams.of(rows.schema.metadata)
    xyz = [np.empty(min(group_rows, rows.num_rows), np.float32) for _ in _AXES]
    boxes = []
    for first in range(0, rows.num_rows, group_rows):
        part = rows.slice(first, group_rows)
        own = [values[: part.num_rows] for values in xyz]
        beams.places(packed_of(part), own)
        boxes.append([[float(values.min()), float(values.max())] for values in own])
    about = {BEAMS: beams.encoded(), _BOXES: json.dumps(boxes, separators=(",", ":")).encode()}
    runs = [c.name for c in table_schema(PACKED).columns if c.encoding == "RLE_DICTIONARY"]
    from roadscan.store.codecs.parquet.tables import write_number_table

    write_number_table(path, rows.replace_schema_metadata(about), group_rows, runs)


def box_of(metadata: Mapping[bytes, bytes] | None, group: int) -> list[list[float]] | None:
    """Return least and greatest x, y, z (m) of a row group, from the footer; None where it does not say."""
    boxes = _boxes(bytes((metadata or {}).get(_BOXES, b"[]")))
    return boxes[group] if group < len(boxes) else None


@functools.lru_cache(maxsize=16)
def _boxes(encoded: bytes) -> list[list[list[float]]]:
    found: list[list[list[float]]] = json.loads(encoded)
    return found


@functools.lru_cache(maxsize=64)
def _beams(encoded: bytes) -> Beams:
    rows = json.loads(encoded or b"[]")
    columns = table_schema("beams").columns
    if not 0 < len(rows) <= SLOTS or [row.get("slot") for row in rows] != list(range(len(rows))):
        raise ValueError("its footer does not hold the sensor's beams")
    return Beams({c.name: np.array([row[c.name] for row in rows], c.type) for c in columns})


def _padded(values: Numbers) -> Numbers:
    """Return values by slot (s,) as (256,), 0 for slots that the sensor does not have."""
    return np.concatenate([values, np.zeros(SLOTS - values.size, values.dtype)])


@functools.cache
def _heads() -> Float32:
    """Return sine and cosine (2, 65536) of each azimuth that 16 bits can state."""
    angle = np.radians(np.arange(1 << 16, dtype=np.uint16) * _CENTIDEG)
    return np.stack([np.sin(angle), np.cos(angle)]).astype(np.float32)


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
