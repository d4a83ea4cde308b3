"""Lists all topics of a bag: what each is, what roadscan makes of it, and where its frame stands on the vehicle."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from roadscan.core.counted import counted
from roadscan.core.frames import BODY_FROM_AXES, rotation_from_quaternion, rph_from_rotation
from roadscan.core.gpstime import NS_PER_S
from roadscan.formats.ros.bag import Bag, Topic, bag_files
from roadscan.formats.ros.containers.mcap_file import McapFile
from roadscan.formats.ros.containers.ros1_file import Ros1File
from roadscan.formats.ros.containers.sqlite_file import SqliteFile
from roadscan.ingest.reading.format import Contents, Part, Reject

Float64 = npt.NDArray[np.float64]

_KINDS: Final[dict[type, str]] = {Ros1File: "ROS 1", SqliteFile: "ROS 2 (SQLite)", McapFile: "ROS 2 (MCAP)"}
_STATIC: Final = "tf2_msgs/msg/TFMessage"
_ROS1_STATIC: Final = "tf/msg/tfMessage"  # as ROS 1 called it before tf2
_STATIC_NAME: Final = "tf_static"
_UNPACKED: Final = tuple(f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "TimeReference"))
_VEHICLE: Final = "base_link"  # frame of the vehicle by REP 105
_MOST_TREES: Final = 100  # messages of transforms that are read
_MOST_FRAMES: Final = 100  # longest way from a frame to the vehicle's
_FLU: Final = np.diag([1.0, -1.0, -1.0])  # forward, right, down from x ahead, y left, z up (REP 103)


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
        mountings = _mountings(bag)
        parts = tuple(_part(bag, bag.topics[name], readers, mountings) for name in sorted(bag.topics))
        faults = [*bag.faults, *(fault for _, container in bag.files for fault in container.faults)]
        kinds = " and ".join(sorted({_KINDS[type(container)] for _, container in bag.files}))
        what = f"a bag of {kinds} with {counted(len(parts), 'topic')}"
        return Contents(what, parts, tuple(fault.reason for fault in faults))


def _part(bag: Bag, topic: Topic, readers: tuple[Reader, ...], mountings: dict[str, tuple[str, Float64]]) -> Part:
    frame = _frame(bag, topic)
    parent, pose = mountings.get(frame, ("", np.eye(4)))
    return Part(
        name=topic.name,
        words=_words(topic),
        format=next((one.name for one in readers if one.reads(bag, topic)), ""),
        options={"topic": topic.name},
        frame=frame,
        parent=parent,
        mounting=_mounting(pose) if parent else {},
    )


def _words(topic: Topic) -> str:
    words = f"{topic.type.replace('/msg/', '/')}, {counted(topic.count, 'message')}"
    if topic.span is not None and topic.rate_hz is not None:
        words += f", {topic.rate_hz:.4g} Hz, {(topic.span.last_ns - topic.span.first_ns) / NS_PER_S:,.1f} s"
    if topic.type in _UNPACKED:
        words += ", `roadscan unpack` makes files of them"
    return words


def _frame(bag: Bag, topic: Topic) -> str:
    """Return the frame that the first message names; of poses that which is posed."""
    if not topic.count:
        return ""
    for content in _contents(bag, topic, 1):
        posed = getattr(content, "child_frame_id", "")
        return str(posed or getattr(getattr(content, "header", None), "frame_id", ""))
    return ""


def _contents(bag: Bag, topic: Topic, most: int) -> Iterator[Any]:
    """Yield the content of the first messages; nothing where they cannot be read."""
    try:
        for number, item in enumerate(bag.decoded(topic.name)):
            if number >= most:
                return
            if not isinstance(item, Reject):
                yield item[1]
    except Exception:  # noqa: BLE001 — a listing names what can be named: a type without a definition, a missing package
        return


def _mountings(bag: Bag) -> dict[str, tuple[str, Float64]]:
    """Return, for each frame of the static transforms, the frame at their root and the pose (4, 4) root from frame."""
    steps: dict[str, tuple[str, Float64]] = {}
    for topic in bag.topics.values():
        if topic.type in {_STATIC, _ROS1_STATIC} and topic.name.split("/")[-1] == _STATIC_NAME:
            for content in _contents(bag, topic, _MOST_TREES):
                for one in content.transforms:
                    steps[_plain(one.child_frame_id)] = _plain(one.header.frame_id), _pose(one.transform)
    found = {}
    for frame in steps:
        root, pose = frame, np.eye(4)
        for _ in range(_MOST_FRAMES):
            if root not in steps or root == _VEHICLE:
                break
            root, step = steps[root]
            pose = step @ pose
        found[frame] = root, pose
    return found


def _plain(frame: str) -> str:
    return frame.strip("/")


def _pose(transform: Any) -> Float64:
    pose = np.eye(4)
    turn, shift = transform.rotation, transform.translation
    quaternion = np.array([turn.w, turn.x, turn.y, turn.z])
    if np.linalg.norm(quaternion) > 0:
        pose[:3, :3] = rotation_from_quaternion(quaternion)
    pose[:3, 3] = shift.x, shift.y, shift.z
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
