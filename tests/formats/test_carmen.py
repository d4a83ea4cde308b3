"""CARMEN logs: messages written by hand, poses and axes, ranges, damage; the recording of ACES against plain Python."""

from __future__ import annotations

import bz2
import gzip
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import ScanGeometry, Sensor
from roadscan.ingest.reading.format import LogSource, Reject, Rows, format_named, format_of
from roadscan.store.schema import table_schema

GPS = Clock(TimeSystem.GPS)
FIRST_S = 1_400_000_000


@dataclass(frozen=True)
class Log:
    """All that a log yielded."""

    attributes: dict[str, Any]
    tables: dict[str, pa.Table]
    rejects: list[Reject]

    def column(self, table: str, name: str) -> np.ndarray:
        return self.tables[table].column(name).to_numpy()

    def lists(self, name: str) -> np.ndarray:
        size = self.attributes["scan_geometry"]["readings"]
        return self.tables["scans"].column(name).combine_chunks().flatten().to_numpy().reshape(-1, size)

    @property
    def ranges(self) -> np.ndarray:
        return self.lists("range")

    @property
    def geometry(self) -> ScanGeometry:
        return ScanGeometry.parse(self.attributes["scan_geometry"])


def read_carmen(path: Path, options: dict[str, Any] | None = None, clock: Clock | None = GPS, **stated: Any) -> Log:
    """Read a log as ingest does; every row has to fit its table."""
    log_format = format_named("carmen")
    source = LogSource(path, log_format.options.parse(options or {}), clock=clock, **stated)
    header = log_format.header(source)
    batches: dict[str, list[pa.RecordBatch]] = {"scans": [], "trajectory": []}
    rejects = []
    for item in log_format.read(source, header):
        if isinstance(item, Reject):
            rejects.append(item)
            continue
        assert isinstance(item, Rows)
        schema = table_schema(item.table)
        batch = schema.conform(item.batch, header.list_size)
        assert batch.num_rows > 0
        assert schema.faults(batch) == []
        batches[item.table].append(batch)
    tables = {name: pa.Table.from_batches(parts, table_schema(name).arrow(header.list_size))
              for name, parts in batches.items()}  # fmt: skip
    return Log(header.attributes, tables, rejects)


def flaser(k: int, ranges: list[str], laser: str = "1 2 0.5", robot: str = "1 2 0.5", name: str = "FLASER") -> str:
    return f"{name} {len(ranges)} {' '.join(ranges)} {laser} {robot} {FIRST_S + k}.25 host {k}.5"


def plain(k: int, **other: str) -> str:
    return flaser(k, [f"{1 + k / 100 + i / 1000:.2f}" for i in range(181)], **other)


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(["# CARMEN Logfile", "PARAM robot_frontlaser_offset 0.3 host 0", *lines, ""]))
    return path


# --- messages by hand -------------------------------------------------------------------------------


def test_an_old_message(tmp_path: Path) -> None:
    ranges = ["0.31", "1.5", "50.0", "50.01", "79.99", "80.00", "81.91", "0"] + ["2"] * 173
    path = write(tmp_path / "a.clf", flaser(0, ranges, "10.5 -20.25 0.1", "10.5 -20.25 0.1"), "SYNC here",
                 "ODOM 1 2 0.5 0 0 0 1400000000 host 0")  # fmt: skip
    assert format_of(path).name == "carmen"
    log = read_carmen(path)
    assert log.rejects == []
    assert log.ranges[0, :9].tolist() == [31, 150, 0, 5001, 7999, 0, 0, 0, 200]
    assert log.geometry.range_step_m == 0.01
    assert log.column("scans", "epoch_gps_ns").tolist() == [FIRST_S * 10**9 + 250_000_000]
    assert log.attributes["laser_params"] == {"robot_frontlaser_offset": "0.3"}
    assert log.attributes["messages_at_start"] == {"FLASER": 1}
    assert log.attributes["world_frame"] == "local"
    assert [log.column("trajectory", f"{a}_world_m")[0] for a in "xyz"] == [10.5, -20.25, 0.0]


