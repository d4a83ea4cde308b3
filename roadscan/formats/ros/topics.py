"""What the formats of a bag's topics share: topics, stamps, blocks of messages, and messages that hold packets.

Compares the stamps of messages' headers with the stamps at which the recording computer received them.

A message is never received before it was measured, and the fastest of some seconds took much the same time as those of
any other seconds. So the least difference of each window shows how the two clocks run against each other.
"""

from __future__ import annotations

import functools
import struct
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np

from roadscan.core.errors import ConfigError, FormatError, Missing, RoadscanError, TimeSystemError
from roadscan.core.extras import need
from roadscan.core.gpstime import NS_PER_S, SCALES, Clock, TimeSystem, ahead_of_utc_s
from roadscan.core.strict import Strict
from roadscan.core.witness import Finding, Witness
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.ros.bag import METADATA, Bag, Decode, Message, Topic, bag_files, is_bag, packets, stamp_ns
from roadscan.formats.ros.overview import Reader, contents
from roadscan.ingest.reading.format import Contents, Item, LogFormat, LogHeader, LogSource, Reject, log_formats
from roadscan.ingest.reading.records import options_of

TIME: Final = (
    "stamps of a bag are nanoseconds from 1970 on the scale of whoever wrote them: state clock.system, mostly unix_utc "
    "(a computer's clock); unix_tai or unix_gps where a lidar on PTP or GPS stamps the headers; free with pairs where "
    "it counts from power-on"
)
"""`LogFormat.time` of all topics."""


class TopicOptions(Strict):
    """Settings of a bag's topic."""

    topic: str | None = None
    """Topic that is read, such as "/imu/data". Needed where the bag has several of a type that the format reads."""
    stamps: Literal["header", "receive"] = "header"
    """Which stamps of a message count: that of its header, which whoever measured wrote, or that at which the recording
    computer received it, which is late by the way of the message. The run watches their difference in either case."""


@dataclass(frozen=True)
class Timed:
    """A message with its content and the stamp that counts."""

    message: Message
    content: Any
    stamp_ns: int


class TopicFormat(LogFormat):
    """A format of messages of a bag."""

    time = TIME
    options: ClassVar[type[Strict]] = TopicOptions
    types: ClassVar[tuple[str, ...]]
    """Types of messages that it reads, `package/msg/Name`."""
    suffixes: ClassVar[tuple[str, ...]] = ()

    def sniff(self, path: Path) -> bool:
        """True for a bag with a topic that it reads."""
        topics = [topic for topic in topics_of(path).values() if topic.type in self.types and topic.count]
        try:
            with Bag.open(path) if topics else nullcontext() as bag:
                return bag is not None and any(self.reads(bag, topic) for topic in topics)
        except RoadscanError:
            return False

    def reads(self, bag: Bag, topic: Topic) -> bool:
        """Return whether it reads a topic."""
        return topic.type in self.types and topic.count > 0

    def files(self, path: Path) -> list[Path]:
        """Return the bag's files, with its metadata."""
        metadata = path / METADATA
        return sorted([*bag_files(path), *([metadata] if metadata.is_file() else [])])

    def contents(self, path: Path) -> Contents | None:
        """Return all topics of the bag; None for what is none."""
        if not is_bag(path):
            return None
        return contents(path, tuple(one for one in log_formats().values() if isinstance(one, Reader)))

    def header(self, source: LogSource) -> LogHeader:
        """Find the topic and check the clock; the first message says the frame."""
        need("rosbags.typesys", "a ROS bag")
        with Bag.open(source.path) as bag:
            topic = self.topic(bag, source)
            message_clock(source)
            first = next(
                (one[1] for one in bag.decoded(topic.name, self.decoder(topic)) if isinstance(one, tuple)), None
            )
            _check_stamp(first, source)
            attributes = {"topic": topic.name, "type": topic.type, "stamps": options_of(source, TopicOptions).stamps}
            frame = getattr(getattr(first, "header", None), "frame_id", "")
            return LogHeader(attributes | ({"frame_id": frame} if frame else {}) | self.attributes(source, bag, topic))

    def decoder(self, topic: Topic) -> Decode:
        """Return what reads the topic's messages: by its definition, unless a format knows a faster way."""
        return topic.decoder()

    @abstractmethod
    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """What else the header states, after a check of what the format needs."""

    def topic(self, bag: Bag, source: LogSource) -> Topic:
        """Return the topic to read.

        Raises
        ------
        ConfigError
            where the bag has several and none is stated.
        FormatError
            where it has none, or not the one that is stated.
        """
        name = getattr(options_of(source, self.options), "topic", None)
        if name is not None:
            topic = bag.topic(name)
            if topic.type not in self.types:
                raise FormatError(
                    f"the topic {name} is of type {topic.type}", expected=" or ".join(self.types), file=source.path
                )
            return topic
        fitting = sorted(t.name for t in bag.topics.values() if self.reads(bag, t))
        if not fitting:
            raise FormatError("the bag has no topic to read", expected=" or ".join(self.types), file=source.path)
        if fitting[1:]:
            raise ConfigError(
                f"the bag has {len(fitting)} topics that {self.name} reads",
                file=source.path,
                missing=Missing("options.topic", choices=tuple(fitting)),
            )
        return bag.topics[fitting[0]]

    def timed(self, source: LogSource, bag: Bag) -> Iterator[Timed | Item]:
        """Yield the topic's messages with the stamps that count; at the end, what their stamps say of the clocks."""
        topic, by_header = self.topic(bag, source), options_of(source, TopicOptions).stamps == "header"
        arrivals = Arrivals(message_clock(source))
        for item in bag.decoded(topic.name, self.decoder(topic)):
            if isinstance(item, Reject):
                yield item
                continue
            message, content = item
            own_ns = stamp_ns(content.header.stamp) if hasattr(content, "header") else 0
            if own_ns:
                arrivals.take(own_ns, message.receive_ns)
            elif by_header:
                yield Reject("the message has no stamp", message.number, message.offset, 1, message.file)
                continue
            yield Timed(message, content, own_ns if by_header else message.receive_ns)
        yield from arrivals.findings(by_header=by_header)


