"""Velodyne captures: hand-made packets decoded by the manual, a recording against velodyne-decoder, hours, damage."""

from __future__ import annotations

import datetime as dt
import math
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import velodyne_decoder

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.readings import Readings, read

DATE = dt.date(2026, 5, 4)
CLOCK = Clock(TimeSystem.UTC_HOUR, date=DATE)
HDL_32E, VLP_16 = 0x21, 0x22
STRONGEST, LAST, DUAL = 0x37, 0x38, 0x39
PERIOD_US = {HDL_32E: 552.96, VLP_16: 1327.104}
"""From packet to packet, single return."""

Packets = list[tuple[int, bytes]]
"""Capture time (POSIX ns) and frame."""


def gps_ns(moment: dt.datetime) -> int:
    """GPS ns of a UTC moment after 2017, when GPS − UTC became 18 s."""
    delta = moment.replace(tzinfo=None) - dt.datetime(1980, 1, 6)
    return (delta // dt.timedelta(microseconds=1)) * 1000 + 18 * 10**9


def posix_ns(moment: dt.datetime) -> int:
    return (moment.replace(tzinfo=None) - dt.datetime(1970, 1, 1)) // dt.timedelta(microseconds=1) * 1000


HOUR_9 = dt.datetime(2026, 5, 4, 9, tzinfo=dt.UTC)
HOUR_9_GPS = gps_ns(HOUR_9)


# --- writing captures -------------------------------------------------------------------------------


def data_packet(
    stamp_us: int,
    azimuths: Iterable[int],
    distances: np.ndarray | int = 1000,
    *,
    mode: int = STRONGEST,
    product: int = HDL_32E,
    reflectivity: np.ndarray | int = 7,
) -> bytes:
    """1,206 bytes: distances and reflectivities (12, 32)."""
    far = np.broadcast_to(distances, (12, 32))
    bright = np.broadcast_to(reflectivity, (12, 32))
    out = b""
    for block, azimuth in enumerate(azimuths):
        out += struct.pack("<HH", 0xEEFF, azimuth % 36_000)
        out += b"".join(struct.pack("<HB", int(far[block, j]), int(bright[block, j])) for j in range(32))
    return out + struct.pack("<IBB", stamp_us, mode, product)


def position_packet(stamp_us: int, moment: dt.datetime, status: str = "A") -> bytes:
    """512 bytes with a GPRMC sentence."""
    body = f"GPRMC,{moment:%H%M%S}.00,{status},4807.038,N,01131.000,E,022.4,084.4,{moment:%d%m%y},003.1,W"
    check = 0
    for character in body.encode():
        check ^= character
    payload = bytearray(512)
    struct.pack_into("<I", payload, 198, stamp_us)
    sentence = f"${body}*{check:02X}\r\n".encode()
    payload[206 : 206 + len(sentence)] = sentence
    return bytes(payload)


def frame(payload: bytes, port: int = 2368, sender: str = "192.168.1.201", link: str = "ethernet") -> bytes:
    """Link, IPv4 and UDP headers before a payload."""
    udp = struct.pack(">HHHH", 443, port, 8 + len(payload), 0)
    address = bytes(map(int, sender.split(".")))
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 28 + len(payload), 1, 0, 64, 17, 0) + address + b"\xff\xff\xff\xff"
    links = {
        "ethernet": bytes.fromhex("ffffffffffff6076880000000800"),
        "vlan": bytes.fromhex("ffffffffffff607688000000810000050800"),
        "raw": b"",
        "cooked": bytes(14) + b"\x08\x00",
    }
    return links[link] + ip + udp + payload


def capture(path: Path, packets: Packets, *, order: str = "<", nanoseconds: bool = False, link: int = 1) -> Path:
    """Write a PCAP file."""
    magic = 0xA1B23C4D if nanoseconds else 0xA1B2C3D4
    out = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65_535, link)
    for time_ns, content in packets:
        seconds, rest = divmod(time_ns, 10**9)
        ticks = rest if nanoseconds else rest // 1000
        out += struct.pack(order + "IIII", seconds, ticks, len(content), len(content)) + content
    path.write_bytes(out)
    return path


