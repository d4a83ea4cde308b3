"""``roadscan inspect``: figures of recordings and of hand-made bytes, what is wrong with them, and hostile files."""

from __future__ import annotations

import gzip
import io
import json
import os
import random
import struct
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rasterio
from rich.console import Console
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.inspect import diagnosis as diagnosis_module
from roadscan.ingest.inspect import inspect as inspect_module
from roadscan.ingest.inspect.inspect import Inspection, inspect
from roadscan.ingest.inspect.inspect_text import print_inspection
from roadscan.ingest.inspect.log_figures import Fault
from roadscan.ingest.inspect.provisional import Stated, open_log, parse_clock, parse_option
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Provisional, log_formats
from roadscan.store.schema import table_schema

RECORD = 136
WEEK_CLOCK = Stated(clock=Clock(TimeSystem.GPS_WEEK, week=2417), crs="EPSG:4979")


def sbet(times: np.ndarray, latitude_deg: np.ndarray | None = None) -> np.ndarray:
    """SBET records (n, 17): northwards at 10 m/s from 48° N, 11° E, 500 m (Applanix layout)."""
    records = np.zeros((times.size, 17))
    records[:, 0] = times
    records[:, 1] = np.radians(48.0 + (times - times[0]) * 10 / 111_200 if latitude_deg is None else latitude_deg)
    records[:, 2] = np.radians(11.0)
    records[:, 3] = 500.0
    return records


def written(path: Path, records: np.ndarray, tail: bytes = b"") -> Path:
    path.write_bytes(records.astype("<f8").tobytes() + tail)
    return path


def fault(found: Inspection, words: str) -> Fault:
    (one,) = [f for f in found.faults if words in f.what]
    return one


def text_of(found: Inspection) -> str:
    out = io.StringIO()
    print_inspection(found, Console(file=out, width=110))
    return out.getvalue()


# --- recordings --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "name", "table", "rows", "duration_s"),
    [
        # 0.275927 s from the first to the last packet's stamp, and the packet's own 0.542592 ms
        ("velodyne/hdl32e.pcap", "velodyne_pcap", "returns", 146_705, 0.276470),
        ("formats/two_points.sbet", "sbet", "trajectory", 2, 0.005),
        ("formats/strips.las.gz", "las", "cloud", 14_408, None),
        ("formats/accuracy.smrmsg.gz", "smrmsg", "trajectory_accuracy", 21_902, 21_901.0),
        ("kitti_drive/poses.csv", "pose_matrices", "trajectory", 154, 15.8),
        ("av2_drive/city_SE3_egovehicle.feather", "pose_quaternions", "trajectory", 2_706, 15.95),
        ("drive/gnss_rtk.pos.gz", "rtklib_pos", "gnss", None, 549.0),
        ("drive/imu.csv.gz", "imu_csv", "imu", None, 549.0),
        ("lms/aces.clf.bz2", "carmen", "scans", 7_374, None),
    ],
)
def test_recordings_hold_what_their_page_says(
    recordings: Path, file: str, name: str, table: str, rows: int | None, duration_s: float | None
) -> None:
    if name not in log_formats():
        pytest.skip(f"there is no format '{name}' yet")
    found = inspect(recordings / file)
    assert found.readable, found.error
    assert found.log is not None
    assert found.log.opened.format.name == name
    assert found.log.complete
    figures = found.log.figures.tables[table]
    assert rows is None or figures.rows == rows
    if duration_s is not None:
        assert figures.epochs is not None
        assert figures.epochs.span_s == pytest.approx(duration_s, abs=max(5e-5, 2e-3 * duration_s))
    assert text_of(found).splitlines()[0] == str(recordings / file)


