"""Small sound bags of every kind of container and topic, to be damaged."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from tests.formats.ros_files import NS, header, write_bag
from tests.formats.test_ros_topics import T0, cloud, nmea_lines, spinning

UTC: Final = Clock(TimeSystem.UNIX_UTC)
LIDAR: Final = {"clock": UTC, "sensor": Sensor(kind="lidar")}
_MESSAGES: Final = 12


def _points(k: int) -> dict[str, Any]:
    sweep = spinning([("t", "<u4"), ("ring", "<u2")], 40)
    sweep["t"] = np.linspace(0, 99_000_000, sweep.size)
    return cloud(sweep, T0 + k * NS // 10, height=4)


def _livox(k: int) -> dict[str, Any]:
    points = [{"offset_time": i * 1_000_000, "x": 1.0 + i, "y": 2.0, "z": 0.5} for i in range(20)]
    return {"header": header(T0 + k * NS // 10), "point_num": 20, "points": points}


def _imu(k: int) -> dict[str, Any]:
    return {"header": header(T0 + k * NS // 10), "linear_acceleration": {"z": 9.8}}


def _fix(k: int) -> dict[str, Any]:
    return {"header": header(T0 + k * NS // 10), "latitude": 48.0, "longitude": 11.0, "altitude": 500.0}


def _pose(k: int) -> dict[str, Any]:
    pose = {"pose": {"position": {"x": 0.8 * k}, "orientation": {"w": 1.0}}}
    return {"header": header(T0 + k * NS // 10), "child_frame_id": "base_link", "pose": pose}


def _sentence(k: int) -> dict[str, Any]:
    return {"sentence": nmea_lines(_MESSAGES)[k]}


TOPICS: Final[dict[str, tuple[str, Callable[[int], dict[str, Any]]]]] = {
    "ros_points": ("sensor_msgs/msg/PointCloud2", _points),
    "ros_livox": ("livox_ros_driver2/msg/CustomMsg", _livox),
    "ros_imu": ("sensor_msgs/msg/Imu", _imu),
    "ros_gnss": ("sensor_msgs/msg/NavSatFix", _fix),
    "ros_poses": ("nav_msgs/msg/Odometry", _pose),
    "ros_nmea": ("nmea_msgs/msg/Sentence", _sentence),
}
"""Type of the messages of each format, and the fields of its k-th one."""

CONTAINERS: Final = ("ros1", "ros1-bz2", "ros1-lz4", "sqlite", "mcap", "mcap-storage")


def bag(name: str, kind: str) -> Callable[[Path], Path]:
    """What writes a bag of one file with a topic of a format."""

    def make(folder: Path) -> Path:
        type_name, fields = TOPICS[name]
        rows = [(T0 + k * NS // 10 + 1_000_000, fields(k)) for k in range(_MESSAGES)]
        written = write_bag(folder / "bag", kind, {"/topic": (type_name, rows)})
        if written.is_file():
            return written
        file = next(p for p in written.iterdir() if p.suffix in {".db3", ".mcap"})
        moved = folder / file.name
        shutil.move(file, moved)
        shutil.rmtree(written)
        return moved

    return make
