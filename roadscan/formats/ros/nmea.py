"""NMEA sentences in a bag (nmea_msgs/Sentence, std_msgs/String), as the reader of NMEA logs reads them."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Final

from roadscan.core.errors import RoadscanError
from roadscan.core.strict import Strict
from roadscan.formats.motion.nmea import Nmea, NmeaOptions
from roadscan.formats.ros.bag import Bag, Topic
from roadscan.formats.ros.topics import TopicFormat
from roadscan.ingest.reading.format import Item, LogHeader, LogSource, Reject
from roadscan.ingest.reading.records import options_of

_SENTENCES: Final = "nmea_msgs/msg/Sentence"
_STRINGS: Final = "std_msgs/msg/String"
_LOOKED_AT: Final = 50  # messages of strings among which a sentence has to be


class RosNmeaOptions(NmeaOptions):
    """Settings of `ros_nmea`: those of `nmea`, and the topic."""

    topic: str | None = None
    """Topic that is read, such as "/nmea_sentence". Needed where the bag has several of sentences."""


class RosNmea(TopicFormat):
    """A message a sentence. The time is that of the sentences themselves: UTC, with the date of RMC or ZDA.

    The stamps of the messages are not used. A record is a sentence, in the order of the bag.
    """

    name = "ros_nmea"
    title = "NMEA sentences in a ROS bag (nmea_msgs/Sentence, std_msgs/String)"
    yields = ("gnss",)
    types = (_SENTENCES, _STRINGS)
    time = "UTC by its nature, with the date of RMC or ZDA"
    options: ClassVar[type[Strict]] = RosNmeaOptions

    def reads(self, bag: Bag, topic: Topic) -> bool:
        """Return whether a topic has NMEA sentences: one of strings has, where one of its first is a sentence."""
        if not super().reads(bag, topic) or topic.type == _SENTENCES:
            return super().reads(bag, topic)
        first = itertools.islice(bag.decoded(topic.name), _LOOKED_AT)
        return any(isinstance(one, tuple) and _text(one[1]).lstrip().startswith("$G") for one in first)

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights, as for a log of sentences."""
        with self._sentences(source) as (log, topic):
            return LogHeader({"topic": topic, **Nmea().header(log).attributes})

    def attributes(self, source: LogSource, bag: Bag, topic: Topic) -> dict[str, Any]:
        """See :meth:`header`."""
        return {}

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream solutions."""
        with self._sentences(source) as (log, _):
            yield from Nmea().read(log, header)

    @contextmanager
    def _sentences(self, source: LogSource) -> Iterator[tuple[LogSource, str]]:
        """Give the log as a file of sentences, which is removed afterwards; errors name the bag."""
        stated = options_of(source, RosNmeaOptions)
        options = NmeaOptions.parse(stated.model_dump(exclude={"topic"}, exclude_unset=True), file=source.path)
        with tempfile.TemporaryDirectory(prefix="roadscan-nmea-") as folder, Bag.open(source.path) as bag:
            file, topic = Path(folder) / "sentences.nmea", self.topic(bag, source)
            with file.open("w", encoding="utf-8", errors="replace") as out:
                for item in bag.decoded(topic.name):
                    out.write("\n" if isinstance(item, Reject) else f"{_text(item[1]).strip()}\n")
            try:
                yield replace(source, path=file, options=options), topic.name
            except RoadscanError as error:
                raise error.at(source.path, error.record) from error


def _text(content: Any) -> str:
    return str(content.sentence if hasattr(content, "sentence") else content.data)
