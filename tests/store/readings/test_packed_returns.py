"""Packed returns: files hold the sensor's own values, and roadscan, Arrow and DuckDB make the same rows of them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import StoreError
from roadscan.door import open_survey
from roadscan.store.logs import LogRecord, read_log_records, write_log_record
from roadscan.store.query.sql import query
from roadscan.store.readings.packed_returns import as_returns
from roadscan.store.readings.row_groups import ReturnsReader, read_groups
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import LogWriter
from tests.store.readings.test_returns import same

EXAMPLES = Path(__file__).parents[3] / "examples" / "real-data"
PAGE = Path(__file__).parents[3] / "docs" / "tables.md"
BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("slots", [("far", "<u2"), ("bright", "u1")], 32)])


@pytest.fixture(scope="module")
def recording(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The survey of the recorded HDL-32E, ingested: 500 packets."""
    folder = tmp_path_factory.mktemp("hdl32e")
    (folder / "recordings").symlink_to(recordings)
    shutil.copyfile(EXAMPLES / "hdl32e.toml", folder / "SURVEY.toml")
    done = CliRunner().invoke(app, ["ingest", str(folder / "SURVEY.toml")])
    assert done.exit_code == 0, done.output
    return folder


def store_of(folder: Path) -> tuple[Store, str]:
    """The store, and the file of its returns."""
    store = Store(str(folder / "store"), "hdl32e")
    (record,) = read_log_records(store)
    (file,) = record.tables["returns"]
    return store, file.path


def test_the_sensors_own_numbers_are_stored_in_less_room_than_the_packets(recording: Path) -> None:
    """The packets' bytes, cut out of the capture by hand, are the oracle."""
    capture = (recording / "recordings/velodyne/hdl32e.pcap").read_bytes()
    at, whole = 0, []
    while (at := capture.find(b"\xff\xee", at)) >= 0:
        flags = [capture[at + 100 * k : at + 100 * k + 2] for k in range(12)]
        step = 1206 if flags == [b"\xff\xee"] * 12 else 1
        whole += [capture[at : at + 1200]] if step > 1 else []
        at += step
    assert len(whole) == 500
    blocks = np.frombuffer(b"".join(whole), BLOCK)
    _, block, slot = np.nonzero(blocks["slots"]["far"][None])
    store, path = store_of(recording)
    rows = pq.read_table(store.path(path), partitioning=None, page_checksum_verification=True)
    assert np.array_equal(rows["distance"], blocks["slots"]["far"][block, slot])
    assert np.array_equal(rows["intensity"], blocks["slots"]["bright"][block, slot])
    assert np.array_equal(rows["head"], blocks["azimuth"][block])
    assert np.array_equal(rows["slot"], slot)
    assert Path(store.path(path)).stat().st_size <= 4.5 * rows.num_rows


def test_roadscan_arrow_and_duckdb_make_the_same_rows(recording: Path) -> None:
    store, path = store_of(recording)
    groups = range(pq.read_metadata(store.path(path)).num_row_groups)
    rows = read_groups(store, path, groups)
    assert rows.schema.equals(table_schema("returns").arrow()) and rows.num_rows == 146_705
    assert as_returns(pq.read_table(store.path(path), partitioning=None)).equals(rows)  # read by Arrow
    reader = ReturnsReader(store, path)
    assert same(reader.read(groups), rows)
    part = read_groups(store, path, [1], ["laser", "z_sensor_m"])
    assert part.equals(
        rows.slice(pq.read_metadata(store.path(path)).row_group(0).num_rows).select(part.column_names)[: part.num_rows]
    )
    asked = query(
        store, "SELECT * EXCLUDE (run, sensor, log, gps_bin_s, survey) FROM returns ORDER BY epoch_gps_ns, laser"
    )
    apart = [np.abs(np.subtract(asked[f"{a}_sensor_m"], rows[f"{a}_sensor_m"])).max() for a in "xyz"]
    assert max(apart) < 1e-5  # a last bit
    whole = [name for name in rows.column_names if not name.endswith("_sensor_m")]
    assert asked.select(whole).to_pylist() == rows.select(whole).to_pylist()
    assert open_survey(recording / "SURVEY.toml").table("returns")["laser"].nunique() == 31


