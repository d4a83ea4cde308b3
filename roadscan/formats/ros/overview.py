"""Lists all topics of a bag: what each is, what roadscan makes of it, and where its frame stands on the vehicle."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from PIL import Image

from roadscan.compute.array_types import Float64
from roadscan.core.counted import counted
from roadscan.core.errors import FormatError
from roadscan.core.frames import BODY_FROM_AXES, rotation_from_quaternion, rph_from_rotation
from roadscan.core.gpstime import NS_PER_S
from roadscan.formats.ros.bag import Bag, Message, Topic, bag_files, stamp_ns
from roadscan.formats.ros.containers.mcap_file import McapFile
from roadscan.formats.ros.containers.ros1_file import Ros1File
from roadscan.formats.ros.containers.sqlite_file import SqliteFile
from roadscan.ingest.reading.format import Contents, Part, Reject

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


_TYPES: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")  # the second is that of ROS 1 before tf2
_NAME: Final = "tf_static"
_VEHICLES: Final = ("base_link", "base_footprint")  # frames of the vehicle (REP 105, 120); the first that is named
_MOST_MESSAGES: Final = 100  # messages of transforms that are read
_MOST_REJECTS: Final = 1_000  # messages that cannot be read before a topic is given up
_TURN_OFF: Final = 0.01  # of the length of a quaternion from 1; tf2 refuses such a transform, too
_SAME: Final = 1e-6  # by which two statements of one transform may differ (m, and of the rotation's matrix)
_FLU: Final = np.diag([1.0, -1.0, -1.0])  # forward, right, down from x ahead, y left, z up (REP 103)


@dataclass
class StaticTransforms:
    """The tree of the static transforms of a bag."""

    steps: dict[str, tuple[str, Float64]] = field(default_factory=dict)
    """By frame: its parent, and the pose (4, 4) parent from frame."""
    faults: dict[str, str] = field(default_factory=dict)
    """By frame: why the transform that places it is not used, a sentence each."""

    @property
    def vehicle(self) -> str:
        """The frame of the vehicle: `base_link`, and `base_footprint` where no transform names the first."""
        named = {*self.steps, *(parent for parent, _ in self.steps.values())}
        return next((one for one in _VEHICLES if one in named), _VEHICLES[0])

    def mounting(self, frame: str) -> tuple[dict[str, Any], str]:
        """Return a frame's mounting on the vehicle's frame; without one, why it has none ("" if none is stated)."""
        frame, vehicle, pose = _plain(frame), self.vehicle, np.eye(4)
        if frame in {"", vehicle}:
            return {}, ""
        at = frame
        while at != vehicle:
            if at in self.faults:
                return {}, self.faults[at]
            if at not in self.steps:
                return {}, self._apart(frame)
            at, step = self.steps[at]
            pose = step @ pose
        return _mounting(pose), ""

    def take(self, parent: str, child: str, transform: Any) -> None:
        """Take one transform; one that contradicts itself or an earlier one becomes a fault."""
        pose = _pose(transform)
        if child in self.steps:
            before, known = self.steps[child]
            if pose is None or before != parent or not np.allclose(known, pose, rtol=0.0, atol=_SAME):
                self.faults[child] = f"the static transforms place the frame {child} in two ways"
            return
        self.steps[child] = parent, np.eye(4) if pose is None else pose
        if pose is None:
            self.faults[child] = (
                f"the static transform of {child} on {parent} is not finite, or its quaternion is not of length 1"
            )

    def find_cycles(self) -> None:
        """Make faults of transforms that go round."""
        seen = set[str]()
        for frame in self.steps:
            way, at = list[str](), frame
            while at in self.steps and at not in seen:
                seen.add(at)
                way.append(at)
                at = self.steps[at][0]
            ring = way[way.index(at) :] if at in way else []
            for one in ring:
                self.faults.setdefault(one, f"the static transforms go round: {' on '.join([*ring, at])}")

    def _apart(self, frame: str) -> str:
        parents = {parent for parent, _ in self.steps.values()}
        if frame not in self.steps and frame not in parents:
            return ""  # no transform names it
        above, at = set[str](), self.vehicle
        while at in self.steps and at not in above:
            above.add(at)
            at = self.steps[at][0]
        if frame in above | {at}:
            return f"{self.vehicle} stands on the frame {frame} by the static transforms, not the other way round"
        return f"the static transforms do not place the frame {frame} on {self.vehicle}"


def static_transforms(bag: Bag) -> StaticTransforms:
    """Return the static transforms of a bag; those that contradict themselves are its faults."""
    found = StaticTransforms()
    for topic in bag.topics.values():
        if topic.type in _TYPES and topic.name.split("/")[-1] == _NAME:
            for content in first_contents(bag, topic, _MOST_MESSAGES):
                for one in content.transforms:
                    found.take(_plain(one.header.frame_id), _plain(one.child_frame_id), one.transform)
    found.find_cycles()
    return found


def first_contents(bag: Bag, topic: Topic, most: int) -> Iterator[Any]:
    """Yield the content of the first messages that can be read; nothing where the type cannot be."""
    good = bad = 0
    try:
        for item in bag.decoded(topic.name):
            if isinstance(item, Reject):
                bad += 1
            else:
                good += 1
                yield item[1]
            if good >= most or bad >= _MOST_REJECTS:
                return
    except Exception:  # noqa: BLE001 — a listing names what can be named: a type without a definition, a missing package
        return


def _plain(frame: str) -> str:
    return frame.strip("/")


def _pose(transform: Any) -> Float64 | None:
    """Return the pose (4, 4) of a transform; None where it is none."""
    turn, shift = transform.rotation, transform.translation
    quaternion = np.array([turn.w, turn.x, turn.y, turn.z])
    pose = np.eye(4)
    pose[:3, 3] = shift.x, shift.y, shift.z
    if not np.isfinite(pose).all() or not abs(np.linalg.norm(quaternion) - 1.0) <= _TURN_OFF:
        return None
    pose[:3, :3] = rotation_from_quaternion(quaternion)
    return pose


def _mounting(pose: Float64) -> dict[str, Any]:
    """Return lever arm, axes and boresight as the rig file states them, if the root is x ahead, y left, z up."""
    turn = _FLU @ pose[:3, :3]
    axes = max(BODY_FROM_AXES, key=lambda name: float(np.trace(turn @ BODY_FROM_AXES[name].T)))
    angles = np.degrees(rph_from_rotation(turn @ BODY_FROM_AXES[axes].T))
    angles = np.round((np.asarray(angles) + 180.0) % 360.0 - 180.0, 6) + 0.0
    return {
        "lever_arm_body_m": [round(float(value), 6) + 0.0 for value in _FLU @ pose[:3, 3]],
        "axes": axes,
        "boresight": dict(zip(("roll_deg", "pitch_deg", "heading_deg"), map(float, angles), strict=True)),
    }


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