def test_axes_and_signs(tmp_path: Path) -> None:
    """A beam at 30° to the left of a robot at (1, 2) that looks along θ = 50° ends at 80° from x."""
    theta = np.radians(50)
    ranges = ["50"] * 181
    ranges[120] = "4.00"  # −90° + 120°
    log = read_carmen(write(tmp_path / "a.clf", flaser(0, ranges, f"1 2 {theta:.9f}", f"1 2 {theta:.9f}")))
    origins, directions = log.geometry.rays()
    sensor = origins + directions * (log.ranges[0] * log.geometry.range_step_m)[:, None]
    body_from_sensor = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    quaternion = [log.column("trajectory", f"q{a}")[0] for a in "xyzw"]
    world = Rotation.from_quat(quaternion).apply(body_from_sensor @ sensor[120]) + np.array([1, 2, 0])
    assert world == pytest.approx([1 + 4 * np.cos(np.radians(80)), 2 + 4 * np.sin(np.radians(80)), 0], abs=1e-6)
    # The body's forward axis looks along θ, its down axis down.
    forward, down = Rotation.from_quat(quaternion).apply([[1, 0, 0], [0, 0, 1]])
    assert forward == pytest.approx([np.cos(theta), np.sin(theta), 0], abs=1e-9)
    assert down == pytest.approx([0, 0, -1], abs=1e-9)


@pytest.mark.parametrize(("readings", "first", "step"), [(180, -90, 1), (181, -90, 1), (360, -90, 0.5), (361, -90, 0.5),
                                                          (401, -50, 0.25)])  # fmt: skip
def test_angles_of_old_messages(tmp_path: Path, readings: int, first: float, step: float) -> None:
    log = read_carmen(write(tmp_path / "a.clf", flaser(0, ["1.0"] * readings)))
    assert np.degrees([log.geometry.first, log.geometry.step]) == pytest.approx([-first, -step])


def test_unusual_angles_have_to_be_stated(tmp_path: Path) -> None:
    path = write(tmp_path / "a.clf", flaser(0, ["1.0"] * 100))
    with pytest.raises(ConfigError, match=r"angles of 100 readings of FLASER.*options\.first_angle_deg"):
        read_carmen(path)
    log = read_carmen(path, {"first_angle_deg": -120.0, "angle_step_deg": 2.4})
    assert np.degrees([log.geometry.first, log.geometry.step]) == pytest.approx([120, -2.4])


def raw(name: str, k: int, ranges: str, bright: str, *tail: str, start: float = -1.5707963) -> str:
    count = len(ranges.split())
    remissions = bright.split()
    words = [name, "0", f"{start}", "3.14159265", "0.78539816", "30.0", "0.01", "0", str(count), ranges,
             str(len(remissions)), *remissions, *tail, f"{FIRST_S + k}.5", "host", f"{k}.5"]  # fmt: skip
    return " ".join(words)


def test_a_raw_message_with_remissions(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.log",
        raw("RAWLASER1", 0, "1.234 2 30.0 29.999 4", "1 2 3 250 5"),
        f"ODOM 5 6 0 0 0 0 {FIRST_S}.25 host 0.25",
        f"ODOM 5.5 6 0 0 0 0 {FIRST_S}.75 host 0.75",
        raw("RAWLASER1", 1, "1.234 2 30.5 29.999 4", "1 2 3 250 5", start=-1.5),
        raw("RAWLASER1", 2, "1.234 2 3 4 5", "1 2 3 250 256"),
    )
    log = read_carmen(path)
    assert log.ranges.tolist() == [[1234, 2000, 0, 29999, 4000]]
    assert log.lists("intensity").tolist() == [[1, 2, 3, 250, 5]]
    assert log.geometry.range_step_m == 0.001
    assert np.degrees([log.geometry.first, log.geometry.step]) == pytest.approx([90, -45], abs=1e-4)
    assert log.column("trajectory", "x_world_m").tolist() == [5.0, 5.5]
    assert log.column("trajectory", "epoch_gps_ns").tolist() == [FIRST_S * 10**9 + 250_000_000 * k for k in (1, 3)]
    assert [(r.record, r.reason) for r in log.rejects] == [
        (5, "the scan's angles are not those of the log's first scans"),
        (6, "a remission is no number from 0 to 255: state options.remission_step"),
    ]
    assert read_carmen(path, {"remission_step": 2.0}).lists("intensity")[1].tolist() == [0, 1, 2, 125, 128]
    assert read_carmen(path, {"pose": "none"}).tables["trajectory"].num_rows == 0
    with pytest.raises(ConfigError, match="RAWLASER1 holds no pose"):
        read_carmen(path, {"pose": "laser"})