def turning(start: int, step: float = 16.6) -> list[int]:
    """Azimuths of a packet's twelve blocks (0.01°)."""
    return [round(start + step * b) for b in range(12)]


def drive(count: int, first_us: float = 1_000_000.0, hour: dt.datetime = HOUR_9, **packet: Any) -> Packets:
    """`count` packets one after another, as a sensor sends them over an hour's end."""
    period = PERIOD_US[packet.get("product", HDL_32E)]
    packets = []
    for k in range(count):
        total_us = round(first_us + k * period)
        content = frame(data_packet(total_us % 3_600_000_000, turning(round(k * 12 * 16.6)), **packet))
        packets.append((posix_ns(hour) + total_us * 1000 + 400_000, content))
    return packets


# --- decoding by the manual -------------------------------------------------------------------------

HDL_32E_ELEVATIONS = [-30.67 if k == 0 else round(-92 / 3 + 4 / 3 * k, 2) for k in range(32)]
VLP_16_MANUAL = [
    (-15, 11.2), (1, -0.7), (-13, 9.7), (3, -2.2), (-11, 8.1), (5, -3.7), (-9, 6.6), (7, -5.1),
    (-7, 5.1), (9, -6.6), (-5, 3.7), (11, -8.1), (-3, 2.2), (13, -9.7), (-1, 0.7), (15, -11.2),
]  # fmt: skip
"""Elevation (°) and vertical correction (mm) by laser: VLP-16 user manual 63-9243, table 9-1."""


def by_the_manual(payload: bytes, first_gps_ns: int) -> list[tuple[Any, ...]]:
    """Every return of a single-return packet, one slot after another: epoch, x, y, z, reflectivity, laser."""
    product = payload[1205]
    azimuths = [struct.unpack_from("<H", payload, 100 * b + 2)[0] for b in range(12)]
    cycles = 1 if product == HDL_32E else 2
    cycle_ns, firing_ns = (46_080, 1_152) if product == HDL_32E else (55_296, 2_304)
    rate = ((azimuths[11] - azimuths[0]) % 36_000) / (11 * cycles * cycle_ns)  # 0.01° a ns
    found = []
    for block in range(12):
        for slot in range(32):
            units, bright = struct.unpack_from("<HB", payload, 100 * block + 4 + 3 * slot)
            if units == 0:
                continue
            if product == HDL_32E:
                laser = slot
                rising = HDL_32E_ELEVATIONS[slot // 2 + (16 if slot % 2 else 0)]
                height_m = hdl_32e_rise_mm(rising) / 1000
                within_ns = slot * firing_ns
            else:
                laser = slot % 16
                rising, rise_mm = VLP_16_MANUAL[laser]
                height_m = rise_mm / 1000
                within_ns = slot // 16 * cycle_ns + laser * firing_ns
            time_ns = block * cycles * cycle_ns + within_ns
            azimuth = math.radians((azimuths[block] + rate * within_ns) / 100)
            distance = units * 0.002
            level = distance * math.cos(math.radians(rising))
            x, y = level * math.cos(azimuth), -level * math.sin(azimuth)
            z = distance * math.sin(math.radians(rising)) + height_m
            found.append((first_gps_ns + time_ns, x, y, z, bright * 257, laser))
    return found


def hdl_32e_rise_mm(elevation_deg: float) -> float:
    """Height of a beam's origin: the beams of drawing 86-0106 meet at one point 28.95 mm behind the axis."""
    return -28.95 * math.tan(math.radians(elevation_deg))


def assert_decoded(log: Readings, expected: list[tuple[Any, ...]], rise_m: float) -> None:
    epochs, x, y, z, bright, laser = (np.array(column) for column in zip(*expected, strict=True))
    assert np.array_equal(log.epochs, epochs)
    assert np.array_equal(log["pose_epoch_gps_ns"], epochs)
    assert np.abs(log.xyz_sensor_m[:, :2] - np.stack([x, y], axis=-1)).max() < 3e-5  # float32 at 131 m
    assert np.abs(log["z_sensor_m"] - z).max() < rise_m
    assert np.array_equal(log["intensity"], bright)
    assert np.array_equal(log["laser"], laser)


@pytest.mark.parametrize("product", [HDL_32E, VLP_16])
def test_packets_decode_as_the_manual_says(tmp_path: Path, product: int) -> None:
    draw = np.random.default_rng(product)
    packets, expected = [], []
    for k in range(6):
        distances = draw.integers(0, 65_536, (12, 32)) * (draw.random((12, 32)) < 0.7)
        stamp_us = 1_234_567 + round(k * PERIOD_US[product])
        payload = data_packet(
            stamp_us,
            turning(35_800 + k * 200, 16.6 if product == HDL_32E else 39.8),
            distances,
            product=product,
            reflectivity=draw.integers(0, 256, (12, 32)),
        )
        packets.append((posix_ns(HOUR_9) + stamp_us * 1000, frame(payload)))
        expected += by_the_manual(payload, HOUR_9_GPS + stamp_us * 1000)
    path = capture(tmp_path / "a.pcap", packets)
    assert format_of(path).name == "velodyne_pcap"
    log = read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)
    assert log.rejects == []
    assert log.attributes["model"] == ("HDL-32E" if product == HDL_32E else "VLP-16")
    assert_decoded(log, expected, 2e-5)