def test_a_capture_without_gprmc_shows_stamps_and_the_line_to_state(recordings: Path) -> None:
    found = inspect(recordings / "velodyne/hdl32e.pcap")
    assert found.log is not None
    assert found.log.time is not None
    assert found.log.time.raw == pytest.approx((835.374684, 835.651151), abs=1e-6)
    assert found.log.time.would_be() == {}
    (clock, hour) = found.log.opened.needs
    assert clock.line == 'clock = { system = "utc_hour", date = ????-??-?? }'
    assert hour.key == "options.hour"
    assert found.log.figures.tables["returns"].columns["sweep"].max == 3  # three azimuth wraps
    assert "past the full UTC hour" in text_of(found)
    known = inspect(
        recordings / "velodyne/hdl32e.pcap", Stated(parse_clock("utc_hour,date=2012-05-04"), options={"hour": 9})
    )
    assert known.log is not None
    assert known.log.opened.needs == ()
    assert "2012-05-04T09:13:55.374684Z" in text_of(known)


def test_the_unit_that_fits_is_proposed(recordings: Path) -> None:
    """The trap of the recordings' page: pass 1's radar stamps are nanoseconds, the others microseconds."""
    units = {}
    for name in ("pass1_radar_poses", "pass1_lidar_poses"):
        found = inspect(recordings / f"two_pass/{name}.csv.gz")
        assert found.log is not None
        units[name] = next(need.line for need in found.log.opened.needs if need.key == "clock")
    assert units == {
        "pass1_radar_poses": 'clock = { system = "????", unit = "ns" }',
        "pass1_lidar_poses": 'clock = { system = "????", unit = "us" }',
    }


# --- hand-made bytes -----------------------------------------------------------------------------------


