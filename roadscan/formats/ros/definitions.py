"""Definitions of message types that bags do not hold themselves, and what reads messages by a definition.

Bags of ROS 1, MCAP files, and SQLite files since ROS 2 Iron hold the definitions of their messages, which count. For
older SQLite files, those of ROS 2 itself come from the package rosbags, and those of lidar makers' drivers stand here.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import Any, Final

from roadscan.core.errors import FormatError
from roadscan.core.extras import needed

WHAT: Final = "a ROS bag"  # as the error of a missing package names it

_LIVOX_POINT: Final = """uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
_LIVOX_MESSAGE: Final = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""
_SHIPPED: Final = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets\n",
    "pandar_msgs/msg/PandarPacket": "builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size\n",
    "pandar_msgs/msg/PandarScan": "std_msgs/Header header\nPandarPacket[] packets\n",
    "nebula_msgs/msg/NebulaPacket": "builtin_interfaces/Time stamp\nuint8[] data\n",
    "nebula_msgs/msg/NebulaPackets": "std_msgs/Header header\nNebulaPacket[] packets\n",
    "rslidar_msg/msg/RslidarPacket": "std_msgs/Header header\nuint8 is_difop\nuint8 is_frame_begin\nuint8[] data\n",
    "rslidar_msgs/msg/rslidarPacket": "builtin_interfaces/Time stamp\nuint8[1248] data\n",
    "rslidar_msgs/msg/rslidarScan": "std_msgs/Header header\nrslidarPacket[] packets\n",
    "ouster_ros/msg/PacketMsg": "uint8[] buf\n",
    "ouster_msgs/msg/PacketMsg": "uint8[] buf\n",
    "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf\n",
    "livox_ros_driver/msg/CustomPoint": _LIVOX_POINT,
    "livox_ros_driver/msg/CustomMsg": _LIVOX_MESSAGE,
    "livox_ros_driver2/msg/CustomPoint": _LIVOX_POINT,
    "livox_ros_driver2/msg/CustomMsg": _LIVOX_MESSAGE,
    "livox_interfaces/msg/CustomPoint": _LIVOX_POINT,
    "livox_interfaces/msg/CustomMsg": _LIVOX_MESSAGE,
    "nmea_msgs/msg/Sentence": "std_msgs/Header header\nstring sentence\n",
}
"""Definitions from the public repositories of the drivers, as these publish them for ROS 2."""

_TYPE: Final = re.compile(r"([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)", re.ASCII)
_RULE: Final = "=" * 80 + "\n"  # divides the definitions of a text

Decode = Callable[[bytes | memoryview], Any]
"""Reads a serialised message; raises anything where the bytes are no such message."""


def type_name(recorded: str) -> str:
    """`package/msg/Name` of a type as a bag names it (ROS 1 leaves `msg` out); as recorded where it is no such name."""
    match = _TYPE.fullmatch(recorded)
    return f"{match[1]}/msg/{match[2]}" if match else recorded


def decoder(name: str, encoding: str, definition: str, language: str = "msg") -> Decode:
    """What reads messages of a type.

    Raises
    ------
    FormatError
        where neither the bag nor roadscan knows the type, or its serialisation is another than those of ROS.
    ConfigError
        where the package rosbags is not installed.
    """
    if encoding not in {"cdr", "ros1"}:
        raise FormatError(f"its messages are serialised as '{encoding}'", expected="those of ROS: ros1 or cdr")
    store = _store(name, definition, language)
    read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return functools.partial(read, typename=name)


@functools.lru_cache(maxsize=64)
def _store(name: str, definition: str, language: str) -> Any:
    """The types that a message needs; a text of a bag becomes code in rosbags, so its name has to be a plain one."""
    typesys = needed("rosbags.typesys", WHAT)
    if not _TYPE.fullmatch(name):
        raise FormatError(f"'{name}' is no name of a message type")
    try:
        if not definition:
            return _known_store(name)
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        store.register(_parsed(typesys, name, definition, language))
        store.get_msgdef(name)
    except Exception as error:  # whatever a damaged definition raises
        raise FormatError(f"the definition of {name} cannot be read", change="record the topic again") from error
    return store


def _parsed(typesys: Any, name: str, definition: str, language: str) -> dict[str, Any]:
    if language == "msg" and not definition.startswith(_RULE + "IDL: "):
        return dict(typesys.get_types_from_msg(definition, name))
    found: dict[str, Any] = {}
    for part in definition.split(_RULE)[1:] or ["\n" + definition]:
        found |= typesys.get_types_from_idl(part.split("\n", 1)[1])
    return found


@functools.cache
def _ros2_store() -> Any:
    typesys = needed("rosbags.typesys", WHAT)
    store = typesys.get_typestore(typesys.Stores.LATEST)
    for name, text in _SHIPPED.items():
        store.register(typesys.get_types_from_msg(text, name))
    return store


def _known_store(name: str) -> Any:
    store = _ros2_store()
    if name not in store.fielddefs:
        raise FormatError(f"neither the bag nor roadscan holds the definition of {name}")
    return store