def test_dual_returns_are_kept_once_where_they_agree(tmp_path: Path) -> None:
    distances = np.full((12, 32), 5000)
    distances[1::2, :16] = 4000  # strongest differs from last in half of the slots
    distances[0, 3] = 0  # no last return: only the strongest one is there
    azimuths = [1000 + 17 * (b // 2) for b in range(12)]
    payload = data_packet(10, azimuths, distances, mode=DUAL)
    log = read("velodyne_pcap", capture(tmp_path / "a.pcap", [(0, frame(payload))]), {"hour": 9}, clock=CLOCK)
    assert log.attributes["return_mode"] == "dual"
    assert len(log) == 6 * 32 + 6 * 16 - 1
    offsets = log.epochs - HOUR_9_GPS - 10_000
    # Both blocks of a pair were fired at the same time.
    assert np.array_equal(np.unique(offsets), np.unique(np.add.outer(46_080 * np.arange(6), 1_152 * np.arange(32))))
    lasers = log["laser"]
    assert ((lasers < 16) == (np.bincount(offsets // 1_152)[offsets // 1_152] == 2))[offsets != 3 * 1_152].all()
    azimuth = np.degrees(np.arctan2(-log["y_sensor_m"], log["x_sensor_m"])) % 360
    assert azimuth.min() == pytest.approx(10.0, abs=1e-4)
    assert azimuth.max() == pytest.approx(10.85 + 0.17 * 31 * 1_152 / 46_080, abs=1e-4)


def test_the_recording_against_velodyne_decoder(recordings: Path) -> None:
    """146,705 returns, all kept; positions and times as the published decoder finds them."""
    path = recordings / "velodyne" / "hdl32e.pcap"
    assert format_of(path).name == "velodyne_pcap"
    clock = Clock(TimeSystem.UTC_HOUR, date=dt.date(2011, 10, 28))
    log = read("velodyne_pcap", path, {"hour": 2}, clock=clock)
    assert (len(log), log.rejected) == (146_705, 0)
    assert np.bincount(log["sweep"]).size == 4  # three passes of 360°
    config = velodyne_decoder.Config(min_range=0, max_range=1000, timestamp_first_packet=True)
    scans = list(velodyne_decoder.read_pcap(str(path), config, as_pcl_structs=True))
    points = np.concatenate([scan.points for scan in scans])
    other = np.stack([points[a].astype(float) for a in "xyz"], axis=-1)
    assert np.abs(log["z_sensor_m"] - other[:, 2]).max() < 1e-5
    level, other_level = np.hypot(*log.xyz_sensor_m[:, :2].T), np.hypot(*other[:, :2].T)
    assert np.abs(level - other_level).max() < 2e-5
    turned = np.angle(np.exp(1j * (np.arctan2(*log.xyz_sensor_m[:, 1::-1].T) - np.arctan2(*other[:, 1::-1].T))))
    # The decoder rounds azimuths to 0.01° (and computes in float32), so it may be half of that away.
    assert np.degrees(np.abs(turned)).max() < 0.0051
    assert np.array_equal(log["intensity"], points["intensity"].astype(int) * 257)
    # Its packets' times are doubles of POSIX seconds, 238 ns apart; the host's hour stands before.
    after_ns = [np.rint(s.points["time"].astype(float) * 1e9).astype(np.int64) for s in scans]
    times_ns = [round(s.stamp.device * 1e6) * 1000 + after for s, after in zip(scans, after_ns, strict=True)]
    apart_ns = log.epochs - np.concatenate(times_ns) + 315_964_800 * 10**9
    assert np.abs(apart_ns - 15 * 10**9).max() < 250
    assert log.epochs[0] == gps_ns(dt.datetime(2011, 10, 28, 2)) - 3 * 10**9 + 835_374_683_000 + 1_152


def test_early_firmware_that_stamps_the_end_of_a_packet(tmp_path: Path) -> None:
    path = capture(tmp_path / "a.pcap", drive(1))
    begin = read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)
    end = read("velodyne_pcap", path, {"hour": 9, "stamp": "packet_end"}, clock=CLOCK)
    # Manual 63-9113, appendix E: −542.592 µs + 46.08 µs · block + 1.152 µs · laser.
    assert set((begin.epochs - end.epochs).tolist()) == {542_592}


def test_sweeps_end_where_the_azimuth_passes_a_turn(tmp_path: Path) -> None:
    packets = [(0, frame(data_packet(k * 553, turning(35_500 + 200 * k)))) for k in range(6)]
    log = read("velodyne_pcap", capture(tmp_path / "a.pcap", packets), {"hour": 9}, clock=CLOCK)
    azimuth = np.degrees(np.arctan2(-log["y_sensor_m"], log["x_sensor_m"])) % 360
    settled = (azimuth > 1) & (azimuth < 359)
    assert np.array_equal(log["sweep"][settled], (azimuth[settled] < 180).astype(int))


# --- hours ------------------------------------------------------------------------------------------


def test_the_hour_is_never_guessed(tmp_path: Path) -> None:
    path = capture(tmp_path / "a.pcap", drive(3))
    for clock in (None, CLOCK):
        with pytest.raises(TimeSystemError, match=r"hour is not known.*options\.hour = 9"):
            read("velodyne_pcap", path, clock=clock)
    with pytest.raises(TimeSystemError, match="without a date"):
        read("velodyne_pcap", path, {"hour": 9})
    with pytest.raises(ConfigError, match="0 to 23"):
        read("velodyne_pcap", path, {"hour": 24}, clock=CLOCK)
    with pytest.raises(TimeSystemError, match=r"clock\.system is 'unix_utc'"):
        read("velodyne_pcap", path, {"hour": 9}, clock=Clock(TimeSystem.UNIX_UTC))


def test_the_hour_from_a_sentence(tmp_path: Path) -> None:
    packets = drive(20)
    position = position_packet(1_005_000, HOUR_9 + dt.timedelta(seconds=1))
    packets.insert(10, (packets[10][0], frame(position, 8308)))
    path = capture(tmp_path / "a.pcap", packets)
    for clock, options in ((None, {}), (CLOCK, {}), (CLOCK, {"hour": 9})):
        log = read("velodyne_pcap", path, options, clock=clock)
        assert log.epochs[0] == HOUR_9_GPS + 10**9
        assert len(log) == 20 * 384
    with pytest.raises(TimeSystemError, match="GPRMC puts the first data packet into the hour from 2026-05-04T09"):
        read("velodyne_pcap", path, {"hour": 10}, clock=CLOCK)
    with pytest.raises(TimeSystemError, match="survey file says 2026-05-05"):
        read("velodyne_pcap", path, clock=Clock(TimeSystem.UTC_HOUR, date=dt.date(2026, 5, 5)))


@pytest.mark.parametrize("late", [0, 700_000])
def test_over_the_end_of_an_hour(tmp_path: Path, late: int) -> None:
    """The stamp starts again at 3,600 s, or some packets later; the sentence still names the second before."""
    first_us = 3_600_000_000 - 5 * 552.96
    packets: Packets = []
    for k in range(12):
        total_us = round(first_us + k * 552.96)
        stamp_us = total_us if total_us < 3_600_000_000 + late / 1000 else total_us - 3_600_000_000
        packets.append((posix_ns(HOUR_9) + total_us * 1000, frame(data_packet(stamp_us, turning(200 * k)))))
    sentence = position_packet(1_200, dt.datetime(2026, 5, 4, 9, 59, 59))
    packets.insert(9, (packets[9][0], frame(sentence, 8308)))
    path = capture(tmp_path / "a.pcap", packets)
    expected = HOUR_9_GPS + np.array([round(first_us + k * 552.96) * 1000 for k in range(12)])
    for options in ({}, {"hour": 9}):
        log = read("velodyne_pcap", path, options, clock=CLOCK)
        assert np.array_equal(log.epochs[::384], expected)


def test_over_midnight(tmp_path: Path) -> None:
    hour = dt.datetime(2026, 5, 4, 23, tzinfo=dt.UTC)
    packets = drive(2000, 3_599_500_000, hour)
    after = position_packet(2_000, dt.datetime(2026, 5, 5))
    packets.insert(950, (packets[950][0], frame(after, 8308)))
    log = read("velodyne_pcap", capture(tmp_path / "a.pcap", packets), clock=CLOCK)
    assert log.epochs[0] == gps_ns(hour) + 3_599_500_000_000
    assert (np.diff(log.epochs) > 0).all()
    assert log.epochs[-1] - log.epochs[0] == pytest.approx(1999 * 552_960 + 11 * 46_080 + 31 * 1_152, abs=1000)


def test_over_the_end_of_a_gps_week(tmp_path: Path) -> None:
    """Week 2418 begins on Saturday 2026-05-09 at 23:59:42 UTC, 18 s before the hour, the day and the UTC week end."""
    hour = dt.datetime(2026, 5, 9, 23, tzinfo=dt.UTC)
    packets: Packets = []
    for k in range(400):  # 20 s, a packet in 50 ms
        total_us = 3_600_000_000 - 19_000_000 + k * 50_000
        packets.append((posix_ns(hour) + total_us * 1000, frame(data_packet(total_us % 3_600_000_000, turning(0)))))
    path = capture(tmp_path / "a.pcap", packets)
    log = read("velodyne_pcap", path, {"hour": 23}, clock=Clock(TimeSystem.UTC_HOUR, date=hour.date()))
    week = 2418 * 604_800 * 10**9
    first = log.epochs.reshape(-1, 384)[:, 0]
    assert first[0] == week - 10**9  # a second before it
    assert (np.diff(first) == 50_000_000).all()  # nothing at either end
    assert week in first
    assert first[-1] > week + 18 * 10**9  # and on over midnight
    # The same seconds of the week as an SBET beside it would state them, in week 2418.
    trajectory = Clock(TimeSystem.GPS_WEEK, week=2418).to_epoch_gps_ns(np.array([0.0, 18.0]))
    assert trajectory.tolist() == [week, gps_ns(dt.datetime(2026, 5, 10))]


def test_over_several_hours(tmp_path: Path) -> None:
    """A packet in ten minutes for 30 hours: hours, a midnight and no drift of the count."""
    packets: Packets = []
    for k in range(181):
        total_us = 90_000_000 + k * 600_000_000
        packets.append((posix_ns(HOUR_9) + total_us * 1000, frame(data_packet(total_us % 3_600_000_000, turning(0)))))
    log = read("velodyne_pcap", capture(tmp_path / "a.pcap", packets), {"hour": 9}, clock=CLOCK)
    expected = HOUR_9_GPS + (90 + 600 * np.arange(181)) * 10**9
    assert np.array_equal(log.epochs[::384], expected)


@pytest.mark.parametrize("day", [dt.date(2015, 6, 30), dt.date(2016, 12, 31)])
def test_over_a_leap_second(tmp_path: Path, day: dt.date) -> None:
    """The last hour of such a day has 3,601 s; the receiver's 23:59:60 is stamped 3,600 s and more."""
    hour = dt.datetime(day.year, day.month, day.day, 23, tzinfo=dt.UTC)
    packets: Packets = []
    for k in range(45):  # from 23:59:57.5 on, ten a second
        total_us = 3_597_500_000 + k * 100_000
        stamp_us = total_us if total_us < 3_601_000_000 else total_us - 3_601_000_000
        packets.append((posix_ns(hour) + total_us * 1000, frame(data_packet(stamp_us, turning(0)))))
    path = capture(tmp_path / "a.pcap", packets)
    log = read("velodyne_pcap", path, {"hour": 23}, clock=Clock(TimeSystem.UTC_HOUR, date=day))
    before = 16 if day.year == 2015 else 17  # GPS − UTC that day (IERS Bulletin C)
    start = gps_ns(hour) - 18 * 10**9 + before * 10**9
    assert np.array_equal(log.epochs[::384], start + (3_597_500_000 + 100_000 * np.arange(45)) * 1000)
    # Midnight is one second later on the GPS scale than 86,400 s after the midnight before.
    midnight = gps_ns(dt.datetime(day.year, day.month, day.day) + dt.timedelta(days=1)) - (17 - before) * 10**9
    assert log.epochs[35 * 384] == midnight


def test_the_captures_clock_only_when_told(tmp_path: Path) -> None:
    path = capture(tmp_path / "a.pcap", drive(3))
    log = read("velodyne_pcap", path, {"hour": "capture"})
    assert log.epochs[0] == HOUR_9_GPS + 10**9
    assert log.attributes["capture_minus_sensor_s"] == pytest.approx(0.0004)
    with pytest.raises(TimeSystemError, match="capture's clock says 2026-05-04"):
        read("velodyne_pcap", path, {"hour": "capture"}, clock=Clock(TimeSystem.UTC_HOUR, date=dt.date(2026, 5, 3)))


def test_void_or_damaged_sentences_tell_nothing(tmp_path: Path) -> None:
    void = position_packet(1_000_000, HOUR_9 + dt.timedelta(seconds=1), status="V")
    damaged = position_packet(1_000_000, HOUR_9 + dt.timedelta(seconds=1)).replace(b"4807.038", b"4807.039")
    packets = [(0, frame(void, 8308)), (0, frame(damaged, 8308)), *drive(3)]
    with pytest.raises(TimeSystemError, match="hour is not known"):
        read("velodyne_pcap", capture(tmp_path / "a.pcap", packets))


def test_a_lidar_that_is_not_locked_is_refused(tmp_path: Path) -> None:
    position = position_packet(1_000_000, HOUR_9 + dt.timedelta(seconds=90))
    packets = [(0, frame(position, 8308)), *drive(3)]
    path = capture(tmp_path / "a.pcap", packets)
    with pytest.raises(TimeSystemError, match=r"-89\.0 s off the GPRMC"):
        read("velodyne_pcap", path)
    free = Clock(TimeSystem.FREE, offset_s=1.4e9)
    assert read("velodyne_pcap", path, clock=free).epochs[0] == 1_400_000_001 * 10**9


@pytest.mark.parametrize("sentences", [False, True])
def test_a_gap_of_hours_is_refused(tmp_path: Path, sentences: bool) -> None:
    before, after = drive(100), drive(1000, hour=HOUR_9 + dt.timedelta(hours=2))
    if sentences:
        for packets, hour in ((before, 9), (after, 11)):
            moment = dt.datetime(2026, 5, 4, hour, 0, 1)
            packets.insert(50, (packets[50][0], frame(position_packet(1_020_000, moment), 8308)))
    path = capture(tmp_path / "a.pcap", before + after)
    with pytest.raises(TimeSystemError, match="split the capture"):
        read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)


# --- sensors ----------------------------------------------------------------------------------------


def test_another_sensor_than_stated_is_refused(tmp_path: Path) -> None:
    path = capture(tmp_path / "a.pcap", drive(3))
    stated: dict[str, Any] = {"clock": CLOCK}
    assert len(
        read("velodyne_pcap", path, {"hour": 9}, sensor=Sensor(kind="lidar", model="Velodyne HDL-32E"), **stated)
    )
    with pytest.raises(ConfigError, match="the rig's sensor is 'VLP-16 Puck', the packets are HDL-32E"):
        read("velodyne_pcap", path, {"hour": 9}, sensor=Sensor(kind="lidar", model="VLP-16 Puck"), **stated)
    with pytest.raises(ConfigError, match=r"options\.model is VLP-16"):
        read("velodyne_pcap", path, {"hour": 9, "model": "VLP-16"}, **stated)
    with pytest.raises(ConfigError, match="only early HDL-32E"):
        vlp = capture(tmp_path / "b.pcap", drive(3, product=VLP_16))
        read("velodyne_pcap", vlp, {"hour": 9, "stamp": "packet_end"}, **stated)


def test_unknown_products_are_named(tmp_path: Path) -> None:
    path = capture(tmp_path / "a.pcap", [(0, frame(data_packet(5, turning(0), product=0x23)))])
    with pytest.raises(FormatError, match="the packets are VLP-32A/B"):
        read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)


def test_firmware_that_names_no_product(tmp_path: Path) -> None:
    path = capture(tmp_path / "a.pcap", [(0, frame(data_packet(5, turning(0), mode=0, product=0)))])
    with pytest.raises(FormatError, match=r"state options\.model"):
        read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)
    assert len(read("velodyne_pcap", path, {"hour": 9, "model": "HDL-32E"}, clock=CLOCK)) == 384


def test_two_sensors_are_told_apart_by_their_address(tmp_path: Path) -> None:
    packets = []
    for time, content in drive(5):
        packets += [(time, content), (time, frame(content[42:], sender="10.0.0.7"))]
    path = capture(tmp_path / "a.pcap", packets)
    with pytest.raises(FormatError, match=r"2 sensors sent to port 2368: 10\.0\.0\.7, 192\.168\.1\.201"):
        read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)
    log = read("velodyne_pcap", path, {"hour": 9, "sender": "10.0.0.7"}, clock=CLOCK)
    assert (len(log), log.rejects) == (5 * 384, [])


