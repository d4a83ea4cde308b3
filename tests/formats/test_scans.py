"""Line scanners as Parquet and Arrow IPC: what an exporter writes comes back, damage costs itself."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import LogSource, NoOptions, Rows, format_named, format_of
from tests.formats.readings import read

READINGS = 12
PROFILES = 200
GEOMETRY: dict[str, Any] = {
    "kind": "cartesian",
    "readings": READINGS,
    "first": -0.6,
    "step": 0.1,
    "range_offset_m": 1.5,
    "range_step_m": 0.0001,
}
EPOCHS = np.arange(PROFILES) * 35_714 + 1_462_000_000_000_000_000
RANGES = np.random.default_rng(1).integers(0, 65_536, (PROFILES, READINGS)).astype(np.uint16)
INTENSITIES = np.random.default_rng(2).integers(0, 256, (PROFILES, READINGS)).astype(np.uint8)

Writer = Callable[[pa.Table, Path], None]


def fixed(values: np.ndarray) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def profiles(metadata: dict[str, Any] | None = GEOMETRY, **columns: Any) -> pa.Table:
    """A table as an exporter writes it; None leaves a column out."""
    given = {"epoch_gps_ns": EPOCHS, "range": fixed(RANGES), "intensity": fixed(INTENSITIES)} | columns
    table = pa.table({name: values for name, values in given.items() if values is not None})
    return table.replace_schema_metadata({"roadscan.scan_geometry": json.dumps(metadata)} if metadata else None)


def write_parquet(table: pa.Table, path: Path) -> None:
    pq.write_table(table, path, row_group_size=50)


def write_arrow(table: pa.Table, path: Path, compression: str | None = None) -> None:
    options = pa.ipc.IpcWriteOptions(compression=compression)
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema, options=options) as writer:
        writer.write_table(table, 50)


def write_compressed(table: pa.Table, path: Path) -> None:
    write_arrow(table, path, "zstd")


@pytest.mark.parametrize("write", [write_parquet, write_arrow, write_compressed])
@pytest.mark.parametrize("kind", ["fixed", "list", "large"])
def test_what_was_exported_comes_back(tmp_path: Path, write: Writer, kind: str) -> None:
    types = {
        "fixed": pa.list_(pa.uint16(), READINGS),
        "list": pa.list_(pa.uint16()),
        "large": pa.large_list(pa.uint16()),
    }
    ticks = pa.array(np.arange(PROFILES, dtype=np.int32))
    table = profiles(range=fixed(RANGES).cast(types[kind]), encoder_ticks=ticks, note=pa.array(["x"] * PROFILES))
    path = tmp_path / "head.table"
    write(table, path)
    assert format_of(path).name == "scans"
    log = read("scans", path)
    assert log.attributes["scan_geometry"] == GEOMETRY | {"reading_period_ns": 0.0}
    assert np.array_equal(log.epochs, EPOCHS)
    flat = {name: log.table.column(name).combine_chunks().flatten().to_numpy() for name in ("range", "intensity")}
    assert np.array_equal(flat["range"], RANGES.ravel())
    assert np.array_equal(flat["intensity"], INTENSITIES.ravel())
    assert np.array_equal(log["encoder_ticks"], np.arange(PROFILES))
    assert log.rejects == []


def test_a_folder_is_read_in_order_of_names(tmp_path: Path) -> None:
    write_parquet(profiles().slice(100), tmp_path / "b.parquet")
    write_arrow(profiles().slice(0, 100), tmp_path / "a.feather")
    (tmp_path / "readme.txt").write_text("not a table")
    assert format_of(tmp_path).name == "scans"
    log = read("scans", tmp_path)
    assert np.array_equal(log.epochs, EPOCHS)
    assert [r.file for r in log.rows][:1] == ["a.feather"]
    assert [r.first_record for r in log.rows if r.file == "b.parquet"] == [0, 50]


def test_chunks_stay_small_whatever_the_row_groups(tmp_path: Path) -> None:
    wide = np.arange(3000 * 4000).reshape(3000, 4000).astype(np.uint16)
    table = profiles(
        GEOMETRY | {"readings": 4000}, range=fixed(wide), intensity=None, epoch_gps_ns=np.arange(3000) + 10**18
    )
    pq.write_table(table, tmp_path / "wide.parquet")
    write_arrow(table, tmp_path / "wide.arrow")
    for name in ("wide.parquet", "wide.arrow"):
        log = read("scans", tmp_path / name)  # checks the size of every chunk
        assert len(log.rows) > 1
        assert np.array_equal(log.table.column("range").combine_chunks().flatten().to_numpy(), wide.ravel())


def test_short_batches_are_joined_and_a_damaged_one_costs_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.arrow"
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, profiles().schema) as writer:
        writer.write_table(profiles(), 3)
    data = path.read_bytes()
    at = data.index(RANGES[30:33].tobytes())
    message = data.rindex(b"\xff\xff\xff\xff", 0, at)  # where the eleventh batch begins
    path.write_bytes(data[: message + 8] + bytes(16) + data[message + 24 :])
    log = read("scans", path)
    assert np.array_equal(log["epoch_gps_ns"], np.delete(EPOCHS, [30, 31, 32]))
    assert [(r.record, r.records) for r in log.rejects] == [(30, 1)]
    assert [len(part.batch) for part in log.rows] == [30, len(EPOCHS) - 33]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux states what a process holds")
def test_a_long_log_is_passed_without_holding_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadscan.formats.scanners.scans._CHUNK_BYTES", 1 << 20)
    wide = np.arange(2000 * 4000, dtype=np.uint64).reshape(2000, 4000).astype(np.uint16)
    geometry = GEOMETRY | {"readings": 4000}
    write_arrow(
        profiles(
            geometry, range=fixed(wide), intensity=fixed(wide.astype(np.uint8)), epoch_gps_ns=np.arange(2000) + 10**18
        ),
        tmp_path / "long.arrow",
    )
    source = LogSource(tmp_path / "long.arrow", NoOptions())
    scans = format_named("scans")
    before, most, kept, first = _mapped_mb(), 0.0, [], 0
    for item in scans.read(source, scans.header(source)):
        assert isinstance(item, Rows)
        kept.append(item.batch)
        values = item.batch.column("range").flatten().to_numpy()
        assert np.array_equal(values, wide[first : first + item.batch.num_rows].ravel())
        first += item.batch.num_rows
        assert item.batch.column("intensity").flatten().to_numpy().any()
        most = max(most, _mapped_mb() - before)
    assert first == 2000
    assert most < 14, "24 MB are in the log, 8 MB are handed on before pages are given back"
    again = pa.concat_arrays([batch.column("range").flatten() for batch in kept])
    assert np.array_equal(again.to_numpy(), wide.ravel())  # what was given back is there again when asked for


def _mapped_mb() -> float:
    """Pages of files that this process holds (MB)."""
    (line,) = (t for t in Path("/proc/self/status").read_text().splitlines() if t.startswith("RssFile"))
    return int(line.split()[1]) * 1024 / 1e6


# --- geometry ---------------------------------------------------------------------------------------


def test_geometry_from_the_options(tmp_path: Path) -> None:
    write_parquet(profiles(None), tmp_path / "a.parquet")
    log = read("scans", tmp_path / "a.parquet", {"scan_geometry": GEOMETRY})
    assert log.attributes["scan_geometry"]["readings"] == READINGS


def test_a_log_without_geometry_says_what_to_write(tmp_path: Path) -> None:
    write_parquet(profiles(None), tmp_path / "a.parquet")
    with pytest.raises(ConfigError, match=r"geometry of the readings is not stated.*options\.scan_geometry = \{ kind"):
        read("scans", tmp_path / "a.parquet")


def test_two_geometries_are_refused(tmp_path: Path) -> None:
    write_parquet(profiles(), tmp_path / "a.parquet")
    with pytest.raises(ConfigError, match="another scan geometry than the log's options"):
        read("scans", tmp_path / "a.parquet", {"scan_geometry": GEOMETRY | {"step": 0.2}})
    write_parquet(profiles(GEOMETRY | {"first": 0.0}), tmp_path / "b.parquet")
    with pytest.raises(ConfigError, match="split the log"):
        read("scans", tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[1]", "not a JSON object"),
        ('{"kind": "flat"}', "'kind'"),
        ('{"redings": 4}', "unknown key"),
    ],
)
def test_bad_metadata_names_the_fault(tmp_path: Path, text: str, message: str) -> None:
    write_parquet(profiles().replace_schema_metadata({"roadscan.scan_geometry": text}), tmp_path / "a.parquet")
    with pytest.raises(ConfigError, match=message):
        read("scans", tmp_path / "a.parquet")


# --- time -------------------------------------------------------------------------------------------


def test_stamps_in_a_stated_clock(tmp_path: Path) -> None:
    stamps = np.arange(PROFILES) * 1000 + 1_700_000_000_000_000
    write_parquet(profiles(epoch_gps_ns=None, time=stamps), tmp_path / "a.parquet")
    log = read("scans", tmp_path / "a.parquet", clock=Clock(TimeSystem.UNIX_UTC, unit="us"))
    # 2023-11-14: 18 leap seconds between GPS and UTC; the GPS epoch is Unix second 315,964,800.
    assert np.array_equal(log.epochs, (stamps - 315_964_800_000_000 + 18_000_000) * 1000)


def test_stamps_over_a_weeks_end(tmp_path: Path) -> None:
    seconds = np.mod(604_799.0 + 0.01 * np.arange(PROFILES), 604_800.0)
    write_parquet(profiles(epoch_gps_ns=None, time=seconds), tmp_path / "a.parquet")
    log = read("scans", tmp_path / "a.parquet", clock=Clock(TimeSystem.GPS_WEEK, week=2300))
    first = 2300 * 604_800 + 604_799
    assert np.abs(log.epochs - (first * 10**9 + np.arange(PROFILES) * 10_000_000)).max() <= 1


def test_time_is_never_guessed(tmp_path: Path) -> None:
    write_parquet(profiles(epoch_gps_ns=None, time=np.arange(PROFILES)), tmp_path / "a.parquet")
    with pytest.raises(TimeSystemError, match="time system is not stated"):
        read("scans", tmp_path / "a.parquet")
    write_parquet(profiles(), tmp_path / "a.parquet")
    with pytest.raises(ConfigError, match="is GPS time already"):
        read("scans", tmp_path / "a.parquet", clock=Clock(TimeSystem.GPS))


def test_a_wrong_unit_is_refused(tmp_path: Path) -> None:
    stamps = np.arange(PROFILES) * 1000 + 1_700_000_000_000_000
    write_parquet(profiles(epoch_gps_ns=None, time=stamps), tmp_path / "a.parquet")
    with pytest.raises(TimeSystemError, match=r'clock\.unit = "us"'):
        read("scans", tmp_path / "a.parquet", clock=Clock(TimeSystem.UNIX_UTC))


# --- damage -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [write_parquet, write_arrow])
def test_a_bad_row_costs_itself(tmp_path: Path, write: Writer) -> None:
    ranges: list[Any] = RANGES.tolist()
    ranges[3], ranges[4], ranges[60][5] = None, ranges[4][:-1], None
    intensities: list[Any] = INTENSITIES.tolist()
    intensities[7] = None
    epochs: list[Any] = EPOCHS.tolist()
    epochs[9], epochs[130] = None, -5
    write(
        profiles(
            range=pa.array(ranges, pa.list_(pa.uint16())),
            intensity=pa.array(intensities, pa.list_(pa.uint8())),
            epoch_gps_ns=pa.array(epochs, pa.int64()),
        ),
        tmp_path / "a.table",
    )
    log = read("scans", tmp_path / "a.table")
    assert {(r.record, r.reason) for r in log.rejects} == {
        (3, "range is missing"),
        (4, f"range does not hold {READINGS} readings"),
        (7, "intensity is missing"),
        (9, "the time stamp is missing"),
        (130, "epoch_gps_ns is outside 1980–2080"),
    }
    kept = [i for i in range(PROFILES) if i not in {3, 4, 7, 9, 130}]
    assert np.array_equal(log.epochs, EPOCHS[kept])
    expected = RANGES.copy()
    expected[60, 5] = 0  # a null reading is no return
    got = log.table.column("range").combine_chunks().flatten().to_numpy()
    assert np.array_equal(got, expected[kept].ravel())


def test_a_damaged_row_group_costs_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    write_parquet(profiles(), path)
    start = pq.read_metadata(path).row_group(1).column(1).data_page_offset
    data = bytearray(path.read_bytes())
    data[start : start + 60] = b"\xff" * 60
    path.write_bytes(data)
    log = read("scans", path)
    assert np.array_equal(log.epochs, np.concatenate([EPOCHS[:50], EPOCHS[100:]]))
    assert [(r.record, r.records) for r in log.rejects] == [(50, 50)]


def test_a_damaged_file_costs_itself_in_a_folder_and_is_refused_alone(tmp_path: Path) -> None:
    write_parquet(profiles(), tmp_path / "a.parquet")
    (tmp_path / "b.parquet").write_bytes(b"PAR1 and then nothing of use PAR1")
    log = read("scans", tmp_path)
    assert len(log) == PROFILES
    assert [r.file for r in log.rejects] == ["b.parquet"]
    with pytest.raises(FormatError, match="no file can be read"):
        read("scans", tmp_path / "b.parquet")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"range": fixed(RANGES.astype(np.int32))}, "column 'range' is fixed_size_list"),
        ({"intensity": fixed(INTENSITIES.astype(np.float32))}, "column 'intensity' is"),
        ({"range": pa.array(RANGES[:, 0])}, "the table has the columns"),
        ({"epoch_gps_ns": EPOCHS.astype(np.float64)}, "column 'epoch_gps_ns' is double"),
        ({"encoder_ticks": pa.array(["a"] * PROFILES)}, "column 'encoder_ticks' is string"),
    ],
)
def test_wrong_types_are_named(tmp_path: Path, columns: dict[str, Any], message: str) -> None:
    write_parquet(profiles(**columns), tmp_path / "a.parquet")
    with pytest.raises(FormatError, match=message):
        read("scans", tmp_path / "a.parquet")


def test_other_tables_are_not_taken_for_scans(tmp_path: Path) -> None:
    pq.write_table(pa.table({"a": [1]}), tmp_path / "a.parquet")
    assert not format_named("scans").sniff(tmp_path / "a.parquet")
    assert not format_named("scans").sniff(tmp_path / "missing.parquet")
    (tmp_path / "empty").mkdir()
    assert not format_named("scans").sniff(tmp_path / "empty")
