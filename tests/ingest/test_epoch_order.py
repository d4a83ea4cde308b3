"""Time that goes back within a log, through `roadscan ingest`: left out or named, and never sorted in silently."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.survey import Survey
from roadscan.store.logs import LogRecord, read_log_records
from roadscan.store.store import Store
from tests.formats.test_velodyne_clock import heard, piece
from tests.formats.test_velodyne_pcap import capture

START_S = 1_461_920_418.0
RATE_HZ = 100
IMU = "time_s,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s,acc_x_g,acc_y_g,acc_z_g\n"
SURVEY = """
id = "s"
store = "store"
[map]
crs = "EPSG:32632"
[rig.sensors.imu]
kind = "imu"
axes = "frd"
[[runs]]
id = "r"
[[runs.logs]]
path = "i.csv"
sensor = "imu"
clock = {clock}
"""
GPS, FREE = '{ system = "gps", unit = "s" }', '{ system = "free", unit = "s", offset_s = 1.0 }'


def line(stamp_s: float, number: int) -> str:
    return f"{stamp_s:.4f},0.{number % 997:04d},0,0,0,0,1\n"


def even(first: int, count: int, off_s: float = 0.0) -> list[str]:
    """Lines of readings `first` and on, of a clock that is off."""
    return [line(START_S + k / RATE_HZ + off_s, k) for k in range(first, first + count)]


def ingested(folder: Path, lines: list[str], clock: str = GPS) -> LogRecord:
    (folder / "i.csv").write_text(IMU + "".join(lines))
    (folder / "SURVEY.toml").write_text(SURVEY.replace("{clock}", clock))
    done = CliRunner().invoke(app, ["ingest", str(folder / "SURVEY.toml")])
    assert done.exit_code == 0, f"{done.output}{done.exception}"
    survey = Survey.load(folder / "SURVEY.toml")
    (record,) = read_log_records(Store(survey.store_url, survey.config.id))
    return record


def said(record: LogRecord) -> dict[str, str]:
    return {one.witness: one.text for one in record.findings}


@pytest.mark.witness("time_goes_back")
@pytest.mark.parametrize("clock", [GPS, FREE])
def test_a_clock_that_starts_anew_is_not_sorted_into_what_came_before(tmp_path: Path, clock: str) -> None:
    """After 20 s the stamps start again 15 s back: 15 s of them would lie among the first."""
    record = ingested(tmp_path, even(0, 2_000) + even(2_000, 2_500, -15.0), clock)
    assert record.rows == 3_000
    assert record.rejected == 1_500
    assert "by 14.990 s" in said(record)["time_goes_back"]
    done = CliRunner().invoke(app, ["status", str(tmp_path / "SURVEY.toml")])
    assert "time goes back once" in " ".join(done.output.split())


def test_a_leap_second_inside_a_log_loses_a_second_and_is_named(tmp_path: Path) -> None:
    record = ingested(tmp_path, even(0, 2_000) + even(2_000, 2_000, -1.0))
    assert (record.rows, record.rejected) == (3_900, 100)
    assert "by 0.990 s" in said(record)["time_goes_back"]


def test_the_count_of_a_free_clock_never_goes_back(tmp_path: Path) -> None:
    """Before the first stamp: another log of a GPS clock, a restart of a count."""
    lines = even(0, 1_000) + even(1_000, 500, -500.0)
    (tmp_path / "gps").mkdir()
    record = ingested(tmp_path / "gps", lines)
    assert (record.rows, record.rejected) == (1_500, 0)
    assert "500 at times of which it holds no other row are used" in said(record)["time_goes_back"]
    (tmp_path / "free").mkdir()
    record = ingested(tmp_path / "free", lines, FREE)
    assert (record.rows, record.rejected) == (1_000, 500)


def test_a_log_appended_to_itself_counts_once(tmp_path: Path) -> None:
    record = ingested(tmp_path, even(0, 30_000) + even(0, 30_000))
    assert (record.rows, record.rejected) == (30_000, 30_000)


@pytest.mark.witness("rows_twice")
def test_rows_that_stand_twice_count_once(tmp_path: Path) -> None:
    record = ingested(tmp_path, [one for one in even(0, 500) for _ in range(2)])
    assert (record.rows, record.reject_reasons) == (500, {"the row stands twice, one after the other": 500})


def test_late_rows_that_fill_a_gap_are_used_and_named(tmp_path: Path) -> None:
    lines = even(0, 1_000)
    lines[100], lines[101] = lines[101], lines[100]
    lines.insert(560, lines.pop(500))
    record = ingested(tmp_path, lines)
    assert (record.rows, record.rejected) == (1_000, 0)
    assert "time goes back 2 times" in said(record)["time_goes_back"]


@pytest.mark.parametrize("count", [3, 300])
def test_stamps_that_leap_and_come_back_are_left_out(tmp_path: Path, count: int) -> None:
    """Both neighbours exclude them, though later stamps reach their time."""
    lines = even(0, 1_000) + even(1_000, count, 20.0) + even(1_000 + count, 4_000)
    record = ingested(tmp_path, lines)
    assert (record.rows, record.rejected) == (5_000, count)
    assert set(record.reject_reasons) == {"the stamps leap out of the log's order and come back"}


@pytest.mark.witness("time_jumps")
def test_a_jump_forward_of_an_imu_is_named(tmp_path: Path) -> None:
    record = ingested(tmp_path, even(0, 2_000) + even(2_000, 2_000, 5.0))
    assert (record.rows, record.rejected) == (4_000, 0)
    assert "by 5.010 s" in said(record)["time_jumps"]


def test_sound_logs_are_not_doubted(tmp_path: Path) -> None:
    """Jitter, lost rows and a rate that changes."""
    rng = np.random.default_rng(5)
    stamps = START_S + np.cumsum(np.concatenate([rng.uniform(0.008, 0.012, 3_000), rng.uniform(0.018, 0.022, 1_000)]))
    lines = [line(s, k) for k, s in enumerate(stamps.tolist()) if k % 50]
    record = ingested(tmp_path, lines)
    assert (record.rejected, record.findings) == (0, ())


@pytest.mark.witness("same_content")
def test_a_log_that_is_listed_twice_under_two_names_counts_once_and_is_named(tmp_path: Path) -> None:
    text = IMU + "".join(even(0, 500))
    for name in ("i.csv", "copy.csv"):
        (tmp_path / name).write_text(text)
    stated = SURVEY.replace("{clock}", GPS)
    (tmp_path / "SURVEY.toml").write_text(stated + stated[stated.index("[[runs.logs]]") :].replace("i.csv", "copy.csv"))
    assert CliRunner().invoke(app, ["ingest", str(tmp_path / "SURVEY.toml")]).exit_code == 0
    said = " ".join(CliRunner().invoke(app, ["status", str(tmp_path / "SURVEY.toml")]).output.split())
    assert "the same bytes as" in said
    assert "counts once" in said
    (tmp_path / "copy.csv").write_text(text.replace("0,0,0,0,1", "0,0,0,0,2"))  # another log
    CliRunner().invoke(app, ["ingest", str(tmp_path / "SURVEY.toml")])
    assert "the same bytes as" not in CliRunner().invoke(app, ["status", str(tmp_path / "SURVEY.toml")]).output


@pytest.mark.slow
def test_one_capture_in_two_runs_is_named(tmp_path: Path) -> None:
    """A drive that is listed twice would be two passes that agree."""
    capture(tmp_path / "l.pcap", heard(600.0, 600.1) + piece(600.2, 600.2))
    (tmp_path / "again.pcap").write_bytes((tmp_path / "l.pcap").read_bytes())
    text = 'id = "s"\nstore = "store"\n[map]\ncrs = "EPSG:32632"\n[rig.sensors.roof]\nkind = "lidar"\naxes = "flu"\n'
    for run, name in (("one", "l"), ("two", "again")):
        text += f'[[runs]]\nid = "{run}"\n[[runs.logs]]\npath = "{name}.pcap"\nsensor = "roof"\n'
    (tmp_path / "SURVEY.toml").write_text(text)
    CliRunner().invoke(app, ["ingest", str(tmp_path / "SURVEY.toml")])
    said = " ".join(CliRunner().invoke(app, ["status", str(tmp_path / "SURVEY.toml")]).output.split())
    assert "its readings count a second time as two/roof" in said


def test_one_drive_that_was_written_anew_for_another_run_is_named(tmp_path: Path) -> None:
    """The same packets in a capture of other bytes: its header states another snap length."""
    capture(tmp_path / "l.pcap", heard(600.0, 600.1) + piece(600.2, 600.2))
    anew = bytearray((tmp_path / "l.pcap").read_bytes())
    anew[16:20] = (anew[16] ^ 1).to_bytes(1, "little") + bytes(anew[17:20])  # the snap length: no reading depends on it
    (tmp_path / "again.pcap").write_bytes(anew)
    text = 'id = "s"\nstore = "store"\n[map]\ncrs = "EPSG:32632"\n[rig.sensors.roof]\nkind = "lidar"\naxes = "flu"\n'
    for run, name in (("one", "l"), ("two", "again")):
        text += f'[[runs]]\nid = "{run}"\n[[runs.logs]]\npath = "{name}.pcap"\nsensor = "roof"\n'
    (tmp_path / "SURVEY.toml").write_text(text)
    CliRunner().invoke(app, ["ingest", str(tmp_path / "SURVEY.toml")])
    said = " ".join(CliRunner().invoke(app, ["status", str(tmp_path / "SURVEY.toml")]).output.split())
    assert "to the nanosecond: they count a second time as two/roof" in said


@pytest.mark.slow
def test_parts_of_a_capture_in_another_order_are_used_and_named(tmp_path: Path) -> None:
    packets = heard(602.0, 602.1) + piece(602.2, 602.2, 700) + heard(600.0, 600.1) + piece(600.2, 600.2, 700)
    capture(tmp_path / "l.pcap", packets)
    text = 'id = "s"\nstore = "store"\n[map]\ncrs = "EPSG:32632"\n[rig.sensors.roof]\nkind = "lidar"\naxes = "flu"\n'
    (tmp_path / "SURVEY.toml").write_text(
        f'{text}[[runs]]\nid = "r"\n[[runs.logs]]\npath = "l.pcap"\nsensor = "roof"\n'
    )
    CliRunner().invoke(app, ["ingest", str(tmp_path / "SURVEY.toml")])
    survey = Survey.load(tmp_path / "SURVEY.toml")
    (record,) = read_log_records(Store(survey.store_url, survey.config.id))
    assert (record.rows, record.rejected) == (1_400 * 384, 0)
    assert "parts were joined in another order" in said(record)["time_goes_back"]


NMEA_LINES = [
    "GPGGA,{t},4800.0000,N,00900.0000,E,4,12,0.8,300.0,M,47.0,M,1.0,0001",
    "GPRMC,{t},A,4800.0000,N,00900.0000,E,0.0,0.0,040526,,,A",
]


def nmea(first: int, count: int) -> str:
    """Sentences of `count` seconds from 09:00 on."""
    out = ""
    for k in range(first, first + count):
        for body in NMEA_LINES:
            text = body.format(t=f"{90000 + k // 60 * 100 + k % 60:06d}.00")
            check = 0
            for character in text.encode():
                check ^= character
            out += f"${text}*{check:02X}\r\n"
    return out


def sbet(first: int, count: int) -> bytes:
    """Records of `count` seconds of the week, ten a second."""
    records = np.zeros((10 * count, 17))
    records[:, 0] = 1_000.0 + first + np.arange(10 * count) / 10
    records[:, 1:4] = np.radians(48.0), np.radians(9.0), 300.0
    return records.astype("<f8").tobytes()


def poses(first: int, count: int) -> str:
    return "".join(f"{START_S + k},48.0,9.0,300,0,0,10\n" for k in range(first, first + count))


POSES = "time_s,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg\n"


@pytest.mark.witness("nmea_time_goes_back")
@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.parametrize(
    ("name", "content", "stated"),
    [
        ("a.nmea", lambda a, b: (nmea(*a) + nmea(*b)).encode(), 'format = "nmea"\ncrs = "EPSG:4979"\nsensor = "gnss"\n'
         'height = "ellipsoidal"\n'),
        ("a.sbet", lambda a, b: sbet(*a) + sbet(*b), 'format = "sbet"\ncrs = "EPSG:4979"\n'
         'clock = { system = "gps_week_seconds", date = 2026-05-04 }\n'),
        ("a.csv", lambda a, b: (POSES + poses(*a) + POSES + poses(*b)).encode(), 'crs = "EPSG:4979"\n'
         f"clock = {GPS}\n"),
        ("e.csv", lambda a, b: ("time_s,ticks\n" + "".join(
            f"{START_S + k},{100 * n}\n" for n, k in enumerate([*range(sum(a)), *range(b[0], sum(b))]))).encode(),
         f'sensor = "wheel"\noptions = {{ record = "total" }}\nclock = {GPS}\n'),
    ],
)  # fmt: skip
def test_siblings_whose_clock_goes_back(
    tmp_path: Path, name: str, content: Callable[[tuple[int, int], tuple[int, int]], bytes], stated: str, restart: bool
) -> None:
    """A log appended to itself, and one whose clock is set back by 20 s: what goes back is left out and counted."""
    (tmp_path / name).write_bytes(content((0, 100), (80, 50) if restart else (0, 100)))
    text = 'id = "s"\nstore = "store"\n[map]\ncrs = "EPSG:32632"\n[rig.sensors.wheel]\nkind = "encoder"\n'
    text += '[rig.sensors.gnss]\nkind = "gnss"\n[[runs]]\nid = "r"\n[[runs.logs]]\n'
    (tmp_path / "SURVEY.toml").write_text(f'{text}path = "{name}"\n{stated}')
    done = CliRunner().invoke(app, ["ingest", str(tmp_path / "SURVEY.toml")])
    assert done.exit_code == 0, f"{done.output}{done.exception}"
    survey = Survey.load(tmp_path / "SURVEY.toml")
    (record,) = read_log_records(Store(survey.store_url, survey.config.id))
    rate = 10 if name == "a.sbet" else 1
    assert record.rows == rate * (130 if restart else 100)
    if name == "a.nmea":
        back = "a second GGA sentence of one epoch: the first stands"
        assert record.reject_reasons[back] == (20 if restart else 100)
        assert "nmea_time_goes_back" in said(record)
        return
    back = "the stamp goes back to a time that the log holds already"
    assert record.reject_reasons[back] == rate * (20 if restart else 100)
    assert "time_goes_back" in said(record)
