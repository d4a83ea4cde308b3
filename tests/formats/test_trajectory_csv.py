"""Trajectories as CSV: columns, units, time, damage."""

from __future__ import annotations

import bz2
import gzip
import lzma
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError, FormatError, RoadscanError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.log_reading import GPS_SECONDS, read_log

NAMES = "time_s,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"
STATED: dict[str, Any] = {"clock": GPS_SECONDS, "crs": "EPSG:4979"}
ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
GPS_MINUS_UTC_S = 18  # since 2017


def line(i: int, **changed: object) -> str:
    fields: dict[str, object] = {"t": 1.4e9 + i, "lat": 50 + 1e-5 * i, "lon": 10, "h": 100, "r": 1, "p": -2, "y": 359}
    return ",".join(str(v) for v in (fields | changed).values())


def write(path: Path, lines: list[str], names: str = NAMES, end: str = "\n") -> Path:
    path.write_bytes((end.join([names, *lines]) + end).encode())
    return path


def test_units_are_read_from_the_names(tmp_path: Path) -> None:
    degrees = write(tmp_path / "deg.csv", [line(i) for i in range(3)])
    radians = write(
        tmp_path / "rad.csv",
        [
            f"{math.radians(359)};{1400000000 + i}000;{math.radians(50 + 1e-5 * i)!r};{math.radians(10)!r};"
            f"{100 / 0.3048!r};{math.radians(1)!r};{math.radians(-2)!r};0.02;30"
            for i in range(3)
        ],
        names="Heading_rad;time_ms;lat_rad;lon_rad;altitude_ft;roll_rad;pitch_rad;sigma_north_m;sigma_down_mm",
    )
    a = read_log("trajectory_csv", degrees, **STATED)
    b = read_log("trajectory_csv", radians, clock=Clock(TimeSystem.GPS, unit="ms"), crs="EPSG:4979")
    np.testing.assert_array_equal(a.epochs, [(1_400_000_000 + i) * 10**9 for i in range(3)])
    np.testing.assert_array_equal(a.epochs, b.epochs)
    np.testing.assert_allclose(a.positions, b.positions, atol=1e-8)
    assert (a.attitudes * b.attitudes.inv()).magnitude().max() < 1e-12
    np.testing.assert_allclose(a.positions[1], ECEF.transform(10, 50.00001, 100), atol=1e-8)
    assert a.table["sigma_north_m"].null_count == 3
    np.testing.assert_allclose(b.column("sigma_north_m"), 0.02, rtol=1e-6)
    np.testing.assert_allclose(b.column("sigma_down_m"), 0.03, rtol=1e-6)
    assert b.table["sigma_east_m"].null_count == 3


