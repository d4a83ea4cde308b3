"""Bags through the command line: inspected, a survey begun, ingested; and very large ones."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.survey import Survey
from roadscan.ingest.ingest import survey_records
from roadscan.ingest.sources import same_content_findings
from roadscan.store.store import Store
from tests.answers import answer_questions, first_survey, roadscan
from tests.formats.ros_files import NS, header, write_bag
from tests.formats.test_ros_topics import T0, cloud, spinning

_SWEEPS = 40


def _transform(parent: str, child: str, place: tuple[float, float, float], yaw_deg: float = 0.0) -> dict[str, Any]:
    half = np.radians(yaw_deg) / 2
    turn = {"w": np.cos(half), "x": 0.0, "y": 0.0, "z": np.sin(half)}
    return {
        "header": header(T0, parent),
        "child_frame_id": child,
        "transform": {"translation": dict(zip("xyz", place, strict=True)), "rotation": turn},
    }


def rig_bag(path: Path, kind: str) -> Path:
    """4 s of a rig: two lidars, an IMU, odometry, transforms, and a topic that nothing reads."""
    points, odometry, imu = [], [], []
    for k in range(_SWEEPS):
        ns = T0 + k * NS // 10
        sweep = spinning([("t", "<u4"), ("ring", "<u2")], 500)
        sweep["t"] = np.linspace(0, 99_000_000, sweep.size)
        points.append((ns + 110_000_000, sweep, ns))
        pose = {"pose": {"position": {"x": 0.8 * k, "y": 0.0, "z": 1.0}, "orientation": {"w": 1.0}}}
        odometry.append((ns, {"header": header(ns, "map"), "child_frame_id": "base_link", "pose": pose}))
    for k in range(10 * _SWEEPS):
        ns = T0 + k * NS // 100
        imu.append((ns, {"header": header(ns, "imu"), "linear_acceleration": {"z": 9.81}}))
    tree = [
        _transform("base_link", "mast", (0.5, 0.0, 1.0)),
        _transform("mast", "left", (0.7, 0.1, 0.9), 91.0),
        _transform("mast", "right", (0.7, -0.1, 0.9)),
    ]
    cloud_type = "sensor_msgs/msg/PointCloud2"
    return write_bag(
        path,
        kind,
        {
            "/left/points": (cloud_type, [(at, cloud(sweep, ns, frame="left")) for at, sweep, ns in points]),
            "/right/points": (cloud_type, [(at, cloud(sweep, ns, frame="right")) for at, sweep, ns in points]),
            "/imu": ("sensor_msgs/msg/Imu", imu),
            "/odom": ("nav_msgs/msg/Odometry", odometry),
            "/tf_static": ("tf2_msgs/msg/TFMessage", [(T0, {"transforms": tree})]),
            "/chatter": ("std_msgs/msg/String", [(T0, {"data": "hello"})]),
        },
    )


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_inspect_lists_the_topics_of_a_bag(kind: str, tmp_path: Path) -> None:
    bag = rig_bag(tmp_path / "drive", kind)
    done = roadscan("inspect", bag, "--json")
    assert done.exit_code == 0, done.output
    parts = {part["name"]: part for part in json.loads(done.stdout)[0]["parts"]}
    assert {name: part["format"] for name, part in parts.items()} == {
        "/chatter": "", "/imu": "ros_imu", "/left/points": "ros_points", "/odom": "ros_poses",
        "/right/points": "ros_points", "/tf_static": "",
    }  # fmt: skip
    assert parts["/imu"]["words"] == "sensor_msgs/Imu, 400 messages, 100 Hz, 4.0 s"
    assert (parts["/left/points"]["frame"], parts["/left/points"]["parent"]) == ("left", "base_link")
    # x ahead 1.2, y left 0.1, z up 1.9 is forward 1.2, right −0.1, down −1.9; turned left by 91°, x points left
    # and back by 1°, which is a heading of −1°.
    assert parts["/left/points"]["mounting"] == {
        "lever_arm_body_m": [1.2, -0.1, -1.9],
        "axes": "lbu",
        "boresight": {"roll_deg": 0.0, "pitch_deg": 0.0, "heading_deg": -1.0},
    }
    assert "/left/points: sensor_msgs/PointCloud2" in roadscan("inspect", bag).stdout
    one = roadscan("inspect", bag, "--option", "topic=/right/points")
    assert "20,000 rows of returns" in one.stdout


def test_a_bag_of_which_nothing_is_read_is_listed_all_the_same(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", "sqlite", {"/chatter": ("std_msgs/msg/String", [(T0, {"data": "hello"})])})
    done = roadscan("inspect", bag)
    assert done.exit_code == 2
    assert "/chatter: std_msgs/String, 1 message" in done.stdout
    assert "of which no raw format reads one" in done.stdout
    file = tmp_path / "cut.mcap"
    file.write_bytes(b"\x89MCAP0\r\n" + bytes(3))
    assert roadscan("inspect", file).exit_code == 2
    file.write_bytes(b"\x89MCAP0\r\n")
    assert "the MCAP file ends after its first 8 bytes" in " ".join(roadscan("inspect", file).stdout.split())


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_survey_of_one_bag_is_asked_for_topic_by_topic(kind: str, tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    rig_bag(tmp_path / "logs" / "drive", kind)
    survey_file, _ = first_survey(tmp_path / "logs")
    rig_text = (tmp_path / "RIG.toml").read_text()
    assert "#? lever_arm_body_m = [1.2, -0.1, -1.9]" in rig_text
    assert "the frame left as the recording's static transforms place it on the frame base_link" in rig_text
    asked = answer_questions(
        survey_file,
        {
            "map.crs": 'local = { name = "street" }',
            "clock": 'clock = { system = "unix_utc" }',
            "crs": 'crs = "local"',
            "options.axes": 'options.axes = "flu"',
        },
    )
    assert asked == 7
    rig_file = tmp_path / "RIG.toml"
    rig_file.write_text(rig_file.read_text().replace("#? ", "").replace('axes = "????"', 'axes = "flu"'))
    done = roadscan("ingest", survey_file)
    assert done.exit_code == 0, done.output
    survey = Survey.load(survey_file)
    records = survey_records(survey, Store(survey.store_url, survey.config.id))
    assert {record.sensor: record.rows for record in records} == {
        "left_points": 20_000, "right_points": 20_000, "imu": 400, "trajectory": 40,
    }  # fmt: skip
    assert same_content_findings(survey, records) == []


def _huge_bag(path: Path, chunks: int, message_bytes: int) -> int:
    """Write a ROS 1 bag whose messages are holes of the file: as long as stated, and nearly empty on the disk.

    Returns where the last chunk begins.
    """

    def record(fields: dict[str, bytes], data: bytes | int) -> bytes:
        head = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in fields.items())
        size = data if isinstance(data, int) else len(data)
        return struct.pack("<I", len(head)) + head + struct.pack("<I", size) + (b"" if isinstance(data, int) else data)

    text = b"message_definition=" + b"float64[] values\n"
    about = b"".join(
        struct.pack("<I", len(v)) + v for v in (b"topic=/big", b"type=a/Big", b"md5sum=" + b"0" * 32, text)
    )
    connection = record({"op": b"\x07", "conn": struct.pack("<I", 0), "topic": b"/big"}, about)
    with path.open("wb") as out:
        out.write(b"#ROSBAG V2.0\n")
        out.write(bytes(4_096))
        infos = []
        for k in range(chunks):
            start, time = out.tell(), struct.pack("<II", 1_700_000_000 + k, 0)
            message = record({"op": b"\x02", "conn": struct.pack("<I", 0), "time": time}, message_bytes)
            size = len(connection) + len(message) + message_bytes
            out.write(record({"op": b"\x05", "compression": b"none", "size": struct.pack("<I", size)}, size))
            out.write(connection + message)
            out.seek(message_bytes, 1)
            entry = time + struct.pack("<I", len(connection))
            out.write(
                record({"op": b"\x04", "ver": struct.pack("<I", 1), "conn": bytes(4), "count": b"\1\0\0\0"}, entry)
            )
            infos.append((start, time))
        index = out.tell()
        out.write(connection)
        for start, time in infos:
            fields = {"op": b"\x06", "ver": struct.pack("<I", 1), "chunk_pos": struct.pack("<Q", start)}
            fields |= {"start_time": time, "end_time": time, "count": b"\1\0\0\0"}
            out.write(record(fields, struct.pack("<II", 0, 1)))
        out.seek(13)
        sizes = {
            "index_pos": struct.pack("<Q", index),
            "conn_count": b"\1\0\0\0",
            "chunk_count": struct.pack("<I", chunks),
        }
        head = record({"op": b"\x03", **sizes}, 0)[:-4]
        out.write(head + struct.pack("<I", 4_096 - len(head) - 4))
    return infos[-1][0]


_MEASURED = """
import sys, time
from pathlib import Path
from roadscan.formats.ros.bag import Bag
begun = time.perf_counter()
from roadscan.ingest.reading.format import format_named
found = format_named("ros_points").contents(Path(sys.argv[1]))
peak_kb = Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]
print(found.parts[0].words, "|", time.perf_counter() - begun, int(peak_kb) / 1024)
"""


@pytest.mark.parametrize(
    ("chunks", "cut", "least_bytes"),
    [
        (200, False, 200 << 20),
        (200, True, 150 << 20),
        pytest.param(10_000, False, 10 << 30, marks=pytest.mark.nightly),
        pytest.param(10_000, True, 10 << 30, marks=pytest.mark.nightly),
    ],
)
def test_a_large_bag_is_listed_in_seconds_and_little_memory(
    chunks: int, cut: bool, least_bytes: int, tmp_path: Path
) -> None:
    file = tmp_path / "large.bag"
    last = _huge_bag(file, chunks, 1_100_000)
    if cut:
        with file.open("r+b") as stream:
            stream.truncate(last + 1_000)
    assert file.stat().st_size > least_bytes
    done = subprocess.run([sys.executable, "-c", _MEASURED, str(file)], capture_output=True, text=True, check=True)
    words, figures = done.stdout.split("|")
    seconds, megabytes = (float(word) for word in figures.split())
    counted = int(words.split(", ")[1].split()[0].replace(",", ""))
    assert counted == chunks - cut
    assert seconds < 10.0
    assert megabytes < 300.0