def test_the_documented_query_needs_duckdb_alone(recording: Path) -> None:
    store, path = store_of(recording)
    statements = re.findall(r"```sql\n(CREATE VIEW .*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(statements) == 1
    with duckdb.connect() as connection:
        connection.execute(statements[0].replace("store/survey=town", store.root))
        found = connection.sql("SELECT * FROM returns ORDER BY epoch_gps_ns, laser").to_arrow_table()
    rows = read_groups(store, path, [0, 1, 2])
    for name in ("epoch_gps_ns", "x_sensor_m", "y_sensor_m", "z_sensor_m", "intensity", "laser", "sweep"):
        assert np.allclose(found[name], rows[name], rtol=0, atol=1e-5), name


def test_logs_in_both_forms_are_one_table(recording: Path, tmp_path: Path) -> None:
    """Rows as stores before packed returns hold them: x, y and z."""
    shutil.copytree(recording / "store", tmp_path / "store")
    store, path = store_of(tmp_path)
    rows = read_groups(store, path, [0, 1, 2])
    (record,) = read_log_records(store)
    with store.scratch() as folder:
        writer = LogWriter(folder, None)
        for batch in rows.to_batches():
            assert writer.add("returns", batch) == []
        writer.finish()
        tables = writer.publish(store, "before", "lidar", "0123456789abcdef")
    write_log_record(
        store, LogRecord("0123456789abcdef", "before", "lidar", *["x"] * 3, 1, tables, {}, rows.num_rows, 0, {})
    )
    (old,) = tables["returns"]
    assert old.path.startswith("tables/returns/") and old.bytes > 3 * record.tables["returns"][0].bytes
    assert same(ReturnsReader(store, old.path).read(range(len(old.group_rows))), rows)
    counts = query(
        store, "SELECT run, count(*) AS n, sum(laser) AS s FROM returns GROUP BY run ORDER BY run"
    ).to_pylist()
    assert [one["run"] for one in counts] == ["before", "capture"] and counts[0]["n"] == counts[1]["n"] == 146_705
    assert counts[0]["s"] == counts[1]["s"]
    first = rows["epoch_gps_ns"][0].as_py()
    (near,) = query(store, f"SELECT count(*) AS n FROM returns_between({first}, {first})").to_pylist()
    assert near["n"] == 2


def test_rows_that_are_left_out_and_merged_keep_their_beams(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, path = store_of(recording)
    rows = pq.read_table(store.path(path), partitioning=None)
    monkeypatch.setattr("roadscan.store.writer.BUDGET_BYTES", rows.nbytes // 3)
    writer = LogWriter(tmp_path, None)
    half = rows.num_rows // 2
    for part in (rows[half:], rows[:half]):
        assert writer.add("packed_returns", part.combine_chunks().to_batches()[0]) == []
    writer.finish()
    assert writer.rows == {"returns": rows.num_rows}
    expected = as_returns(rows)
    assert pa.concat_tables(writer.tables("returns")).equals(expected)
    count = writer.leave_out("returns", lambda some: np.asarray(some["laser"]) == 5)
    kept = expected.filter(np.asarray(expected["laser"]) != 5)
    assert count == expected.num_rows - kept.num_rows > 0 and writer.rows["returns"] == kept.num_rows
    assert pa.concat_tables(writer.tables("returns", ["x_sensor_m", "laser"])).equals(
        kept.select(["x_sensor_m", "laser"])
    )


@pytest.mark.own_codecs
def test_every_damaged_byte_that_is_read_is_told(recording: Path, tmp_path: Path) -> None:
    shutil.copytree(recording / "store", tmp_path / "store")
    store, path = store_of(tmp_path)
    whole = store.read_bytes(path)
    group = pq.read_metadata(store.path(path)).row_group(1)
    right = read_groups(store, path, [0])
    chunks = [group.column(k) for k in range(6)]  # all but the sweep
    starts = [
        (c.dictionary_page_offset if c.has_dictionary_page else c.data_page_offset, c.total_compressed_size)
        for c in chunks
    ]
    for at in [start + step for start, size in starts for step in (*range(0, 60, 3), size // 2, size - 1)]:
        store.write_bytes(path, whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        reader = ReturnsReader(store, path)
        with pytest.raises(StoreError, match="row groups 1"):
            reader.read([1])
    assert same(reader.read([0]), right)
    store.write_bytes(path, whole.replace(b"roadscan.beams", b"roadscan.bears"))
    with pytest.raises(StoreError, match=r"cannot be read"):
        ReturnsReader(store, path)
