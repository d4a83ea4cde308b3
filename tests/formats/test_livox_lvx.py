"""LVX and LVX2, written by hand from Livox's specifications: points of all types, stamps, damage, several lidars."""

from __future__ import annotations

import datetime as dt
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.errors import FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_of
from tests.formats.readings import Readings, read
from tests.formats.test_velodyne_pcap import gps_ns

FREE = Clock(TimeSystem.FREE)
FIRST_NS = 7_000_000_000
STEP_NS = 480_000  # 96 points at 200,000 a second
MAGIC = 0xAC0EA767

Package = tuple[int, int, bytes, int, bytes]
"""Device, kind of stamp, stamp, data type, points."""


def stamp(ns: int) -> bytes:
    return ns.to_bytes(8, "little")


def lvx(packages: list[list[Package]], version: tuple[int, int] = (2, 0), devices: int = 1) -> bytes:
    """A file with frames of packages."""
    out = bytearray(b"livox_tech".ljust(16, b"\0") + bytes([*version, 0, 0]) + struct.pack("<I", MAGIC))
    out += struct.pack("<B", devices) if version == (1, 0) else struct.pack("<IB", 50, devices)
    for k in range(devices):
        names = f"SN{k}".encode().ljust(16, b"\0") + bytes(16)
        mounting = struct.pack("<6f", 1, 2, 3, 0.1, 0.2, 0.3)
        keys = {(1, 0): struct.pack("<BB", k, 1), (1, 1): struct.pack("<BBB", k, 7, 1)}
        out += names + keys.get(version, struct.pack("<IBBB", k, 0, 9, 1)) + mounting
    for number, own in enumerate(packages):
        body = b""
        for device, kind, when, data_type, points in own:
            if version == (2, 0):
                body += struct.pack("<BIBB8sHBIB4s", 0, device, 0, kind, when, 0, data_type, len(points), 0, b"")
            else:
                body += struct.pack("<5BIBB8s", device, 5, 0, 1, 0, 0, kind, data_type, when)
            body += points
        head = 32 if version == (1, 0) else 24
        place = len(out)
        out += struct.pack("<QQQ", place, place + head + len(body), number)
        out += (struct.pack("<Q", len(own)) if version == (1, 0) else b"") + body
    return out


def cartesian(
    count: int, seed: int, *, tag: bool = True, kind: str = "i", returns: int = 1
) -> tuple[bytes, np.ndarray]:
    """Points as bytes, and (count, returns, 4) of x, y, z, reflectivity."""
    random = np.random.default_rng(seed)
    high = 30_000 if kind == "h" else 100_000
    numbers = random.integers(1, high, (count, returns, 4))
    numbers[..., 3] %= 256
    layout = f"<3{kind}B" + ("B" if tag else "")
    rows = [struct.pack(layout, *one, *([7] if tag else [])) for point in numbers.tolist() for one in point]
    return b"".join(rows), numbers


def frames(count: int = 4, packages: int = 3, device: int = 0, seed: int = 0) -> tuple[list[list[Package]], np.ndarray]:
    """Frames of LVX2 with 96 points a package, and all their numbers (n, 4)."""
    made, numbers = [], []
    for f in range(count):
        own: list[Package] = []
        for p in range(packages):
            k = f * packages + p
            content, values = cartesian(96, seed + k)
            own.append((device, 0, stamp(FIRST_NS + k * STEP_NS), 1, content))
            numbers.append(values[:, 0])
        made.append(own)
    return made, np.concatenate(numbers)


def sample(folder: Path) -> Path:
    """A small file of LVX2."""
    (folder / "a.lvx2").write_bytes(lvx(frames()[0]))
    return folder / "a.lvx2"


def old_sample(folder: Path) -> Path:
    """A small file of LVX, with an IMU package in each frame."""
    imu = struct.pack("<6f", 0, 0, 0, 0, 0, 1)
    own = [
        [(0, 0, stamp(FIRST_NS + k * 400_000), 2, cartesian(96, k)[0]), (0, 0, stamp(FIRST_NS), 6, imu)]
        for k in range(4)
    ]
    (folder / "a.lvx").write_bytes(lvx(own, (1, 1)))
    return folder / "a.lvx"