def test_other_ports(tmp_path: Path) -> None:
    packets = [(t, frame(c[42:], 2370)) for t, c in drive(2)]
    path = capture(tmp_path / "a.pcap", packets)
    with pytest.raises(FormatError, match=r"no Velodyne data packet was sent to port 2368.*options\.port"):
        read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)
    assert len(read("velodyne_pcap", path, {"hour": 9, "port": 2370}, clock=CLOCK)) == 2 * 384


# --- capture files ----------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("nanoseconds", [False, True])
def test_all_kinds_of_pcap(tmp_path: Path, order: str, nanoseconds: bool) -> None:
    path = capture(tmp_path / "a.pcap", drive(3), order=order, nanoseconds=nanoseconds)
    assert format_named("velodyne_pcap").sniff(path)
    log = read("velodyne_pcap", path, {"hour": "capture"})
    assert (len(log), log.rejects) == (3 * 384, [])


@pytest.mark.parametrize(("name", "link"), [("ethernet", 1), ("vlan", 1), ("raw", 101), ("cooked", 113)])
def test_link_types(tmp_path: Path, name: str, link: int) -> None:
    packets = [(t, frame(c[42:], link=name)) for t, c in drive(3)]
    path = capture(tmp_path / "a.pcap", packets, link=link)
    assert len(read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)) == 3 * 384


