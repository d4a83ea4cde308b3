"""RoboSense packets in a bag of ROS 1 or ROS 2, as the driver's packet topic holds them."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import ClassVar

from roadscan.core.strict import Strict
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.lidars.robosense_packets import DIFOP_ID
from roadscan.formats.lidars.robosense_pcap import RobosenseOptions, RobosensePcap, Source
from roadscan.formats.ros.topics import PacketTopic, TopicFormat
from roadscan.ingest.reading.format import LogSource, Reject


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

    def packets(self, source: LogSource) -> Source:
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
