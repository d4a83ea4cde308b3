"""Simulates the recording of a low-cost rig: one ROS bag with the lidar's clouds, IMU, GNSS positions and mountings.

Vehicle and sensors have axes x ahead, y left, z up (REP 103). A cloud is a turn of the head (of a Mid-360 a frame, in
the messages of Livox's driver); `t` counts nanoseconds from the header's stamp (as Ouster's driver writes it). Stamps
are Unix UTC of each sensor's clock; messages arrive late by random times, in the order of their arrival. An
odometry, where the scene has one, is the pose since the start, with an error that grows with the way.

Writes messages of Livox's driver (livox_ros_driver2/CustomMsg), serialised here: objects of single points are slow.

ROS 2 lays each number at a multiple of its size, counted from the fifth byte (CDR, little-endian), ROS 1 all fields one
after another. Coordinates are whole millimetres, as the sensor sends them; a firing without a return is 0, 0, 0.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from roadscan.core.gpstime import NS_PER_S, TimeSystem
from roadscan.simulate.caster import World
from roadscan.simulate.drive import Drive
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.noise import stream
from roadscan.simulate.scene import ClockError, Mount, Scene
from roadscan.simulate.sensors import gnss, lidar
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.lidar import BODY_FROM_AXES, Packets

CLOUDS: Final = "/lidar/points"
IMU: Final = "/imu/data"
POSITIONS: Final = "/gnss/fix"
MOUNTINGS: Final = "/tf_static"
ODOMETRY: Final = "/odom"
_TYPES: Final = {
    CLOUDS: "sensor_msgs/msg/PointCloud2", IMU: "sensor_msgs/msg/Imu", POSITIONS: "sensor_msgs/msg/NavSatFix",
    MOUNTINGS: "tf2_msgs/msg/TFMessage",
}  # fmt: skip
_FIELDS: Final = (
    ("x", "<f4", 7), ("y", "<f4", 7), ("z", "<f4", 7), ("intensity", "<f4", 7), ("t", "<u4", 6), ("ring", "<u2", 4),
)  # fmt: skip
"""Fields of a point: name, type, and the type's constant in sensor_msgs/PointField."""
_POINT: Final = np.dtype([(name, kind) for name, kind, _ in _FIELDS])
_STATUS: Final = {gnss.FIXED: 2, gnss.FLOAT: 0}
"""sensor_msgs/NavSatStatus of a solution: GBAS_FIX of a fixed one, FIX of a float one."""


class _Sent(NamedTuple):
    """A message on its way to the recording computer."""

    arrival_ns: int
    """By that computer's clock (POSIX ns)."""
    topic: str
    content: Any
    returns: int


def points_format(scene: Scene) -> str:
    """Return the format that reads the lidar's topic."""
    return "ros_livox" if _is_livox(scene) else "ros_points"


def _is_livox(scene: Scene) -> bool:
    return lidar_model(scene.lidar.model).figures.rosette is not None and scene.bag.livox == "CustomMsg"


def _types(scene: Scene) -> dict[str, str]:
    """Return the type of each topic."""
    types = _TYPES | ({CLOUDS: MESSAGE} if _is_livox(scene) else {})
    return types | ({ODOMETRY: "nav_msgs/msg/Odometry"} if scene.bag.odometry.on else {})


def file_name(scene: Scene) -> str:
    """Return the name of a pass's bag: a file of ROS 1, a folder of ROS 2."""
    return "rig.bag" if scene.bag.container == "ros1" else "rig"


def bag_clock(scene: Scene, error: ClockError) -> SensorClock:
    """Return the clock of a sensor that a computer stamps: Unix UTC, with the sensor's error."""
    return SensorClock.of(scene, error.model_copy(update={"system": None}), TimeSystem.UNIX_UTC)


