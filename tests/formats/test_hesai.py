"""Hesai packets: written by the manuals and read back, recordings against another program's sweeps, clocks, damage."""

from __future__ import annotations

import datetime as dt
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.formats.lidars.hesai_packets import crc_faults
from roadscan.ingest.reading.format import format_of
from tests.formats import ros_files
from tests.formats.hesai_files import DUAL, MOMENT, SHAPES, TRIPLE, angle_file, packet, turning
from tests.formats.readings import Readings, read
from tests.formats.test_velodyne_pcap import capture, frame, gps_ns, posix_ns

FREE = Clock(TimeSystem.FREE, offset_s=1e9)


def angles_of(model: str) -> tuple[np.ndarray, np.ndarray]:
    """Some angles, to three decimals as in the maker's files."""
    rng = np.random.default_rng(1)
    channels = SHAPES[model][1]
    return rng.uniform(-25, 15, channels).round(3), rng.uniform(-6, 6, channels).round(3)


def log_of(folder: Path, model: str, payloads: Sequence[bytes], *, late_s: float = 0.001, port: int = 2368) -> Path:
    """A capture of packets, and the angle file beside it."""
    angle_file(folder / "angles.csv", *angles_of(model))
    captured = posix_ns(MOMENT) + 10**9 + round(late_s * 1e9)
    frames = [(captured + k * 400_000, frame(p, port)) for k, p in enumerate(payloads)]
    return capture(folder / "a.pcap", frames, nanoseconds=True)


def read_log(folder: Path, model: str, payloads: Sequence[bytes], more: dict[str, Any] | None = None) -> Readings:
    options: dict[str, Any] = {"angles": "angles.csv"} | (more or {})
    if model in ("Pandar128", "OT128"):
        options["model"] = model
    return read("hesai_pcap", log_of(folder, model, payloads), options)