def test_a_sound_trajectory(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.sbet", sbet(200_000 + np.arange(2_001) / 200))
    found = inspect(path, WEEK_CLOCK)
    assert found.faults == []
    assert found.log is not None
    assert found.log.opened.needs == ()
    assert found.log.time is not None
    assert found.log.time.assumed is None
    # 2026-05-03T00:00:00 GPS starts week 2417; 18 leap seconds
    assert "2026-05-05T07:33:02" in text_of(found)
    figures = found.log.figures.tables["trajectory"]
    assert figures.epochs is not None
    assert figures.epochs.rate_hz == pytest.approx(200)
    assert figures.epochs.period_s == pytest.approx(0.005, rel=0.012)
    assert figures.extent is not None
    assert figures.extent.degrees_low == pytest.approx([11.0, 48.0], abs=1e-9)
    assert figures.extent.degrees_high == pytest.approx([11.0, 48.0 + 100 / 111_200], abs=1e-9)
    assert figures.path_m == pytest.approx(100.0, rel=1e-3)


def test_nothing_is_guessed(tmp_path: Path) -> None:
    found = inspect(written(tmp_path / "drive.sbet", sbet(200_000 + np.arange(50) / 200)))
    assert found.log is not None
    assert [need.line for need in found.log.opened.needs] == [
        'clock = { system = "gps_week_seconds", week = ???? }',
        'crs = "????"',
    ]
    assert found.log.time is not None
    assert found.log.time.raw == pytest.approx((200_000, 200_000.245))
    assert found.log.time.would_be() == {"gps_week_seconds": "Tuesday 07:33:20 GPS time"}
    assert "world_frame" not in found.log.header
    assert "which is not stated" in text_of(found)
    assert found.as_json()["log"]["time"]["known"] is False


def test_every_fault_is_counted_with_its_first_record(tmp_path: Path) -> None:
    times = 200_000 + np.arange(2_000) / 200
    times[300:] += 2.0  # a gap before record 300
    times[500] = times[499]  # record 500 twice
    times[700:] -= 0.5  # back before record 700
    records = sbet(times)
    records[900, 1] += np.radians(0.01)  # 1.1 km to the north and back
    records[1_200, 2] = np.nan
    records[1_201, 2] = 50.0
    found = inspect(written(tmp_path / "drive.sbet", records, b"\1" * 40), WEEK_CLOCK)
    assert found.readable
    # The two lost records leave a gap of their own.
    assert (fault(found, "gaps in time, the longest 2.005 s").count, fault(found, "go back").record) == (2, 700)
    assert (fault(found, "stand twice").count, fault(found, "stand twice").record) == (1, 500)
    assert (fault(found, "positions leap").count, fault(found, "positions leap").record) == (2, 900)
    lost = fault(found, "longitude is missing or not a number")
    assert (lost.count, lost.record, lost.offset) == (1, 1_200, 1_200 * RECORD)
    assert fault(found, "longitude is outside").offset == 1_201 * RECORD
    end = fault(found, "the file ends inside a record: 40 bytes of 136")
    assert (end.record, end.offset) == (2_000, 2_000 * RECORD)
    shown = text_of(found)
    assert "gap of 2.005 s, 1.495 s after the first epoch" in shown
    assert "1 × the file ends inside a record: 40 bytes of 136, first at record 2,000 byte 272,000" in shown


def test_a_rate_that_changes_is_named(tmp_path: Path) -> None:
    steps = np.concatenate([[0.0], np.full(1_279, 0.01), np.full(1_280, 0.02)])
    found = inspect(written(tmp_path / "drive.sbet", sbet(200_000 + np.cumsum(steps))), WEEK_CLOCK)
    changed = fault(found, "the rate changes: 100, 50 Hz")
    assert changed.count == 1
    assert abs(changed.record - 1_280) <= 64


def test_chunks_of_the_reader_change_nothing(tmp_path: Path) -> None:
    """Faults at the seam of the reader's chunks of 16,384 records."""
    times = 200_000 + np.arange(40_000) / 200
    times[16_384:] += 1.0
    times[32_768:] -= 2.0
    found = inspect(written(tmp_path / "drive.sbet", sbet(times)), WEEK_CLOCK)
    assert fault(found, "gaps in time").count == 1
    assert (fault(found, "go back").count, fault(found, "go back").record) == (1, 32_768)


def test_scans_show_ranges_and_missing_returns(tmp_path: Path) -> None:
    geometry = {
        "kind": "cartesian", "readings": 4, "first": -1.5, "step": 1.0, "range_offset_m": 1.5, "range_step_m": 0.001
    }  # fmt: skip
    ranges = np.array([[100, 200, 0, 400], [150, 0, 0, 500]], dtype=np.uint16)
    table = pa.table(
        {
            "epoch_gps_ns": pa.array([10**18, 10**18 + 10**9]),
            "range": pa.FixedSizeListArray.from_arrays(pa.array(ranges.ravel()), 4),
        }
    )
    path = tmp_path / "left.parquet"
    pq.write_table(table.replace_schema_metadata({"roadscan.scan_geometry": json.dumps(geometry)}), path)
    found = inspect(path)
    assert found.log is not None
    readings = found.log.figures.tables["scans"].readings
    assert readings is not None
    assert vars(readings) == {
        "total": 8, "no_return": 3, "range_min_m": pytest.approx(1.6), "range_max_m": pytest.approx(2.0)
    }  # fmt: skip
    assert "8, 37.5% without return, ranges 1.600 to 2.000 m from the sensor" in text_of(found)


def test_control_points_need_their_crs_and_role(tmp_path: Path) -> None:
    path = tmp_path / "control.csv"
    path.write_text("name,easting_m,northing_m,height_m\nA,500000,5400000,100\nB,500100,5400200,101\nC,x,1,2\n")
    found = inspect(path)
    assert found.log is not None
    assert {need.key for need in found.log.opened.needs} == {"crs", "options.role"}
    assert "gcp" in next(n.reason for n in found.log.opened.needs if n.key == "options.role")
    assert found.log.figures.rejected == 1
    stated = inspect(path, Stated(crs="EPSG:32632", options={"role": "gcp"}))
    assert stated.log is not None
    extent = stated.log.figures.tables["control_points"].extent
    assert extent is not None
    assert extent.low == pytest.approx([500_000, 5_400_000, 100])
    # easting 500 km of zone 32 is its central meridian; the northing's latitude by PROJ's own cs2cs
    assert extent.degrees_low == pytest.approx([9.0, 48.752], abs=2e-3)


def ply(path: Path, *properties: str, value: int = 7) -> Path:
    """Ten points with x, y and z, and `value` for each further property."""
    top = ["ply", "format ascii 1.0", "element vertex 10", *(f"property float {a}" for a in "xyz")]
    rows = [" ".join([f"{k} 0 0", *[str(value)] * len(properties)]) for k in range(10)]
    path.write_text("\n".join([*top, *(f"property {p}" for p in properties), "end_header", *rows, ""]))
    return path


def needs_of(found: Inspection) -> dict[str, str]:
    assert found.log is not None
    return {need.key: need.reason for need in found.log.opened.needs}


def test_what_is_assumed_of_a_scan_is_not_shown_as_known(tmp_path: Path) -> None:
    found = inspect(ply(tmp_path / "a.ply", "uchar intensity"))
    needs = needs_of(found)
    assert list(needs) == ["crs", "options.unit", "options.epoch"]
    assert needs["crs"].startswith("the CRS of the log's positions is not stated")
    assert "PLY does not say the unit" in needs["options.unit"]
    assert "the file says no time" in needs["options.epoch"]
    assert found.log is not None
    assert found.log.is_time_assumed
    assert found.log.time is None
    assert "unit_m" not in found.log.header
    shown = text_of(found)
    assert "not known, and the log holds no stamps of its own" in shown
    assert "1980" not in shown
    assert "intensity 1,799" in shown
    assert "0.000 in a unit that is not stated, as written" in shown


def test_a_setting_is_asked_for_only_where_the_reader_does(tmp_path: Path) -> None:
    scaleless = needs_of(inspect(ply(tmp_path / "a.ply", "float intensity")))
    assert list(scaleless) == ["crs", "options.unit", "options.epoch", "options.intensity"]
    assert "whose scale the file does not say" in scaleless["options.intensity"]
    timed = inspect(ply(tmp_path / "b.ply", "double gps_time", value=300_000_007))
    assert list(needs_of(timed)) == ["clock", "crs", "options.unit"]
    assert timed.log is not None
    assert timed.log.time is not None
    assert timed.log.time.raw == (300_000_007, 300_000_007)


@pytest.mark.parametrize("name", ["x.bin", "x.sbet"])
def test_a_large_unknown_file_is_not_read_to_its_end(tmp_path: Path, name: str) -> None:
    counts = Path("/proc/self/io")
    if not counts.exists():
        pytest.skip("this system does not count bytes read")
    path = tmp_path / name
    with path.open("wb") as stream:
        stream.truncate(2 << 30)  # sparse
    before = int(counts.read_text().split()[1])
    assert "no known raw format" in inspect(path, quick=True).error
    assert int(counts.read_text().split()[1]) - before < 1 << 30


def test_a_quick_look_reads_a_prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inspect_module, "QUICK_VALUES", 1_000)
    path = written(tmp_path / "drive.sbet", sbet(200_000 + np.arange(40_000) / 200))
    found = inspect(path, WEEK_CLOCK, quick=True)
    assert found.log is not None
    assert not found.log.complete
    assert 1_000 <= found.log.figures.rows < 40_000
    assert "only its beginning was read" in text_of(found)