@pytest.mark.parametrize("more", [["0.1", "0.2", "0.3", "0.4"], ["0.1", "0.2", "0.3", "0.4", "0.5"]])
def test_a_robot_message(tmp_path: Path, more: list[str]) -> None:
    """Scanner 0.3 m ahead of a robot that looks along y; the choice has to be stated."""
    poses = ["1", "2.3", "1.57079633", "1", "2", "1.57079633"]
    path = write(tmp_path / "a.log", raw("ROBOTLASER1", 0, "1 2 3 4 5", "", *poses, *more))
    with pytest.raises(ConfigError, match=r'poses of scanner and robot, and they differ.*options\.pose = "laser"'):
        read_carmen(path)
    for pose, y in (("laser", 2.3), ("robot", 2.0)):
        log = read_carmen(path, {"pose": pose})
        assert log.column("trajectory", "y_world_m").tolist() == [y]
        found = log.attributes["laser_from_robot"]
        assert found == {"forward_m": pytest.approx(0.3), "left_m": pytest.approx(0, abs=1e-6), "turned_rad": 0.0}


def test_both_poses_with_the_mounting_they_imply_place_a_beam_alike(tmp_path: Path) -> None:
    """A scanner 0.3 m behind and 0.2 m left of a robot, looking back: seen from either pose, one place."""
    robot = np.array([1.0, 2.0, 0.7])
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    laser = [*(robot[:2] + turn @ [-0.3, 0.2]), 0.7 + np.pi]
    poses = [f"{value:.9f}" for value in (*laser, *robot)]
    path = write(tmp_path / "a.log", raw("ROBOTLASER1", 0, "1 2 3 4 5", "", *poses, "0", "0", "0", "0"))
    ahead_m = {}
    for pose in ("laser", "robot"):
        log = read_carmen(path, {"pose": pose})
        mounting = Sensor(kind="profiler").mounted_as(log.attributes["mounting"]).mounting()
        body_from_sensor, lever_arm = mounting.arrays()
        forward, right, down = body_from_sensor @ [0.0, 0.0, 5.0] + lever_arm  # 5 m along the middle reading
        x, y, heading = laser if pose == "laser" else robot
        ahead_m[pose] = (x + forward * np.cos(heading) + right * np.sin(heading),
                         y + forward * np.sin(heading) - right * np.cos(heading), down)  # fmt: skip
    assert ahead_m["laser"] == pytest.approx(ahead_m["robot"], abs=1e-5)
    assert ahead_m["laser"][:2] == pytest.approx(robot[:2] + turn @ [-5.3, 0.2], abs=1e-5)


def test_two_scanners_in_one_log(tmp_path: Path) -> None:
    rear = plain(0, laser="1 2 3.6", name="RLASER").replace("RLASER 181 1.00", "RLASER 181 7.77")
    path = write(tmp_path / "a.clf", plain(0), rear, plain(1))
    with pytest.raises(ConfigError, match=r'FLASER, RLASER; expected options\.message = "FLASER"'):
        read_carmen(path)
    assert len(read_carmen(path, {"message": "FLASER"}).ranges) == 2
    assert read_carmen(path, {"message": "RLASER", "pose": "none"}).ranges[:, 0].tolist() == [777]
    with pytest.raises(ConfigError, match="expected a message with ranges"):
        read_carmen(path, {"message": "ODOM"})


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress])
def test_packed_logs(tmp_path: Path, pack: Any) -> None:
    text = write(tmp_path / "a.clf", *[plain(k) for k in range(50)]).read_bytes()
    path = tmp_path / "a.clf.x"
    path.write_bytes(pack(text))
    assert format_of(path).name == "carmen"
    assert np.array_equal(read_carmen(path).ranges, read_carmen(tmp_path / "a.clf").ranges)
    path.write_bytes(pack(text * 40)[:-200])  # the last of bzip2's blocks is lost, a little of gzip's stream
    log = read_carmen(path)
    assert len(log.ranges) > 500
    assert "damaged from here on" in log.rejects[-1].reason


# --- ranges -----------------------------------------------------------------------------------------