def message_clock(source: LogSource) -> Clock:
    """Return the clock of the stamps, in nanoseconds; an error where none is stated."""
    return replace(source.need_clock("unix_utc", unit="ns"), unit="ns")


def _check_stamp(first: Any, source: LogSource) -> None:
    """Refuse headers without a stamp, where they are to count."""
    header = getattr(first, "header", None)
    if header is not None and not stamp_ns(header.stamp) and options_of(source, TopicOptions).stamps == "header":
        raise TimeSystemError(
            "the headers of the messages have no stamp",
            expected='options.stamps = "receive": the stamps of the recording computer, late by the way of a message',
            file=source.path,
            missing=Missing("options.stamps", "receive"),
        )


def topics_of(path: Path) -> dict[str, Topic]:
    """Return the topics of a bag with their figures; empty for anything else, and for a bag that cannot be opened."""
    try:
        if not is_bag(path):
            return {}
        stamp = tuple((str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in bag_files(path))
        return _topics(path, stamp)
    except (OSError, FormatError, ConfigError):
        return {}


@functools.lru_cache(maxsize=16)
def _topics(path: Path, stamp: object) -> dict[str, Topic]:
    with Bag.open(path) as bag:
        return bag.topics


STAMPS_OF_A_BAG: Final = Witness(
    "stamps_of_a_bag",
    input="topics of a ROS bag",
    fault="The clock that stamped the headers steps, drifts or counts on another scale than is stated.",
    asks="the stamps at which the recording computer received the messages: the least latency of each 10 s",
    does="all messages are used by the stamps that are stated; the finding names the offset, step or drift",
    told=("findings",),
)

_WINDOW_NS: Final = 10 * NS_PER_S  # the least latency is found in windows of so long
_STEP_NS: Final = 50_000_000
"""A change of the least latency between two windows that is named a step (ns): networks and queues seldom cost more for
10 s, and at 20 m/s it is 1 m."""
_DRIFT_NS: Final = 20_000_000
"""Change of the least latency over the log that is named a drift (ns), where no step explains it."""
_EARLY_NS: Final = 2_000_000
"""A message that was received so long before its stamp (ns) is named: clocks of NTP agree better."""
_LATE_NS: Final = 2 * NS_PER_S  # a least latency of so much (ns) is named
_SAME_SCALE_NS: Final = NS_PER_S // 2  # an offset so near to one of two scales is taken for it (ns)
_OWN_COUNT_NS: Final = 86_400 * NS_PER_S  # stamps farther apart count from another origin, such as power-on


class Arrivals:
    """The least difference of receive stamp and header stamp of each window of a topic."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._least: dict[int, int] = {}
        """Receive less header stamp (ns), by the window of the receive stamp."""

    def take(self, header_ns: int, receive_ns: int) -> None:
        """Take the stamps of a message (ns)."""
        window, late = receive_ns // _WINDOW_NS, receive_ns - header_ns
        if late < self._least.get(window, late + 1):
            self._least[window] = late

    def findings(self, *, by_header: bool) -> Iterator[Finding]:
        """Yield what is doubtful, at the end of the topic; `by_header` where the headers' stamps are used."""
        if not self._least:
            return
        windows = np.array(sorted(self._least))
        late = np.array([self._least[window] for window in windows.tolist()])
        used = "the headers' stamps are used" if by_header else "the receive stamps are used"
        offset = self._offset(int(np.median(late)), int(windows[0]) * 10)
        if offset:
            yield STAMPS_OF_A_BAG.finds("", f"{offset}; {used}")
        steps = np.diff(late)
        worst = int(np.argmax(np.abs(steps))) if steps.size else 0
        if steps.size and abs(steps[worst]) > _STEP_NS:
            yield STAMPS_OF_A_BAG.finds(
                "",
                f"the difference of receive stamp and header stamp steps {np.count_nonzero(np.abs(steps) > _STEP_NS)} "
                f"times, by {steps[worst] / NS_PER_S:+.3f} s at the most ({(windows[worst + 1] - windows[0]) * 10} s "
                f"after the first message): one of the two clocks was set, or messages waited; {used}",
            )
        elif abs(grown := int(late[-1] - late[0])) > _DRIFT_NS:
            seconds = float(windows[-1] - windows[0]) * 10
            yield STAMPS_OF_A_BAG.finds(
                "",
                f"the difference of receive stamp and header stamp grows by {grown / NS_PER_S:+.3f} s in "
                f"{seconds:,.0f} s ({grown / 1e3 / seconds:+.1f} ppm): the two clocks drift apart; {used}",
            )

    def _offset(self, late_ns: int, unix_s: int) -> str:
        """Say what a constant difference means; '' where it is the way of a message."""
        if abs(late_ns) > _OWN_COUNT_NS or self._clock.system is TimeSystem.FREE:
            return ""  # a separate counter, which the stated clock explains
        for system, ahead_s in ahead_of_utc_s(unix_s).items():
            if abs(late_ns + ahead_s * NS_PER_S) < _SAME_SCALE_NS:
                if self._clock.system is system:
                    return ""
                return (
                    f"the headers' stamps are {ahead_s} s ahead of the receive stamps, as {SCALES[system]} is ahead of "
                    f"UTC, and the log's clock says {self._clock.system}: headers on that scale need clock.system = "
                    f"{system}"
                )
        if late_ns < -_EARLY_NS:
            return f"messages were received {-late_ns / NS_PER_S:.3f} s before their headers' stamps: the clocks differ"
        if late_ns > _LATE_NS:
            return f"messages were received {late_ns / NS_PER_S:.3f} s or more after the stamps of their headers"
        return ""


_MESSAGES: Final = 8_192  # messages of a block


def blocks(items: Iterator[Timed | Item]) -> Iterator[list[Timed] | Item]:
    """Yield lists of messages, and between them what is not a message."""
    pending: list[Timed] = []
    file = ""
    for item in items:
        if not isinstance(item, Timed):
            yield item
            continue
        if pending and (len(pending) >= _MESSAGES or item.message.file != file):
            yield pending
            pending = []
        file = item.message.file
        pending.append(item)
    if pending:
        yield pending


_ROOM: Final = {
    "velodyne_msgs/msg/VelodyneScan": (1206, False),
    "pandar_msgs/msg/PandarScan": (1500, True),
    "hesai_lidar/msg/PandarScan": (1500, True),
}
"""Bytes that each packet of a message takes, and whether the packet's length follows them."""
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