def write_bag(scene: Scene, world: World | None, drive: Drive, bag: Path, hits_file: Path | None) -> Iterator[int]:
    """Write the bag of one pass, a message a step; yields the returns of each."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    is_ros1, types = scene.bag.container == "ros1", _types(scene)
    kinds = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    trees = {_TYPES[MOUNTINGS]: "geometry_msgs/TransformStamped[] transforms\n"} if is_ros1 else {}
    for name, text in (DEFINITIONS | trees).items():
        kinds.register(get_types_from_msg(text, name))
    messages = _Messages(scene, drive, kinds.types)
    with ExitStack() as stack:
        writer = stack.enter_context(_writer(scene, bag))
        hits = stack.enter_context(pq.ParquetWriter(hits_file, lidar.HITS_SCHEMA)) if hits_file else None
        topics = {name: writer.add_connection(name, kind, typestore=kinds) for name, kind in types.items()}
        pack = kinds.serialize_ros1 if is_ros1 else kinds.serialize_cdr
        streams = [messages.mountings(), messages.rates(), messages.positions(), messages.clouds(world, hits),
                   messages.odometry()]  # fmt: skip
        for sent in heapq.merge(*streams, key=lambda one: one.arrival_ns):
            content = sent.content
            data = content if isinstance(content, bytes) else pack(content, types[sent.topic])
            writer.write(topics[sent.topic], sent.arrival_ns, data)
            yield sent.returns


def _writer(scene: Scene, bag: Path) -> Any:
    from rosbags import rosbag1, rosbag2

    if scene.bag.container == "ros1":
        bag.unlink(missing_ok=True)
        return rosbag1.Writer(bag)
    for file in (*bag.glob("*"), bag) if bag.is_dir() else ():
        file.unlink() if file.is_file() else file.rmdir()
    plugin = rosbag2.StoragePlugin.MCAP if scene.bag.container == "mcap" else rosbag2.StoragePlugin.SQLITE3
    return rosbag2.Writer(bag, version=9, storage_plugin=plugin)


class _Messages:
    """The messages of one pass."""

    def __init__(self, scene: Scene, drive: Drive, types: dict[str, Any]) -> None:
        self.scene, self.drive, self.types = scene, drive, types

    def _sent(self, topic: str, measured: Iterator[tuple[int, Any, int]]) -> Iterator[_Sent]:
        """Yield messages with their arrivals by the computer's clock, which is right; none overtakes another.

        measured : when each was whole in truth (GPS ns), its content, and its returns.
        """
        rng, last = stream(self.scene.seed, self.drive.number, f"bag {topic}"), 0
        delay_ns = self.scene.bag.delay_s * NS_PER_S
        for epoch, content, returns in measured:
            last = max(last + 1, self._utc_ns(epoch) + round(delay_ns * (0.5 + rng.random())))
            yield _Sent(last, topic, content, returns)

    def _utc_ns(self, epoch_gps_ns: int) -> int:
        return int(bag_clock(self.scene, ClockError()).stamps_ns(np.array([epoch_gps_ns]))[0])

    def _header(self, stamp_ns: int, frame: str, number: int) -> Any:
        time = self.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, NS_PER_S))
        kind = self.types["std_msgs/msg/Header"]
        sequence = {"seq": number} if "seq" in kind.__dataclass_fields__ else {}  # of ROS 1
        return kind(**sequence, stamp=time, frame_id=frame)

    def mountings(self) -> Iterator[_Sent]:
        """Yield the transforms from the vehicle to the sensors, once."""
        rig = {"lidar": self.scene.lidar.mount, "imu_link": gnss.AT_BODY,
               "gnss": gnss.antenna_mount(self.scene)}  # fmt: skip
        epoch = lidar.starts_gps_ns(self.drive) - NS_PER_S  # before all others
        stamp = self._utc_ns(epoch)
        made = self.types["tf2_msgs/msg/TFMessage"]([self._mounting(stamp, n, m.nominal()) for n, m in rig.items()])
        yield from self._sent(MOUNTINGS, iter([(epoch, made, 0)]))

    def _mounting(self, stamp_ns: int, frame: str, mount: Mount) -> Any:
        get = self.types
        x, y, z = BODY_FROM_AXES @ mount.lever_arm_body_m
        boresight = Rotation.from_euler("ZYX", [mount.heading_deg, mount.pitch_deg, mount.roll_deg], degrees=True)
        turn = Rotation.from_matrix(BODY_FROM_AXES @ boresight.as_matrix() @ BODY_FROM_AXES).as_quat()
        return get["geometry_msgs/msg/TransformStamped"](
            self._header(stamp_ns, "base_link", 0), frame,
            get["geometry_msgs/msg/Transform"](
                get["geometry_msgs/msg/Vector3"](x, y, z), get["geometry_msgs/msg/Quaternion"](*turn)
            ),
        )  # fmt: skip

    def rates(self) -> Iterator[_Sent]:
        """Yield the IMU's samples."""
        if self.scene.imu.on:
            yield from self._sent(IMU, self._rates())

    def _rates(self) -> Iterator[tuple[int, Any, int]]:
        get, clock, unknown = self.types, bag_clock(self.scene, self.scene.imu.clock), np.zeros(9)
        vector, kind = get["geometry_msgs/msg/Vector3"], get["sensor_msgs/msg/Imu"]
        none = get["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        no_attitude = np.array([-1.0, *[0.0] * 8])
        number = 0
        for epochs, rate, force in gnss.samples(self.scene, self.drive, gnss.imu_of(self.scene)):
            rates, forces = rate @ BODY_FROM_AXES, force @ BODY_FROM_AXES
            stamps = clock.stamps_ns(epochs).tolist()
            for epoch, stamp, w, f in zip(epochs.tolist(), stamps, rates, forces, strict=True):
                header = self._header(stamp, "imu_link", number)
                yield epoch, kind(header, none, no_attitude, vector(*w), unknown, vector(*f), unknown), 0
                number += 1

    def positions(self) -> Iterator[_Sent]:
        """Yield the receiver's solutions; a pass without one has none."""
        if self.scene.gnss.on:
            yield from self._sent(POSITIONS, self._positions())

    def _positions(self) -> Iterator[tuple[int, Any, int]]:
        get, found = self.types, gnss.solve(self.scene, self.drive)
        for i, epoch in enumerate(found.epoch_gps_ns.tolist()):
            longitude, latitude, height = found.geographic[i]
            north, east, down = found.sigma_ned_m[i] ** 2
            status = get["sensor_msgs/msg/NavSatStatus"](_STATUS[int(found.quality[i])], 1)
            fix = get["sensor_msgs/msg/NavSatFix"](
                self._header(self._utc_ns(epoch), "gnss", i), status, latitude, longitude, height,
                np.diag([east, north, down]).ravel(), 2,
            )  # fmt: skip
            yield epoch, fix, 0

    def odometry(self) -> Iterator[_Sent]:
        """Yield the poses of an odometry."""
        if self.scene.bag.odometry.on:
            yield from self._sent(ODOMETRY, self._odometry())

    def _odometry(self) -> Iterator[tuple[int, Any, int]]:
        """The true pose of the vehicle in its first one, with the stated drift of length and heading."""
        get, stated = self.types, self.scene.bag.odometry
        first, last = self.drive.recorded_span_gps_ns
        epochs = np.arange(first, last + 1, round(NS_PER_S / stated.rate_hz))
        poses = self.drive.poses(epochs)
        start = poses.ecef_from_body[0]
        steps = np.diff(start.inv().apply(poses.position_ecef_m - poses.position_ecef_m[0]), axis=0, prepend=0.0)
        driven_m = np.cumsum(np.linalg.norm(steps, axis=1))
        flu = Rotation.from_matrix(BODY_FROM_AXES)
        turned = Rotation.from_rotvec(np.outer(stated.turn_deg_per_m * driven_m, [0.0, 0.0, 1.0]), degrees=True)
        places = np.cumsum((1.0 + stated.scale) * turned.apply(flu.apply(steps)), axis=0)
        quaternions = (turned * flu * start.inv() * poses.ecef_from_body * flu).as_quat()
        zero, unknown = get["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), np.zeros(36)
        twist = get["geometry_msgs/msg/TwistWithCovariance"](get["geometry_msgs/msg/Twist"](zero, zero), unknown)
        for number, (epoch, place, quaternion) in enumerate(zip(epochs.tolist(), places, quaternions, strict=True)):
            pose = get["geometry_msgs/msg/Pose"](
                get["geometry_msgs/msg/Point"](*place), get["geometry_msgs/msg/Quaternion"](*quaternion)
            )
            uncertain = get["geometry_msgs/msg/PoseWithCovariance"](pose, unknown)
            header = self._header(self._utc_ns(epoch), "odom", number)
            yield epoch, get["nav_msgs/msg/Odometry"](header, "base_link", uncertain, twist), 0

    def clouds(self, world: World | None, hits: pq.ParquetWriter | None) -> Iterator[_Sent]:
        """Yield the lidar's turns."""
        if world is not None and self.scene.lidar.on:
            yield from self._sent(CLOUDS, self._clouds(world, hits))

    def _clouds(self, world: World, hits: pq.ParquetWriter | None) -> Iterator[tuple[int, Any, int]]:
        clock, first = bag_clock(self.scene, self.scene.lidar.clock), lidar.starts_gps_ns(self.drive)
        turn_ns, begun, number = round(NS_PER_S / self.scene.lidar.turns_per_s), first, 0
        pending: list[tuple[npt.NDArray[np.int64], npt.NDArray[np.void]]] = []
        is_livox, is_ros1 = _is_livox(self.scene), self.scene.bag.container == "ros1"

        def cloud(upto: int) -> Iterator[tuple[int, Any, int]]:
            epochs = np.concatenate([one[0] for one in pending])
            points = np.concatenate([one[1] for one in pending])
            now = epochs < upto
            pending[:] = [(epochs[~now], points[~now])]
            stamp = int(clock.stamps_ns(np.array([begun]))[0])
            sweep = points[now].copy()
            sweep["t"] = np.maximum(clock.stamps_ns(epochs[now]) - stamp, 0)  # jitter may put one before its turn
            if is_livox:
                message = serialised(sweep, stamp, "lidar", number, is_ros1=is_ros1)
                yield begun + turn_ns, message, int(np.count_nonzero(sweep["intensity"]))
                return
            yield begun + turn_ns, self._cloud(stamp, sweep, number), sweep.size

        for block in lidar.measure(self.scene, world, self.drive):
            if hits is not None:
                hits.write_batch(lidar.hits_of(block))
            pending.append(firings(block) if is_livox else _points(block))
            while block.epoch_gps_ns[-1] >= begun + turn_ns:
                yield from cloud(begun + turn_ns)
                begun, number = begun + turn_ns, number + 1
        yield from cloud(np.iinfo(np.int64).max)

    def _cloud(self, stamp_ns: int, points: npt.NDArray[np.void], number: int) -> Any:
        kind, field = self.types["sensor_msgs/msg/PointCloud2"], self.types["sensor_msgs/msg/PointField"]
        offsets = np.cumsum([0, *(np.dtype(kind).itemsize for _, kind, _ in _FIELDS)]).tolist()
        fields = [field(name, offset, kind, 1) for (name, _, kind), offset in zip(_FIELDS, offsets, strict=False)]
        size = points.size * _POINT.itemsize
        header = self._header(stamp_ns, "lidar", number)
        data = points.view(np.uint8).reshape(size)
        return kind(header, 1, points.size, fields, False, _POINT.itemsize, size, data, True)


def _points(block: lidar.Packets) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.void]]:
    """Return epochs (m,) and points (m,) of a block's returns, in the sensor's axes; `t` is not filled in."""
    seen = block.ranges > 0
    range_m = block.ranges[seen] * block.model.figures.range_step_m
    azimuth = np.radians(block.azimuth_deg[seen])
    laser = np.broadcast_to(np.arange(block.model.lasers), seen.shape)[seen]
    elevation = np.radians(block.elevation_deg[seen])
    out = np.zeros(range_m.size, _POINT)
    out["x"], out["y"] = range_m * np.cos(elevation) * np.cos(azimuth), -range_m * np.cos(elevation) * np.sin(azimuth)
    out["z"] = range_m * np.sin(elevation) + block.model.rise_m[laser]
    out["intensity"], out["ring"] = block.intensity[seen], laser
    return block.stamped_gps_ns()[seen], out


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