def test_no_digit_is_lost(tmp_path: Path) -> None:
    lines = [flaser(0, ["1.23"] * 181), flaser(1, ["1.234"] + ["1.2"] * 180), flaser(2, ["1.2345"] + ["1"] * 180)]
    log = read_carmen(write(tmp_path / "a.clf", *lines))
    assert log.geometry.range_step_m == pytest.approx(1e-4)
    assert log.ranges[:, 0].tolist() == [12_300, 12_340, 12_345]
    # 1 MB on, a finer digit than the beginning has: the line is not rounded but rejected.
    far = [plain(k) for k in range(1200)] + [flaser(1200, ["1.005"] + ["1"] * 180), plain(1201)]
    log = read_carmen(write(tmp_path / "b.clf", *far))
    assert len(log.ranges) == 1201
    assert [(r.record, r.reason) for r in log.rejects] == [
        (1202, "a range is no multiple of 0.01 m, as the log's first are: state options.range_step_m")
    ]
    assert len(read_carmen(tmp_path / "b.clf", {"range_step_m": 0.01}).ranges) == 1202


def test_digits_that_do_not_fit_have_to_be_given_up(tmp_path: Path) -> None:
    path = write(tmp_path / "a.clf", flaser(0, ["1.123456", "70.1"] + ["1"] * 179))
    with pytest.raises(ConfigError, match=r"6 decimal places and reach 70\.1 m.*options\.range_step_m"):
        read_carmen(path)
    assert read_carmen(path, {"range_step_m": 0.002}).ranges[0, :3].tolist() == [562, 35_050, 500]
    log = read_carmen(path, {"range_step_m": 0.001})
    assert log.ranges.size == 0
    assert "beyond 65,535 steps of 0.001 m" in log.rejects[0].reason


def test_the_maximum_as_stated(tmp_path: Path) -> None:
    path = write(tmp_path / "a.clf", flaser(0, ["19.99", "20.0", "50.0", "81.91"] + ["1"] * 177))
    assert read_carmen(path, {"max_range_m": 20.0}).ranges[0, :4].tolist() == [1999, 0, 0, 0]
    assert read_carmen(path, {"max_range_m": 81.91}).ranges[0, :4].tolist() == [1999, 2000, 5000, 0]


# --- what is wrong ----------------------------------------------------------------------------------


def test_damaged_lines_cost_themselves(tmp_path: Path) -> None:
    lines = [plain(k) for k in range(40)]
    lines[3] = lines[3].replace("1.03", "1.O3", 1)
    lines[7] = lines[7][:300]
    lines[9] = lines[9].replace("FLASER", "FLAXER")
    lines[10] = "\x02\x01"
    lines[12] = flaser(12, ["1.0"] * 180)
    lines[15] = lines[15].replace("FLASER 181 1.15", "FLASER 181 -1.15")
    lines[18] = lines[18].replace(f"{FIRST_S + 18}.25", "1500000000.25")
    lines[20] = lines[20].replace("FLASER 181", "FLASER 171")
    lines[22] = "  " + lines[22].replace(" ", "   ") + " \r"
    lines[25] = lines[25].replace("1 2 0.5", "1 two 0.5", 1)
    path = write(tmp_path / "a.clf", *lines)
    log = read_carmen(path)
    assert len(log.ranges) == 40 - 9 + 1  # the pose that is none costs the pose alone
    assert log.tables["trajectory"].num_rows == len(log.ranges) - 1
    data = path.read_bytes()
    assert [(r.record - 2, r.records, r.reason) for r in sorted(log.rejects, key=lambda r: r.record)] == [
        (3, 1, "a range is missing or not a number"),
        (7, 1, "the line does not hold 191 words".replace("191", "192")),
        (9, 2, "the line begins with no message of CARMEN"),
        (12, 1, "180 readings and 0 remissions, unlike the log's first scans"),
        (15, 1, "a range is negative"),
        (18, 1, "time stamp leaps out of the log's order by over 10 s and back"),
        (20, 1, "the line does not hold 181 readings"),
        (25, 1, "y is missing or not a number"),
    ]
    for reject in log.rejects:
        assert data[: reject.offset].count(b"\n") == reject.record


