"""Containers of bags against the package rosbags, which wrote them, and against real recordings."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
import struct
import zlib
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from roadscan.core.errors import FormatError
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.ros.bag import Bag, Message, is_bag, packets
from roadscan.ingest.reading.format import Reject
from tests.formats.ros_files import KINDS, NS, header, write_bag

_T0 = 1_700_000_000 * NS
_IMU = "sensor_msgs/msg/Imu"


def _topics(messages: int = 4_000) -> dict[str, Any]:
    """An IMU of 100 Hz and a text once a second: several chunks of 1 MB."""
    imu = [
        (
            _T0 + i * NS // 100 + 7,
            {
                "header": header(_T0 + i * NS // 100, "imu"),
                "linear_acceleration": {"x": float(i), "y": 0.5 * i, "z": 9.81},
                "angular_velocity_covariance": np.arange(9.0),
            },
        )
        for i in range(messages)
    ]
    text = [(_T0 + i * NS, {"data": f"line {i}"}) for i in range(1, messages // 100)]
    return {"/imu": (_IMU, imu), "/text": ("std_msgs/msg/String", text)}


def _raw(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """All messages as rosbags reads them."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    with (Reader1 if path.suffix == ".bag" else Reader2)(path) as reader:
        for connection, ns, data in reader.messages():
            found.setdefault(connection.topic, []).append((ns, bytes(data)))
    return found


