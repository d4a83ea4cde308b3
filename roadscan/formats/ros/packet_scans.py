"""Packets of lidars and of their IMUs in the bags of ROS."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, Final

from roadscan.core.errors import FormatError, Missing
from roadscan.core.extras import need
from roadscan.core.strict import Strict
from roadscan.formats.lidars.hesai_pcap import HesaiOptions, HesaiPcap, Source
from roadscan.formats.lidars.ouster_metadata import OusterMetadata, metadata_of, read_metadata
from roadscan.formats.lidars.ouster_packets import (
    OusterDecoder,
    OusterOptions,
    examined,
    is_lidar_packet,
    packet_bytes,
    sensor_clock,
)
from roadscan.formats.lidars.ouster_pcap import LOOKED_AT, decoded, described, least_delay_s
from roadscan.formats.lidars.pcap import Datagram, Wanted
from roadscan.formats.lidars.robosense_packets import DIFOP_ID
from roadscan.formats.lidars.robosense_pcap import RobosenseOptions, RobosensePcap
from roadscan.formats.lidars.robosense_pcap import Source as RobosenseSource
from roadscan.formats.lidars.velodyne_packets import DATA_BYTES
from roadscan.formats.lidars.velodyne_pcap import Source as VelodyneSource
from roadscan.formats.lidars.velodyne_pcap import VelodyneOptions, VelodynePcap
from roadscan.formats.motion.ouster_imu import imu_described, imu_items, imu_packet_bytes
from roadscan.formats.ros.bag import Bag, Topic, packets
from roadscan.formats.ros.topics import PacketTopic, TopicFormat
from roadscan.ingest.reading.format import Item, LogHeader, LogSource, Reject, beside
from roadscan.ingest.reading.records import EpochReader, options_of


class HesaiScansOptions(HesaiOptions):
    """Settings of Hesai packets in a bag."""

    topic: str | None = None
    """Topic of the packets, where the bag has several."""


class HesaiScans(HesaiPcap, PacketTopic):
    """Packets of type `pandar_msgs/PandarScan`, `hesai_lidar/PandarScan` or `nebula_msgs/NebulaPackets`.

    They are read as those of a capture: see `hesai_pcap`. The stamp that the driver gave a packet takes the place of
    the capture's clock. Where the bag has several such topics, state `options.topic`.
    """

    name: ClassVar[str] = "hesai_scans"
    title: ClassVar[str] = "Hesai packets in a ROS bag (PandarScan), a stamp per return"
    suffixes: ClassVar[tuple[str, ...]] = ()
    types: ClassVar[tuple[str, ...]] = (
        "pandar_msgs/msg/PandarScan",
        "hesai_lidar/msg/PandarScan",
        "nebula_msgs/msg/NebulaPackets",
    )
    options: ClassVar[type[Strict]] = HesaiScansOptions

    sniff = TopicFormat.sniff
    files = TopicFormat.files
    contents = TopicFormat.contents

    def packets(self, source: LogSource) -> Source:
        """Return what gives the topic's packets."""
        return functools.partial(self._of_length, source)

    def _of_length(self, source: LogSource, length: int | None, sender: str | None) -> Iterator[Datagram | Reject]:
        """Yield the topic's packets; those of another length are rejected where one is given."""
        for item in self.datagrams(source):
            if isinstance(item, Reject) or length is None or len(item.payload) == length:
                yield item
            else:
                yield Reject(f"a data packet is not {length:,} bytes long", item.number, item.offset)


class RobosenseScansOptions(RobosenseOptions):
    """Settings of RoboSense packets in a bag."""

    topic: str | None = None
    """Topic of the packets, where the bag has several."""


class RobosenseScans(RobosensePcap, PacketTopic):
    """Packets of type `rslidar_msg/RslidarPacket`, and of the older `rslidar_msgs/rslidarScan`.

    They are read as those of a capture: see `robosense_pcap`. The stamp that the driver gave a packet takes the place
    of the capture's clock. DIFOP packets in the topic give the angles; older drivers write them to a topic of their
    own, which is not read: state `options.angles`. Where the bag has several such topics, state `options.topic`.
    """

    name: ClassVar[str] = "robosense_scans"
    title: ClassVar[str] = "RoboSense packets in a ROS bag (RslidarPacket, rslidarScan), a stamp per return"
    suffixes: ClassVar[tuple[str, ...]] = ()
    types: ClassVar[tuple[str, ...]] = ("rslidar_msg/msg/RslidarPacket", "rslidar_msgs/msg/rslidarScan")
    options: ClassVar[type[Strict]] = RobosenseScansOptions

    sniff = TopicFormat.sniff
    files = TopicFormat.files
    contents = TopicFormat.contents

    def packets(self, source: LogSource) -> RobosenseSource:
        """Return what gives the topic's packets."""
        return functools.partial(self._of_length, source)

    def _of_length(self, source: LogSource, length: int, sender: str | None) -> Iterator[Datagram | Reject]:
        """Yield the topic's packets; DIFOP packets only where no length is given."""
        for item in self.datagrams(source):
            if isinstance(item, Reject) or not length:
                yield item
            elif item.payload.startswith(DIFOP_ID):
                continue
            elif len(item.payload) == length:
                yield item
            else:
                yield Reject(f"a data packet is not {length:,} bytes long", item.number, item.offset)


