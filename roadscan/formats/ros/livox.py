"""Returns of Livox lidars in a bag (CustomMsg of their ROS drivers)."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any, ClassVar, Final

import numpy as np

from roadscan.core.strict import Strict
from roadscan.formats.ros.bag import Bag, Topic
from roadscan.formats.ros.definitions import Decode
from roadscan.formats.ros.return_rows import ReturnRows
from roadscan.formats.ros.topics import Timed, TopicFormat, TopicOptions
from roadscan.ingest.reading.format import Item, LogHeader, LogSource

_POINT: Final = (
    ("offset_ns", "u4"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"),
)  # fmt: skip
"""CustomPoint of livox_ros_driver and livox_ros_driver2."""
_EIGHT_TO_SIXTEEN_BITS: Final = np.uint16(257)  # scales 255 to 65,535, as for all sensors of 8 bits
_ROS1_BYTES: Final = 19  # bytes of a point in ROS 1, where fields follow one another
_CDR_BYTES: Final = 20  # bytes from one point to the next in ROS 2, where the first field lies at a multiple of four
_BEHIND_HEADER: Final = 16  # bytes of timebase, number of points, lidar and three reserved ones, before the points
_CDR_HEAD: Final = 4  # bytes before a message of ROS 2: how it is serialised


class RosLivox(TopicFormat):
    """A message a frame: points with x, y, z (m), reflectivity (255 becomes 65,535), line, time after the stamp.

    A point of 0, 0, 0 is no return. The tag (kind of the return, and the driver's opinion of noise) is not kept. The
    stamp is that of the header, which the driver takes from the lidar's own clock: with PTP or GPS that is its time,
    without either it counts from power-on.
    """

    name = "ros_livox"
    title = "Livox lidar in a ROS bag (CustomMsg)"
    version = 2
    yields = ("returns",)
    types = tuple(
        f"{package}/msg/CustomMsg" for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
    )
    options: ClassVar[type[Strict]] = TopicOptions
    axes_on_sensor: ClassVar[str] = "x points ahead out of the window (Mid-360: away from its cable), y left, z up"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "it stands upright and looks ahead"}

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """Check the sensor."""
        source.need_sensor("lidar")
        return {"frame": "sensor"}

    def decoder(self, topic: Topic) -> Decode:
        """Return what reads a message's points at once: rosbags would make an object of each."""
        return _ros1 if topic.encoding == "ros1" else _cdr

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream message by message."""
        with Bag.open(source.path) as bag:
            rows = ReturnRows(source, compensated=False)
            for item in self.timed(source, bag):
                if not isinstance(item, Timed):
                    yield item
                    continue
                points = item.content.points
                yield from rows.items(
                    item.message, item.stamp_ns, [points[axis] for axis in "xyz"], points["offset_ns"].astype(np.int64),
                    points["reflectivity"] * _EIGHT_TO_SIXTEEN_BITS, points["line"],
                )  # fmt: skip


def _ros1(data: bytes | memoryview) -> Any:
    """A message as ROS 1 serialises it: all fields one after another."""
    _, seconds, ns, length = struct.unpack_from("<IIII", data)
    return _message(data, "<", seconds, ns, bytes(data[16 : 16 + length]), 16 + length + _BEHIND_HEADER, _ROS1_BYTES)


def _cdr(data: bytes | memoryview) -> Any:
    """A message as ROS 2 serialises it: every number at a multiple of its size, counted from the fifth byte."""
    order = "<" if data[1] else ">"
    seconds, ns, length = struct.unpack_from(order + "iII", data, _CDR_HEAD)
    behind = 12 + length
    at = _CDR_HEAD + behind + -behind % 8 + _BEHIND_HEADER
    return _message(
        data, order, seconds, ns, bytes(data[_CDR_HEAD + 12 : _CDR_HEAD + behind]).rstrip(b"\0"), at, _CDR_BYTES
    )


def _message(data: bytes | memoryview, order: str, seconds: int, ns: int, frame: bytes, at: int, step: int) -> Any:
    """Return header and points; raises where the bytes are no such message.

    at : place of the number of points.
    """
    count = struct.unpack_from(order + "I", data, at)[0]
    names, kinds = zip(*_POINT, strict=True)
    places = [0, 4, 8, 12, 16, 17, 18]
    points = np.dtype({"names": names, "formats": [order + k for k in kinds], "offsets": places, "itemsize": step})
    needed = (count - 1) * step + _ROS1_BYTES if count else 0  # the last one is not filled up
    content = bytes(data[at + 4 :])
    if not needed <= len(content) < needed + step:
        raise ValueError("the message is no CustomMsg")
    content = content.ljust(count * step, b"\0")
    stamp = SimpleNamespace(sec=seconds, nanosec=ns)
    header = SimpleNamespace(stamp=stamp, frame_id=frame.decode(errors="replace"))
    return SimpleNamespace(header=header, points=np.frombuffer(content, points, count=count))