def polar(log: Readings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range (m), azimuth (° clockwise from x) and elevation (°) of the returns."""
    x, y, z = log.xyz_sensor_m.T
    return np.hypot(np.hypot(x, y), z), np.degrees(np.arctan2(-y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))


# --- the manuals ------------------------------------------------------------------------------------

FIRED_US = [
    ("Pandar40P", 10, 4, -28.58 - 3.62),
    ("Pandar40P", 1, 8, -28.58 - 9 * 55.56 - 54.67),
    ("Pandar64", 3, 5, -42.58 - 3 * 55.56 - 17.964),
    ("Pandar64", 6, 40, -42.58 - 54.668),
    ("PandarXT-16", 1, 16, 51.36 - 7 * 50),
    ("PandarXT-32", 8, 1, 6.0),
    ("PandarXT-32", 8, 32, 52.872),
    ("XT32M", 6, 16, 49.32),
    ("XT32M", 5, 17, 6.0 - 50),
    ("PandarQT", 1, 1, 25.71 + 12.31),
    ("PandarQT", 4, 56, 25.71 + 500 + 129.6),
    ("QT128", 1, 33, 9.0 - 111.11 + 27.656),
    ("QT128", 2, 1, 9.0 + 2.312),
    ("Pandar128", 2, 1, 3.148 + 4.436),
    ("Pandar128", 1, 128, 3.148 - 55.556 + 28.554),
    ("OT128", 2, 1, 3.148 + 46.645),
]
"""Model, block, channel (from 1) and time of firing after the packet's (µs): manuals, appendix "Laser firing time"."""

TURNED_US = {
    "Pandar40P": {4: -3.62, 8: -54.67}, "Pandar64": {5: -17.964, 40: -54.668}, "PandarXT-16": {1: 6.0, 16: 51.36},
    "PandarXT-32": {1: 6.0, 32: 52.872}, "XT32M": {1: 6.0, 16: 49.32, 17: 6.0}, "PandarQT": {1: 2.31, 64: 136.45},
    "OT128": {1: 46.645, 8: 0.0, 25: 20.52, 128: 0.0},
}  # fmt: skip
"""Firing times (µs) of channels by the maker's own firing-time files, which its SDK multiplies by the speed."""


@pytest.mark.parametrize(("model", "block", "channel", "fired_us"), FIRED_US)
def test_times_are_those_of_the_manual(tmp_path: Path, model: str, block: int, channel: int, fired_us: float) -> None:
    blocks, channels, _ = SHAPES[model]
    payloads = turning(model, 3)
    log = read_log(tmp_path, model, payloads)
    assert log.attributes["model"] == model
    assert len(log) == 3 * blocks * channels
    assert log.rejected == 0
    row = (block - 1) * channels + channel - 1
    assert log["laser"][row] == channel - 1
    assert log.epochs[row] - gps_ns(MOMENT) - 10**9 == pytest.approx(fired_us * 1e3, abs=1.5)


@pytest.mark.parametrize("model", list(SHAPES))
def test_positions_are_those_of_the_manual(tmp_path: Path, model: str) -> None:
    """Range of the packet, elevation of the file, azimuth of block and file, and what the head turned."""
    _, channels, _ = SHAPES[model]
    payloads = turning(model, 40)
    elevation, azimuth = angles_of(model)
    log = read_log(tmp_path, model, payloads)
    range_m, az, el = polar(log)
    np.testing.assert_allclose(range_m, 10.0, atol=2e-5)
    np.testing.assert_allclose(el, elevation[log["laser"]], atol=1e-4)
    first = 20 + azimuth
    for channel, turned_us in TURNED_US.get(model, {}).items():
        assert az[channel - 1] == pytest.approx(first[channel - 1] + 3600e-6 * turned_us, abs=2e-3)
    plain = read_log(tmp_path, model, payloads, {"azimuth": "driver"})
    np.testing.assert_allclose(polar(plain)[1][:channels], first, atol=1e-4)
    assert set(log["intensity"]) == {7 * 257}


@pytest.mark.parametrize(("model", "mode"), [("PandarXT-32", DUAL), ("XT32M", TRIPLE), ("Pandar64", DUAL)])
def test_returns_of_a_firing_have_one_time_and_equal_ones_count_once(tmp_path: Path, model: str, mode: int) -> None:
    blocks, channels, cycle_us = SHAPES[model]
    returns = 2 if mode == DUAL else 3
    far = np.full((blocks, channels), 1_000)
    far[1::returns] = 2_000
    far[1::returns, 0] = 1_000  # channel 1 has one return
    far[:, 3] = 0
    log = read_log(tmp_path, model, turning(model, 2, mode=mode, distances=far))
    firings = 2 * blocks // returns
    assert log.attributes["returns"] == returns
    assert len(log) == firings * (2 * (channels - 2) + 1)
    second = log.table.filter(np.array(log["laser"]) == 1)
    stamps = np.unique(second.column("epoch_gps_ns").to_numpy())
    assert stamps.size == firings
    np.testing.assert_allclose(np.diff(stamps[: firings // 2]), cycle_us * 1e3, atol=1)


def test_sequences_of_a_qt128_alternate(tmp_path: Path) -> None:
    """In dual return the mode flag says which of both sequences a packet holds (manual, 3.1.2.3)."""
    payloads = [packet("QT128", [2000, 2000], 1_000_000, mode=DUAL, flag=1, reflectivity=_two())]
    payloads.append(packet("QT128", [2040, 2040], 1_000_111, mode=DUAL, flag=0, reflectivity=_two()))
    log = read_log(tmp_path, "QT128", payloads)
    for k, (channel, fired_us) in enumerate([(33, 27.656), (1, 2.312)]):
        row = k * 256 + channel - 1
        assert log.epochs[row] - log.epochs.min() >= 0
        assert log.epochs[row] - gps_ns(MOMENT) - 10**9 - k * 111_000 == pytest.approx((9 + fired_us) * 1e3, abs=1.5)


def _two() -> np.ndarray:
    return np.array([[7], [9]])


def test_high_resolution_halves_the_cycle(tmp_path: Path) -> None:
    """Pandar128E3X manual, appendix: block 1 starts 27.778 µs before block 2, and its channels fire inside that time.

    Channels 1, 26, 29, 36 fire after 4.436, 10.381, 14.951 and 24.091 µs (azimuth state 0).
    """
    log = read_log(tmp_path, "Pandar128", turning("Pandar128", 3, flag=0))
    assert log.epochs[128] - log.epochs[0] == pytest.approx(27_778, abs=1)
    late = log.epochs[[25, 28, 35]] - log.epochs[0]
    np.testing.assert_allclose(late, [10_381 - 4_436, 14_951 - 4_436, 24_091 - 4_436], atol=800)


@pytest.mark.parametrize(("model", "front_m", "side_m"), [("PandarXT-32", 0.0315, 0.013), ("OT128", 0.04, 0.012)])
def test_beams_can_begin_at_the_optical_centre(tmp_path: Path, model: str, front_m: float, side_m: float) -> None:
    """The SDK's formula, to first order in offset over distance: less than 0.1 mm at 10 m."""
    _, channels, _ = SHAPES[model]
    elevation, own = (np.radians(a) for a in angles_of(model))
    log = read_log(tmp_path, model, turning(model, 40), {"optical_centre": True, "azimuth": "driver"})
    head = np.radians(20.0)
    distance = 10.0 - np.cos(elevation) * (front_m * np.cos(own) - side_m * np.sin(own))
    right = distance * np.cos(elevation) * np.sin(head + own) - side_m * np.cos(head) + front_m * np.sin(head)
    ahead = distance * np.cos(elevation) * np.cos(head + own) + side_m * np.sin(head) + front_m * np.cos(head)
    expected = np.stack([ahead, -right, distance * np.sin(elevation)], axis=1)
    np.testing.assert_allclose(log.xyz_sensor_m[:channels], expected, atol=1e-4)


def test_a_gap_of_the_view_is_waited_for(tmp_path: Path) -> None:
    """Blocks before and after the azimuths that the sensor leaves out are fired a part of a turn apart."""
    payloads, number = [], 0
    for turn in range(3):
        for k, first in enumerate([8_600, 8_744, 8_888, 9_032]):
            azimuths = [first + 18 * b for b in range(8)]
            begin_us = 1_000_000 + 100_000 * turn + 400 * k
            if k == 3:
                azimuths[4:] = [27_000 + 18 * b for b in range(4)]
                begin_us += (27_000 - 9_086) * 100_000 // 36_000 - 50
            payloads.append(packet("PandarXT-32", azimuths, begin_us, sequence=number))
            number += 1
    log = read_log(tmp_path, "PandarXT-32", payloads)
    assert log.rejected == 0
    block = log.epochs[3 * 256 :][:256].reshape(8, 32)[:, 0]
    before = log.epochs[2 * 256 :][:256].reshape(8, 32)[:, 0]
    assert block[0] - before[-1] == pytest.approx(50_000, abs=30_000)
    assert block[4] - block[3] == pytest.approx((27_000 - 9_086) / 36_000 * 1e8, rel=1e-3)
    assert block[7] - block[4] == pytest.approx(150_000, abs=2)


# --- recordings -------------------------------------------------------------------------------------


def sweep_of(folder: Path) -> np.ndarray:
    """The one sweep that tier4/nebula decoded (n, 3), its axes: x right, y ahead."""
    content = next(folder.glob("*.pcd")).read_bytes()
    return np.frombuffer(content.split(b"DATA binary\n", 1)[1], np.float32).reshape(-1, 3).astype(float)


@pytest.mark.parametrize(
    ("name", "angles", "turn", "least_m", "most_m"),
    [
        ("hesai_40p", "Pandar40P.csv", 2, 0.3, 200.0),
        ("hesai_xt32", "PandarXT32.csv", 3, 0.05, 120.0),
    ],
)
def test_recordings_against_the_sweeps_of_another_program(
    recordings: Path, name: str, angles: str, turn: int, least_m: float, most_m: float
) -> None:
    """Each point within 5 mm, and equal counts, within nebula's own range limits.

    That program does not add what the head turns until a firing. It cuts sweeps where each point's azimuth, not its
    block's, passes 0.
    """
    folder = recordings / "lidars" / name
    options = {"angles": folder / angles, "azimuth": "driver"}
    log = read("hesai_scans", folder / "bag", options, clock=FREE)
    assert format_of(folder / "bag").name == "hesai_scans"
    assert log.rejected == 0
    assert log.findings == []
    sweep = sweep_of(folder)
    own = np.loadtxt(folder / angles, delimiter=",", skiprows=1)[:, 2][log["laser"]]
    range_m, azimuth, _ = polar(log)
    azimuth %= 360
    block = np.round(azimuth - own, 2) % 360
    turns = log["sweep"] + ((block > 340) & (azimuth < 20)) - ((block < 20) & (azimuth > 340))
    kept = (turns >= turn) & (turns <= turn + 1) & (range_m > least_m - 1e-6) & (range_m < most_m)
    points = np.stack([-log.xyz_sensor_m[:, 1], log.xyz_sensor_m[:, 0], log.xyz_sensor_m[:, 2]], axis=1)
    far, nearest = cKDTree(points[kept]).query(sweep)
    assert far.max() < 0.005
    assert np.unique(nearest).size == len(sweep)
    own_turn = kept & (turns == turn)
    assert own_turn.sum() == len(sweep)
    strays = own_turn & (cKDTree(sweep).query(points)[0] > 1e-4)
    assert (np.minimum(azimuth, 360 - azimuth)[strays] < 0.2).all()


def test_a_sensor_that_nothing_set_is_told_by_the_drivers_stamps(recordings: Path) -> None:
    """The Pandar40P of the recording shows 2017, its driver 2023."""
    folder = recordings / "lidars" / "hesai_40p"
    with pytest.raises(TimeSystemError, match="-168,685,36") as raised:
        read("hesai_scans", folder / "bag", {"angles": folder / "Pandar40P.csv"})
    assert "free" in str(raised.value)


# --- clocks -----------------------------------------------------------------------------------------


@pytest.mark.witness("lidar_clock_unset")
@pytest.mark.parametrize(("late_s", "system"), [(-37.0, "unix_tai"), (-18.0, "unix_gps"), (3_600.0, "free")])
def test_a_clock_that_is_not_utc_is_refused_and_proposed(tmp_path: Path, late_s: float, system: str) -> None:
    path = log_of(tmp_path, "PandarXT-32", turning("PandarXT-32", 5), late_s=late_s)
    with pytest.raises(TimeSystemError, match="recording computer's clock") as raised:
        read("hesai_pcap", path, {"angles": "angles.csv"})
    assert raised.value.missing[0][0].proposed["system"] == system
    log = read("hesai_pcap", path, {"angles": "angles.csv"}, clock=Clock(TimeSystem.UNIX_TAI))
    assert log.epochs[7 * 32] == pytest.approx(gps_ns(MOMENT) + 10**9 + 6_000 - 37 * 10**9, abs=2)


def test_seconds_since_1970_in_place_of_the_date(tmp_path: Path) -> None:
    """Newer firmware can write 0 and five bytes of seconds, most significant first (SDK 2.0)."""
    payloads = turning("PandarXT-32", 3)
    at = 12 + 8 * 130 + 13
    seconds = int(MOMENT.timestamp()) + 1
    counted = [p[:at] + b"\0" + struct.pack(">Q", seconds)[3:] + p[at + 6 :] for p in payloads]
    np.testing.assert_array_equal(
        read_log(tmp_path, "PandarXT-32", counted).epochs, read_log(tmp_path, "PandarXT-32", payloads).epochs
    )


# --- damage -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("at", "value", "reason"),
    [
        (12, 0xFF, "the azimuth jumps inside the packet"),
        (13, 0xFF, "an azimuth is 360° or more"),
        (12 + 8 * 130 + 10, 0, "the return mode is unknown"),
        (12 + 8 * 130 + 14, 13, "date or time are impossible"),
        (7, 4, "the head is not that of the log"),
    ],
)
def test_a_damaged_packet_costs_itself(tmp_path: Path, at: int, value: int, reason: str) -> None:
    payloads = turning("PandarXT-32", 8)
    payloads[4] = payloads[4][:at] + bytes([value]) + payloads[4][at + 1 :]
    log = read_log(tmp_path, "PandarXT-32", payloads)
    assert [(r.reason, r.record, r.records) for r in log.rejects] == [(reason, 4, 1)]
    assert len(log) == 7 * 256


def test_a_block_of_a_pandar40p_without_its_mark(tmp_path: Path) -> None:
    payloads = turning("Pandar40P", 8)
    payloads[4] = payloads[4][:124] + b"\0" + payloads[4][125:]
    assert read_log(tmp_path, "Pandar40P", payloads).reasons == {"a block does not begin with 0xFFEE"}


def test_a_packet_with_a_wrong_checksum_is_rejected(tmp_path: Path) -> None:
    payloads = turning("QT128", 8)
    payloads[4] = payloads[4][:100] + bytes([payloads[4][100] ^ 1]) + payloads[4][101:]
    log = read_log(tmp_path, "QT128", payloads)
    assert [(r.reason, r.record) for r in log.rejects] == [("the checksum is wrong", 4)]


@pytest.mark.witness("lidar_checksum_unknown")
def test_checksums_of_an_unknown_rule_are_named(tmp_path: Path) -> None:
    log = read_log(tmp_path, "QT128", turning("QT128", 8, crc=17))
    assert log.rejected == 0
    assert [f.witness for f in log.findings] == ["lidar_checksum_unknown"]


@pytest.mark.parametrize(("kind", "value"), [("CRC-32", 0xCBF43926), ("CRC-32/MPEG-2", 0x0376E6E7)])
def test_checksums_have_their_published_check_values(kind: str, value: int) -> None:
    """Of "123456789" (catalogue of parametrised CRC algorithms)."""
    sound = b"123456789" + struct.pack("<I", value)
    assert crc_faults([sound, b"0" + sound[1:]], (0, 9), kind).tolist() == [False, True]


@pytest.mark.witness("lidar_packets_lost")
def test_lost_packets_are_counted_by_their_numbers(tmp_path: Path) -> None:
    payloads = turning("PandarXT-16", 30)
    log = read_log(tmp_path, "PandarXT-16", payloads[:10] + payloads[13:])
    assert [f.witness for f in log.findings] == ["lidar_packets_lost"]
    assert "3 data packets are missing" in str(log.findings[0])


def test_packets_that_stand_twice_count_once(tmp_path: Path) -> None:
    payloads = turning("PandarXT-16", 6)
    log = read_log(tmp_path, "PandarXT-16", [p for p in payloads for _ in range(2)])
    assert len(log) == 6 * 128
    assert log.rejected == 6


# --- statements -------------------------------------------------------------------------------------


def test_angles_have_to_be_stated(tmp_path: Path) -> None:
    path = log_of(tmp_path, "Pandar64", turning("Pandar64", 2))
    with pytest.raises(ConfigError, match="angles of this Pandar64 are not stated"):
        read("hesai_pcap", path)
    with pytest.raises(ConfigError, match="no angles by design"):
        read("hesai_pcap", path, {"angles": "design"})
    angle_file(tmp_path / "short.csv", np.zeros(40), np.zeros(40))
    with pytest.raises(ConfigError, match="has 40 channels"):
        read("hesai_pcap", path, {"angles": "short.csv"})


def test_the_xt_family_can_be_read_by_design(tmp_path: Path) -> None:
    log = read("hesai_pcap", log_of(tmp_path, "XT32M", turning("XT32M", 2)), {"angles": "design"})
    np.testing.assert_allclose(polar(log)[2][:32], 19.5 - 1.3 * np.arange(32), atol=1e-4)


def test_which_sensor_of_128_channels_has_to_be_stated(tmp_path: Path) -> None:
    path = log_of(tmp_path, "OT128", turning("OT128", 2))
    with pytest.raises(FormatError, match="Pandar128 or OT128"):
        read("hesai_pcap", path, {"angles": "angles.csv"})
    sensor = Sensor(kind="lidar", model="Hesai OT128")
    assert read("hesai_pcap", path, {"angles": "angles.csv"}, sensor=sensor).attributes["model"] == "OT128"
    with pytest.raises(ConfigError, match=r"options\.model is OT128"):
        read("hesai_pcap", log_of(tmp_path, "QT128", turning("QT128", 2)), {"angles": "angles.csv", "model": "OT128"})


def test_a_capture_is_known_by_its_packets(tmp_path: Path) -> None:
    for model in SHAPES:
        assert format_of(log_of(tmp_path, model, turning(model, 2), port=9_000)).name == "hesai_pcap"
    with pytest.raises(FormatError, match="no data packet of a known Hesai"):
        read("hesai_pcap", tmp_path / "a.pcap", {"angles": "angles.csv"})


def test_sweeps_end_where_the_azimuth_passes_360(tmp_path: Path) -> None:
    log = read_log(tmp_path, "PandarXT-16", turning("PandarXT-16", 8, start_deg=358.0))
    _, azimuth, _ = polar(
        read_log(tmp_path, "PandarXT-16", turning("PandarXT-16", 8, start_deg=358.0), {"azimuth": "driver"})
    )
    own = angles_of("PandarXT-16")[1][log["laser"]]
    passed = (np.round(azimuth - own, 2) % 360) < 180
    np.testing.assert_array_equal(log["sweep"], passed.astype(int))


def test_a_year_is_counted_from_the_right_one(tmp_path: Path) -> None:
    """Old sensors count years from 2000, newer ones from 1900."""
    for model in ("Pandar40P", "PandarXT-32"):
        log = read_log(tmp_path, model, turning(model, 2))
        assert abs(log.epochs[0] - gps_ns(MOMENT + dt.timedelta(seconds=1))) < 10**6


# --- bags -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
@pytest.mark.parametrize("message", ["pandar_msgs/msg/PandarScan", "nebula_msgs/msg/NebulaPackets"])
def test_a_bag_gives_what_a_capture_gives(tmp_path: Path, kind: str, message: str) -> None:
    payloads = turning("QT128", 9)
    begin_ns = posix_ns(MOMENT) + 10**9

    def sent(k: int) -> dict[str, Any]:
        data = np.frombuffer(payloads[k], np.uint8)
        own = {"stamp": ros_files.stamp(begin_ns + k * 400_000), "data": data}
        return (
            own
            if message.startswith("nebula")
            else own | {"data": np.pad(data, (0, 1500 - data.size)), "size": data.size}
        )

    rows = [
        (begin_ns + k, {"header": {"frame_id": "top"}, "packets": [sent(k), sent(k + 1), sent(k + 2)]})
        for k in (0, 3, 6)
    ]
    path = ros_files.write_bag(tmp_path / "bag", kind, {"/lidar": (message, rows)})
    angles = angle_file(tmp_path / "angles.csv", *angles_of("QT128"))
    assert format_of(path).name == "hesai_scans"
    log = read("hesai_scans", path, {"angles": angles})
    direct = read_log(tmp_path, "QT128", payloads)
    assert log.table.equals(direct.table)
    with pytest.raises(FormatError, match="no topic '/lidr'"):
        read("hesai_scans", path, {"angles": angles, "topic": "/lidr"})