def _messages(bag: Bag, topic: str) -> list[Message]:
    return [item for item in bag.messages(topic) if isinstance(item, Message)]


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_each_kind_gives_what_was_written(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", kind, _topics())
    expected = _raw(path)
    assert is_bag(path)
    with Bag.open(path) as bag:
        assert not bag.faults
        assert {t: topic.count for t, topic in bag.topics.items()} == {t: len(rows) for t, rows in expected.items()}
        for topic, rows in expected.items():
            assert [(m.receive_ns, m.data) for m in _messages(bag, topic)] == rows
            span = bag.topics[topic].span
            assert span is not None
            assert (span.first_ns, span.last_ns) == (rows[0][0], rows[-1][0])
        last = [item for item in bag.decoded("/imu") if not isinstance(item, Reject)][-1]
        assert last[1].linear_acceleration.y == 0.5 * 3_999
        assert last[1].header.frame_id == "imu"
        assert bag.topics["/imu"].rate_hz == pytest.approx(100.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ros1", "ros1-lz4", "mcap", "mcap-storage", "sqlite"])
@pytest.mark.parametrize("share", [0.5, 0.97])
def test_a_bag_cut_off_keeps_whole_chunks(kind: str, share: float, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", kind, _topics(20_000))
    expected = _raw(path)["/imu"]
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in {".db3", ".mcap"})
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    with Bag.open(path) as bag:
        items = list(bag.messages("/imu"))
        messages = [(m.receive_ns, m.data) for m in items if isinstance(m, Message)]
        assert any(isinstance(item, Reject) for item in items)
        # SQLite writes its pages out of order: a few later ones stand before the cut.
        assert set(messages) <= set(expected) if kind == "sqlite" else messages == expected[: len(messages)]
        assert len(messages) > (share - 0.2) * len(expected)
        assert bag.topics["/imu"].count == len(messages)


@pytest.mark.slow
def test_a_damaged_chunk_costs_its_own_messages(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "ros1-bz2", _topics(20_000))
    expected = _raw(path)["/imu"]
    content = bytearray(path.read_bytes())
    with Reader1(path) as reader:
        chunk = list(reader.chunks.values())[3]
    content[chunk.datapos + chunk.datasize // 2] ^= 0xFF
    path.write_bytes(content)
    with Bag.open(path) as bag:
        items = list(bag.messages("/imu"))
    lost = [item for item in items if isinstance(item, Reject)]
    found = {(m.receive_ns, m.data) for m in items if isinstance(m, Message)}
    assert len(lost) == 1
    assert "damaged" in lost[0].reason
    assert found < set(expected)
    assert len(found) + lost[0].records == len(expected)


def test_files_of_a_folder_without_metadata_are_read_in_their_order(tmp_path: Path) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    for number in (10, 9):
        part = write_bag(
            tmp_path / f"part{number}", "mcap", {"/text": ("std_msgs/msg/String", [(number, {"data": "x"})])}
        )
        shutil.copy(next(part.glob("*.mcap")), folder / f"drive_{number}.mcap")
    with Bag.open(folder) as bag:
        assert [(m.receive_ns, m.file) for m in _messages(bag, "/text")] == [(9, "drive_9.mcap"), (10, "drive_10.mcap")]


def test_a_part_that_metadata_names_and_that_is_missing_is_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "sqlite", _topics(10))
    text = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(text.replace("- bag.db3", "- bag.db3\n  - bag_1.db3"))
    with Bag.open(path) as bag:
        assert any("bag_1.db3" in item.reason for item in bag.messages("/imu") if isinstance(item, Reject))


def test_messages_that_metadata_count_and_that_are_missing_are_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "sqlite", _topics(100))
    with closing(sqlite3.connect(path / "bag.db3")) as base, base:
        base.execute("UPDATE messages SET topic_id = 77 WHERE id = 5")
    with Bag.open(path) as bag:
        (lost,) = (item for item in bag.messages("/imu") if isinstance(item, Reject))
    assert (lost.reason, lost.records) == ("metadata.yaml counts more messages than the files hold", 1)


def test_a_hostile_type_name_is_no_code(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "ros1", {"/text": ("std_msgs/msg/String", [(1, {"data": "x"})])})
    evil = b"type=x/A:0;f=[]#####"
    content = path.read_bytes().replace(b"type=std_msgs/String", evil)
    assert evil in content
    path.write_bytes(content)
    with Bag.open(path) as bag, pytest.raises(FormatError, match="no name of a message type"):
        bag.topics["/text"].decoder()


def test_no_bag(tmp_path: Path) -> None:
    (tmp_path / "a.db3").write_bytes(b"SQLite format 3\0" + bytes(4_080))
    assert not is_bag(tmp_path / "a.db3")
    with pytest.raises(FormatError):
        Bag.open(tmp_path / "a.db3")


@pytest.mark.parametrize(
    ("name", "topic", "count", "length", "first_ns"),
    [
        # counts by the sizes of the messages; stamps as the package rosbags reads them
        ("lidars/hesai_40p/bag", "/pandar_packets", 1_439, 1_262, 1673400149311270952),
        ("lidars/hesai_xt32/bag", "/pandar_packets", 2_000, 1_080, 1673400677700635194),
        ("lidars/velodyne_vlp32/bag", "/sensing/lidar/front/velodyne_packets", 379, 1_206, 1713492677327771785),
        ("lidars/ouster/512x10_raw.bag", "/os_node0/lidar_packets", 32, 8_448, 1723828414279578824),
    ],
)
def test_packets_of_real_bags(recordings: Path, name: str, topic: str, count: int, length: int, first_ns: int) -> None:
    with Bag.open(recordings / name) as bag:
        found = list(packets(bag, topic))
    assert all(isinstance(one, Datagram) for one in found)
    assert len(found) == count
    assert {len(one.payload) for one in found if isinstance(one, Datagram)} == {length}
    assert isinstance(found[0], Datagram)
    assert found[0].capture_ns == first_ns
    assert hashlib.sha256(found[0].payload).digest() != hashlib.sha256(bytes(length)).digest()


@pytest.mark.slow
def test_an_mcap_without_chunks(tmp_path: Path) -> None:
    """As ROS 2 writes it with the preset `fastwrite`: the records of the chunks, at the top level, and no summary."""
    path = write_bag(tmp_path / "bag", "mcap", _topics(20_000))
    expected = _raw(path)["/imu"]
    content, at, records = (path / "bag.mcap").read_bytes(), 8, b""
    while at < len(content) - 8:
        kind, size = struct.unpack_from("<BQ", content, at)
        body = content[at + 9 : at + 9 + size]
        if kind == 1:
            records += content[at : at + 9 + size]
        elif kind == 6:  # two times, size, CRC, no compression's name, and size again stand before the records
            records += body[28 + 4 + 8 :]
        at += 9 + size
    footer = struct.pack("<BQ", 15, 4) + bytes(4) + struct.pack("<BQ", 2, 20) + bytes(20)
    whole = tmp_path / "flat.mcap"
    whole.write_bytes(content[:8] + records + footer + content[:8])
    with Bag.open(whole) as bag:
        assert not bag.faults
        assert [(m.receive_ns, m.data) for m in _messages(bag, "/imu")] == expected
        assert bag.topics["/imu"].count == len(expected)
    whole.write_bytes((content[:8] + records)[:-40])
    with Bag.open(whole) as bag:
        assert [(m.receive_ns, m.data) for m in _messages(bag, "/imu")] == expected[: bag.topics["/imu"].count]
        assert bag.topics["/imu"].count >= len(expected) - 1


def test_a_wrong_checksum_of_a_chunk_costs_it(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "mcap", _topics(20_000))
    expected = _raw(path)["/imu"]
    file = path / "bag.mcap"
    content = bytearray(file.read_bytes())
    at, chunks = 8, []
    while at < len(content) - 8:
        kind, size = struct.unpack_from("<BQ", content, at)
        chunks += [at] if kind == 6 else []
        at += 9 + size
    for number, start in enumerate(chunks):  # rosbags writes none (0)
        size = struct.unpack_from("<Q", content, start + 1)[0]
        crc = zlib.crc32(content[start + 9 + 40 : start + 9 + size]) + (number == 2)
        content[start + 9 + 24 : start + 9 + 28] = struct.pack("<I", crc)
    file.write_bytes(content)
    with Bag.open(path) as bag:
        items = list(bag.messages("/imu"))
    lost = [item for item in items if isinstance(item, Reject)]
    assert "checksum" in lost[0].reason
    assert sum(one.records for one in lost) + len(items) - len(lost) == len(expected)