def test_progress_is_heard(tmp_path: Path) -> None:
    heard: list[tuple[int, float | None]] = []
    path = written(tmp_path / "drive.sbet", sbet(200_000 + np.arange(40_000) / 200))
    inspect(path, WEEK_CLOCK, progress=lambda rows, share: heard.append((rows, share)))
    assert [rows for rows, _ in heard] == sorted(rows for rows, _ in heard)
    assert heard[-1][0] == 40_000
    assert all(share is None or 0 <= share <= 1 for _, share in heard)


# --- compressed files ----------------------------------------------------------------------------------


def test_compressed_files_are_looked_into(tmp_path: Path) -> None:
    plain = written(tmp_path / "drive.sbet", sbet(200_000 + np.arange(400) / 200)).read_bytes()
    whole, cut = tmp_path / "drive.sbet.gz", tmp_path / "cut.sbet.gz"
    whole.write_bytes(gzip.compress(plain))
    cut.write_bytes(gzip.compress(plain)[:-200])
    found = inspect(whole, WEEK_CLOCK)
    assert found.wrappers == ("gzip",)
    assert found.log is not None
    assert found.log.figures.rows == 400
    assert found.bytes == whole.stat().st_size
    damaged = inspect(cut, WEEK_CLOCK)
    assert damaged.wrappers == ("gzip",)
    assert damaged.log is None or 0 < damaged.log.figures.rows < 400
    assert any("the gzip file is cut off after" in f.what for f in damaged.faults)


