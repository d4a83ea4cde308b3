"""The store: nothing half-written is seen, nothing is read twice, a second of an hour is one partition."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import StoreError
from roadscan.core.gpstime import NS_PER_S
from roadscan.store import manifest as manifest_module
from roadscan.store.logs import DataFile, LogRecord, has_log, read_log_records, retire_log, write_log_record
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.query.sql import connect, query
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import LogWriter, merged
from tests.store.killed import dies_at_removal

START = 1_400_000_000


@pytest.fixture(params=["folder", "memory"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    return Store(str(tmp_path) if request.param == "folder" else f"memory://{tmp_path.name}", "s1")


def read_stored(store: Store, file: DataFile) -> pa.Table:
    with store.fs.open(store.path(file.path)) as stream:
        return pq.ParquetFile(stream).read()


def returns(epochs_ns: np.ndarray) -> pa.RecordBatch:
    n = epochs_ns.size
    return pa.RecordBatch.from_pydict(
        {
            "epoch_gps_ns": epochs_ns,
            "pose_epoch_gps_ns": epochs_ns,
            "x_sensor_m": np.arange(n, dtype=np.float32) % 100,
            "y_sensor_m": np.zeros(n, np.float32),
            "z_sensor_m": np.zeros(n, np.float32),
            "intensity": np.ones(n, np.uint16),
            "laser": np.zeros(n, np.uint8),
            "sweep": np.zeros(n, np.int32),
        }
    )


def write(store: Store, batches: list[pa.RecordBatch], key: str = "abc") -> dict[str, tuple[DataFile, ...]]:
    with store.scratch() as folder:
        writer = LogWriter(folder, None)
        for batch in batches:
            for rows, reason in writer.add("returns", batch):
                writer.reject("", int(rows[0]), -1, rows.size, reason)
        writer.finish()
        tables = writer.publish(store, "r", "lidar", key)
    record = LogRecord(key, "r", "lidar", "test", "x", "c", 1, tables, {}, sum(writer.rows.values()), 0, {})
    write_log_record(store, record)
    return tables


def test_rows_are_partitioned_and_sorted_whatever_their_order(store: Store) -> None:
    epochs = START * NS_PER_S + np.arange(40_000, dtype=np.int64) * 1_000_000
    shuffled = np.random.default_rng(0).permutation(epochs)
    files = write(store, [returns(part) for part in np.array_split(shuffled, 7)])["returns"]
    assert [f.path.split("/")[5] for f in files] == [f"gps_bin_s={START + 10 * k}" for k in range(4)]
    seen = []
    for f in files:
        with store.fs.open(store.path(f.path)) as stream:
            own = pq.ParquetFile(stream).read().column("epoch_gps_ns").to_numpy()
        assert (np.diff(own) > 0).all()
        assert f.span == (own[0], own[-1])
        seen.append(own)
    assert np.array_equal(np.concatenate(seen), epochs)


def test_parts_of_a_partition_that_overlap_are_merged(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadscan.store.writer.BUDGET_BYTES", 20_000)
    epochs = START * NS_PER_S + np.arange(3000, dtype=np.int64) * 1_000_000
    in_turn = write(store, [returns(p) for p in np.split(epochs, 10)], "one")["returns"]
    assert len(in_turn) > 1
    batches = [returns(p) for p in np.split(np.random.default_rng(0).permutation(epochs), 10)]
    mixed = write(store, batches, "two")["returns"]
    assert all(a.span[1] < b.span[0] for a, b in itertools.pairwise(mixed))  # type: ignore[index]
    assert max(f.rows for f in mixed) * batches[0].nbytes / batches[0].num_rows <= 20_000
    found = pa.concat_tables([read_stored(store, f) for f in mixed])
    expected = pa.Table.from_batches(batches).sort_by("epoch_gps_ns")
    assert found.select(expected.column_names).cast(expected.schema).equals(expected)


def test_stamps_that_jitter_make_no_partition_be_merged(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadscan.store.writer.BUDGET_BYTES", 40_000)
    monkeypatch.setattr("roadscan.store.writer.merged", lambda *_: pytest.fail("a partition was merged"))
    rng = np.random.default_rng(2)
    epochs = START * NS_PER_S + np.arange(9000, dtype=np.int64) * 1_000_000 + rng.integers(-9_000_000, 9_000_000, 9000)
    batches = [returns(part) for part in np.split(np.maximum(epochs, START * NS_PER_S), 90)]
    files = write(store, batches)["returns"]
    assert len(files) > 5
    assert all(a.span[1] <= b.span[0] for a, b in itertools.pairwise(files))  # type: ignore[operator,index]
    found = pa.concat_tables([read_stored(store, f) for f in files]).column("epoch_gps_ns").to_numpy()
    np.testing.assert_array_equal(
        found, np.sort(np.concatenate([b.column("epoch_gps_ns").to_numpy() for b in batches]))
    )


def test_merged_rows_of_equal_epochs_keep_the_order_of_their_files(tmp_path: Path) -> None:
    """A stable sort of all rows by Arrow is the oracle."""
    rng = np.random.default_rng(1)
    order = [("epoch_gps_ns", "ascending"), ("laser", "ascending"), ("x_sensor_m", "ascending")]
    tables = []
    for k, n in enumerate((700, 800, 900, 1000)):
        batch = returns(START * NS_PER_S + rng.integers(0, 50, n))
        batch = batch.set_column(6, "laser", pa.array(rng.integers(0, 3, n), pa.uint8()))
        batch = batch.set_column(2, "x_sensor_m", pa.array(np.arange(n) + 1000 * k, pa.float32()))
        tables.append(pa.Table.from_batches([batch]).sort_by(order))
        pq.write_table(tables[-1], tmp_path / f"{k}.parquet", row_group_size=64)
    pieces = list(merged(sorted(tmp_path.glob("*.parquet")), table_schema("returns"), 250))
    assert [p.num_rows for p in pieces] == [250] * 13 + [150]
    assert pa.concat_tables(pieces).equals(pa.concat_tables(tables).sort_by(order))


def test_rows_that_break_the_schema_cost_themselves(store: Store) -> None:
    batch = returns(START * NS_PER_S + np.arange(5, dtype=np.int64))
    x = np.array([1, np.nan, 3, 99_999, 5], np.float32)
    batch = batch.set_column(2, "x_sensor_m", pa.array(x))
    tables = write(store, [batch])
    assert tables["returns"][0].rows == 3
    with store.fs.open(store.path(tables["rejects"][0].path)) as stream:
        rejects = pq.ParquetFile(stream).read().to_pylist()
    assert [(r["record"], r["reason"]) for r in rejects] == [
        (1, "x_sensor_m is not a finite number"),
        (3, "x_sensor_m is above 10000"),
    ]


def test_log_record_comes_back_as_it_was(store: Store) -> None:
    tables = write(store, [returns(START * NS_PER_S + np.arange(5, dtype=np.int64))])
    (record,) = read_log_records(store)
    assert record.tables == tables
    assert record.span("returns") == (START * NS_PER_S, START * NS_PER_S + 4)


def test_one_second_of_an_hour_touches_its_partition_only(tmp_path: Path) -> None:
    store = Store(str(tmp_path), "s1")
    epochs = START * NS_PER_S + np.arange(36_000, dtype=np.int64) * 100_000_000
    files = write(store, [returns(epochs)])["returns"]
    assert len(files) == 360
    first = (START + 1234) * NS_PER_S
    statement = f"SELECT count(*) AS n FROM returns_between({first}, {first + NS_PER_S - 1})"
    assert query(store, statement).to_pylist() == [{"n": 10}]
    with connect(store) as connection:
        plan = "\n".join(r[1] for r in connection.sql("EXPLAIN ANALYZE " + statement).fetchall())
    assert "Scanning Files: 1/360" in plan or "Total Files Read: 1" in plan, plan


def test_tables_open_without_roadscan(tmp_path: Path) -> None:
    store = Store(str(tmp_path), "s1")
    write(store, [returns(START * NS_PER_S + np.arange(20, dtype=np.int64) * NS_PER_S)])
    pattern = f"{tmp_path}/survey=*/tables/returns/**/*.parquet"
    statement = f"SELECT count(*), min(run), count(DISTINCT gps_bin_s) FROM read_parquet('{pattern}')"
    (row,) = duckdb.sql(statement).fetchall()
    assert row == (20, "r", 2)


@pytest.mark.parametrize("above", ["run=other/gps_bin_s=7/survey=x", "a::b", "it's 5 %20"])
def test_folders_above_the_store_say_nothing(tmp_path: Path, above: str) -> None:
    root = tmp_path / above
    store = Store(str(root), "s1")
    rows = returns(np.arange(START, START + 40, dtype=np.int64) * NS_PER_S)
    broken = np.where(np.arange(40) == 3, np.nan, 1.0).astype(np.float32)
    tables = write(store, [rows.set_column(2, rows.schema.field(2), pa.array(broken))])
    assert all((root / "survey=s1" / f.path).is_file() for f in tables["returns"])
    (row,) = query(store, "SELECT DISTINCT survey, run, sensor, log FROM returns").to_pylist()
    assert row == {"survey": "s1", "run": "r", "sensor": "lidar", "log": "abc"}
    asked = f"SELECT count(*) AS n FROM returns_between({(START + 9) * NS_PER_S}, {(START + 12) * NS_PER_S})"
    assert query(store, asked).to_pylist() == [{"n": 4}]
    reject = query(store, "SELECT run, sensor, record FROM rejects").to_pylist()
    assert reject == [{"run": "r", "sensor": "lidar", "record": 3}]


def test_manifest_survives_and_forgets(store: Store) -> None:
    manifest = Manifest(store)
    for k in range(70):
        store.write_bytes(f"tiles/las/{k}_0.laz", b"x" * k)
        manifest.add([OutputRecord("las", f"{k}_0", f"key{k}", f"tiles/las/{k}_0.laz", k, "d")])
    again = Manifest(store)
    assert len(again.of("las")) == 70
    assert again.is_current("las", "5_0", "key5")
    assert not again.is_current("las", "5_0", "other")
    store.write_bytes("tiles/las/5_0.laz", b"short")
    assert again.is_current("las", "5_0", "key5")
    store.write_bytes("tiles/las/5_0.laz", b"longer than recorded")
    assert not again.is_current("las", "5_0", "key5")
    again.remove([again.of("las")["6_0"]])
    assert not store.exists("tiles/las/6_0.laz")
    assert Manifest(store).get("las", "6_0") is None
    again.compact()
    assert len(Manifest(store).of("las")) == 69


def test_second_run_is_kept_out_and_a_dead_one_forgotten(tmp_path: Path) -> None:
    store = Store(str(tmp_path), "s1")
    with store.lock(), pytest.raises(StoreError, match=rf"process {os.getpid()} on .* is working"), store.lock():
        pass
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    pid = int(dead.stdout)
    lock = Path(store.path("manifest/lock"))
    lock.write_text(f"{os.uname().nodename} {pid}")
    leftover = Path(store.path(f".staging/{pid}-abc"))
    leftover.mkdir(parents=True)
    with store.lock():
        assert not leftover.exists()
    assert not lock.exists()


def test_of_runs_that_begin_at_once_one_has_the_store(tmp_path: Path) -> None:
    store = Store(str(tmp_path), "s1")
    inside: list[int] = []
    together: list[int] = []

    def try_often(me: int) -> None:
        for _ in range(300):
            try:
                with store.lock():
                    inside.append(me)
                    together.append(len(inside))
                    time.sleep(0.0002)
                    inside.pop()
            except StoreError as error:
                assert "is working on this store" in str(error)

    with ThreadPoolExecutor(3) as threads:
        list(threads.map(try_often, range(3)))
    assert set(together) == {1}


@pytest.mark.parametrize("words", ["", "two words", "here 99999999999999999999", "\0\0\0"])
def test_a_lock_that_names_no_process_is_taken(tmp_path: Path, words: str) -> None:
    store = Store(str(tmp_path), "s1")
    lock = Path(store.path("manifest/lock"))
    lock.parent.mkdir(parents=True, exist_ok=True)
    lock.write_text(words.replace("here", os.uname().nodename))
    stray = Path(store.path(".staging/no-process"))
    stray.mkdir(parents=True)
    with store.lock():
        assert not stray.exists()


def test_a_lock_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    store = Store(str(tmp_path), "s1")
    Path(store.path("manifest/lock")).mkdir(parents=True)
    with pytest.raises(StoreError, match=r"manifest/lock: .*remove it if no run is at work"), store.lock():
        pass


def test_a_log_whose_retiring_is_cut_short_is_not_half_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(str(tmp_path), "s1")
    write(store, [returns(START * NS_PER_S + np.arange(5, dtype=np.int64))])
    (record,) = read_log_records(store)

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(type(store.fs), "mv", killed)
        with pytest.raises(KeyboardInterrupt):
            retire_log(store, record)
    assert not has_log(store, record.key)
    assert store.exists(f"superseded/manifest/logs/{record.key}.json")
    assert all(store.exists(f.path) for files in record.tables.values() for f in files)


def test_publishing_a_folder_replaces_it_at_once(store: Store) -> None:
    for content in (b"old", b"new"):
        with store.scratch() as folder:
            (folder / "t").mkdir()
            (folder / "t" / content.decode()).write_bytes(content)
            store.publish_folder(folder / "t", "tables/t")
    assert store.files("tables/t") == ["tables/t/new"]


def test_missing_file_is_named(store: Store) -> None:
    with pytest.raises(StoreError, match=r"manifest/none.json: the file is missing"):
        store.read_bytes("manifest/none.json")


@pytest.mark.parametrize("dies_at", [None, 3, 40])
def test_manifest_of_a_long_run_is_merged_and_says_the_same(
    tmp_path: Path, dies_at: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against a dictionary; where the process dies while merged parts are removed, too."""
    monkeypatch.setattr(manifest_module, "_MOST_PARTS", 64)
    store, known, written = Store(str(tmp_path), "long"), {}, []
    manifest, write = Manifest(store), store.write_bytes
    monkeypatch.setattr(store, "write_bytes", lambda path, content: (written.append(path), write(path, content)))
    dies_at_removal(store, dies_at, monkeypatch)
    for k in range(150):
        record = OutputRecord("las", f"{k % 90}_0", f"key{k}", "", k, "d")
        try:
            if k % 7 == 6 and f"{k % 50}_0" in manifest.of("las"):
                known.pop(f"{k % 50}_0", None)
                manifest.remove([manifest.of("las")[f"{k % 50}_0"]])
            else:
                known[record.unit] = record
                manifest.add([record])
        except KeyboardInterrupt:
            manifest = Manifest(store)
        assert manifest.of("las") == known
    assert Manifest(store).of("las") == known
    assert len(store.files("manifest/outputs")) <= 65
    assert len(written) < 156  # a part each, and few of several
    manifest.compact()
    assert len(store.files("manifest/outputs")) == 1
    assert Manifest(store).of("las") == known