def test_pcapng_says_how_to_convert_it(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    path.write_bytes(b"\x0a\x0d\x0d\x0a" + bytes(24) + drive(1)[0][1] + bytes(600))
    assert format_of(path).name == "velodyne_pcap"
    with pytest.raises(FormatError, match="editcap -F pcap"):
        read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)


def test_other_captures_are_not_taken(tmp_path: Path) -> None:
    path = capture(tmp_path / "a.pcap", [(0, frame(bytes(1206)))])
    assert not format_named("velodyne_pcap").sniff(path)
    assert not format_named("velodyne_pcap").sniff(tmp_path)
    with pytest.raises(FormatError, match="no Velodyne data packet"):
        read("velodyne_pcap", path, {"hour": 9}, clock=CLOCK)


# --- damage -----------------------------------------------------------------------------------------


def test_a_damaged_packet_costs_itself(tmp_path: Path) -> None:
    packets = drive(40)
    changed = {
        3: ("a data packet is not 1,206 bytes long", lambda c: frame(c[42:-10])),
        5: ("a block does not begin with 0xEEFF", lambda c: c[: 42 + 300] + b"\0" + c[42 + 301 :]),
        8: ("the azimuth jumps", lambda c: c[: 42 + 403] + bytes([c[42 + 403] ^ 0x40]) + c[42 + 404 :]),
        11: ("an azimuth is 360° or more", lambda c: c[: 42 + 302] + b"\xff\xff" + c[42 + 304 :]),
        14: ("the product byte", lambda c: c[:-1] + b"\x22"),
        17: ("the return mode is unknown", lambda c: c[:-2] + b"\x01" + c[-1:]),
        20: ("more than 3,660 s", lambda c: c[:-6] + struct.pack("<I", 3_700_000_000) + c[-2:]),
        23: ("leaps out of the log's order", lambda c: c[:-6] + struct.pack("<I", 2_900_000_000) + c[-2:]),
        26: ("as long as a data packet", lambda c: c[:23] + b"\x06" + c[24:]),
        29: ("sent to another port", lambda c: frame(c[42:], 2369)),
        32: ("came from another sender", lambda c: frame(c[42:], sender="192.168.1.202")),
    }
    for number, (_, damage) in changed.items():
        if number != 32:
            packets[number] = (packets[number][0], damage(packets[number][1]))
    packets = packets[:1000] + drive(1100, 1_000_000 + 40 * 552.96)
    packets[1060] = (packets[1060][0], changed[32][1](packets[1060][1]))
    log = read("velodyne_pcap", capture(tmp_path / "a.pcap", packets), {"hour": 9}, clock=CLOCK)
    reasons = {r.record: r.reason for r in log.rejects}
    assert sorted(reasons) == [*sorted(set(changed) - {32}), 1060]
    for number, (reason, _) in changed.items():
        assert reason in reasons[1060 if number == 32 else number]
    assert len(log) == (1140 - len(changed)) * 384
    assert (np.diff(log.epochs) > 0).all()
    offsets = {r.record: r.offset for r in log.rejects}
    assert offsets[3] == 24 + 3 * (16 + 1248)
    assert offsets[5] == 24 + 5 * (16 + 1248) - 10


