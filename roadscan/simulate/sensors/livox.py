"""Writes messages of Livox's driver (livox_ros_driver2/CustomMsg), serialised here: objects of single points are slow.

ROS 2 lays each number at a multiple of its size, counted from the fifth byte (CDR, little-endian), ROS 1 all fields one
after another. Coordinates are whole millimetres, as the sensor sends them; a firing without a return is 0, 0, 0.
"""

from __future__ import annotations

import struct
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.gpstime import NS_PER_S
from roadscan.simulate.sensors.lidar import Packets

MESSAGE: Final = "livox_ros_driver2/msg/CustomMsg"
DEFINITIONS: Final = {
    "livox_ros_driver2/msg/CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "uint8 reflectivity\nuint8 tag\nuint8 line\n",
    MESSAGE: "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points\n",
}
"""Definitions of the messages, of the driver's public repository."""
POINT: Final = np.dtype([
    ("t", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("tag", "u1"), ("line", "u1"),
    ("_", "u1"),
])  # fmt: skip
"""A point as ROS 2 lays it; the last byte, which the last point of a message lacks, is none of ROS 1."""
_LITTLE_ENDIAN: Final = b"\0\1\0\0"  # begin of a message of ROS 2


def firings(block: Packets) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.void]]:
    """Return stamped epochs (m,) and points (m,) of all firings of a block; `t` is not filled in."""
    out = np.zeros(block.ranges.shape, POINT)
    range_mm = 1000.0 * block.model.figures.range_step_m * block.ranges
    azimuth, elevation = np.radians(block.azimuth_deg), np.radians(block.elevation_deg)
    flat = range_mm * np.cos(elevation)
    for axis, value in zip("xyz", (flat * np.cos(azimuth), -flat * np.sin(azimuth), range_mm * np.sin(elevation)),
                           strict=True):  # fmt: skip
        out[axis] = np.rint(value) / 1000.0
    out["intensity"], out["line"] = block.intensity, np.arange(block.model.lasers)
    return block.stamped_gps_ns().ravel(), out.ravel()


def serialised(points: npt.NDArray[np.void], stamp_ns: int, frame: str, number: int, *, is_ros1: bool) -> bytes:
    """Return the message of a frame: its first point has the stamp, and `t` counts from there."""
    name, seconds = frame.encode("ascii"), divmod(stamp_ns, NS_PER_S)
    counts = struct.pack("<QI4xI", stamp_ns, points.size, points.size)
    if is_ros1:
        packed = points.view(np.uint8).reshape(points.size, -1)[:, :-1].tobytes()
        return struct.pack(f"<IIII{len(name)}s", number, *seconds, len(name), name) + counts + packed
    header = struct.pack(f"<iII{len(name) + 1}s", *seconds, len(name) + 1, name)
    header += bytes(-len(header) % 8)
    return (_LITTLE_ENDIAN + header + counts + points.tobytes())[: -1 if points.size else None]