def read_lvx(path: Path, clock: Clock | None = FREE, **options: Any) -> Readings:
    return read("livox_lvx", path, options, clock=clock)


def test_lvx2_gives_what_was_written(tmp_path: Path) -> None:
    made, numbers = frames()
    path = tmp_path / "a.lvx2"
    path.write_bytes(lvx(made))
    assert format_of(path).name == "livox_lvx"
    found = read_lvx(path)
    np.testing.assert_allclose(found.xyz_sensor_m, numbers[:, :3] * 1e-3, rtol=1e-7)
    assert np.array_equal(found["intensity"], numbers[:, 3] * 257)
    assert np.array_equal(found.epochs, FIRST_NS + np.arange(12 * 96) * (STEP_NS // 96))
    assert np.bincount(found["sweep"]).tolist() == [288] * 4
    assert found.attributes["model"] == "Mid-360"
    assert found.attributes["stated_in_file"]["xyz_m"] == pytest.approx([0.1, 0.2, 0.3])
    assert found.rejects == []


def test_points_of_centimetres(tmp_path: Path) -> None:
    content, numbers = cartesian(96, 1, kind="h")
    (tmp_path / "a.lvx2").write_bytes(lvx([[(0, 0, stamp(FIRST_NS), 2, content)]]))
    np.testing.assert_allclose(read_lvx(tmp_path / "a.lvx2").xyz_sensor_m, numbers[:, 0, :3] * 1e-2, rtol=1e-7)


@pytest.mark.parametrize(
    ("data_type", "count", "returns", "tag"), [(0, 100, 1, False), (2, 96, 1, True), (4, 48, 2, True), (7, 30, 3, True)]
)
def test_cartesian_points_of_lvx(data_type: int, count: int, returns: int, tag: bool, tmp_path: Path) -> None:
    packages, numbers = [], []
    for k in range(3):
        content, values = cartesian(count, k, tag=tag, returns=returns)
        packages.append((0, 0, stamp(FIRST_NS + k * 400_000), data_type, content))
        numbers.append(values)
    (tmp_path / "a.lvx").write_bytes(lvx([packages], (1, 1)))
    found = read_lvx(tmp_path / "a.lvx")
    expected = np.concatenate(numbers).reshape(-1, 4)
    np.testing.assert_allclose(found.xyz_sensor_m, expected[:, :3] * 1e-3, rtol=1e-7)
    pulses = np.repeat(np.arange(count), returns) * (400_000 / count)
    assert np.array_equal(found.epochs[: count * returns], FIRST_NS + np.rint(pulses).astype(np.int64))


@pytest.mark.parametrize(("data_type", "count"), [(1, 100), (3, 96), (5, 48), (8, 30)])
def test_spherical_points_of_lvx(data_type: int, count: int, tmp_path: Path) -> None:
    """Zenith from the axis out of the top, azimuth from x to y (Livox SDK, "Spherical Coordinate")."""
    depth, zenith, azimuth = 12_345, 6_000, 3_000
    angles = struct.pack("<HH", zenith, azimuth)
    one = {
        1: struct.pack("<IHHB", depth, zenith, azimuth, 9),
        3: struct.pack("<IHHBB", depth, zenith, azimuth, 9, 0),
        5: angles + struct.pack("<IBB", depth, 9, 0) * 2,
        8: angles + struct.pack("<IBB", depth, 9, 0) * 3,
    }[data_type]
    (tmp_path / "a.lvx").write_bytes(lvx([[(0, 0, stamp(FIRST_NS), data_type, one * count)]], (1, 1)))
    found = read_lvx(tmp_path / "a.lvx")
    assert len(found) == count * {5: 2, 8: 3}.get(data_type, 1)
    sine, cosine = np.sin(np.radians(60)), np.cos(np.radians(60))
    expected = 12.345 * np.array([sine * np.cos(np.radians(30)), sine * np.sin(np.radians(30)), cosine])
    np.testing.assert_allclose(found.xyz_sensor_m, np.tile(expected, (len(found), 1)), rtol=1e-6)


def test_lvx_1_0_holds_metres(tmp_path: Path) -> None:
    points = b"".join(struct.pack("<fffB", 1 + k, 2, 3, k) for k in range(100))
    (tmp_path / "a.lvx").write_bytes(lvx([[(0, 0, stamp(FIRST_NS), 0, points)]], (1, 0)))
    found = read_lvx(tmp_path / "a.lvx")
    assert found["x_sensor_m"].tolist() == [1.0 + k for k in range(100)]
    assert found.attributes["model"] == "Mid-40 or Mid-100"


def test_imu_packages_are_passed_over(tmp_path: Path) -> None:
    found = read_lvx(old_sample(tmp_path))
    assert len(found) == 4 * 96
    assert found.rejects == []


def test_pixels_without_a_return_are_left_out(tmp_path: Path) -> None:
    points = struct.pack("<3iBB", 0, 0, 0, 0, 0) * 95 + struct.pack("<3iBB", 1000, 0, 0, 255, 0)
    (tmp_path / "a.lvx2").write_bytes(lvx([[(0, 0, stamp(FIRST_NS), 1, points)]]))
    found = read_lvx(tmp_path / "a.lvx2")
    assert (len(found), found["intensity"][0], found.rejects) == (1, 65_535, [])


def test_several_lidars_are_told_apart_by_their_serial_number(tmp_path: Path) -> None:
    first, second = frames()[0], frames(device=1, seed=50)[0]
    both = [a + b for a, b in zip(first, second, strict=True)]
    (tmp_path / "a.lvx2").write_bytes(lvx(both, devices=2))
    with pytest.raises(FormatError, match="2 lidars: SN0, SN1"):
        read_lvx(tmp_path / "a.lvx2")
    expected = frames(device=1, seed=50)[1]
    np.testing.assert_allclose(
        read_lvx(tmp_path / "a.lvx2", device="SN1")["x_sensor_m"], expected[:, 0] * 1e-3, rtol=1e-7
    )


def test_stamps_are_what_their_kind_says(tmp_path: Path) -> None:
    path = sample(tmp_path)
    for clock in (None, Clock(TimeSystem.UNIX_UTC)):
        with pytest.raises(TimeSystemError, match="count from power-on"):
            read_lvx(path, clock)
    content = cartesian(96, 1)[0]
    ptp = 1_777_887_000 * 10**9
    path.write_bytes(lvx([[(0, 1, stamp(ptp), 1, content)]]))
    with pytest.raises(TimeSystemError, match="PTP or GPS master"):
        read_lvx(path, None)
    assert read_lvx(path, Clock(TimeSystem.UNIX_TAI)).epochs[0] == ptp - (315_964_800 + 19) * 10**9
    path.write_bytes(lvx([[(0, 4, stamp(5), 2, content)]], (1, 1)))
    with pytest.raises(TimeSystemError, match="last pulse per second"):
        read_lvx(path)


def test_calendar_stamps_are_utc(tmp_path: Path) -> None:
    when = struct.pack("<4BI", 26, 5, 4, 9, 1_800_000_001)  # 2026-05-04 09:30:00.000001
    (tmp_path / "a.lvx").write_bytes(lvx([[(0, 3, when, 2, cartesian(96, 1)[0])]], (1, 1)))
    moment = dt.datetime(2026, 5, 4, 9, 30, 0, 1, tzinfo=dt.UTC)
    assert read_lvx(tmp_path / "a.lvx", None).epochs[0] == gps_ns(moment)
    with pytest.raises(TimeSystemError, match="calendar time"):
        read_lvx(tmp_path / "a.lvx", FREE)


def test_a_damaged_frame_costs_itself(tmp_path: Path) -> None:
    path = sample(tmp_path)
    whole = read_lvx(path)
    content = bytearray(path.read_bytes())
    at = 24 + 5 + 63
    size = struct.unpack_from("<Q", content, at + 8)[0] - at
    content[at + size] ^= 0xFF  # the second frame's own offset
    path.write_bytes(content)
    found = read_lvx(path)
    assert [(r.reason, r.offset) for r in found.rejects] == [("no frame; bytes skipped to the next one", at + size)]
    kept = whole["sweep"] != 1
    assert np.array_equal(found.epochs, whole.epochs[kept])


def test_a_file_that_is_cut_off_keeps_its_whole_packages(tmp_path: Path) -> None:
    path = sample(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    found = read_lvx(path)
    assert len(found) % 96 == 0
    assert len(found) >= 5 * 96
    assert [r.reason for r in found.rejects] == ["the package is cut off, or its length is wrong"]
