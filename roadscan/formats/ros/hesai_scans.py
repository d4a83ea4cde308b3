"""Hesai packets in a bag of ROS 1 or ROS 2, as the drivers' packet topics hold them."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, Final

from roadscan.core.strict import Strict
from roadscan.formats.lidars.hesai_pcap import HesaiOptions, HesaiPcap, Source
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.ros.lidar_packets import only_of, topic_packets
from roadscan.ingest.reading.format import LogSource, Reject
from roadscan.ingest.reading.records import options_of

TYPES: Final = ("pandar_msgs/msg/PandarScan", "hesai_lidar/msg/PandarScan", "nebula_msgs/msg/NebulaPackets")


class HesaiScansOptions(HesaiOptions):
    """Settings of Hesai packets in a bag."""

    topic: str | None = None
    """Topic of the packets, where the bag has several."""


class HesaiScans(HesaiPcap):
    """Packets of type `pandar_msgs/PandarScan`, `hesai_lidar/PandarScan` or `nebula_msgs/NebulaPackets`.

    They are read as those of a capture: see `hesai_pcap`. The stamp that the driver gave a packet takes the place of
    the capture's clock. In a bag with other topics, state `format` and `options.topic`.
    """

    name: ClassVar[str] = "hesai_scans"
    title: ClassVar[str] = "Hesai packets in a ROS bag (PandarScan), a stamp per return"
    suffixes: ClassVar[tuple[str, ...]] = ()
    options: ClassVar[type[Strict]] = HesaiScansOptions

    def sniff(self, path: Path) -> bool:
        """True for a bag that holds nothing but such packets."""
        return only_of(path, TYPES)

    def packets(self, source: LogSource) -> Source:
        """Return what gives the topic's packets."""
        return functools.partial(_of_length, source.path, options_of(source, HesaiScansOptions).topic)


def _of_length(path: Path, topic: str | None, length: int | None, sender: str | None) -> Iterator[Datagram | Reject]:
    """Yield the packets of a topic; those of another length are rejected where one is given."""
    for item in topic_packets(path, topic, TYPES):
        if isinstance(item, Reject) or length is None or len(item.payload) == length:
            yield item
        else:
            yield Reject(f"a data packet is not {length:,} bytes long", item.number, item.offset)
