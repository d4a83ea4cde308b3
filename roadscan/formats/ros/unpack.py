"""Writes what a topic of a bag holds as files that other parts of roadscan read: pictures, and pairs of stamps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from roadscan.core.errors import FormatError
from roadscan.core.gpstime import NS_PER_S
from roadscan.formats.ros.bag import Bag, Message, Topic, stamp_ns
from roadscan.ingest.reading.format import Reject

STAMPS: Final = "stamps.csv"  # table of pictures and their stamps, as the format `images` finds it
PAIRS: Final = "pairs.csv"  # table of pairs of stamps, as `clock.pairs.table` reads it

_PICTURE: Final = "sensor_msgs/msg/Image"
_COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
_TIME_REFERENCE: Final = "sensor_msgs/msg/TimeReference"
PICTURES: Final = (_PICTURE, _COMPRESSED)
"""Types of messages that are pictures."""
_ENCODINGS: Final[dict[str, tuple[str, int, tuple[int, ...]]]] = {
    "mono8": ("u1", 1, (0,)),
    "8UC1": ("u1", 1, (0,)),
    "mono16": ("u2", 1, (0,)),
    "16UC1": ("u2", 1, (0,)),
    "rgb8": ("u1", 3, (0, 1, 2)),
    "bgr8": ("u1", 3, (2, 1, 0)),
    "8UC3": ("u1", 3, (2, 1, 0)),
    "rgba8": ("u1", 4, (0, 1, 2)),
    "bgra8": ("u1", 4, (2, 1, 0)),
}
"""Kind of numbers, channels, and which of them are red, green, blue (or grey), by `sensor_msgs/image_encodings`."""
_SUFFIXES: Final = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png"}  # by a compressed picture's first bytes


@dataclass(frozen=True)
class Unpacked:
    """What was written."""

    table: Path
    rows: int
    rejects: tuple[Reject, ...]
    """Messages that could not be written."""


def unpack(path: Path, topic: str, folder: Path) -> Unpacked:
    """Write a topic's pictures with their stamps, or its pairs of stamps, into a folder that is made.

    Pictures become files with a table `stamps.csv` (file, time): the format `images` reads the folder. Any other topic
    becomes `pairs.csv` (stamp, time): the header's stamp with the time of a TimeReference, else with the receive stamp.
    Stamps and times are seconds from the origin of their clocks, with nine decimals.

    Raises
    ------
    FormatError
        if the bag has no such topic, its messages have no header, or none could be written.
    """
    with Bag.open(path) as bag:
        found = bag.topic(topic)
        table = folder / (STAMPS if found.type in PICTURES else PAIRS)
        if table.exists():
            raise FormatError("the table is there already", change="name another folder", file=table)
        folder.mkdir(parents=True, exist_ok=True)
        rows, rejects = 0, []
        with table.open("w", encoding="utf-8") as out:
            out.write("file,time\n" if found.type in PICTURES else "stamp,time\n")
            for one in _written(bag, found, folder):
                if isinstance(one, Reject):
                    rejects.append(one)
                else:
                    out.write(",".join(one) + "\n")
                    rows += 1
    if not rows:
        why = rejects[0].reason if rejects else "it holds no message"
        raise FormatError(f"nothing of the topic {topic} could be written: {why}", file=path)
    return Unpacked(table, rows, tuple(rejects))


def _written(bag: Bag, topic: Topic, folder: Path) -> Iterator[tuple[str, str] | Reject]:
    """Yield the rows of the table; write the pictures."""
    for item in bag.decoded(topic.name):
        if isinstance(item, Reject):
            yield item
            continue
        message, content = item
        try:
            if topic.type in PICTURES:
                yield _picture(message, content, folder), _seconds(stamp_ns(content.header.stamp))
            else:
                time_ns = stamp_ns(content.time_ref) if topic.type == _TIME_REFERENCE else message.receive_ns
                yield _seconds(stamp_ns(content.header.stamp)), _seconds(time_ns)
        except (ValueError, AttributeError) as error:
            yield Reject(str(error), message.number, message.offset, 1, message.file)


def _seconds(ns: int) -> str:
    return f"{ns // NS_PER_S}.{ns % NS_PER_S:09d}"


def _picture(message: Message, content: Any, folder: Path) -> str:
    """Write a picture, compressed ones as they are; return its name."""
    if hasattr(content, "format"):
        data = content.data.tobytes()
        suffix = next((end for magic, end in _SUFFIXES.items() if data.startswith(magic)), None)
        if suffix is None:
            raise ValueError(f"the picture's compression is '{content.format}', neither JPEG nor PNG")
        (folder / f"{message.number:06d}{suffix}").write_bytes(data)
        return f"{message.number:06d}{suffix}"
    name = f"{message.number:06d}.png"
    Image.fromarray(_pixels(content)).save(folder / name, compress_level=1)
    return name


def _pixels(content: Any) -> npt.NDArray[Any]:
    """Return the pixels (rows, columns), or (rows, columns, 3) red, green, blue."""
    if content.encoding not in _ENCODINGS:
        raise ValueError(f"the picture's encoding '{content.encoding}' is none of {', '.join(_ENCODINGS)}")
    kind, channels, order = _ENCODINGS[content.encoding]
    number = np.dtype(kind).newbyteorder(">" if content.is_bigendian else "<")
    rows, columns, step = int(content.height), int(content.width), int(content.step)
    wide = columns * channels * number.itemsize
    if not rows or not wide or step < wide or content.data.size < rows * step:
        raise ValueError("the picture holds fewer bytes than its pixels need")
    lines = content.data[: rows * step].reshape(rows, step)[:, :wide]
    pixels = np.ascontiguousarray(lines).view(number).reshape(rows, columns, channels)[:, :, list(order)]
    return np.ascontiguousarray(pixels[:, :, 0] if channels == 1 else pixels).astype(kind)