def test_angle_sigmas_become_degrees(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", [line(0) + ",0.05,3,0.001"], f"{NAMES},sigma_roll_deg,sigma_pitch_arcmin,sd_yaw")
    options = {"columns": {"sigma_heading": {"name": "sd_yaw", "unit": "rad"}}}
    log = read_log("trajectory_csv", path, options, **STATED)
    row = log.table.to_pylist()[0]
    assert [row[f"sigma_{a}_deg"] for a in ("roll", "pitch", "heading")] == pytest.approx(
        [0.05, 0.05, math.degrees(0.001)]
    )
    assert row["sigma_north_m"] is None


def test_attitude_of_a_local_frame(tmp_path: Path) -> None:
    names = "time_s,x_m,y_m,z_m,roll_deg,pitch_deg,heading_deg"
    log = read_log(
        "trajectory_csv", write(tmp_path / "a.csv", ["5,1,2,3,10,20,30"], names), clock=GPS_SECONDS, crs="local"
    )
    assert log.attributes["world_frame"] == "local"
    assert log.positions.tolist() == [[1, 2, 3]]
    ned = Rotation.from_euler("ZYX", [30, 20, 10], degrees=True)
    enu_from_ned = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert (log.attitudes[0] * (enu_from_ned * ned).inv()).magnitude() < 1e-12


def test_columns_are_mapped_in_options(tmp_path: Path) -> None:
    names = "Zeit Breite Laenge H Roll Pitch Azimut"
    path = write(
        tmp_path / "a.txt", ["% a preamble", names, *(line(i).replace(",", "   ") for i in range(2))], "POSPac 8.9"
    )
    options: dict[str, Any] = {
        "skip_lines": 1,
        "comment": "%",
        "delimiter": " ",
        "columns": {
            "time": {"name": "Zeit"},
            "latitude": {"name": "Breite", "unit": "deg"},
            "longitude": {"name": "Laenge", "unit": "deg"},
            "height": {"name": "H", "unit": "m"},
            "roll": {"name": "Roll", "unit": "deg"},
            "pitch": {"name": "Pitch", "unit": "deg"},
            "heading": {"name": "Azimut", "unit": "deg"},
        },
    }
    mapped = read_log("trajectory_csv", path, options, **STATED)
    plain = read_log("trajectory_csv", write(tmp_path / "b.csv", [line(i) for i in range(2)]), **STATED)
    assert mapped.table.equals(plain.table)
    headless = tmp_path / "c.csv"
    headless.write_text("\n".join(line(i) for i in range(2)))
    named = read_log("trajectory_csv", headless, {"names": NAMES.split(",")}, **STATED)
    assert named.table.equals(plain.table)
    assert named.rows[0].first_offset == 0


@pytest.mark.parametrize(
    ("names", "options", "error", "says"),
    [
        (NAMES.replace("roll_deg", "roll"), {}, FormatError, "column 'roll' says no unit; expected .*'roll_rad'"),
        (NAMES.replace("roll_deg", "bank"), {}, FormatError, "no column holds the roll"),
        (NAMES.replace("roll_deg", "roll_deg,roll_rad"), {}, FormatError, "'roll_deg' and 'roll_rad' both hold"),
        (NAMES.replace("roll_deg", "pitch_deg"), {}, FormatError, "two columns are called 'pitch_deg'"),
        (NAMES, {"columns": {"rol": {"name": "roll_deg"}}}, ConfigError, "did you mean 'roll'"),
        (NAMES, {"columns": {"roll": {"name": "rol_deg"}}}, ConfigError, "did you mean 'roll_deg'"),
        (NAMES, {"columns": {"roll": {"name": "roll_deg", "unit": "grad"}}}, ConfigError,
         "'grad' .did you mean 'rad'"),
        (NAMES.replace("roll_deg", "R"), {"columns": {"roll": {"name": "R"}}}, ConfigError,
         r"column 'R' \(roll\) is not stated"),
        (NAMES, {"delimiter": "::"}, ConfigError, "expected one character"),
        (NAMES, {"delimiter": '"'}, ConfigError, "expected one character"),
        (NAMES, {"delimeter": ";"}, ConfigError, "did you mean 'delimiter'"),
        (NAMES.replace("time_s", "time_ms"), {}, TimeSystemError,
         'is in ms by its name, the clock says s.*clock.unit = "ms"'),
    ],
)  # fmt: skip
def test_columns_are_never_guessed(tmp_path: Path, names: str, options: dict, error: type, says: str) -> None:
    path = write(tmp_path / "a.csv", [line(0)], names)
    with pytest.raises(error, match=says):
        read_log("trajectory_csv", path, options, **STATED)


UTC_NS = (1_777_887_000 - 315_964_800 + GPS_MINUS_UTC_S) * 10**9 + 125_000_000  # 2026-05-04T09:30:00.125Z


@pytest.mark.parametrize(
    ("words", "clock", "expected"),
    [
        (["2026-05-04T09:30:00.125Z", "2026-05-04 11:30:01.125+02:00"], None, UTC_NS),
        (["2026-05-04T09:29:59.625Z", "2026-05-04T09:30:00.625Z"], Clock(TimeSystem.UNIX_UTC, offset_s=0.5), UTC_NS),
        (["2026-05-04 09:30:00.125", "2026-05-04 09:30:01.125"], Clock(TimeSystem.UNIX_UTC), UTC_NS),
        (["2026-05-04 09:30:18.125", "2026-05-04 09:30:19.125"], Clock(TimeSystem.UNIX_GPS), UTC_NS),
        (["2026-05-04 09:30:37.125", "2026-05-04 09:30:38.125"], Clock(TimeSystem.UNIX_TAI), UTC_NS),
    ],
)  # fmt: skip
def test_time_as_text(tmp_path: Path, words: list[str], clock: Clock | None, expected: int) -> None:
    path = write(tmp_path / "a.csv", [line(i, t=w) for i, w in enumerate(words)], NAMES.replace("time_s", "time_utc"))
    log = read_log("trajectory_csv", path, clock=clock, crs="EPSG:4979")
    assert log.epochs.tolist() == [expected, expected + 10**9]


@pytest.mark.parametrize(
    ("word", "clock", "says"),
    [
        ("2026-05-04 09:30:00", None, "has no zone"),
        ("2026-05-04 09:30:00", GPS_SECONDS, "has no zone"),
        ("2026-05-04T09:30:00Z", GPS_SECONDS, "so it is UTC, the clock says gps"),
        ("04.05.2026", None, "neither a number nor ISO 8601"),
        ("1.4e9", None, "time system is not stated"),
    ],
)
def test_time_is_never_guessed(tmp_path: Path, word: str, clock: Clock | None, says: str) -> None:
    path = write(tmp_path / "a.csv", [line(0, t=word)], NAMES.replace("time_s", "time"))
    with pytest.raises(FormatError if "neither" in says else TimeSystemError, match=says):
        read_log("trajectory_csv", path, {"columns": {"time": {"name": "time"}}}, clock=clock, crs="EPSG:4979")


def test_a_first_stamp_that_lost_its_fraction_costs_no_other(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.csv", [line(0, t="1400000000"), *(line(i, t=f"{1_400_000_000 + i}.5") for i in range(1, 5))]
    )
    log = read_log("trajectory_csv", path, **STATED)
    assert log.rejects == []
    assert log.epochs[1:].tolist() == [(1_400_000_000 + i) * 10**9 + 500_000_000 for i in range(1, 5)]


def test_a_line_of_names_without_end(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", [line(0)], NAMES + "," + "x" * 70_000)
    with pytest.raises(FormatError, match="does not end within 65,536 bytes"):
        read_log("trajectory_csv", path, **STATED)


def test_a_block_of_zeros_costs_its_lines(tmp_path: Path) -> None:
    """What a file system leaves of blocks that were never written."""
    lines = [line(i) for i in range(40)]
    path = write(tmp_path / "a.csv", [*lines[:20], "\0" * 512 + lines[20][30:], *lines[21:]])
    assert format_of(path).name == "trajectory_csv"
    log = read_log("trajectory_csv", path, **STATED)
    assert [r.record for r in log.rejects] == [20]
    assert log.table.num_rows == 39
    path.write_bytes(path.read_bytes().replace(b"height", b"hei\0ght"))
    with pytest.raises(FormatError, match="holds no text"):
        read_log("trajectory_csv", path, **STATED)


@pytest.mark.parametrize("start", ["# a comment\r", "\r", "#\r\r\n\r"])
def test_a_comment_or_blank_line_hides_no_line_that_a_return_ends(tmp_path: Path, start: str) -> None:
    path = write(tmp_path / "a.csv", [line(0), start + line(1), line(2), "# plain", "", line(3)])
    log = read_log("trajectory_csv", path, **STATED)
    assert log.epochs.tolist() == [(1_400_000_000 + i) * 10**9 for i in (0, 2, 3)]
    assert sum(r.records for r in log.rejects) == start.count("\n") + 1
    assert all("fields, expected 7" in r.reason for r in log.rejects)


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress, bytes])
def test_damaged_lines_cost_themselves(tmp_path: Path, pack: Any) -> None:
    lines = [line(i) for i in range(12)]
    lines[2] = line(2, lat="north")
    lines[4] = line(4) + ",1"
    lines[5] = line(5, lat=91)
    lines[6] = line(6, h="")
    lines[7] = line(7, t="1e30")
    lines[8] = line(8, r="nan")
    lines[9] = '"' + line(9)  # a stray quote must not swallow the next line
    lines[11] = "1400000011,50"  # cut
    text = "\n".join([NAMES, lines[0], "# a remark", "", *lines[1:]]).encode()
    path = tmp_path / "a.csv"
    path.write_bytes(pack(text))
    log = read_log("trajectory_csv", path, **STATED)
    np.testing.assert_array_equal(log.epochs, [(1_400_000_000 + i) * 10**9 for i in (0, 1, 3, 10)])
    found = {r.record: r.reason for r in log.rejects}
    assert {k: found[k] for k in (2, 4, 5, 6, 8, 11)} == {
        2: "latitude_deg 'north' is not a number",
        4: "8 fields, expected 7",
        5: "latitude is outside -1.5708 to 1.5708 rad",
        6: "height is missing or not a number",
        8: "roll is missing or not a number",
        11: "2 fields, expected 7",
    }
    assert "falls outside 1980–2080" in found[7]
    assert set(found) == {2, 4, 5, 6, 7, 8, 9, 11}
    for reject in log.rejects:
        assert text[reject.offset :].startswith(lines[reject.record].encode())


