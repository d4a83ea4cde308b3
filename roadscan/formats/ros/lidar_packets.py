"""The one topic of a lidar's packets that a log of a bag reads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from roadscan.core.errors import FormatError, Missing
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.ros.bag import Bag, is_bag, packets
from roadscan.ingest.reading.format import Reject


def only_of(path: Path, types: tuple[str, ...]) -> bool:
    """Return True for a bag all of whose topics are of these types; never raises."""
    try:
        if not is_bag(path):
            return False
        with Bag.open(path) as bag:
            return bool(bag.topics) and all(topic.type in types for topic in bag.topics.values())
    except (FormatError, OSError):
        return False


def topic_of(path: Path, bag: Bag, stated: str | None, types: tuple[str, ...]) -> str:
    """Return the stated topic, or the only one of these types; an error that asks where there are several."""
    found = sorted(name for name, topic in bag.topics.items() if topic.type in types)
    if stated is not None:
        if bag.topic(stated).type not in types:
            raise FormatError(
                f"topic {stated} is of type {bag.topic(stated).type}", expected=" or ".join(types), file=path
            )
        return stated
    if len(found) != 1:
        raise FormatError(
            f"the bag has {len(found)} topics of {' or '.join(types)}",
            expected="one topic a log, as options.topic",
            file=path,
            missing=Missing("options.topic", choices=tuple(found)),
        )
    return found[0]


def topic_packets(path: Path, stated: str | None, types: tuple[str, ...]) -> Iterator[Datagram | Reject]:
    """Yield the packets of the topic (:func:`topic_of`) in their order."""
    with Bag.open(path) as bag:
        yield from packets(bag, topic_of(path, bag, stated, types))