def test_a_log_is_refused_as_a_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "a.clf", plain(0), plain(1))
    with pytest.raises(TimeSystemError, match="time system is not stated"):
        read_carmen(path, clock=None)
    with pytest.raises(TimeSystemError, match=r"record 2: stamp 1400000000 read as ms .*as 's' it would fit"):
        read_carmen(path, clock=Clock(TimeSystem.UNIX_UTC, unit="ms"))
    with pytest.raises(ConfigError, match="the crs of the log is stated as 'EPSG:4979'"):
        read_carmen(path, crs="EPSG:4979")
    assert len(read_carmen(path, crs="local").ranges) == 2
    with pytest.raises(FormatError, match="no scan of message RLASER"):
        read_carmen(path, {"message": "RLASER"})
    with path.open("wb") as stream:
        stream.write(b"# nothing here\n" * (1_200_000))
        stream.write(plain(0).encode())
    with pytest.raises(FormatError, match="holds no scan in its first 16 MB"):
        read_carmen(path)
    for text in ("", "ODOM 1 2 3 0 0 0 1 host 0\n", plain(0)[:500], "FLASER\n", "FLASER 3\n"):
        path.write_text(text)
        assert not format_named("carmen").sniff(path)
        with pytest.raises(FormatError, match="holds no scan"):
            read_carmen(path)
    assert not format_named("carmen").sniff(tmp_path)


@pytest.mark.parametrize("word", ["1e308", "-1e308", "inf", "1e999"])
def test_numbers_beyond_all_numbers_cost_their_scan(tmp_path: Path, word: str) -> None:
    lines = [plain(k) for k in range(4)]
    far = flaser(2, [word] + ["2"] * 180, laser=f"{word} 1 {word}", robot=f"1 2 {word}")
    path = write(tmp_path / "a.clf", *lines[:2], far, lines[3])
    options = {"range_step_m": 0.01, "pose": "laser"}
    with pytest.raises(ConfigError, match="they differ"):
        read_carmen(path)
    log = read_carmen(path, options)
    known = read_carmen(write(tmp_path / "b.clf", *lines[:2], lines[3]), options)
    assert np.array_equal(log.ranges[[0, 1, -1]], known.ranges)
    assert sum(r.records for r in log.rejects) >= 1


@pytest.mark.parametrize("above", ["# a comment", "SYNC 1", "PARAM a 1"])
def test_lines_that_returns_alone_end_do_not_vanish(tmp_path: Path, above: str) -> None:
    lines = [plain(k) for k in range(4)]
    path = write(tmp_path / "a.clf", lines[0], f"{above}\r{lines[1]}\r{lines[2]}", "# plain\r", lines[3])
    log = read_carmen(path)
    assert len(log.ranges) == 2
    assert [(r.record, r.records) for r in log.rejects] == [(3, 1)]


def sample(path: Path) -> Path:
    """A small sound log."""
    return write(path, *[plain(k) for k in range(6)])


# --- the recording ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_recording_against_plain_python(recordings: Path) -> None:
    """7,374 scans of 180 readings, every digit of them, their stamps and poses."""
    path = recordings / "lms" / "aces.clf.bz2"
    assert format_of(path).name == "carmen"
    lines = [line.split() for line in bz2.decompress(path.read_bytes()).decode().splitlines()
             if line.startswith("FLASER")]  # fmt: skip
    assert len(lines) == 7_374
    assert {line[1] for line in lines} == {"180"}
    expected = np.array([[round(100 * float(w)) for w in line[2:182]] for line in lines])
    stamps = np.array([round(float(line[188]) * 1e9) for line in lines])
    log = read_carmen(path, clock=Clock(TimeSystem.FREE, offset_s=1e9))
    assert log.rejects == []
    assert log.geometry.range_step_m == 0.01
    assert np.array_equal(log.ranges, np.where(expected == 5000, 0, expected))
    assert (expected == 5000).sum() == (log.ranges == 0).sum() == 11_139
    assert np.abs(log.column("scans", "epoch_gps_ns") - stamps - 10**18).max() <= 1
    assert np.array_equal(log.column("trajectory", "epoch_gps_ns"), log.column("scans", "epoch_gps_ns"))
    xy = np.array([[float(w) for w in line[182:184]] for line in lines])
    found = np.stack([log.column("trajectory", f"{a}_world_m") for a in "xy"], axis=-1)
    assert np.array_equal(found, xy)
    assert log.attributes["laser_from_robot"] == {"forward_m": 0.0, "left_m": 0.0, "turned_rad": 0.0}
