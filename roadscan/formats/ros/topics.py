"""What the formats of a bag's topics share: which topic is read, which of its stamps count, and what watches them."""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

from roadscan.core.errors import ConfigError, FormatError, Missing, RoadscanError, TimeSystemError
from roadscan.core.extras import need
from roadscan.core.gpstime import Clock
from roadscan.core.strict import Strict
from roadscan.formats.ros.arrivals import Arrivals
from roadscan.formats.ros.bag import METADATA, Bag, Message, Topic, bag_files, is_bag, stamp_ns
from roadscan.formats.ros.definitions import Decode
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
