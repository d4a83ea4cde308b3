"""Bags written by the package rosbags, of all kinds that it writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from roadscan.formats.ros.bag import _SHIPPED

KINDS: Final = ("ros1", "ros1-bz2", "ros1-lz4", "sqlite", "sqlite-message", "sqlite-file", "mcap", "mcap-storage")

_TREE: Final = "geometry_msgs/TransformStamped[] transforms\n"
NS: Final = 1_000_000_000

Topics = Mapping[str, tuple[str, Sequence[tuple[int, Mapping[str, Any]]]]]
"""By topic: type, and each message's receive stamp (ns) with its fields; what is left out is zero or empty."""


def stamp(ns: int) -> dict[str, int]:
    """Fields of a stamp."""
    return {"sec": ns // NS, "nanosec": ns % NS}


def header(ns: int, frame: str = "") -> dict[str, Any]:
    """Fields of a header."""
    return {"stamp": stamp(ns), "frame_id": frame}


def store_of(kind: str) -> Any:
    """Types of ROS 1 or ROS 2, and those of lidar drivers."""
    store = get_typestore(Stores.ROS1_NOETIC if kind.startswith("ros1") else Stores.LATEST)
    tree = {} if "tf2_msgs/msg/TFMessage" in store.fielddefs else {"tf2_msgs/msg/TFMessage": _TREE}
    for name, text in (_SHIPPED | tree).items():
        store.register(get_types_from_msg(text, name))
    return store


def message(store: Any, name: str, fields: Mapping[str, Any]) -> Any:
    """A message of a type."""
    values = {}
    unknown = set(fields)
    for field, kind in store.fielddefs[name][1]:
        unknown.discard(field)
        values[field] = _value(store, kind, fields.get(field))
    assert not unknown, unknown
    return store.types[name](**values)


def _value(store: Any, kind: Any, given: Any) -> Any:
    node, what = kind
    if node == Nodetype.NAME:
        return message(store, what, given or {})
    if node == Nodetype.BASE:
        empty: Any = "" if what[0] == "string" else 0
        return empty if given is None else given
    (inner, name), length = what
    if inner == Nodetype.NAME:
        return [message(store, name, one) for one in given or ()]
    if name[0] == "string":
        return list(given or ())
    dtype = {"float32": "f4", "float64": "f8", "byte": "u1", "octet": "u1", "bool": "?"}.get(name[0], name[0])
    return np.zeros(length, dtype) if given is None else np.ascontiguousarray(given, dtype)


def write_bag(path: Path, kind: str, topics: Topics) -> Path:
    """Write a bag; return its file (ROS 1) or folder."""
    store = store_of(kind)
    path = path.with_suffix(".bag") if kind.startswith("ros1") else path
    with _writer(path, kind) as writer:
        connections = {t: writer.add_connection(t, name, typestore=store) for t, (name, _) in topics.items()}
        queue = [(ns, t, name, fields) for t, (name, rows) in topics.items() for ns, fields in rows]
        serialise = store.serialize_ros1 if kind.startswith("ros1") else store.serialize_cdr
        for ns, topic, name, fields in sorted(queue, key=lambda one: one[0]):
            writer.write(connections[topic], ns, serialise(message(store, name, fields), name))
    return path


def _writer(path: Path, kind: str) -> Any:
    if kind.startswith("ros1"):
        one = Writer1(path)
        if "-" in kind:
            one.set_compression(Writer1.CompressionFormat[kind.split("-")[1].upper()])
        return one
    plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
    two = Writer2(path, version=9, storage_plugin=plugin)
    if "-" in kind:
        two.set_compression(CompressionMode[kind.split("-")[1].upper()], CompressionFormat.ZSTD)
    return two
