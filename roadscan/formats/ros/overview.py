"""Lists all topics of a bag: what each is, what roadscan makes of it, and where its frame stands on the vehicle."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import ClassVar, Final, Protocol, runtime_checkable

from roadscan.core.counted import counted
from roadscan.core.gpstime import NS_PER_S
from roadscan.formats.ros.bag import Bag, Topic, bag_files
from roadscan.formats.ros.containers.mcap_file import McapFile
from roadscan.formats.ros.containers.ros1_file import Ros1File
from roadscan.formats.ros.containers.sqlite_file import SqliteFile
from roadscan.formats.ros.transforms import StaticTransforms, first_contents, static_transforms
from roadscan.ingest.reading.format import Contents, Part

_KINDS: Final[dict[type, str]] = {Ros1File: "ROS 1", SqliteFile: "ROS 2 (SQLite)", McapFile: "ROS 2 (MCAP)"}
_UNPACKED: Final = tuple(f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "TimeReference"))


@runtime_checkable
class Reader(Protocol):
    """A format that reads topics of bags: any :class:`LogFormat` with this method, whatever else it reads."""

    name: ClassVar[str]

    def reads(self, bag: Bag, topic: Topic) -> bool:
        """Return whether it reads a topic."""


def contents(path: Path, readers: tuple[Reader, ...]) -> Contents:
    """Return the topics of a bag by name, each with the reader that reads it."""
    return _contents_of(path, readers, tuple((str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in bag_files(path)))


@functools.lru_cache(maxsize=16)
def _contents_of(path: Path, readers: tuple[Reader, ...], stamp: object) -> Contents:
    with Bag.open(path) as bag:
        transforms = static_transforms(bag)
        parts = tuple(_part(bag, bag.topics[name], readers, transforms) for name in sorted(bag.topics))
        faults = [*bag.faults, *(fault for _, container in bag.files for fault in container.faults)]
        kinds = " and ".join(sorted({_KINDS[type(container)] for _, container in bag.files}))
        what = f"a bag of {kinds} with {counted(len(parts), 'topic')}"
        return Contents(what, parts, (*(fault.reason for fault in faults), *dict.fromkeys(transforms.faults.values())))


def _part(bag: Bag, topic: Topic, readers: tuple[Reader, ...], transforms: StaticTransforms) -> Part:
    frame = _frame(bag, topic)
    mounting, why_not = transforms.mounting(frame)
    return Part(
        name=topic.name,
        words=_words(topic),
        format=next((one.name for one in readers if one.reads(bag, topic)), ""),
        options={"topic": topic.name},
        frame=frame,
        parent=transforms.vehicle if mounting else "",
        mounting=mounting,
        unmounted=why_not,
    )


def _words(topic: Topic) -> str:
    words = f"{topic.type.replace('/msg/', '/')}, {counted(topic.count, 'message')}"
    if topic.span is not None and topic.rate_hz is not None:
        words += f", {topic.rate_hz:.4g} Hz, {(topic.span.last_ns - topic.span.first_ns) / NS_PER_S:,.1f} s"
    if topic.type in _UNPACKED:
        words += ", `roadscan unpack` makes files of them"
    return words


def _frame(bag: Bag, topic: Topic) -> str:
    """Return the frame that the first message that can be read names; of poses that which is posed."""
    if not topic.count:
        return ""
    for content in first_contents(bag, topic, 1):
        posed = getattr(content, "child_frame_id", "")
        return str(posed or getattr(getattr(content, "header", None), "frame_id", ""))
    return ""
