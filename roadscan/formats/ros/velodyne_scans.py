"""Velodyne packets in a bag of ROS 1 or ROS 2, as the driver's packet topic holds them."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import ClassVar

from roadscan.core.strict import Strict
from roadscan.formats.lidars.pcap import Datagram, Wanted
from roadscan.formats.lidars.velodyne_packets import DATA_BYTES
from roadscan.formats.lidars.velodyne_pcap import Source, VelodyneOptions, VelodynePcap
from roadscan.formats.ros.topics import PacketTopic, TopicFormat
from roadscan.ingest.reading.format import LogSource, Reject


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

    def packets(self, source: LogSource) -> Source:
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
