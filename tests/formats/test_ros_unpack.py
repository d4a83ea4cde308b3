"""Pictures and pairs of stamps of a bag, read back by what they are for."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.core.survey import ClockConfig
from roadscan.formats.ros.overview import unpack
from roadscan.ingest import clock_pairs
from tests.answers import roadscan
from tests.formats.readings import read
from tests.formats.ros_files import NS, header, write_bag

_T0 = 1_700_000_000 * NS + 123_456_789


@pytest.mark.parametrize(
    ("encoding", "channels"), [("mono8", [0]), ("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("bgra8", [2, 1, 0])]
)
def test_raw_pictures(encoding: str, channels: list[int], tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    depth = {"mono8": 1, "bgra8": 4}.get(encoding, 3)
    pixels = rng.integers(0, 255, (7, 5, depth), np.uint8)
    rows = np.pad(pixels.reshape(7, -1), ((0, 0), (0, 3)))
    fields = {
        "header": header(_T0),
        "height": 7,
        "width": 5,
        "encoding": encoding,
        "step": rows.shape[1],
        "data": rows.ravel(),
    }
    broken = fields | {"data": rows.ravel()[:-9]}
    bag = write_bag(
        tmp_path / "bag", "mcap", {"/camera": ("sensor_msgs/msg/Image", [(_T0, fields), (_T0 + NS, broken)])}
    )
    done = roadscan("unpack", bag, "/camera", tmp_path / "pictures")
    assert done.exit_code == 0, done.output
    assert "message 1: the picture holds fewer bytes than its pixels need" in done.output
    found = np.asarray(Image.open(tmp_path / "pictures/000000.png"))
    np.testing.assert_array_equal(found, np.squeeze(pixels[:, :, channels]))


def test_compressed_pictures_are_read_with_their_stamps(tmp_path: Path) -> None:
    messages = []
    for k in range(3):
        stream = io.BytesIO()
        Image.fromarray(np.full((8, 6), 50 * k, np.uint8)).save(stream, "JPEG")
        data = np.frombuffer(stream.getvalue(), np.uint8)
        messages.append((_T0 + k * NS, {"header": header(_T0 + k * NS), "format": "jpeg", "data": data}))
    bag = write_bag(tmp_path / "bag", "ros1", {"/camera": ("sensor_msgs/msg/CompressedImage", messages)})
    assert unpack(bag, "/camera", tmp_path / "pictures").rows == 3
    rows = read("images", tmp_path / "pictures", clock=Clock(TimeSystem.UNIX_UTC), sensor=Sensor(kind="camera"))
    late_ns = rows.epochs - (_T0 + np.arange(3) * NS - 315_964_800 * NS + 18 * NS)
    assert np.abs(late_ns).max() < 200  # seconds of today as a double
    assert rows["file"].tolist() == ["000000.jpg", "000001.jpg", "000002.jpg"]
    assert rows["height_px"].tolist() == [8, 8, 8]


def test_pairs_put_a_count_from_power_on_on_gps_time(tmp_path: Path) -> None:
    """A clock that is 20 ppm fast and began at 12 s; messages arrive 1 to 8 ms late."""
    rng = np.random.default_rng(2)
    true_ns = _T0 + np.arange(600) * (NS // 10)
    count_ns = 12 * NS + ((true_ns - _T0) * 1.00002).astype(np.int64)
    late_ns = (1_000_000 + 7_000_000 * rng.random(600)).astype(np.int64)
    messages = [
        (int(t + late), {"header": header(int(c)), "linear_acceleration": {"z": 9.8}})
        for t, c, late in zip(true_ns, count_ns, late_ns, strict=True)
    ]
    bag = write_bag(tmp_path / "bag", "mcap", {"/imu": ("sensor_msgs/msg/Imu", messages)})
    unpack(bag, "/imu", tmp_path / "pairs")
    pairs = {"table": tmp_path / "pairs/pairs.csv", "system": "unix_utc", "arrivals": True, "sigma_s": 0.0005}
    config = ClockConfig.parse({"system": "free", "pairs": pairs})
    fit = clock_pairs._fitted(config.model_dump_json(), tmp_path / "pairs/pairs.csv", "").fit
    clock = Clock(TimeSystem.FREE, offset_s=fit.offset_s, drift_ppm=fit.drift * 1e6, reference_s=fit.reference_s)
    rows = read("ros_imu", bag, clock=clock, sensor=Sensor(kind="imu"))
    late = rows.epochs - (true_ns - 315_964_800 * NS + 18 * NS)
    assert np.abs(late - 1_000_000).max() < 300_000  # the least latency, which no statistics can find
    assert not rows.findings


def test_time_references_are_pairs(tmp_path: Path) -> None:
    messages = [
        (
            _T0 + k * NS,
            {"header": header((50 + k) * NS), "time_ref": {"sec": 1_700_000_000 + k, "nanosec": 5}, "source": "gps"},
        )
        for k in range(3)
    ]
    bag = write_bag(tmp_path / "bag", "sqlite", {"/time": ("sensor_msgs/msg/TimeReference", messages)})
    made = unpack(bag, "/time", tmp_path / "pairs")
    assert made.table.read_text().splitlines() == [
        "stamp,time",
        "50.000000000,1700000000.000000005",
        "51.000000000,1700000001.000000005",
        "52.000000000,1700000002.000000005",
    ]
