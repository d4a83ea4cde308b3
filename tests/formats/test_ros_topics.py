"""Topics of bags against the formats that read the same readings directly, and against what was written."""

from __future__ import annotations

import csv
import gzip
import itertools
import lzma
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.errors import ConfigError, CrsError, FormatError, RoadscanError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.ingest.reading.format import format_of
from tests.formats.readings import Readings, read
from tests.formats.ros_files import NS, header, write_bag

UTC = Clock(TimeSystem.UNIX_UTC)
GPST = Clock(TimeSystem.UNIX_GPS)
KINDS = ("ros1", "sqlite", "mcap")
T0 = 1_700_000_000 * NS
LIDAR, IMU = Sensor(kind="lidar"), Sensor(kind="imu")
_FIELD_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud(points: np.ndarray, ns: int, height: int = 1, gap: int = 0, frame: str = "lidar") -> dict[str, Any]:
    """Fields of a PointCloud2 with the fields of a structured array, whose rows may have gaps behind them."""
    kinds = {name: points.dtype[name] for name in points.dtype.names or ()}
    fields = [
        {"name": n, "offset": points.dtype.fields[n][1], "datatype": _FIELD_TYPES[k.str[1:]], "count": 1}
        for n, k in kinds.items()
    ]
    width = points.size // height
    rows = np.frombuffer(points.tobytes(), np.uint8).reshape(height, -1)
    data = np.pad(rows, ((0, 0), (0, gap))).ravel()
    return {
        "header": header(ns, frame),
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": any(k.str[0] == ">" for k in kinds.values()),
        "point_step": points.dtype.itemsize,
        "row_step": rows.shape[1] + gap,
        "data": data,
        "is_dense": True,
    }


def clouds(path: Path, kind: str, messages: list[tuple[int, dict[str, Any]]]) -> Path:
    return write_bag(path, kind, {"/points": ("sensor_msgs/msg/PointCloud2", messages)})


def spinning(extra: list[tuple[str, str]], count: int = 1_000) -> np.ndarray:
    """A sweep of points 1 to 40 m away."""
    rng = np.random.default_rng(5)
    points = np.zeros(count, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *extra])
    for axis in "xyz":
        points[axis] = rng.uniform(1.0, 40.0, count)
    return points


def same(rows: Readings, direct: Readings, columns: tuple[str, ...]) -> None:
    assert len(rows) == len(direct) > 0
    for name in columns:
        left, right = rows.table.column(name), direct.table.column(name)
        assert left.type == right.type
        np.testing.assert_array_equal(left.to_numpy(), right.to_numpy(), name)


def _head(packed: Path, lines: int) -> bytes:
    with gzip.open(packed) as stream:
        return b"".join(itertools.islice(stream, lines))


# --- the same rows as the direct formats ------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_drive_of_a_bag_is_that_of_its_files(kind: str, recordings: Path, tmp_path: Path) -> None:
    """IMU and RTK positions of a real drive, written by rosbags."""
    imu_file, pos_file = tmp_path / "imu.csv", tmp_path / "gnss.pos"
    imu_file.write_bytes(_head(recordings / "drive/imu.csv.gz", 6_000))
    pos_file.write_bytes(_head(recordings / "drive/gnss_rtk.pos.gz", 600))
    imu = read("imu_csv", imu_file, clock=GPST, sensor=IMU)
    gnss = read("rtklib_pos", pos_file, crs="EPSG:4979", height="ellipsoidal")
    shift_ns = 315_964_800 * NS  # GPS time counted from 1970, as GPST
    samples = [
        (
            int(t) + shift_ns,
            {
                "header": header(int(t) + shift_ns, "imu"),
                "angular_velocity": dict(zip("xyz", w, strict=True)),
                "linear_acceleration": dict(zip("xyz", f, strict=True)),
            },
        )
        for t, w, f in zip(
            imu.epochs,
            np.stack([imu[f"angular_rate_{a}_rad_per_s"] for a in "xyz"], axis=-1).tolist(),
            np.stack([imu[f"specific_force_{a}_m_per_s2"] for a in "xyz"], axis=-1).tolist(),
            strict=True,
        )
    ]
    lines = [line.split() for line in pos_file.read_text().splitlines() if not line.startswith("%")]
    fixes = []
    for t, words in zip(gnss.epochs, lines, strict=True):
        sn, se, su = (float(w) for w in words[7:10])
        fixes.append(
            (
                int(t) + shift_ns,
                {
                    "header": header(int(t) + shift_ns, "antenna"),
                    "latitude": float(words[2]),
                    "longitude": float(words[3]),
                    "altitude": float(words[4]),
                    "status": {"status": 2},
                    "position_covariance": [se * se, 0, 0, 0, sn * sn, 0, 0, 0, su * su],
                    "position_covariance_type": 2,
                },
            )
        )
    bag = write_bag(
        tmp_path / "bag", kind, {"/imu": ("sensor_msgs/msg/Imu", samples), "/fix": ("sensor_msgs/msg/NavSatFix", fixes)}
    )
    same(read("ros_imu", bag, clock=GPST, sensor=IMU), imu, tuple(n for n in imu.table.column_names if "temp" not in n))
    fixed = read("ros_gnss", bag, {"gbas": "fixed"}, clock=GPST, crs="EPSG:4979")
    columns = ("epoch_gps_ns", *(f"{a}_world_m" for a in "xyz"), *(f"sigma_{a}_m" for a in ("north", "east", "down")))
    same(fixed, gnss, columns)
    assert set(fixed["quality"]) == {"fixed"}


