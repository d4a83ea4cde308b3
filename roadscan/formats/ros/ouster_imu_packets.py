"""IMU packets of an Ouster in a bag of ROS 1 or ROS 2."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

from roadscan.core.extras import need
from roadscan.core.strict import Strict
from roadscan.formats.lidars.ouster_packets import sensor_clock
from roadscan.formats.motion.ouster_imu import imu_described, imu_items, imu_packet_bytes
from roadscan.formats.ros.bag import Bag, Topic
from roadscan.formats.ros.ouster_packets import (
    TYPES,
    BagPacketsOptions,
    bag_metadata,
    holds_lidar,
    packets_of_length,
    topic_of_length,
)
from roadscan.formats.ros.topics import TopicFormat
from roadscan.ingest.reading.format import Item, LogHeader, LogSource, beside
from roadscan.ingest.reading.records import EpochReader, options_of


class OusterBagImu(TopicFormat):
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
    types: ClassVar[tuple[str, ...]] = TYPES

    def reads(self, bag: Bag, topic: Topic) -> bool:
        """Return whether a topic is of IMU packets."""
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
            length = imu_packet_bytes(bag_metadata(bag, options), source.path)
            return LogHeader(self.attributes(source, bag, topic_of_length(bag, options, length)))

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """Return what the header states, by the metadata."""
        metadata = bag_metadata(bag, options_of(source, BagPacketsOptions))
        sensor_clock(source, metadata)
        return imu_described(metadata) | {"topic": topic.name}

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packets, some thousands at a time."""
        with Bag.open(source.path) as bag:
            metadata = bag_metadata(bag, options_of(source, BagPacketsOptions))
            found = packets_of_length(bag, str(header.attributes["topic"]), imu_packet_bytes(metadata, source.path))
            yield from imu_items(found, metadata, EpochReader(sensor_clock(source, metadata), source.path))
