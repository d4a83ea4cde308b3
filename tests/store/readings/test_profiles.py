"""Files of profiles: Arrow and DuckDB read what is written here, what they write is read here, damage is told."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import StoreError
from roadscan.store.codecs.parquet.tables import is_list_table
from roadscan.store.readings.row_groups import ProfileReader, Profiles, read_groups
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import LogWriter, write_parquet

SCHEMA = table_schema("scans")
GROUP = SCHEMA.row_group_rows
START = 1_400_000_000_000_000_000
FILE = "tables/scans/a.parquet"


@pytest.fixture(params=["folder", "memory"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    return Store(str(tmp_path / "store") if request.param == "folder" else f"memory://{tmp_path.name}", "s1")


@pytest.fixture
def folder(tmp_path: Path) -> Store:
    return Store(str(tmp_path / "store"), "s1")


def lists(values: np.ndarray, valid: np.ndarray | None = None) -> pa.Array:
    """(n, m) values as fixed-size lists, those not valid null."""
    inner = pa.field("element", pa.from_numpy_dtype(values.dtype), nullable=False)
    mask = None if valid is None else pa.array(~valid)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), type=pa.list_(inner, values.shape[1]), mask=mask)


def table(ranges: np.ndarray, intensities: np.ndarray | None = None, **columns: Any) -> pa.Table:
    """Rows of scans; intensities left out are null."""
    given = {"epoch_gps_ns": START + 71_428 * np.arange(len(ranges)), "range": lists(ranges)}
    given |= {} if intensities is None else {"intensity": lists(intensities)}
    batch = pa.RecordBatch.from_pydict(
        {k: pa.array(v) if isinstance(v, np.ndarray) else v for k, v in (given | columns).items()}
    )
    return pa.Table.from_batches([SCHEMA.conform(batch, ranges.shape[1])])


def random(kind: Any, n: int, m: int, high: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, high, (n, m), endpoint=True).astype(kind)


def put(store: Store, rows: pa.Table, write: Any = None) -> None:
    """Write a file into the store, as the store does it or with a function of path and rows."""
    with store.scratch() as scratch:
        path = scratch / "a.parquet"
        if write is None:
            write_parquet(path, rows, SCHEMA)
        else:
            write(path, rows)
        store.publish(path, FILE)


def same(found: Profiles, rows: pa.Table) -> bool:
    """True if profiles are those of a table, to the last value."""
    size = rows.schema.field("range").type.list_size
    given = {n: np.array(rows.column(n).combine_chunks().flatten()).reshape(-1, size) for n in ("range", "intensity")}
    missing = rows.column("intensity").null_count > 0
    return (
        np.array_equal(found.epoch_gps_ns, rows.column("epoch_gps_ns").to_numpy())
        and np.array_equal(found.range, given["range"])
        and found.range.dtype == np.uint16
        and found.range.flags.c_contiguous
        and (found.intensity is None if missing else np.array_equal(found.intensity, given["intensity"]))
    )


some = np.random.default_rng(3).random(300) < 0.5
TABLES = {
    "random": table(random(np.uint16, 300, 181, 65535), random(np.uint8, 300, 181, 255)),
    "smooth": table(20_000 + random(np.uint16, 150, 4000, 9), random(np.uint8, 150, 4000, 9)),
    "zero": table(np.zeros((200, 181), np.uint16), np.zeros((200, 181), np.uint8)),
    "extremes": table(np.tile(np.array([0, 65535, 65535], np.uint16), (130, 60)), np.full((130, 180), 255, np.uint8)),
    "a reading": table(random(np.uint16, 300, 1, 65535), random(np.uint8, 300, 1, 255)),
    "a row": table(random(np.uint16, 1, 4000, 65535), random(np.uint8, 1, 4000, 255)),
    "a row of a reading": table(random(np.uint16, 1, 1, 65535)),
    "no intensity": table(random(np.uint16, 300, 181, 65535), encoder_ticks=np.arange(300) - 5),
    "some ticks": table(
        random(np.uint16, 300, 7, 65535), encoder_ticks=pa.array(np.arange(300) * 2**40, mask=~some)
    ),
    "some intensities": table(
        random(np.uint16, 300, 7, 9), intensity=lists(random(np.uint8, 300, 7, 255), some), range_low=some.astype("u2")
    ),
    "none": table(np.zeros((0, 181), np.uint16)),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_arrow_and_duckdb_read_what_is_written(name: str, folder: Store) -> None:
    rows = TABLES[name]
    assert is_list_table(rows.schema)
    put(folder, rows)
    path = folder.path(FILE)
    back = pq.read_table(path, partitioning=None, page_checksum_verification=True)
    back.validate(full=True)
    assert back.schema.equals(rows.schema, check_metadata=True)
    assert back.equals(rows)
    assert pq.read_table(path, partitioning=None, memory_map=True, columns=["intensity"]).equals(
        rows.select(["intensity"])
    )
    relation = duckdb.sql(f"SELECT * FROM read_parquet('{path}', hive_partitioning = false)")
    assert relation.to_arrow_table().to_pylist() == rows.to_pylist()


@pytest.mark.parametrize("name", TABLES)
def test_reader_gives_back_what_was_written(name: str, store: Store) -> None:
    rows = TABLES[name]
    put(store, rows)
    reader = ProfileReader(store, FILE)
    groups = range(-(-rows.num_rows // GROUP))
    assert same(reader.read(groups), rows)
    for group in reversed(groups):
        assert same(reader.read([group]), rows.slice(group * GROUP, GROUP))
    assert reader.read([]).range.shape[0] == 0


@pytest.mark.parametrize("name", [name for name in TABLES if name != "none"])
def test_rows_for_other_stages_are_those_that_were_written(name: str, store: Store) -> None:
    rows = TABLES[name]
    put(store, rows)
    groups = range(-(-rows.num_rows // GROUP))
    assert read_groups(store, FILE, groups).equals(rows)
    some_of_it = ["intensity", "epoch_gps_ns", "range"]
    part = read_groups(store, FILE, groups[-1:], some_of_it)
    assert part.select(some_of_it).equals(rows.slice(groups[-1] * GROUP, GROUP).select(some_of_it))


@pytest.mark.own_codecs
def test_row_groups_come_in_the_order_asked_for_into_one_buffer(folder: Store) -> None:
    rows = TABLES["random"]
    put(folder, rows)
    reader = ProfileReader(folder, FILE)
    first = reader.read([1, 0])
    assert same(first, pa.concat_tables([rows.slice(GROUP, GROUP), rows.slice(0, GROUP)]))
    second = reader.read([1])
    assert np.shares_memory(first.range, second.range)
    with pytest.raises(StoreError, match="it has 2 row groups"):
        reader.read([2])


def test_file_is_closed_with_its_reader(folder: Store) -> None:
    put(folder, TABLES["a row"])
    reader = ProfileReader(folder, FILE)
    stream = reader._source.stream
    del reader
    gc.collect()
    assert stream.closed


OTHERS: dict[str, dict[str, Any]] = {
    "as before": {"use_dictionary": False, "column_encoding": {"range.list.element": "DELTA_BINARY_PACKED"},
                  "compression": "zstd", "row_group_size": 128},
    "pages of version 2": {"data_page_version": "2.0", "data_page_size": 1000, "row_group_size": 100},
    "dictionary": {"use_dictionary": True, "write_page_checksum": True, "row_group_size": 64},
    "our encoding": {"use_dictionary": False, "compression": "none", "column_encoding": {
        "range.list.element": "DELTA_BINARY_PACKED", "intensity.list.element": "DELTA_BINARY_PACKED"}},
}  # fmt: skip


@pytest.mark.parametrize("options", OTHERS.values(), ids=list(OTHERS))
@pytest.mark.parametrize("name", ["random", "no intensity", "some intensities"])
def test_files_of_other_writers_are_read(name: str, options: dict[str, Any], store: Store) -> None:
    rows = TABLES[name]
    put(store, rows.select(["intensity", "range", "epoch_gps_ns"]), lambda path, t: pq.write_table(t, path, **options))
    reader = ProfileReader(store, FILE)
    size = options.get("row_group_size", rows.num_rows)
    groups = range(-(-rows.num_rows // size))
    assert same(reader.read(groups), rows)
    assert same(reader.read([groups[-1]]), rows.slice(groups[-1] * size, size))


def test_lists_of_other_types_are_cast_or_refused(folder: Store) -> None:
    ranges = random(np.int64, 20, 5, 65535)
    rows = pa.table({"epoch_gps_ns": np.arange(20), "range": list(ranges), "intensity": list(ranges % 256)})
    put(folder, rows, lambda path, t: pq.write_table(t, path))
    found = ProfileReader(folder, FILE).read([0])
    assert np.array_equal(found.range, ranges)
    assert np.array_equal(found.intensity, ranges % 256)
    for column in ([[70_000]] * 20, [[1, None]] * 20, [[1]] * 19 + [[1, 2]], [None] * 20):
        put(folder, rows.set_column(1, "range", pa.array(column)), lambda path, t: pq.write_table(t, path))
        with pytest.raises(StoreError, match="cannot be read"):
            ProfileReader(folder, FILE).read([0])


def test_what_holds_no_scans_is_refused(store: Store) -> None:
    with pytest.raises(StoreError, match="cannot be read"):
        ProfileReader(store, "tables/scans/missing.parquet")
    put(store, TABLES["a row"].drop_columns(["range"]), lambda path, t: pq.write_table(t, path))
    with pytest.raises(StoreError, match="no column 'range'"):
        ProfileReader(store, FILE)
    for content in (b"", b"PAR1", b"PAR1" * 9, b"\0" * 100):
        store.write_bytes(FILE, content)
        with pytest.raises(StoreError, match="cannot be read"):
            ProfileReader(store, FILE)


@pytest.mark.own_codecs
def test_any_damaged_byte_is_told_or_changes_nothing(folder: Store) -> None:
    """Each byte of the pages, and some of the footer; the mark that begins a Parquet file is not looked at."""
    rows = table(random(np.uint16, 12, 9, 900), random(np.uint8, 12, 9, 9), encoder_ticks=np.arange(12))
    with folder.scratch() as scratch:
        write_parquet(scratch / "a", rows, SCHEMA)
        whole = (scratch / "a").read_bytes()
    metadata = pq.read_metadata(pa.BufferReader(whole)).row_group(0)
    footer = len(whole) - int.from_bytes(whole[-8:-4], "little") - 8
    unread = metadata.column(3).data_page_offset  # from here on, pages of columns that are not wanted
    seal = range(whole.index(b"roadscan.footer_crc32") - 1, len(whole))  # without its name, another writer's file
    looked_at = [
        *range(4, unread),
        *range(footer, seal.start, 5),
        *range(seal.start, seal.stop),
    ]
    path, rng, told = Path(folder.path(FILE)), np.random.default_rng(0), 0
    path.parent.mkdir(parents=True)
    for at in looked_at:
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            assert same(ProfileReader(folder, FILE).read([0]), rows), f"byte {at}"
        except StoreError as error:
            told += 1
            assert error.file == FILE
    assert len(looked_at) - 24 <= told <= len(looked_at)


@pytest.mark.parametrize("kept", [10, 500, -9, -1])
def test_a_file_cut_short_is_refused(kept: int, folder: Store) -> None:
    put(folder, TABLES["a reading"])
    path = Path(folder.path(FILE))
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(StoreError, match="cannot be read"):
        ProfileReader(folder, FILE)


@pytest.mark.own_codecs
def test_damage_names_file_and_row_groups(folder: Store) -> None:
    put(folder, TABLES["random"])
    path = Path(folder.path(FILE))
    start = pq.read_metadata(path).row_group(1).column(1).data_page_offset
    content = bytearray(path.read_bytes())
    content[start + 900] ^= 4
    path.write_bytes(content)
    reader = ProfileReader(folder, FILE)
    assert same(reader.read([0]), TABLES["random"].slice(0, GROUP))
    with pytest.raises(StoreError, match="column 'range': a page does not have its checksum") as caught:
        reader.read([0, 1])
    assert (caught.value.file, caught.value.record) == (FILE, "row groups 0, 1")
    with pytest.raises(OSError, match="CRC"):
        pq.read_table(path, partitioning=None, page_checksum_verification=True)


def test_statistics_let_duckdb_skip_row_groups(folder: Store) -> None:
    rows = TABLES["some ticks"]
    put(folder, rows)
    metadata = pq.read_metadata(folder.path(FILE))
    for k in range(metadata.num_row_groups):
        own = rows.slice(GROUP * k, GROUP)
        for at, name in ((0, "epoch_gps_ns"), (3, "encoder_ticks")):
            found = metadata.row_group(k).column(at).statistics
            ends = pa.compute.min_max(own.column(name)).as_py()
            assert (found.min, found.max, found.null_count) == (ends["min"], ends["max"], own.column(name).null_count)
    assert not metadata.row_group(0).column(4).statistics.has_min_max  # range_low, all null
    first = START + 71_428 * 290
    plan = f"EXPLAIN ANALYZE SELECT range FROM '{folder.path(FILE)}' WHERE epoch_gps_ns >= {first}"
    (row,) = duckdb.sql(f"SELECT count(*) FROM '{folder.path(FILE)}' WHERE epoch_gps_ns >= {first}").fetchall()
    assert row == (10,)
    assert duckdb.sql(plan)


def test_same_rows_same_bytes_however_they_are_cut(tmp_path: Path) -> None:
    rows = TABLES["some intensities"]
    pieces = pa.concat_tables([rows.slice(0, 7), rows.slice(7, 150), rows.slice(157)])
    for name, one in (("a", rows), ("b", pieces), ("c", rows.slice(0))):
        write_parquet(tmp_path / name, one, SCHEMA)
    contents = {(tmp_path / name).read_bytes() for name in "abc"}
    assert len(contents) == 1


def test_lowest_and_highest_range_come_with_the_rows(folder: Store) -> None:
    ranges = random(np.uint16, 500, 50, 65535)
    ranges[random(np.uint8, 500, 50, 1) == 0] = 0
    ranges[7], ranges[8] = 0, 65535
    ranges[9] = np.r_[np.zeros(49), 12]
    with folder.scratch() as scratch:
        writer = LogWriter(scratch, 50)
        writer.add("scans", table(ranges).drop_columns(["range_low", "range_high"]).to_batches()[0])
        writer.finish()
        (file,) = writer.publish(folder, "r", "left", "k")["scans"]
    rows = pq.read_table(folder.path(file.path), partitioning=None)
    returns = np.ma.masked_equal(ranges, 0)
    assert np.array_equal(rows.column("range_low").to_numpy(), returns.min(axis=1).filled(0))
    assert np.array_equal(rows.column("range_high").to_numpy(), ranges.max(axis=1))
    assert file.group_rows == (GROUP, 500 - GROUP)
    assert file.group_spans[1] == (START + 71_428 * GROUP, START + 71_428 * 499)
    statistics = pq.read_metadata(folder.path(file.path)).row_group(1).column(5).statistics
    assert (statistics.min, statistics.max) == (int(ranges[GROUP:].max(axis=1).min()), int(ranges[GROUP:].max()))
