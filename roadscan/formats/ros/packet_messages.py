"""Messages that hold a lidar's packets as it sent them, and how their topics become logs."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from roadscan.core.extras import need
from roadscan.core.gpstime import NS_PER_S
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.ros.bag import Bag, Message, Topic, packets
from roadscan.formats.ros.topics import TopicFormat
from roadscan.ingest.reading.format import LogSource, Reject

_ROOM: Final = {
    "velodyne_msgs/msg/VelodyneScan": (1206, False),
    "pandar_msgs/msg/PandarScan": (1500, True),
    "hesai_lidar/msg/PandarScan": (1500, True),
}
"""Bytes that each packet of a message takes, and whether the packet's own length follows them."""
_HEADER: Final = 12  # bytes before the frame's name: a number or the encapsulation, and the stamp
_LITTLE_ENDIAN: Final = 1  # second byte of the encapsulation of CDR (OMG DDSI-RTPS 2.5, 10.5)


class PacketTopic(TopicFormat):
    """A format of messages that hold a lidar's packets, read by the format of its captures."""

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """Return nothing: the format of captures states what is needed."""
        return {}

    def datagrams(self, source: LogSource) -> Iterator[Datagram | Reject]:
        """Yield the topic's packets in their order, as :func:`roadscan.formats.ros.bag.packets` does."""
        need("rosbags.typesys", "a ROS bag")
        with Bag.open(source.path) as bag:
            topic = self.topic(bag, source)
            if topic.type not in _ROOM:
                yield from packets(bag, topic.name)
                return
            number = 0
            for message in bag.messages(topic.name):
                if isinstance(message, Reject):
                    yield message
                    continue
                found = _packets_of(message, topic, number)
                if found is None:
                    reason = "the message does not fit its definition"
                    yield Reject(reason, message.number, message.offset, 1, message.file)
                    continue
                yield from found
                number += len(found)


def _packets_of(message: Message, topic: Topic, number: int) -> list[Datagram] | None:
    """Return the packets of a message, the first of which has a number; None where its bytes are damaged."""
    data, cdr = message.data, topic.encoding == "cdr"
    room, sized = _ROOM[topic.type]
    if len(data) < _HEADER + 8 or (cdr and data[1] != _LITTLE_ENDIAN):
        return None
    at = _HEADER + 4 + struct.unpack_from("<I", data, _HEADER)[0]
    at += -at % 4 if cdr else 0
    if at + 4 > len(data):
        return None
    count = struct.unpack_from("<I", data, at)[0]
    at += 4
    used = 8 + room + 4 * sized
    step = used + (-used % 4 if cdr else 0)
    if count and at + (count - 1) * step + used > len(data):
        return None
    words = (
        np.dtype(
            {"names": ["stamp", "size"], "formats": [("<u4", (2,)), "<u4"], "offsets": [0, 8 + room], "itemsize": used}
        )
        if sized
        else np.dtype({"names": ["stamp"], "formats": [("<u4", (2,))], "itemsize": used})
    )
    heads = np.ndarray((count,), words, data, at, (step,))
    stamps = heads["stamp"].astype(np.int64) @ np.array([NS_PER_S, 1])
    times = np.where(stamps == 0, message.receive_ns, stamps).tolist()
    sizes = np.minimum(heads["size"], room).tolist() if sized else [room] * count
    begins = range(at + 8, at + 8 + count * step, step)
    return [
        Datagram(number + k, message.offset, time_ns, "", 0, bytes(data[begin : begin + size]))
        for k, (begin, size, time_ns) in enumerate(zip(begins, sizes, times, strict=True))
    ]