@pytest.fixture(scope="module")
def kitti(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[int, int]]:
    """Three sweeps of a town as KITTI's folder, and their stamps (POSIX ns)."""
    folder = tmp_path_factory.mktemp("kitti")
    wanted = []
    with (
        lzma.open(recordings / "kitti_drive/velodyne_points.tar.xz") as packed,
        tarfile.open(fileobj=packed) as archive,
    ):
        for one in archive:
            if one.name.endswith(".bin"):
                stream = archive.extractfile(one)
                assert stream is not None
                path = folder / one.name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(stream.read())
                wanted.append(int(path.stem))
            if len(wanted) == 3:
                break
    with (recordings / "kitti_drive/poses.csv").open() as stream:
        table = list(csv.reader(stream))
    stamps = {int(row[0]): round(float(row[1]) * 100) * (NS // 100) for row in table[1:] if int(row[0]) in wanted}
    text = "frame,stamp\n" + "".join(f"{n},{ns}\n" for n, ns in stamps.items())
    (folder / "stamps.csv").write_text(text)
    return folder, stamps


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turn", ["azimuth", "compensated"])
def test_sweeps_of_a_bag_are_those_of_kitti(
    kind: str, turn: str, kitti: tuple[Path, dict[int, int]], tmp_path: Path
) -> None:
    folder, stamps = kitti
    options: dict[str, Any] = {"stamps": "stamps.csv", "turn": turn}
    direct = read(
        "kitti",
        folder,
        options | ({} if turn == "compensated" else {"period_s": 0.1}),
        clock=Clock(TimeSystem.UNIX_UTC, unit="ns"),
        sensor=LIDAR,
    )
    layout = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]
    messages = []
    for number, ns in sorted(stamps.items()):
        xyzi = np.fromfile(folder / f"velodyne_points/data/{number:010d}.bin", "<f4").reshape(-1, 4)
        points = np.zeros(len(xyzi), layout + ([("t", "<i4")] if turn == "azimuth" else []))
        for place, name in enumerate(("x", "y", "z", "intensity")):
            points[name] = xyzi[:, place]
        if turn == "azimuth":
            angle = np.arctan2(xyzi[:, 1].astype(np.float64), xyzi[:, 0])
            points["t"] = np.rint(angle * (-0.1 * NS / (2 * np.pi)))
        messages.append((ns + 1_000_000, cloud(points, ns)))
    bag = clouds(tmp_path / "bag", kind, messages)
    rows = read("ros_points", bag, {} if turn == "azimuth" else {"untimed": "stamp"}, clock=UTC, sensor=LIDAR)
    same(rows, direct, tuple(name for name in direct.table.column_names if name not in ("sweep", "laser")))
    # These points have no ring; a folder of KITTI tells the laser by the order of its records.
    assert set(rows.table["laser"].to_pylist()) == {0}
    assert set(direct.table["laser"].to_pylist()) == set(range(64))
    assert not rows.findings


@pytest.mark.parametrize("kind", KINDS)
def test_poses_of_a_bag_are_those_of_a_table(kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    quaternions = rng.normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    places = rng.normal(size=(50, 3)) * 100
    text = "timestamp_ns,qw,qx,qy,qz,tx,ty,tz\n"
    messages = []
    for i, (q, p) in enumerate(zip(quaternions.tolist(), places.tolist(), strict=True)):
        ns = T0 + i * 100_000_000
        text += f"{ns}," + ",".join(repr(v) for v in (*q, *p)) + "\n"
        turn, place = dict(zip("wxyz", q, strict=True)), dict(zip("xyz", p, strict=True))
        pose = {
            "pose": {"position": place, "orientation": turn},
            "covariance": np.diag([0.01, 0.04, 0.09, 0, 0, 0]).ravel(),
        }
        messages.append((ns, {"header": header(ns, "map"), "child_frame_id": "base_link", "pose": pose}))
    (tmp_path / "poses.csv").write_text(text)
    direct = read(
        "pose_quaternions",
        tmp_path / "poses.csv",
        {"axes": "flu"},
        clock=Clock(TimeSystem.UNIX_UTC, unit="ns"),
        crs="local",
    )
    bag = write_bag(tmp_path / "bag", kind, {"/odom": ("nav_msgs/msg/Odometry", messages)})
    rows = read("ros_poses", bag, {"axes": "flu"}, clock=UTC, crs="local")
    same(rows, direct, ("epoch_gps_ns", *(f"{a}_world_m" for a in "xyz"), "qw", "qx", "qy", "qz"))
    np.testing.assert_allclose([rows[f"sigma_{a}_m"][0] for a in ("east", "north", "down")], [0.1, 0.2, 0.3], rtol=1e-6)
    assert rows.attributes["child_frame_id"] == "base_link"


def test_poses_about_the_origin_of_utm_are_of_a_local_frame(tmp_path: Path) -> None:
    """As an odometry writes them; by UTM they would lie on the equator, in the sea."""
    pose = {"position": {"x": 3.0, "y": -2.0, "z": 0.5}, "orientation": {"w": 1.0}}
    messages = [(T0 + i * NS, {"header": header(T0 + i * NS), "pose": pose}) for i in range(3)]
    bag = write_bag(tmp_path / "bag", "mcap", {"/pose": ("geometry_msgs/msg/PoseStamped", messages)})
    with pytest.raises(CrsError, match="coordinates of a local frame"):
        read("ros_poses", bag, {"axes": "flu", "heading": "grid"}, clock=UTC, crs="EPSG:32632", height="ellipsoidal")


def test_poses_in_utm_look_where_the_grid_says(tmp_path: Path) -> None:
    """East along UTM 32's axis is heading 90° from grid north: the same pose as a trajectory of headings."""
    messages = [
        (
            T0 + i * NS,
            {
                "header": header(T0 + i * NS),
                "pose": {"position": {"x": 600_000.0 + i, "y": 5_300_000.0, "z": 500.0}, "orientation": {"w": 1.0}},
            },
        )
        for i in range(3)
    ]
    bag = write_bag(tmp_path / "bag", "mcap", {"/pose": ("geometry_msgs/msg/PoseStamped", messages)})
    rows = read("ros_poses", bag, {"axes": "flu", "heading": "grid"}, clock=UTC, crs="EPSG:32632", height="ellipsoidal")
    text = "gps_s,easting_m,northing_m,height_m,roll_deg,pitch_deg,heading_deg\n" + "".join(
        f"{t / NS},{600_000.0 + i},5300000,500,0,0,90\n" for i, t in enumerate(rows.epochs.tolist())
    )
    (tmp_path / "t.csv").write_text(text.replace("gps_s", "time_s"))
    direct = read(
        "trajectory_csv",
        tmp_path / "t.csv",
        {"heading": "grid"},
        clock=Clock(TimeSystem.GPS),
        crs="EPSG:32632",
        height="ellipsoidal",
    )
    for name in ("x_world_m", "y_world_m", "z_world_m"):
        np.testing.assert_array_equal(rows[name], direct[name])
    turns = [np.stack([one[name] for name in ("qw", "qx", "qy", "qz")]) for one in (rows, direct)]
    np.testing.assert_allclose(np.abs(np.sum(turns[0] * turns[1], axis=0)), 1.0, rtol=0, atol=1e-15)


# --- point clouds ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "kind", "unit_ns", "absolute"),
    [
        ("t", "<u4", 1, False),
        ("time", "<f4", NS, False),
        ("offset_time", "<u4", 1, False),
        ("time_stamp", "<u4", 1_000, False),
        ("timestamp", "<f8", NS, True),
        ("timestamp", "<f8", 1, True),
        ("timestamp", "<f8", 1_000, True),
        ("time", "<f8", 1_000_000, False),
    ],
)
def test_times_of_points_are_found_from_their_size(
    name: str, kind: str, unit_ns: int, absolute: bool, tmp_path: Path
) -> None:
    messages, expected = [], []
    for sweep in range(4):
        ns = T0 + sweep * NS // 10
        points = spinning([(name, kind)])
        offsets = np.linspace(0, 99_000_000, points.size).astype(np.int64)
        points[name] = ((ns + offsets) if absolute else offsets) / unit_ns
        messages.append((ns + 120_000_000, cloud(points, ns)))
        expected.append(ns + offsets)
    rows = read("ros_points", clouds(tmp_path / "bag", "mcap", messages), clock=UTC, sensor=LIDAR)
    found = rows.epochs + 315_964_800 * NS - 18 * NS
    coarse = {("<f4", NS): 10, ("<f8", NS): 300, ("<f8", 1): 300}.get((kind, unit_ns), unit_ns)
    assert np.abs(found - np.concatenate(expected)).max() <= coarse
    assert rows.attributes["time_from"] == ("epoch" if absolute else "header")


def test_times_that_may_mean_two_things_are_asked_for(tmp_path: Path) -> None:
    points = spinning([("time", "<f4")])
    points["time"] = np.linspace(0, 100_000, points.size)  # 0.1 s in µs; 100 s in ms
    bag = clouds(tmp_path / "bag", "mcap", [(T0, cloud(points, T0))])
    assert read("ros_points", bag, clock=UTC, sensor=LIDAR).attributes["time_unit"] == "us"
    points["time"] = 0.0
    bag = clouds(tmp_path / "zero", "mcap", [(T0, cloud(points, T0))])
    with pytest.raises(TimeSystemError, match="no usual unit") as caught:
        read("ros_points", bag, clock=UTC, sensor=LIDAR)
    assert [one.key for group in caught.value.missing for one in group] == ["options.time_unit", "options.time_from"]


def sweeps(count: int, kind: str = "<f8", off_s: float = 0.0) -> list[tuple[int, dict[str, Any]]]:
    """Messages of 0.1 s with times of points from 1970 on, which are off against the headers."""
    made = []
    for sweep in range(count):
        ns = T0 + sweep * NS // 10
        points = spinning([("timestamp", kind)])
        points["timestamp"] = ns / NS + off_s + np.linspace(0, 0.099, points.size)
        made.append((ns + 120_000_000, cloud(points, ns)))
    return made


@pytest.mark.witness("clouds_of_a_bag")
def test_times_of_points_that_are_off_the_headers_are_named(tmp_path: Path) -> None:
    rows = read("ros_points", clouds(tmp_path / "off", "mcap", sweeps(4, off_s=1.5)), clock=UTC, sensor=LIDAR)
    (one,) = rows.findings
    assert "the points' own times lie +1.5" in one.text
    rows = read("ros_points", clouds(tmp_path / "right", "mcap", sweeps(4)), clock=UTC, sensor=LIDAR)
    assert rows.findings == []


@pytest.mark.parametrize(("ahead_s", "words"), [(18.0, "as GPS time is ahead"), (37.0, "as TAI is ahead")])
def test_points_on_another_scale_than_their_headers_are_asked_for(ahead_s: float, words: str, tmp_path: Path) -> None:
    bag = clouds(tmp_path / "bag", "mcap", sweeps(4, off_s=ahead_s))
    with pytest.raises(TimeSystemError, match=words):
        read("ros_points", bag, clock=UTC, sensor=LIDAR)
    rows = read("ros_points", bag, {"time_ahead_s": ahead_s}, clock=UTC, sensor=LIDAR)
    first_ns = int(rows.epochs.min()) + 315_964_800 * NS - 18 * NS
    assert first_ns == pytest.approx(T0, abs=1_000)


def test_points_without_a_time_are_rejected(tmp_path: Path) -> None:
    messages = []
    for sweep in range(4):
        ns = T0 + sweep * NS // 10
        points = spinning([("timestamp", "<f8")])
        points["timestamp"] = ns / NS + np.linspace(0, 0.099, points.size)
        points["timestamp"][7] = np.nan
        messages.append((ns, cloud(points, ns)))
    rows = read("ros_points", clouds(tmp_path / "bag", "mcap", messages), clock=UTC, sensor=LIDAR)
    assert (rows.rejected, rows.epochs.size) == (4, 4 * 999)


def test_times_whose_numbers_have_no_steps_fine_enough_are_refused(tmp_path: Path) -> None:
    bag = clouds(tmp_path / "bag", "mcap", sweeps(4, kind="<f4"))
    stated = {"time_unit": "s", "time_from": "epoch"}
    with pytest.raises(TimeSystemError, match="states times to 128 s only"):
        read("ros_points", bag, stated, clock=UTC, sensor=LIDAR)


def test_fractions_that_come_after_whole_numbers_are_named(tmp_path: Path) -> None:
    messages = []
    for sweep in range(10):
        ns = T0 + sweep * NS // 10
        points = spinning([("intensity", "<f4")])
        points["intensity"] = 0.0 if sweep < 8 else 0.25
        messages.append((ns, cloud(points, ns)))
    rows = read("ros_points", clouds(tmp_path / "bag", "mcap", messages), {"untimed": "stamp"}, clock=UTC, sensor=LIDAR)
    (one,) = rows.findings
    assert "2,000 intensities are fractions" in one.text


def test_whole_numbers_as_positions_are_refused(tmp_path: Path) -> None:
    points = spinning([]).astype([("x", "<i4"), ("y", "<i4"), ("z", "<i4")])
    with pytest.raises(FormatError, match="of a unit that no message states"):
        read("ros_points", clouds(tmp_path / "bag", "mcap", [(T0, cloud(points, T0))]), clock=UTC, sensor=LIDAR)


def test_clouds_without_times_are_asked_for(tmp_path: Path) -> None:
    bag = clouds(tmp_path / "bag", "ros1", [(T0, cloud(spinning([]), T0))])
    with pytest.raises(ConfigError, match="no time of each point"):
        read("ros_points", bag, clock=UTC, sensor=LIDAR)


def test_organised_big_endian_clouds_with_gaps(tmp_path: Path) -> None:
    points = spinning([("t", "<u4"), ("ring", "<u2"), ("reflectivity", "<u2")], 64)
    points["t"] = np.arange(64) * 1_500_000
    points["ring"] = np.arange(64) // 8
    points["reflectivity"] = 60_000
    points["x"][5], points["y"][6] = np.nan, np.inf
    for axis in "xyz":
        points[axis][7] = 0.0
    turned = points.astype([(n, points.dtype[n].newbyteorder(">")) for n in points.dtype.names or ()])
    bag = clouds(tmp_path / "bag", "mcap", [(T0, cloud(turned, T0, height=8, gap=13))])
    rows = read("ros_points", bag, clock=UTC, sensor=LIDAR)
    kept = np.delete(np.arange(64), [5, 6, 7])
    np.testing.assert_array_equal(rows["x_sensor_m"], points["x"][kept])
    np.testing.assert_array_equal(rows["laser"], points["ring"][kept])
    assert set(rows["intensity"].tolist()) == {60_000}
    assert rows.rejected == 1  # infinite, which is beyond 10 km


def test_rows_of_no_stated_length_and_padding_are_read(tmp_path: Path) -> None:
    points = spinning([("t", "<u4"), ("p", "u1"), ("q", "u1")])
    points["t"] = np.linspace(0, 99_000_000, points.size)
    for number, row_step in enumerate((0, points.nbytes)):
        messages = []
        for k in range(4):
            fields = cloud(points, T0 + k * NS // 10, height=4) | {"row_step": row_step}
            for one in fields["fields"]:
                one["name"] = {"p": "_", "q": "_"}.get(one["name"], one["name"])
            messages.append((T0 + k * NS // 10, fields))
        rows = read("ros_points", clouds(tmp_path / f"{number}", "mcap", messages), clock=UTC, sensor=LIDAR)
        np.testing.assert_array_equal(rows["x_sensor_m"][: points.size], points["x"])
        assert (len(rows["x_sensor_m"]), rows.rejected) == (4 * points.size, 0)


def test_a_topic_of_refused_clouds_says_why(tmp_path: Path) -> None:
    for name, change, why in (
        ("short", {"width": 5_000}, "the cloud holds fewer bytes than its points need"),
        ("narrow", {"point_step": 9}, "a field reaches beyond its point"),
    ):
        bag = clouds(tmp_path / name, "mcap", [(T0, cloud(spinning([("t", "<u4")]), T0) | change)])
        with pytest.raises(FormatError, match=why):
            read("ros_points", bag, clock=UTC, sensor=LIDAR)


@pytest.mark.parametrize(
    "frame", ["map", "/camera_init", "odom_combined", "local_enu", "local_origin", "world", "ENU", "utm_32n", "car/map"]
)
def test_a_cloud_that_was_placed_already_is_refused(frame: str, tmp_path: Path) -> None:
    bag = clouds(tmp_path / "bag", "mcap", [(T0, cloud(spinning([("t", "<u4")]), T0, frame=frame))])
    with pytest.raises(FormatError, match="placed them already"):
        read("ros_points", bag, clock=UTC, sensor=LIDAR)


def test_fractions_of_unknown_brightness_are_asked_for(tmp_path: Path) -> None:
    points = spinning([("intensity", "<f4")])
    points["intensity"] = np.linspace(0.5, 97.3, points.size)
    bag = clouds(tmp_path / "bag", "mcap", [(T0, cloud(points, T0))])
    with pytest.raises(ConfigError, match="brightest"):
        read("ros_points", bag, {"untimed": "stamp"}, clock=UTC, sensor=LIDAR)
    rows = read("ros_points", bag, {"untimed": "stamp", "intensity_full": 100.0}, clock=UTC, sensor=LIDAR)
    assert rows["intensity"].max() == round(97.3 / 100 * 65_535)


@pytest.mark.parametrize("kind", KINDS)
def test_points_of_livox(kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform(1, 50, (300, 3)).astype(np.float32)
    messages = []
    for k in range(3):
        points = [
            {
                "offset_time": i * 1_000,
                "x": p[0],
                "y": p[1],
                "z": p[2],
                "reflectivity": i % 256,
                "tag": 16,
                "line": i % 4,
            }
            for i, p in enumerate(places.tolist())
        ]
        ns = T0 + k * 100_000_000
        fields = {"header": header(ns, f"livox_frame{'x' * k}"), "timebase": ns, "point_num": 300, "points": points}
        messages.append((ns, fields))
    bag = write_bag(tmp_path / "bag", kind, {"/livox": ("livox_ros_driver2/msg/CustomMsg", messages)})
    rows = read("ros_livox", bag, clock=UTC, sensor=LIDAR)
    np.testing.assert_array_equal(rows.xyz_sensor_m.astype(np.float32), np.tile(places, (3, 1)))
    np.testing.assert_array_equal(rows["intensity"][:300], np.arange(300) % 256 * 257)
    np.testing.assert_array_equal(rows["laser"][:300], np.arange(300) % 4)
    np.testing.assert_array_equal(np.diff(rows.epochs[:300]), 1_000)


@pytest.mark.witness("livox_timebase")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("timebase", "header_late_ns", "late_ns", "says"),
    [
        (T0, lambda k: 0, 0, ""),
        (T0, lambda k: 100_000_000, 0, "+0.100000 s to +0.100000 s from the timebase"),  # stamped when it was sent
        (7 * NS, lambda k: 0, 0, ""),  # since power-on
        (7 * NS, lambda k: 3_000_000 * k, 3_000_000, "the header counts"),  # since power-on, and sent late
        (0, lambda k: 3_000_000 * k, 3_000_000, ""),  # not stated
    ],
)
def test_points_of_livox_count_from_the_timebase(
    kind: str, timebase: int, header_late_ns: Any, late_ns: int, says: str, tmp_path: Path
) -> None:
    """A message's first point is measured at T0 and 0.1 s later; `late_ns` is how late the second message is read."""
    point = {"x": 9.0, "y": 1.0, "z": 0.0, "reflectivity": 9, "tag": 16, "line": 0}
    points = [point | {"offset_time": 1_000 * i} for i in range(3)]
    messages = []
    for k in range(2):
        own = k * 100_000_000
        stamps = {
            "header": header(T0 + own + header_late_ns(k), "livox"),
            "timebase": timebase + own if timebase else 0,
        }
        messages.append((T0 + own + 110_000_000, stamps | {"point_num": 3, "points": points}))
    bag = write_bag(tmp_path / "bag", kind, {"/livox": ("livox_ros_driver2/msg/CustomMsg", messages)})
    log = read("ros_livox", bag, clock=UTC, sensor=LIDAR)
    expected = np.array([0, 1_000, 2_000, *(100_000_000 + late_ns + np.array([0, 1_000, 2_000]))])
    first_ns = T0 - 315_964_800 * NS + 18 * NS  # GPS time runs 18 s ahead of UTC
    np.testing.assert_array_equal(log.epochs - first_ns, expected)
    assert [says in one.text for one in log.findings] == ([True] if says else [])


# --- IMU, GNSS and sentences ------------------------------------------------------------------------


def _imu(
    path: Path, force: float, late_ns: Any = lambda i: 2_000_000, header_ns: Any = lambda i: T0 + i * NS // 10
) -> Path:
    samples = [
        (
            T0 + i * NS // 10 + late_ns(i),
            {"header": header(header_ns(i)), "linear_acceleration": {"x": 0.1, "y": 0.1, "z": force}},
        )
        for i in range(600)
    ]
    return write_bag(path, "mcap", {"/imu": ("sensor_msgs/msg/Imu", samples)})


def test_acceleration_in_g_is_asked_for_and_scaled(tmp_path: Path) -> None:
    bag = _imu(tmp_path / "bag", 1.0)
    with pytest.raises(ConfigError, match=r"median acceleration is 1\.0") as caught:
        read("ros_imu", bag, clock=UTC, sensor=IMU)
    assert caught.value.missing[0][0].proposed == "g"
    rows = read("ros_imu", bag, {"force_unit": "g"}, clock=UTC, sensor=IMU)
    assert rows["specific_force_z_m_per_s2"][0] == 9.80665


@pytest.mark.witness("stamps_of_a_bag")
@pytest.mark.parametrize(
    ("clock", "late_ns", "says"),
    [
        (UTC, lambda i: 2_000_000 + i % 7 * 100_000, None),
        (UTC, lambda i: 2_000_000 + (i > 300) * 400_000_000, "steps 1 times, by +0.400 s"),
        (UTC, lambda i: 2_000_000 + i * 100_000, "drift apart"),
        (UTC, lambda i: -37 * NS + 2_000_000, "clock.system = unix_tai"),
        (UTC, lambda i: -18 * NS + 2_000_000, "clock.system = unix_gps"),
        (GPST, lambda i: -18 * NS + 2_000_000, None),
        (UTC, lambda i: -70_000_000, "before their headers' stamps"),
        (UTC, lambda i: 5 * NS, "after the stamps of their headers"),
    ],
)
def test_the_stamps_of_header_and_arrival_are_compared(
    clock: Clock, late_ns: Any, says: str | None, tmp_path: Path
) -> None:
    rows = read("ros_imu", _imu(tmp_path / "bag", 9.8, late_ns), clock=clock, sensor=IMU)
    assert len(rows) == 600
    assert [one.text for one in rows.findings if says and says in one.text] if says else not rows.findings


def test_messages_without_a_stamp_can_be_placed_by_their_arrival(tmp_path: Path) -> None:
    bag = _imu(tmp_path / "bag", 9.8, header_ns=lambda i: 0)
    with pytest.raises(TimeSystemError, match="no stamp"):
        read("ros_imu", bag, clock=UTC, sensor=IMU)
    rows = read("ros_imu", bag, {"stamps": "receive"}, clock=UTC, sensor=IMU)
    assert rows.epochs[0] == T0 + 2_000_000 - 315_964_800 * NS + 18 * NS


def test_status_and_covariance_of_positions(tmp_path: Path) -> None:
    full = [4.0, 0.5, -0.1, 0.5, 9.0, 0.2, -0.1, 0.2, 16.0]  # east, north, up
    cases = [(-1, 3, full), (0, 3, full), (1, 2, full), (2, 0, full), (9, 3, full)]
    fixes = [
        (
            T0 + i * NS,
            {
                "header": header(T0 + i * NS),
                "latitude": 48.0,
                "longitude": 11.0,
                "altitude": 500.0,
                "status": {"status": status},
                "position_covariance": c,
                "position_covariance_type": kind,
            },
        )
        for i, (status, kind, c) in enumerate(cases)
    ]
    bag = write_bag(tmp_path / "bag", "sqlite", {"/fix": ("sensor_msgs/msg/NavSatFix", fixes)})
    rows = read("ros_gnss", bag, clock=UTC, crs="EPSG:4979")
    assert rows["quality"].tolist() == ["none", "single", "sbas", "dgps"]
    assert rows.reasons == {"the status is none of sensor_msgs/NavSatStatus"}
    one = {name: rows[name][1] for name in rows.table.column_names}
    assert [one[f"sigma_{a}_m"] for a in ("north", "east", "down")] == [3.0, 2.0, 4.0]
    found = [one[f"covariance_{a}_m2"] for a in ("ne", "nd", "ed")]
    np.testing.assert_allclose(found, [0.5, -0.2, 0.1], rtol=1e-6)  # down is the other way than up
    assert np.isnan(rows["covariance_ne_m2"][2])
    assert np.isnan(rows["sigma_north_m"][3])


def test_orthometric_altitudes_need_a_geoid(tmp_path: Path) -> None:
    fix = {"header": header(T0), "latitude": 48.0, "longitude": 11.0, "altitude": 500.0}
    bag = write_bag(tmp_path / "bag", "sqlite", {"/fix": ("sensor_msgs/msg/NavSatFix", [(T0, fix)])})
    with pytest.raises(RoadscanError, match="definition of NavSatFix"):
        read("ros_gnss", bag, clock=UTC, crs="EPSG:4979", height="orthometric")
    with pytest.raises(RoadscanError, match="no geoid"):
        read("ros_gnss", bag, {"altitude": "orthometric"}, clock=UTC, crs="EPSG:4979", height="orthometric")


def nmea_lines(count: int = 6) -> list[str]:
    """Sentences, the last one with the date of the epoch before it."""
    epochs = [f"1200{second:02d}.00" for second in range(count - 1)]
    lines = [f"$GPGGA,{e},4800.0000,N,01100.0000,E,4,12,0.8,500.0,M,46.5,M,1.0,0001*" for e in epochs]
    lines.append(f"$GPRMC,{epochs[-1]},A,4800.0000,N,01100.0000,E,0.0,0.0,140526,,,R*")
    return [line + f"{np.bitwise_xor.reduce(np.frombuffer(line[1:-1].encode(), np.uint8)):02X}" for line in lines]


def test_sentences_are_those_of_an_nmea_log(tmp_path: Path) -> None:
    sums = nmea_lines()
    (tmp_path / "a.nmea").write_text("\n".join(sums) + "\n")
    direct = read("nmea", tmp_path / "a.nmea", crs="EPSG:4979")
    for name, field in (("nmea_msgs/msg/Sentence", "sentence"), ("std_msgs/msg/String", "data")):
        messages = [(T0 + i, {field: text}) for i, text in enumerate(sums)]
        bag = write_bag(
            tmp_path / field,
            "mcap",
            {"/nmea": (name, messages), "/other": ("std_msgs/msg/String", [(T0, {"data": "x"})])},
        )
        assert format_of(bag).name == "ros_nmea"
        rows = read("ros_nmea", bag, crs="EPSG:4979")
        same(rows, direct, ("epoch_gps_ns", "x_world_m", "y_world_m", "z_world_m"))


def test_the_topic_is_asked_for_where_there_are_two(tmp_path: Path) -> None:
    imu = [(T0 + i * NS, {"header": header(T0 + i * NS), "linear_acceleration": {"z": 9.8}}) for i in range(3)]
    bag = write_bag(
        tmp_path / "bag", "mcap", {"/a/imu": ("sensor_msgs/msg/Imu", imu), "/b/imu": ("sensor_msgs/msg/Imu", imu[:2])}
    )
    with pytest.raises(ConfigError, match="2 topics") as caught:
        read("ros_imu", bag, clock=UTC, sensor=IMU)
    assert caught.value.missing[0][0].choices == ("/a/imu", "/b/imu")
    assert len(read("ros_imu", bag, {"topic": "/b/imu"}, clock=UTC, sensor=IMU)) == 2
    with pytest.raises(FormatError, match="no topic '/c'"):
        read("ros_imu", bag, {"topic": "/c"}, clock=UTC, sensor=IMU)