def test_a_wrong_first_stamp_does_not_move_the_hours(tmp_path: Path) -> None:
    packets = drive(10)
    packets[0] = (packets[0][0], packets[0][1][:-6] + struct.pack("<I", 3_000_000_000) + packets[0][1][-2:])
    log = read("velodyne_pcap", capture(tmp_path / "a.pcap", packets), {"hour": 9}, clock=CLOCK)
    assert [r.record for r in log.rejects] == [0]
    assert log.epochs[0] == HOUR_9_GPS + 1_000_553_000


def test_reading_goes_on_after_bytes_that_are_no_record(tmp_path: Path) -> None:
    data = capture(tmp_path / "a.pcap", drive(30)).read_bytes()
    record = 16 + 1248
    lost = data[: 24 + 10 * record + 500] + data[24 + 12 * record + 700 :]  # bytes lost over two records
    garbage = data[: 24 + 20 * record] + b"\xee" * 777 + data[24 + 20 * record :]
    cut = data[: 24 + 29 * record + 100]
    flag, skipped = "a block does not begin with 0xEEFF", "no packet record; bytes skipped to the next data packet"
    expected = {
        # Record 10 swallows the rest of 12 and the head of 13, whose own rest is no record.
        "lost": (26, {(10, 24 + 10 * record, flag), (11, 24 + 11 * record, skipped)}),
        "garbage": (30, {(20, 24 + 20 * record, skipped)}),
        "cut": (29, {(29, 24 + 29 * record, "the record is cut off")}),
    }
    for name, content in (("lost", lost), ("garbage", garbage), ("cut", cut)):
        (tmp_path / name).write_bytes(content)
        log = read("velodyne_pcap", tmp_path / name, {"hour": 9}, clock=CLOCK)
        assert (len(log) / 384, {(r.record, r.offset, r.reason) for r in log.rejects}) == expected[name]
