"""Returns of Livox lidars in a bag (CustomMsg of their ROS drivers)."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any, ClassVar, Final

import numpy as np

from roadscan.core.gpstime import NS_PER_S
from roadscan.core.strict import Strict
from roadscan.core.witness import Finding, Witness
from roadscan.formats.ros.bag import Bag, Decode, Topic
from roadscan.formats.ros.return_rows import ReturnRows
from roadscan.formats.ros.topics import Timed, TopicFormat, TopicOptions
from roadscan.ingest.reading.format import Item, LogHeader, LogSource
from roadscan.ingest.reading.records import options_of
from roadscan.store.readings.packed_returns import EIGHT_TO_SIXTEEN_BITS

_POINT: Final = (
    ("offset_ns", "u4"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"),
)  # fmt: skip
"""CustomPoint of livox_ros_driver and livox_ros_driver2."""
_ROS1_BYTES: Final = 19  # bytes of a point in ROS 1, where fields follow one another
_CDR_BYTES: Final = 20  # bytes from one point to the next in ROS 2, where the first field lies at a multiple of four
_BEHIND_HEADER: Final = 16  # bytes of timebase, number of points, lidar and three reserved ones, before the points
_CDR_HEAD: Final = 4  # bytes before a message of ROS 2: how it is serialised
_SAME_SCALE_NS: Final = 5 * NS_PER_S
"""A header nearer than this (ns) to the timebase is of its scale: GPS time, UTC and TAI are 18 s and more apart."""
_APART_NS: Final = 1_000_000  # drivers round the header to a microsecond; 1 ms is 2 cm at 20 m/s

LIVOX_TIMEBASE: Final = Witness(
    "livox_timebase",
    input="Livox lidars in a ROS bag (CustomMsg)",
    fault="The header was stamped when the message was sent, not when its first point was measured.",
    asks="the timebase of each message, from which the times of its points count",
    does="points count from the timebase where it is within 5 s of the header, else from the header; a difference of "
    "more than 1 ms on one scale, or one that varies so much between two, is named",
    told=("findings",),
)


class RosLivox(TopicFormat):
    """A message a frame: points with x, y, z (m), reflectivity (255 becomes 65,535), line, time after the stamp.

    A point of 0, 0, 0 is no return. The tag (kind of the return, and the driver's opinion of noise) is not kept. The
    stamp is the timebase, the time of the first point by the lidar's clock: with PTP or GPS that is its time,
    without either it counts from power-on. Where the header is 5 s or more off it, it is of another clock, and counts.
    """

    name = "ros_livox"
    title = "Livox lidar in a ROS bag (CustomMsg)"
    version = 3
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
            rows, timebases = ReturnRows(source, compensated=False), _Timebases()
            by_header = options_of(source, TopicOptions).stamps == "header"
            for item in self.timed(source, bag):
                if not isinstance(item, Timed):
                    yield item
                    continue
                points, stamp = item.content.points, item.stamp_ns
                if by_header:
                    stamp = timebases.stamp_ns(stamp, item.content.timebase)
                yield from rows.items(
                    item.message, stamp, [points[axis] for axis in "xyz"], points["offset_ns"].astype(np.int64),
                    points["reflectivity"] * EIGHT_TO_SIXTEEN_BITS, points["line"],
                )  # fmt: skip
            yield from timebases.findings()


class _Timebases:
    """Which stamp each message's points count from, and how far headers and timebases are apart."""

    def __init__(self) -> None:
        self._spans: dict[bool, tuple[int, int]] = {}
        """Least and greatest header less timebase (ns), by whether both are of one scale."""

    def stamp_ns(self, header_ns: int, timebase_ns: int) -> int:
        """Return the time of a message's first point (ns)."""
        if not timebase_ns:  # it is not stated
            return header_ns
        late = header_ns - timebase_ns
        is_same = abs(late) < _SAME_SCALE_NS
        low, high = self._spans.get(is_same, (late, late))
        self._spans[is_same] = min(low, late), max(high, late)
        return timebase_ns if is_same else header_ns

    def findings(self) -> Iterator[Finding]:
        """Yield what is doubtful, at the end of the topic."""
        for is_same, (low, high) in self._spans.items():
            if (max(abs(low), abs(high)) if is_same else high - low) > _APART_NS:
                used = "the timebase counts" if is_same else "they are of two clocks, and the header counts"
                yield LIVOX_TIMEBASE.finds(
                    "",
                    f"the headers' stamps are {low / NS_PER_S:+,.6f} s to {high / NS_PER_S:+,.6f} s from the timebase, "
                    f"at which the first point of a message was measured: {used}",
                )


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
    """Return header, timebase (ns) and points; raises where the bytes are no such message.

    at : place of the number of points.
    """
    timebase = struct.unpack_from(order + "Q", data, at - _BEHIND_HEADER)[0]
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
    return SimpleNamespace(header=header, timebase=timebase, points=np.frombuffer(content, points, count=count))