def test_an_impossible_sigma_costs_its_record_and_a_missing_one_nothing(tmp_path: Path) -> None:
    lines = [f"{line(i)},{sigma}" for i, sigma in enumerate(("0.01", "-0.01", "inf", "", "1e300"))]
    log = read_log("trajectory_csv", write(tmp_path / "a.csv", lines, NAMES + ",sigma_east_m"), **STATED)
    assert log.table["sigma_east_m"].to_pylist() == [pytest.approx(0.01), None]
    assert [(r.record, r.records) for r in log.rejects] == [(1, 2), (4, 1)]


def test_windows_line_ends_and_a_byte_order_mark(tmp_path: Path) -> None:
    plain = read_log("trajectory_csv", write(tmp_path / "a.csv", [line(i) for i in range(3)]), **STATED)
    path = write(tmp_path / "b.csv", [line(i) for i in range(3)], "\ufeff" + NAMES, end="\r\n")
    assert format_of(path).name == "trajectory_csv"
    assert read_log("trajectory_csv", path, **STATED).table.equals(plain.table)


def test_blocks_join_without_a_seam(tmp_path: Path) -> None:
    """3 MB of text are some blocks: every line arrives once, with its own record and offset."""
    lines = [line(i) for i in range(80_000)]
    lines[41_234] = "x" * 100_000  # longer than any line may be
    lines[50_000] = line(50_000, lat=-99)
    path = write(tmp_path / "a.csv", lines)
    log = read_log("trajectory_csv", path, **STATED)
    assert len(log.rows) > 2
    keep = [i for i in range(80_000) if i not in (41_234, 50_000)]
    np.testing.assert_array_equal(log.epochs, [(1_400_000_000 + i) * 10**9 for i in keep])
    offsets = {r.record: r.offset for r in log.rejects}
    before = len(NAMES) + 1
    assert offsets == {n: before + sum(len(x) + 1 for x in lines[:n]) for n in (41_234, 50_000)}


