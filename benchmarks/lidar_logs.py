"""Long logs of lidars: one turn, written by the tests' makers of packets, repeated with its stamps running on."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from tests.formats import hesai_files, ouster_files, ros_files, test_livox_lvx, test_velodyne_models
from tests.formats.test_velodyne_pcap import HOUR_9, frame, posix_ns

Bytes = npt.NDArray[np.uint8]

_TURN_NS: Final = 100_000_000  # ten turns a second
_FIRST_NS: Final = posix_ns(HOUR_9) + 10_000_000_000
_POINT: Final = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2")]
)
_KINDS: Final = {"f4": 7, "u4": 6, "u2": 4}
"""Constants of sensor_msgs/PointField."""


class LidarLog(NamedTuple):
    """A log and what its survey file states of it."""

    path: Path
    returns: int
    options: dict[str, Any]
    clock: dict[str, Any]


def points_bag(folder: Path, turns: int = 100, *, by_ring: bool = False) -> LidarLog:
    """Clouds of x, y, z, intensity, t (ns after the header) and ring: firing by firing, or as an organised cloud.

    by_ring : 128 × 1024 points, ring after ring, 0 where nothing returned (Ouster's driver); else 32 × 2,000 in the
        order of their times, returns alone (Velodyne's).
    """
    rings, steps = (128, 1024) if by_ring else (32, 2000)
    made = [_street(rings, steps, seed) for seed in range(4)]
    fields = [
        {"name": name, "offset": _POINT.fields[name][1], "datatype": _KINDS[_POINT[name].str[1:]], "count": 1}
        for name in _POINT.names or ()
    ]
    messages, returns = [], 0
    for k in range(turns):
        points = made[k % len(made)] if by_ring else made[k % len(made)].T
        seen = points["x"] != 0
        cloud = np.ascontiguousarray(points) if by_ring else points[seen]
        stamp = _FIRST_NS + k * _TURN_NS
        width = steps if by_ring else cloud.size
        returns += int(seen.sum())
        content = {
            "header": ros_files.header(stamp, "lidar"), "height": cloud.size // width, "width": width, "fields": fields,
            "point_step": _POINT.itemsize, "row_step": _POINT.itemsize * width, "is_dense": 1,
            "data": cloud.reshape(-1).view(np.uint8),
        }  # fmt: skip
        messages.append((stamp + _TURN_NS, content))
    path = ros_files.write_bag(folder / "bag", "mcap", {"/points": ("sensor_msgs/msg/PointCloud2", messages)})
    return LidarLog(path, returns, {}, {"system": "unix_utc"})


def _street(rings: int, steps: int, seed: int) -> npt.NDArray[np.void]:
    """A turn (rings, steps) between houses on a plane; an eighth of the firings does not return."""
    random = np.random.default_rng(seed)
    azimuth, elevation = np.linspace(0, 2 * np.pi, steps, endpoint=False), np.radians(np.linspace(-25, 15, rings))
    walls_m = 12 + 6 * np.sin(3 * azimuth) + np.abs(4 * np.sin(11 * azimuth))
    ground_m = 1.8 / np.maximum(-np.sin(elevation), 1e-3)
    far_m = np.minimum(ground_m[:, None], walls_m) + random.normal(0, 0.01, (rings, steps))
    far_m[random.random((rings, steps)) < 1 / 8] = 0
    points = np.zeros((rings, steps), _POINT)
    points["x"] = far_m * np.outer(np.cos(elevation), np.cos(azimuth))
    points["y"] = far_m * np.outer(np.cos(elevation), np.sin(azimuth))
    points["z"] = far_m * np.sin(elevation)[:, None]
    points["intensity"] = np.rint(20 + 60 * np.abs(np.sin(7 * azimuth)) + random.integers(0, 30, (rings, steps)))
    points["t"] = np.arange(steps) * (_TURN_NS // steps) + (0 if rings == 128 else np.arange(rings)[:, None] * 1_512)
    points["ring"] = np.arange(rings)[:, None]
    return points


def ouster_capture(folder: Path, turns: int = 80) -> LidarLog:
    """An OS1-128 of 128 × 1024, profile RNG19_RFL8_SIG16_NIR16."""
    profile, rows, columns, a_packet = "RNG19_RFL8_SIG16_NIR16", 128, 1024, 16
    sections = ouster_files.metadata(
        profile, columns_per_frame=columns, column_window=[0, columns - 1], pixels_per_column=rows,
        prod_line="OS-1-128", pixel_shift_by_row=[0] * rows, beam_altitude_angles=np.linspace(21, -21, rows).tolist(),
        beam_azimuth_angles=[0.0] * rows, lidar_mode=f"{columns}x10",
    )  # fmt: skip
    (folder / "a.json").write_text(json.dumps(sections))
    packets, returns = [], 0
    for first in range(0, columns, a_packet):
        fields = ouster_files.pixels(profile, first, a_packet, rows)
        fields["RANGE"] %= 1 << 16
        returns += int(np.count_nonzero(fields["RANGE"]))
        packets.append(ouster_files.lidar_packet(profile, fields, first, 0, np.zeros(a_packet, np.int64)))
    turn = _stacked(packets)
    step = ouster_files.PIXELS[profile][0] * rows + 12
    stamps = np.arange(columns).reshape(-1, a_packet) * (_TURN_NS // columns)

    def turned(k: int) -> Bytes:
        turn[:, 2:4] = np.frombuffer(struct.pack("<H", k), np.uint8)
        for c in range(a_packet):
            own = (stamps[:, c : c + 1] + (ouster_files.FIRST_NS + k * _TURN_NS)).astype("<u8")
            turn[:, 32 + c * step : 40 + c * step] = own.view(np.uint8)
        return turn

    path = _capture(folder / "a.pcap", turned, turns, 7502)
    return LidarLog(path, returns * turns, {"metadata": "a.json"}, {"system": "free", "offset_s": 1_400_000_000})


def hesai_capture(folder: Path, turns: int = 120) -> LidarLog:
    """A PandarXT-32, single returns."""
    model, channels = "PandarXT-32", 32
    count = 250
    random = np.random.default_rng(0)
    packets = [
        hesai_files.packet(
            model, [round(18 * (8 * k + b)) for b in range(8)], 400 * k,
            random.integers(300, 20_000, (8, channels)), reflectivity=random.integers(0, 256, (8, channels)),
        )
        for k in range(count)
    ]  # fmt: skip
    hesai_files.angle_file(folder / "angles.csv", np.linspace(15, -16, channels), np.zeros(channels))
    turn = _stacked(packets)
    moments = [hesai_files.MOMENT + timedelta(microseconds=400 * k) for k in range(count)]
    size = turn.shape[1]

    def turned(k: int) -> Bytes:
        for row, moment in enumerate(moments):
            at = moment + timedelta(microseconds=k * _TURN_NS // 1000)
            tail = bytes([at.year - 1900, at.month, at.day, at.hour, at.minute, at.second])
            tail += struct.pack("<I", at.microsecond) + b"\x42" + struct.pack("<I", k * count + row)
            turn[row, size - len(tail) :] = np.frombuffer(tail, np.uint8)
        return turn

    path = _capture(folder / "a.pcap", turned, turns, 2368)
    return LidarLog(path, turns * count * 8 * channels, {"angles": "angles.csv"}, {"system": "unix_utc"})


def vlp32_capture(folder: Path, turns: int = 120) -> LidarLog:
    """A VLP-32C, single returns."""
    product, cycle_us, count = test_velodyne_models.VLP_32C, 12 * 55.296, 150
    random = np.random.default_rng(0)
    far = random.integers(500, 30_000, (count, 12, 32))
    far[random.random(far.shape) < 1 / 8] = 0
    turn = _stacked([test_velodyne_models.packet(product, k * cycle_us, far[k]) for k in range(count)])
    azimuths = np.arange(count * 12).reshape(count, 12) * (55.296 * test_velodyne_models.RATE)

    def turned(k: int) -> Bytes:
        first = k * count
        stamps = np.rint(10_000_000 + (first + np.arange(count)) * cycle_us).astype("<u4")
        turn[:, 1200:1204] = stamps[:, None].view(np.uint8)
        now = np.rint(azimuths + first * 12 * 55.296 * test_velodyne_models.RATE).astype(np.int64) % 36_000
        for b in range(12):
            turn[:, 100 * b + 2 : 100 * b + 4] = now[:, b : b + 1].astype("<u2").view(np.uint8)
        return turn

    path = _capture(folder / "a.pcap", turned, turns, 2368, round(count * cycle_us * 1000))
    clock = {"system": "utc_hour", "date": HOUR_9.date()}
    return LidarLog(path, turns * int(np.count_nonzero(far)), {"hour": 9}, clock)


def livox_file(folder: Path, seconds: int = 40) -> LidarLog:
    """A Mid-360 (LVX2): 200,000 points a second in packages of 96."""
    frames = seconds * 20
    content, _ = test_livox_lvx.cartesian(96, 0)
    packages, made = 104, []
    for f in range(frames):
        stamps = (test_livox_lvx.FIRST_NS + (f * packages + p) * test_livox_lvx.STEP_NS for p in range(packages))
        made.append([(0, 0, test_livox_lvx.stamp(ns), 1, content) for ns in stamps])
    path = folder / "a.lvx2"
    path.write_bytes(test_livox_lvx.lvx(made))
    return LidarLog(path, frames * packages * 96, {}, {"system": "free", "offset_s": 1_400_000_000})


LIDAR_LOGS: Final[dict[str, tuple[str, str, Callable[[Path], LidarLog], float]]] = {
    "ros_points": ("ros_points", "firing by firing, returns", points_bag, 8.0),
    "ros_points rings": ("ros_points", "ring by ring, returns", lambda at: points_bag(at, 60, by_ring=True), 8.0),
    "ouster_pcap": ("ouster_pcap", "OS1-128, returns", ouster_capture, 10.0),
    "hesai_pcap": ("hesai_pcap", "PandarXT-32, returns", hesai_capture, 10.0),
    "velodyne_pcap VLP-32C": ("velodyne_pcap", "VLP-32C, returns", vlp32_capture, 10.0),
    "livox_lvx": ("livox_lvx", "LVX2, returns", livox_file, 10.0),
}
"""By name: the format, what its log holds, its maker, and the bar of ingest (million returns a second of a core)."""


def _stacked(packets: list[bytes]) -> Bytes:
    return np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), -1).copy()


def _capture(path: Path, turned: Callable[[int], Bytes], turns: int, port: int, turn_ns: int = _TURN_NS) -> Path:
    """Write a capture of turns of packets (n, bytes), evenly in time."""
    with path.open("wb") as stream:
        stream.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65_535, 1))
        for k in range(turns):
            stream.writelines(_records(turned(k), port, _FIRST_NS + k * turn_ns, turn_ns))
    return path


def _records(packets: Bytes, port: int, first_ns: int, turn_ns: int) -> Iterator[bytes]:
    head = frame(bytes(packets.shape[1]), port)[:42]
    for row, packet in enumerate(packets):
        at_us = (first_ns + row * turn_ns // len(packets)) // 1000
        size = 42 + packets.shape[1]
        yield struct.pack("<IIII", at_us // 10**6, at_us % 10**6, size, size) + head + packet.tobytes()
