"""Velodyne packets in a bag of ROS 1 or ROS 2, as the driver's packet topic holds them."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, Final

from roadscan.core.strict import Strict
from roadscan.formats.lidars.pcap import Datagram, Wanted
from roadscan.formats.lidars.velodyne_packets import DATA_BYTES
from roadscan.formats.lidars.velodyne_pcap import Source, VelodyneOptions, VelodynePcap
from roadscan.formats.ros.lidar_packets import only_of, topic_packets
from roadscan.ingest.reading.format import LogSource, Reject
from roadscan.ingest.reading.records import options_of

TYPES: Final = ("velodyne_msgs/msg/VelodyneScan",)


class VelodyneScansOptions(VelodyneOptions):
    """Settings of Velodyne packets in a bag."""

    topic: str | None = None
    """Topic of the packets, where the bag has several."""


class VelodyneScans(VelodynePcap):
    """Packets of type `velodyne_msgs/VelodyneScan`.

    They are read as those of a capture: see `velodyne_pcap`. Such topics hold no position packets, so the hour has to
    be stated; the stamp that the driver gave a packet takes the place of the capture's clock
    (`options.hour = "capture"`). In a bag with other topics, state `format` and `options.topic`.
    """

    name: ClassVar[str] = "velodyne_scans"
    title: ClassVar[str] = "Velodyne packets in a ROS bag (VelodyneScan), a stamp per return"
    version: ClassVar[int] = 1
    suffixes: ClassVar[tuple[str, ...]] = ()
    time: ClassVar[str] = (
        "microseconds past the UTC hour; the hour comes from "
        'clock = { system = "utc_hour", date = … } with options.hour, or from the driver\'s stamps with "capture"'
    )
    options: ClassVar[type[Strict]] = VelodyneScansOptions

    def sniff(self, path: Path) -> bool:
        """True for a bag that holds nothing but such packets."""
        return only_of(path, TYPES)

    def packets(self, source: LogSource) -> Source:
        """Return what gives the topic's packets."""
        return functools.partial(_wanted_of, source.path, options_of(source, VelodyneScansOptions))


def _wanted_of(path: Path, options: VelodyneScansOptions, wanted: Wanted) -> Iterator[Datagram | Reject]:
    """Yield the packets of a topic as if they had been sent to the wanted port."""
    for item in topic_packets(path, options.topic, TYPES):
        if isinstance(item, Reject):
            yield item
        elif len(item.payload) == DATA_BYTES:
            yield item._replace(port=wanted.port)
        else:
            yield Reject(f"a data packet is not {DATA_BYTES:,} bytes long", item.number, item.offset)