def test_unpacking_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inspect_module, "UNPACKED_BYTES_MAX", 1 << 20)
    bomb = tmp_path / "zeros.gz"
    bomb.write_bytes(gzip.compress(gzip.compress(bytes(1 << 24))))
    found = inspect(bomb)
    assert not found.readable
    assert found.wrappers == ("gzip", "gzip")
    assert any("only the first" in f.what for f in found.faults)


# --- what is no log ------------------------------------------------------------------------------------


def _png() -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 640, 480) + bytes(20)


def _jpeg() -> bytes:
    return b"\xff\xd8\xff\xe0\0\4ab\xff\xc0\0\x11\x08" + struct.pack(">HH", 1080, 1920) + bytes(20)


def _zip() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("a.txt", "hello")
    return out.getvalue()


def _npy() -> bytes:
    out = io.BytesIO()
    np.save(out, np.zeros((1_000, 3)))
    return out.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "what", "detail"),
    [
        ("a.png", _png(), "a PNG picture", "640 × 480 pixels"),
        ("a.jpg", _jpeg(), "a JPEG picture", "1,920 × 1,080 pixels"),
        ("a.zip", _zip(), "a zip archive", "1 file: a.txt"),
        ("a.npy", _npy()[:5_000], "a NumPy array", "the file ends early"),
        ("a.csv", b"x_m,iri\n1,2\n3,4\n", "text, 2 columns named x_m, iri", "lines: 3"),
        ("a.txt", b"Dear reader, this is a letter\nand no table.\n", "text", "lines: 2"),
        ("a.bin", b"", "an empty file", "0 bytes"),
        ("a.bin", random.Random(1).randbytes(5_000), "binary data of no known kind", "first bytes"),
        ("a.pdf", b"%PDF-1.7\n", "a PDF document", ""),
        ("a.toml", b"[x\n", "a TOML file", "not valid TOML"),
    ],
)
def test_other_files_are_told_by_their_bytes(tmp_path: Path, name: str, content: bytes, what: str, detail: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    found = inspect(path)
    assert (found.what, found.readable) == (what, False)
    assert detail in text_of(found)


def test_settings_files_are_checked(tmp_path: Path) -> None:
    examples = Path(__file__).resolve().parents[2] / "docs" / "examples"
    found = inspect(examples / "SURVEY.toml")
    assert (found.what, found.readable) == ("a survey file of roadscan", True)
    assert "the log raw/morning.sbet does not exist" in text_of(found)
    assert inspect(examples / "RIG.toml").readable
    broken = tmp_path / "RIG.toml"
    broken.write_text('[sensors.roof]\nkind = "lidar"\naxis = "flu"\n')
    told = inspect(broken)
    assert (told.what, told.readable) == ("a rig file of roadscan", False)
    assert "did you mean 'axes'?" in told.error


def test_rasters_and_tables(tmp_path: Path) -> None:
    raster = tmp_path / "a.tif"
    with rasterio.open(
        raster, "w", driver="GTiff", width=20, height=10, count=1, dtype="float32", crs="EPSG:32632",
        transform=rasterio.Affine(0.5, 0, 500_000, 0, -0.5, 5_400_000),
    ) as out:  # fmt: skip
        out.write(np.zeros((10, 20), dtype=np.float32), 1)
    shown = text_of(inspect(raster))
    assert "a GeoTIFF raster" in shown
    assert "WGS 84 / UTM zone 32N (EPSG:32632)" in shown
    assert "500,000.000 … 500,010.000 east, 5,399,995.000 … 5,400,000.000 north" in shown
    own = tmp_path / "cells.parquet"
    pq.write_table(table_schema("cells").arrow().empty_table(), own)
    found = inspect(own)
    assert (found.what, found.readable) == ("a Parquet table: roadscan's table cells", True)


def test_folders_and_missing_files(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x")
    found = inspect(tmp_path)
    assert found.what == "a folder of 1 file (1 .txt)"
    assert not found.readable
    assert "there is no such file" in inspect(tmp_path / "none").error


def test_the_nearest_format_is_named(tmp_path: Path) -> None:
    """Poses 100 s apart that begin at 0° 0' are no SBET by their content test, and are read as such nevertheless."""
    records = sbet(200_000 + np.arange(30) * 1.0)
    records[:8, 0] = records[:8, 0][::-1]
    path = written(tmp_path / "odd.bin", records)
    found = inspect(path)
    assert found.log is None
    assert not found.formats
    asked = inspect(path, WEEK_CLOCK, "sbet")
    assert asked.log is not None
    assert asked.log.figures.rows == 30
    with pytest.raises(ConfigError, match="did you mean 'sbet'"):
        inspect(path, None, "sbett")


# --- hostile files -------------------------------------------------------------------------------------


class _Liar(LogFormat):
    """A reader of somebody else that breaks its promise."""

    name = "liar"
    title = "lies"
    yields = ("trajectory",)
    time = ""

    def __init__(self, where: str) -> None:
        self._where = where

    def sniff(self, path: Path) -> bool:
        if self._where == "sniff":
            raise ValueError("sniffed")
        return True

    def header(self, source: LogSource) -> LogHeader:
        if self._where == "header":
            raise ZeroDivisionError("no header")
        return LogHeader()

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        raise MemoryError("too much")
        yield


@pytest.mark.parametrize(
    ("where", "said"),
    [("sniff", "no known raw format"), ("header", "ZeroDivisionError: no header"), ("read", "MemoryError: too much")],
)
def test_a_reader_that_breaks_its_promise_ends_in_a_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, said: str
) -> None:
    monkeypatch.setattr(diagnosis_module, "log_formats", lambda: {"liar": _Liar(where)})
    path = tmp_path / "a.bin"
    path.write_bytes(b"\1\2\3")
    found = inspect(path)
    assert not found.readable
    assert said in found.error


def test_a_pipe_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert inspect(tmp_path / "pipe").error.endswith("neither a file nor a folder")


@pytest.mark.slow
def test_damaged_files_never_crash(tmp_path: Path) -> None:
    """Mutants of all samples: told, read, or refused with a message."""
    rng = random.Random(7)
    records = sbet(200_000 + np.arange(40) / 200).astype("<f8").tobytes()
    samples = {
        "a.sbet": records, "a.sbet.gz": gzip.compress(records), "a.png": _png(), "a.jpg": _jpeg(), "a.zip": _zip(),
        "a.npy": _npy()[:400], "a.csv": b"name,easting_m,northing_m,height_m\nA,1,2,3\n" * 3,
        "a.toml": b'[sensors.a]\nkind = "lidar"\n', "a.geojson": b'{"type":"FeatureCollection","features":[]}',
        "a.tif": b"II*\0" + bytes(200),
    }  # fmt: skip
    for number in range(80):
        name, content = rng.choice(list(samples.items()))
        mutant = bytearray(content)
        for _ in range(rng.randint(1, 6)):
            mutant[rng.randrange(len(mutant))] = rng.randrange(256)
        path = tmp_path / f"{number}-{name}"
        path.write_bytes(bytes(mutant[: rng.randint(1, len(mutant))]))
        found = inspect(path, quick=True)
        assert found.what
        assert found.readable or found.error
        assert str(path) in text_of(found)
        json.dumps(found.as_json())


# --- formats that say how to look -----------------------------------------------------------------------


class _Particular(_Liar):
    """Opens with one clock and one CRS only, which nobody would try."""

    name = "particular"
    provisional = (Provisional(clock=Clock(TimeSystem.UNIX_TAI, unit="ms"), crs="EPSG:4937"),)

    def header(self, source: LogSource) -> LogHeader:
        if source.need_clock("unix_tai").unit != "ms" or source.need_crs() != "EPSG:4937":
            raise ConfigError("something else was stated")
        return LogHeader({"world_frame": "local"})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        return iter(())


def test_a_format_may_say_how_to_look(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"x")
    opened = open_log(_Particular(""), path, Stated())
    assert (opened.source.clock, opened.source.crs) == (Clock(TimeSystem.UNIX_TAI, unit="ms"), "EPSG:4937")
    assert [need.key for need in opened.needs] == ["clock", "crs"]
    with pytest.raises(ConfigError, match="something else was stated"):
        open_log(_Particular(""), path, Stated(clock=Clock(TimeSystem.GPS)))


# --- the command line ----------------------------------------------------------------------------------


def test_exit_codes_and_json(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.sbet", sbet(200_000 + np.arange(50) / 200), b"\1")
    stated = ["--clock", "gps_week_seconds,week=2417", "--crs", "EPSG:4979"]
    fine = CliRunner().invoke(app, ["inspect", str(path), *stated, "--json"])
    assert fine.exit_code == 0
    (said,) = json.loads(fine.stdout)
    assert said["formats"] == ["sbet"]
    assert said["log"]["tables"]["trajectory"]["rows"] == 50
    assert said["log"]["to_state"] == []
    assert [f["offset"] for f in said["faults"]] == [50 * RECORD]
    (tmp_path / "a.png").write_bytes(_png())
    bad = CliRunner().invoke(app, ["inspect", str(path), str(tmp_path / "a.png"), "--quick"])
    assert bad.exit_code == 2
    assert "a PNG picture" in bad.stdout
    assert "\x1b" not in bad.stdout


@pytest.mark.slow
def test_a_pipe_gets_plain_text(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.sbet", sbet(200_000 + np.arange(50) / 200))
    command = [sys.executable, "-m", "roadscan", "inspect", str(path), "--clock", "weeks"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    assert "'system' (got 'weeks')" in found.stderr
    assert "Traceback" not in found.stderr
    found = subprocess.run([*command[:-2]], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stderr) == (0, "")
    assert "\x1b" not in found.stdout
    assert '  to state clock = { system = "gps_week_seconds", week = ???? }' in found.stdout


def test_statements_as_typed() -> None:
    assert parse_clock("unix_utc,unit=us") == Clock(TimeSystem.UNIX_UTC, unit="us")
    assert parse_clock('{ system = "gps_week_seconds", week = 2405 }') == Clock(TimeSystem.GPS_WEEK, week=2405)
    assert parse_option("hour=9") == ("hour", 9)
    assert parse_option("axes=flu") == ("axes", "flu")
    for wrong in ("", "gps,week", "{ system ="):
        with pytest.raises(ConfigError):
            parse_clock(wrong)
    with pytest.raises(ConfigError, match="has no value"):
        parse_option("hour")