def test_a_compressed_file_that_breaks_off_keeps_what_came_before(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    lines = [line(i, h=100 + rng.random()) for i in range(5_000)]
    packed = gzip.compress("\n".join([NAMES, *lines]).encode())
    path = tmp_path / "a.csv.gz"
    path.write_bytes(packed[: len(packed) // 2])
    log = read_log("trajectory_csv", path, **STATED)
    assert 1_000 < log.table.num_rows < 4_000
    assert "the compressed file is damaged from here on" in log.rejects[-1].reason
    assert log.rejects[-1].record == log.table.num_rows
    path.write_bytes(packed[:10_000])  # broken off within the bytes that hold the column names
    assert format_of(path).name == "trajectory_csv"
    assert read_log("trajectory_csv", path, **STATED).table.num_rows > 100


def test_sniffing(tmp_path: Path, recordings: Path) -> None:
    sniff = format_named("trajectory_csv").sniff
    assert sniff(write(tmp_path / "a.csv", [line(0)]))
    assert not sniff(write(tmp_path / "b.csv", [line(0)], NAMES.replace("roll_deg", "roll")))
    assert not sniff(tmp_path)
    assert [p for p in recordings.rglob("*") if sniff(p)] == []


def test_an_empty_file(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"")
    with pytest.raises(RoadscanError, match="holds no text"):
        read_log("trajectory_csv", path, **STATED)
