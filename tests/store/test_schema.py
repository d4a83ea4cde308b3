"""The schema files, and what a schema does to rows."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from roadscan.core.errors import SchemaError
from roadscan.store.schema import Column, TableSchema, schema_names, table_schema

TABLE = TableSchema(
    name="demo",
    meaning="A table for these tests.",
    columns=(
        Column("epoch_gps_ns", "int64", "ns", "Epoch.", min=0),
        Column("level", "uint8", "1", "Level."),
        Column("sigma_m", "float32", "m", "1 σ.", frame="map", nullable=True, min=0, max=100),
        Column("role", "string", "text", "Role.", values=("gcp", "check")),
        Column("range", "list<uint16>", "mm", "Ranges.", nullable=True),
    ),
    sort=("epoch_gps_ns",),
    row_group_rows=10,
)


def batch(**columns: pa.Array) -> pa.RecordBatch:
    given = {
        "epoch_gps_ns": pa.array([1, 2, 3], pa.int64()),
        "level": pa.array([1, 2, 3], pa.uint8()),
        "role": pa.array(["gcp", "check", "gcp"]),
        **columns,
    }
    return pa.RecordBatch.from_pydict(given)


@pytest.mark.parametrize("name", schema_names())
def test_every_schema_file(name: str) -> None:
    schema = table_schema(name)
    assert schema.meaning.endswith(".")
    names = [c.name for c in schema.columns]
    assert len(set(names)) == len(names)
    assert set(schema.sort) <= set(names)
    assert schema.row_group_rows > 0
    arrow = schema.arrow(list_size=4)
    for column, field in zip(schema.columns, arrow, strict=True):
        assert column.unit, column.name
        assert column.meaning.endswith("."), column.name
        assert field.metadata[b"unit"].decode() == column.unit
        assert field.nullable == column.nullable
    if schema.partition_s is not None:
        assert schema.sort[0] == "epoch_gps_ns"


# A unit that a column's name ends with has to be the unit the schema states.
SUFFIXES = {"_m": "m", "_ns": "ns", "_rad": "rad", "_deg": "°", "_m2": "m²", "_s": "s"}


@pytest.mark.parametrize("name", schema_names())
def test_names_and_units_agree(name: str) -> None:
    for column in table_schema(name).columns:
        suffix = "_" + column.name.rsplit("_", 1)[-1]
        if suffix in SUFFIXES and "_per_" not in column.name:
            assert column.unit == SUFFIXES[suffix], column.name


def test_the_tables_of_the_design_are_there() -> None:
    assert {"trajectory", "scans", "returns", "cloud", "control_points", "footprints", "tiles", "rejects"} <= set(
        schema_names()
    )


def test_unknown_table_and_column() -> None:
    with pytest.raises(SchemaError, match=r"no table 'trajectry' \(did you mean 'trajectory'\?\)"):
        table_schema("trajectry")
    with pytest.raises(SchemaError, match=r"no column 'levl' \(did you mean 'level'\?\)"):
        TABLE.column("levl")
    assert TABLE.column("level").type == "uint8"


def test_conform_orders_casts_and_fills() -> None:
    given = batch(level=pa.array([1, 2, 3], pa.int32()), sigma_m=pa.array([0.5, None, 2.0], pa.float64()))
    out = TABLE.conform(given.select(["role", "sigma_m", "level", "epoch_gps_ns"]), list_size=2)
    assert out.schema == TABLE.arrow(2)
    assert out.column("level").to_pylist() == [1, 2, 3]
    assert out.column("sigma_m").to_pylist() == [0.5, None, 2.0]
    assert out.column("range").to_pylist() == [None, None, None]
    assert out.schema.field("sigma_m").metadata[b"frame"] == b"map"


def test_conform_brings_lists_to_their_fixed_size() -> None:
    ranges = pa.array([[1, 2], [3, 4], [5, 6]], pa.list_(pa.uint16()))
    out = TABLE.conform(batch(range=ranges), list_size=2)
    assert out.schema.field("range").type.list_size == 2
    assert out.column("range").to_pylist() == [[1, 2], [3, 4], [5, 6]]
    with pytest.raises(SchemaError, match="column 'range'"):
        TABLE.conform(batch(range=ranges), list_size=3)
    with pytest.raises(SchemaError, match="'range' is a fixed-size list; expected the number of readings"):
        TABLE.conform(batch(range=ranges))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (batch().drop_columns(["level"]), r"needs the column 'level' \(uint8\)"),
        (batch(levl=pa.array([1, 2, 3])), r"column 'levl' does not belong to table 'demo' \(did you mean 'level'\?\)"),
        (batch(level=pa.array([1, 2, 300])), "column 'level' of table 'demo' is int64; expected uint8.*300"),
        (batch(level=pa.array([1.0, 2.5, 3.0])), "column 'level' of table 'demo' is double; expected uint8"),
        (batch(level=pa.array(["a", "b", "c"])), "column 'level' of table 'demo' is string"),
    ],
)
def test_conform_refuses_what_would_be_lost(given: pa.RecordBatch, words: str) -> None:
    with pytest.raises(SchemaError, match=words):
        TABLE.conform(given, list_size=2)


def faults(**columns: pa.Array) -> list[tuple[list[int], str]]:
    return [(rows.tolist(), reason) for rows, reason in TABLE.faults(TABLE.conform(batch(**columns), list_size=2))]


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({}, []),
        ({"epoch_gps_ns": pa.array([1, -2, 3])}, [([1], "epoch_gps_ns is below 0")]),
        ({"level": pa.array([None, 2, None], pa.uint8())}, [([0, 2], "level is missing")]),
        ({"sigma_m": pa.array([None, 100.5, 100.0])}, [([1], "sigma_m is above 100")]),
        ({"sigma_m": pa.array([np.nan, np.inf, 1.0])}, [([0, 1], "sigma_m is not a finite number")]),
        # One bad number must not hide another.
        (
            {"sigma_m": pa.array([np.nan, -1.0, 101.0])},
            [([0], "sigma_m is not a finite number"), ([1], "sigma_m is below 0"), ([2], "sigma_m is above 100")],
        ),
        ({"role": pa.array(["gcp", "chek", None])}, [([2], "role is missing"), ([1], "role is not one of gcp, check")]),
        # A row is listed once, for its first fault.
        (
            {"epoch_gps_ns": pa.array([-1, 2, 3]), "sigma_m": pa.array([-1.0, 2.0, 3.0])},
            [([0], "epoch_gps_ns is below 0")],
        ),
    ],
)
def test_faults(columns: dict[str, pa.Array], expected: list[tuple[list[int], str]]) -> None:
    assert faults(**columns) == expected


def test_no_rows_have_no_faults() -> None:
    assert TABLE.faults(TABLE.conform(batch().slice(0, 0), list_size=2)) == []


def test_columns_that_are_sound_by_their_extremes_are_so_value_by_value() -> None:
    schema, random = table_schema("returns"), np.random.default_rng(0)
    for k in range(60):
        values = {
            c.name: random.integers(0, 256, 50).astype(c.arrow_type(None).to_pandas_dtype()) for c in schema.columns
        }
        odd = random.choice([np.nan, np.inf, -np.inf, 1e4, -1e4, 10_001.0, -10_001.0, 0.0])
        values["y_sensor_m"][random.integers(50)] = odd
        values["epoch_gps_ns"][random.integers(50)] = random.integers(-1, 2)
        rows = schema.conform(pa.RecordBatch.from_pydict(values))
        found = {row for bad, _ in schema.faults(rows) for row in bad.tolist()}
        y, epochs = values["y_sensor_m"], values["epoch_gps_ns"]
        assert found == set(np.flatnonzero(~(np.abs(y) <= 1e4) | (epochs < 0)).tolist()), (k, odd)