class VelodyneScansOptions(VelodyneOptions):
    """Settings of Velodyne packets in a bag."""

    topic: str | None = None
    """Topic of the packets, where the bag has several."""


class VelodyneScans(VelodynePcap, PacketTopic):
    """Packets of type `velodyne_msgs/VelodyneScan`.

    They are read as those of a capture: see `velodyne_pcap`. Such topics hold no position packets, so the hour has to
    be stated; the stamp that the driver gave a packet takes the place of the capture's clock
    (`options.hour = "capture"`). Where the bag has several such topics, state `options.topic`.
    """

    name: ClassVar[str] = "velodyne_scans"
    title: ClassVar[str] = "Velodyne packets in a ROS bag (VelodyneScan), a stamp per return"
    version: ClassVar[int] = 1
    suffixes: ClassVar[tuple[str, ...]] = ()
    time: ClassVar[str] = (
        "microseconds past the UTC hour; the hour comes from "
        'clock = { system = "utc_hour", date = … } with options.hour, or from the driver\'s stamps with "capture"'
    )
    types: ClassVar[tuple[str, ...]] = ("velodyne_msgs/msg/VelodyneScan",)
    options: ClassVar[type[Strict]] = VelodyneScansOptions

    sniff = TopicFormat.sniff
    files = TopicFormat.files
    contents = TopicFormat.contents

    def packets(self, source: LogSource) -> VelodyneSource:
        """Return what gives the topic's packets."""
        return functools.partial(self._wanted_of, source)

    def _wanted_of(self, source: LogSource, wanted: Wanted) -> Iterator[Datagram | Reject]:
        """Yield the topic's packets as if they had been sent to the wanted port."""
        for item in self.datagrams(source):
            if isinstance(item, Reject):
                yield item
            elif len(item.payload) == DATA_BYTES:
                yield item._replace(port=wanted.port)
            else:
                yield Reject(f"a data packet is not {DATA_BYTES:,} bytes long", item.number, item.offset)


TYPES: Final = ("ouster_ros/msg/PacketMsg", "ouster_msgs/msg/PacketMsg", "ouster_sensor_msgs/msg/PacketMsg")
"""Messages of packets, of the lidar and of its IMU."""
TEXT: Final = "std_msgs/msg/String"
"""Messages of the metadata."""


class BagPacketsOptions(Strict):
    """Settings of packets of an Ouster in a bag."""

    topic: str | None = None
    """Topic of the packets, where the bag has several."""
    metadata: Path | None = None
    """The sensor's metadata (JSON), relative to the bag's folder, where no topic of the bag holds them."""
    metadata_topic: str | None = None
    """Topic of the metadata, where the bag has several sensors' under other names than the packets'."""


class OusterBagOptions(OusterOptions, BagPacketsOptions):
    """Settings of lidar packets of an Ouster in a bag."""


class OusterBag(TopicFormat):
    """Lidar packets of type `ouster_ros/PacketMsg` (or `ouster_msgs`, `ouster_sensor_msgs`) in a bag of ROS.

    They are read as those of a capture: see `ouster_pcap`. The metadata are those of a topic of strings in the bag
    (`…/metadata`); where no topic holds any, as older drivers served them on demand, `options.metadata` names the
    JSON. IMU packets of the bag are a log of their own (`ouster_bag_imu`).
    """

    name: ClassVar[str] = "ouster_bag"
    title: ClassVar[str] = "Ouster lidar packets in a ROS bag (PacketMsg), a stamp per column"
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    axes_on_sensor: ClassVar[str] = "x points away from the external connector, y left of it, z out of the top"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "it stands upright and its connector points back"}
    time: ClassVar[str] = "the sensor's own, as in a capture (ouster_pcap); the bag's stamps are not used"
    options: ClassVar[type[Strict]] = OusterBagOptions
    types: ClassVar[tuple[str, ...]] = TYPES

    def reads(self, bag: Bag, topic: Topic) -> bool:
        """Return whether a topic is of lidar packets."""
        return holds_lidar(bag, topic) is True

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the metadata, where they are a file."""
        named = options.metadata if isinstance(options, OusterBagOptions) else None
        return [] if named is None else [beside(path, named)]

    def header(self, source: LogSource) -> LogHeader:
        """Return sensor, profile and mode; metadata and packets have to fit each other."""
        need("rosbags.typesys", "a ROS bag")
        options = options_of(source, OusterBagOptions)
        with Bag.open(source.path) as bag:
            length = packet_bytes(bag_metadata(bag, options))
            return LogHeader(self.attributes(source, bag, topic_of_length(bag, options, length)))

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """Return what the header states, by metadata and first packets."""
        options = options_of(source, OusterBagOptions)
        metadata = bag_metadata(bag, options)
        clock = sensor_clock(source, metadata)
        found = packets_of_length(bag, topic.name, packet_bytes(metadata))
        looked = list(itertools.islice((p for p in found if isinstance(p, Datagram)), LOOKED_AT))
        said = {"topic": topic.name, "checksum": examined(looked, metadata, source.path)}
        return described(metadata, options) | said | least_delay_s(looked, metadata, clock)

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packets, decoded some at a time."""
        options, said = options_of(source, OusterBagOptions), header.attributes
        with Bag.open(source.path) as bag:
            metadata = bag_metadata(bag, options)
            clock = sensor_clock(source, metadata)
            decoder = OusterDecoder(metadata, options, clock, source.path, bool(said["checksum"]))
            yield from decoded(packets_of_length(bag, str(said["topic"]), packet_bytes(metadata)), decoder)


