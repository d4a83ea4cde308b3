"""IMU packets of an Ouster in a bag of ROS 1 or ROS 2."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

from roadscan.core.extras import need
from roadscan.core.strict import Strict
from roadscan.formats.lidars.ouster_packets import sensor_clock
from roadscan.formats.motion.ouster_imu import imu_described, imu_items, imu_packet_bytes
from roadscan.formats.ros.bag import Bag, Topic
from roadscan.formats.ros.ouster_packets import (
    BagPacketsOptions,
    bag_metadata,
    holds_lidar,
    holds_only_packets,
    packets_of_length,
    topic_of_length,
)
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Part, beside
from roadscan.ingest.reading.records import EpochReader, options_of


class OusterBagImu(LogFormat):
    """IMU packets of type `ouster_ros/PacketMsg` (or `ouster_msgs`, `ouster_sensor_msgs`) in a bag of ROS.

    They are read as those of a capture (`ouster_imu`), with the metadata of the bag (`ouster_bag`). A bag with lidar
    packets is listed twice in the survey file: as `ouster_bag`, and with format = "ouster_bag_imu" and an IMU.
    """

    name: ClassVar[str] = "ouster_bag_imu"
    title: ClassVar[str] = "IMU packets of an Ouster lidar in a ROS bag (PacketMsg)"
    yields: ClassVar[tuple[str, ...]] = ("imu",)
    axes_on_sensor: ClassVar[str] = "x points away from the external connector, y left of it, z out of the top"
    time: ClassVar[str] = "the sensor's own, as in a capture (ouster_pcap); the bag's stamps are not used"
    options: ClassVar[type[Strict]] = BagPacketsOptions

    def sniff(self, path: Path) -> bool:
        """True for a bag that holds nothing but IMU packets of an Ouster and strings."""
        return holds_only_packets(path) is False

    def files(self, path: Path) -> list[Path]:
        """Return the bag's files, with its metadata."""
        return sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]

    def parts(self, path: Path) -> Sequence[Part]:
        """Return all topics of the bag."""
        from roadscan.formats.ros.overview import parts

        return parts(path)

    def claims(self, bag: Bag, topic: Topic) -> bool:
        """Return True for a topic of IMU packets."""
        return holds_lidar(bag, topic) is False

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the metadata, where they are a file."""
        named = options.metadata if isinstance(options, BagPacketsOptions) else None
        return [] if named is None else [beside(path, named)]

    def header(self, source: LogSource) -> LogHeader:
        """Return sensor and profile."""
        need("rosbags.typesys", "a ROS bag")
        source.need_sensor("imu")
        options = options_of(source, BagPacketsOptions)
        with Bag.open(source.path) as bag:
            metadata = bag_metadata(bag, options)
            sensor_clock(source, metadata)
            topic = topic_of_length(bag, options, imu_packet_bytes(metadata, source.path))
        return LogHeader(imu_described(metadata) | {"topic": topic})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packets, some thousands at a time."""
        with Bag.open(source.path) as bag:
            metadata = bag_metadata(bag, options_of(source, BagPacketsOptions))
            found = packets_of_length(bag, str(header.attributes["topic"]), imu_packet_bytes(metadata, source.path))
            yield from imu_items(found, metadata, EpochReader(sensor_clock(source, metadata), source.path))
