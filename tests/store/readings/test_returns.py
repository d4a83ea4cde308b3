"""Files of returns: Arrow and DuckDB read what is written here, what Arrow writes is read here, damage is told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import StoreError
from roadscan.store.codecs.parquet.tables import is_number_table, write_number_table
from roadscan.store.readings.row_groups import Returns, ReturnsReader
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import write_parquet

SCHEMA = table_schema("returns")
START = 1_454_644_020_000_000_000
FILE = "tables/returns/a.parquet"
GROUP = 150
"""Rows of a row group here."""


def table(n: int = 400, **columns: Any) -> pa.Table:
    """Rows of returns as an HDL-32E makes them."""
    rng = np.random.default_rng(n)
    epochs = START + np.cumsum(rng.choice([1_152, 2_304, 10_368], n, p=[0.9, 0.05, 0.05]))
    place = {f"{a}_sensor_m": rng.normal(0.0, 20.0, n).astype(np.float32) for a in "xyz"}
    shine = 257 * rng.integers(0, 256, n).astype(np.uint16)
    given = {"epoch_gps_ns": epochs, "pose_epoch_gps_ns": epochs} | place | {"intensity": shine}
    given |= {"laser": rng.integers(0, 32, n).astype(np.uint8), "sweep": np.arange(n, dtype=np.int32) // 90}
    return pa.Table.from_batches([SCHEMA.conform(pa.RecordBatch.from_pydict(given | columns), None)])


sweeps = START + 100_000_000 * (np.arange(400) // 90)
TABLES = {
    "own epochs": table(),
    "epochs of sweeps": table(pose_epoch_gps_ns=sweeps),
    "some epochs of sweeps": table(
        pose_epoch_gps_ns=np.where(np.arange(400) < 2 * GROUP, table().column(0).to_numpy(), sweeps)
    ),
    "epochs too far apart for differences": table(pose_epoch_gps_ns=START + (1 << 50) * (np.arange(400) % 3)),
    "zeros": table(x_sensor_m=np.where(np.arange(400) % 2, -0.0, 0.0).astype(np.float32)),
    "a row": table(1),
}


def put(folder: Path, rows: pa.Table, write: Any = write_number_table) -> Store:
    """A store with a file of the rows, as the store writes it or with a function of path, rows and size of groups."""
    store = Store(str(folder / "store"), "s1")
    path = folder / "a.parquet"
    write(path, rows, GROUP)
    store.publish(path, FILE)
    return store


def same(found: Returns, rows: pa.Table) -> bool:
    """True if returns are those of a table, to the last bit."""
    return all(
        values.tobytes() == rows.column(name).to_numpy().tobytes()
        and values.dtype == rows.column(name).to_numpy().dtype
        for name, values in vars(found).items()
        if values is not None
    )


@pytest.mark.parametrize("name", TABLES)
def test_arrow_and_duckdb_read_what_is_written_and_it_is_given_back(name: str, tmp_path: Path) -> None:
    rows = TABLES[name]
    assert is_number_table(rows.schema)
    store = put(tmp_path, rows)
    path = store.path(FILE)
    back = pq.read_table(path, partitioning=None, page_checksum_verification=True)
    assert back.schema.equals(rows.schema, check_metadata=True)
    assert back.equals(rows)
    known = pq.read_metadata(path).row_group(0)
    for k, column in enumerate(rows.column_names):
        own = rows.column(column)[:GROUP].to_numpy()
        assert (known.column(k).statistics.min, known.column(k).statistics.max) == (own.min(), own.max())
    relation = duckdb.sql(f"SELECT * FROM read_parquet('{path}', hive_partitioning = false)")
    assert relation.to_arrow_table().to_pylist() == rows.to_pylist()
    reader = ReturnsReader(store, FILE)
    groups = range(-(-rows.num_rows // GROUP))
    reader.expect(groups)
    assert same(reader.read(groups), rows)
    for group in reversed(groups):
        assert same(reader.read([group]), rows.slice(group * GROUP, GROUP))
    assert reader.read([]).intensity.size == 0


def test_the_store_writes_returns_so(tmp_path: Path) -> None:
    rows = TABLES["own epochs"]
    one = put(tmp_path, rows, lambda path, t, _: write_parquet(path, t, SCHEMA)).read_bytes(FILE)
    write_number_table(tmp_path / "b.parquet", rows, SCHEMA.row_group_rows)
    assert one == (tmp_path / "b.parquet").read_bytes()


@pytest.mark.parametrize("name", TABLES)
def test_equal_rows_give_equal_bytes_in_any_chunks(name: str, tmp_path: Path) -> None:
    rows = TABLES[name]
    parts = pa.concat_tables([rows.slice(k, 37) for k in range(0, rows.num_rows, 37)])
    for file, own in (("a", rows), ("b", parts)):
        write_number_table(tmp_path / file, own, GROUP)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_files_of_arrow_are_read(tmp_path: Path) -> None:
    rows = TABLES["epochs of sweeps"]
    store = put(tmp_path, rows, lambda path, t, size: pq.write_table(t, path, row_group_size=size))
    reader = ReturnsReader(store, FILE)
    assert same(reader.read([0, 1, 2]), rows)
    assert same(reader.read([2]), rows.slice(2 * GROUP))
    with pytest.raises(StoreError, match="3 row groups"):
        reader.read([3])


def test_what_holds_no_returns_is_refused(tmp_path: Path) -> None:
    store = put(tmp_path, TABLES["a row"].drop_columns(["intensity"]))
    with pytest.raises(StoreError, match="no column 'intensity'"):
        ReturnsReader(store, FILE)
    with pytest.raises(StoreError, match="cannot be read"):
        ReturnsReader(store, "tables/returns/missing.parquet")


@pytest.mark.own_codecs
def test_every_damaged_byte_that_is_read_is_told(tmp_path: Path) -> None:
    rows = TABLES["epochs of sweeps"]
    store = put(tmp_path, rows)
    whole = store.read_bytes(FILE)
    group = pq.read_metadata(store.path(FILE)).row_group(1)
    chunks = [group.column(k) for k in range(6)]
    for at in {c.data_page_offset + step for c in chunks for step in range(0, c.total_compressed_size, 7)}:
        store.write_bytes(FILE, whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        reader = ReturnsReader(store, FILE)
        with pytest.raises(StoreError, match="row groups 1"):
            reader.read([1])
        assert same(reader.read([0]), rows.slice(0, GROUP))
