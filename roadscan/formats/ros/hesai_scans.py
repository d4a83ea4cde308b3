"""Hesai packets in a bag of ROS 1 or ROS 2, as the drivers' packet topics hold them."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import ClassVar

from roadscan.core.strict import Strict
from roadscan.formats.lidars.hesai_pcap import HesaiOptions, HesaiPcap, Source
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.ros.topics import PacketTopic, TopicFormat
from roadscan.ingest.reading.format import LogSource, Reject


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
