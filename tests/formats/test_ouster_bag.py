"""Ouster packets in bags: a recording against ouster-sdk, bags of all kinds against captures, two sensors in one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.errors import FormatError
from roadscan.core.rig import Sensor
from roadscan.formats.lidars.ouster_metadata import metadata_of
from roadscan.formats.lidars.ouster_packets import optics_of
from roadscan.formats.lidars.pcap import Datagram, datagrams_of_sizes
from roadscan.ingest.reading.format import format_named, log_formats
from tests.formats import ouster_files as files
from tests.formats.readings import read
from tests.formats.ros_files import KINDS, write_bag
from tests.formats.test_ouster import FREE, OPTIONS

PROFILE = "RNG19_RFL8_SIG16_NIR16"


def topics(sections: dict[str, Any], space: str = "/ouster", *, metadata: bool = True) -> dict[str, Any]:
    """Topics of the maker's driver: packets of lidar and IMU, and the metadata."""
    packets = [(files.POSIX_NS + k, {"buf": np.frombuffer(p, np.uint8)}) for k, p in enumerate(files.turns(PROFILE))]
    imu = [
        (files.POSIX_NS + k, {"buf": np.frombuffer(files.imu_packet(files.FIRST_NS + 10_000_000 * k), np.uint8)})
        for k in range(5)
    ]
    out: dict[str, Any] = {
        f"{space}/lidar_packets": ("ouster_ros/msg/PacketMsg", packets),
        f"{space}/imu_packets": ("ouster_ros/msg/PacketMsg", imu),
    }
    text = [(files.POSIX_NS, {"data": json.dumps(sections)})]
    return out | ({f"{space}/metadata": ("std_msgs/msg/String", text)} if metadata else {})


def small_bag(kind: str, folder: Path, *, imu: bool = False) -> Path:
    """A bag of ten packets of the lidar, or of its IMU, and the metadata."""
    capture = files.ouster("LEGACY", imu=imu)(folder)
    packets = [one for one in datagrams_of_sizes(capture, None) if isinstance(one, Datagram)]
    rows = [(one.capture_ns, {"buf": np.frombuffer(one.payload, np.uint8)}) for one in packets]
    text = [(files.POSIX_NS, {"data": (folder / "a.json").read_text()})]
    for file in folder.iterdir():
        file.unlink()
    own = {"/a/metadata": ("std_msgs/msg/String", text), "/a/packets": ("ouster_ros/msg/PacketMsg", rows)}
    return write_bag(folder / "bag", kind, own)


def test_a_recorded_bag_gives_the_returns_of_ouster_sdk(recordings: Path) -> None:
    """Counts, stamps and Σ|x|, Σ|y|, Σ|z|: ouster-sdk 1.0.1 on the same bag (`open_source`, XYZLut)."""
    path = recordings / "lidars" / "ouster" / "512x10_raw.bag"
    assert {f.name for f in log_formats().values() if f.sniff(path)} == {"ouster_bag", "ouster_bag_imu"}
    found = read("ouster_bag", path, clock=FREE)
    assert len(found) == 28_751
    stamps = np.unique(found.epochs)
    assert (stamps[0], stamps[-1]) == (291_159_252_580, 291_258_956_760)
    sums_m = np.abs(found.xyz_sensor_m).sum(axis=0)
    np.testing.assert_allclose(sums_m, [19190.079, 19222.848, 6224.07], rtol=1e-6)
    imu = read("ouster_bag_imu", path, clock=FREE, sensor=Sensor(kind="imu"))
    assert len(imu) == 10
    assert np.diff(imu.epochs).tolist() == pytest.approx([10_000_042] * 9, abs=1_000)
    assert found.findings == []
    assert found.rejects == []


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_each_kind_gives_the_rows_of_a_capture(kind: str, tmp_path: Path) -> None:
    sections = files.metadata(PROFILE)
    expected = read("ouster_pcap", files.write(tmp_path, files.turns(PROFILE), sections), OPTIONS, clock=FREE)
    found = read("ouster_bag", write_bag(tmp_path / "bag", kind, topics(sections)), clock=FREE)
    assert found.table.equals(expected.table)


def test_drivers_that_add_a_byte_to_each_packet(tmp_path: Path) -> None:
    """`ouster_ros` up to 0.4 made its buffers one byte longer than a packet."""
    sections = files.metadata(PROFILE)
    longer = topics(sections)
    for kind, rows in longer.values():
        if kind.endswith("PacketMsg"):
            rows[:] = [(ns, {"buf": np.append(fields["buf"], np.uint8(0))}) for ns, fields in rows]
    path = write_bag(tmp_path / "bag", "ros1", longer)
    assert len(read("ouster_bag", path, clock=FREE)) == 5478
    assert len(read("ouster_bag_imu", path, clock=FREE, sensor=Sensor(kind="imu"))) == 5


def test_metadata_may_be_a_file(tmp_path: Path) -> None:
    sections = files.metadata(PROFILE)
    (tmp_path / "a.json").write_text(json.dumps(sections))
    path = write_bag(tmp_path / "bag", "ros1", topics(sections, metadata=False))
    with pytest.raises(FormatError, match=r"0 topics hold metadata of an Ouster.*options\.metadata"):
        read("ouster_bag", path, clock=FREE)
    assert len(read("ouster_bag", path, OPTIONS, clock=FREE)) == 5478


def test_two_sensors_of_a_bag_are_told_apart_by_their_topics(tmp_path: Path) -> None:
    left, right = files.metadata(PROFILE), files.metadata(PROFILE, beam_azimuth_angles=[0.0] * files.ROWS)
    path = write_bag(tmp_path / "bag", "mcap", topics(left, "/left") | topics(right, "/right"))
    with pytest.raises(FormatError, match=r"2 topics hold metadata.*/left/metadata, /right/metadata"):
        read("ouster_bag", path, clock=FREE)
    found = read("ouster_bag", path, {"topic": "/right/lidar_packets"}, clock=FREE)
    directions = optics_of(metadata_of(json.dumps(right), path)).directions
    first = found.xyz_sensor_m[found["laser"] == 0][0]
    column = int((found.epochs[found["laser"] == 0][0] - files.FIRST_NS) // (100_000_000 // files.COLUMNS))
    assert first[:2] / np.linalg.norm(first[:2]) == pytest.approx(
        directions[column, 0, :2] / np.linalg.norm(directions[column, 0, :2]), abs=1e-4
    )
    with pytest.raises(FormatError, match=r"/left/imu_packets: 48 bytes"):
        read("ouster_bag", path, {"topic": "/left/imu_packets"}, clock=FREE)


def test_topics_of_packets_are_listed_with_the_formats_that_read_them(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "sqlite", topics(files.metadata(PROFILE)))
    contents = format_named("ouster_bag").contents(path)
    assert contents is not None
    listed = {part.name: part.format for part in contents.parts}
    assert listed["/ouster/lidar_packets"] == "ouster_bag"
    assert listed["/ouster/imu_packets"] == "ouster_bag_imu"
    assert listed["/ouster/metadata"] == ""