def holds_lidar(bag: Bag, topic: Topic) -> bool | None:
    """Return whether a topic of packets of an Ouster holds the lidar's; None for other topics. Never raises."""
    if topic.type not in TYPES:
        return None
    try:
        first = next((p for p in packets(bag, topic.name) if isinstance(p, Datagram)), None)
    except FormatError:
        return None
    if first is None:
        return None
    return is_lidar_packet(first.payload) or is_lidar_packet(first.payload[:-1])  # a byte behind it is the driver's


def _first_payloads(bag: Bag) -> dict[str, bytes]:
    """Return the first packet of each topic of packets that has one."""
    topics = sorted(name for name, topic in bag.topics.items() if topic.type in TYPES)
    firsts = {name: next((p for p in packets(bag, name) if isinstance(p, Datagram)), None) for name in topics}
    return {name: first.payload for name, first in firsts.items() if first is not None}


def topic_of_length(bag: Bag, options: BagPacketsOptions, length: int) -> Topic:
    """Return the stated topic of packets, or the only one whose packets have this length.

    Raises
    ------
    FormatError
        where there is none, or several and none is stated.
    """
    if options.topic is not None and bag.topic(options.topic).type not in TYPES:
        kind = bag.topic(options.topic).type
        raise FormatError(f"topic {options.topic} is of type {kind}", expected=" or ".join(TYPES), file=bag.path)
    firsts = _first_payloads(bag)
    lengths = {length, length + 1}
    fitting = [name for name, own in firsts.items() if len(own) in lengths and options.topic in {None, name}]
    if len(fitting) != 1:
        found_lengths = ", ".join(f"{name}: {len(payload):,} bytes" for name, payload in firsts.items()) or "none"
        raise FormatError(
            f"{len(fitting)} topics hold packets of {length:,} bytes, as the metadata say ({found_lengths})",
            expected="one topic a log",
            file=bag.path,
            missing=Missing("options.topic", choices=tuple(firsts)),
        )
    return bag.topics[fitting[0]]


def bag_metadata(bag: Bag, options: BagPacketsOptions) -> OusterMetadata:
    """Return the metadata that the log's settings name, or those of the bag.

    Raises
    ------
    FormatError
        where the bag holds none, or those of several sensors and none is named like the packets' topic.
    """
    if options.metadata is not None:
        return read_metadata(beside(bag.path, options.metadata))
    found = dict(_texts(bag, options.metadata_topic))
    near = {n: m for n, m in found.items() if options.topic and _parent(n) == _parent(options.topic)}
    if len(found) > 1 and len(near) == 1:
        found = near
    if len(found) != 1:
        key = "options.metadata_topic" if found else "options.metadata"
        raise FormatError(
            f"{len(found)} topics hold metadata of an Ouster" + (": " + ", ".join(sorted(found)) if found else ""),
            expected="those of the packets' sensor",
            change="state options.metadata_topic, or name their JSON as options.metadata",
            file=bag.path,
            missing=Missing(key, choices=tuple(sorted(found))),
        )
    return next(iter(found.values()))


def _texts(bag: Bag, stated: str | None) -> Iterator[tuple[str, OusterMetadata]]:
    """Yield the topics of strings whose first message holds metadata."""
    for name in (stated,) if stated is not None else sorted(bag.topics):
        if bag.topic(name).type != TEXT:
            continue
        content: Any = next((one[1] for one in bag.decoded(name) if not isinstance(one, Reject)), None)
        try:
            yield name, metadata_of(str(getattr(content, "data", "")), bag.path)
        except FormatError:
            if stated is not None:
                raise


def _parent(topic: str) -> str:
    return topic.rpartition("/")[0]


def packets_of_length(bag: Bag, topic: str, length: int) -> Iterator[Datagram | Reject]:
    """Yield the packets of a topic; those of another length are rejected. A byte behind it is the driver's."""
    for item in packets(bag, topic):
        if isinstance(item, Reject) or len(item.payload) == length:
            yield item
        elif len(item.payload) == length + 1:
            yield item._replace(payload=item.payload[:length])
        else:
            yield Reject(f"the packet is not {length:,} bytes long", item.number, item.offset)


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
