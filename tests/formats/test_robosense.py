"""RoboSense packets: written by the maker's descriptions and read back, clocks, damage, and what is not read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.ingest.reading.format import format_of
from tests.formats import ros_files
from tests.formats.readings import Readings, read
from tests.formats.robosense_files import BLOCK_US, MOMENT, angles_of, bag, difop, lasers_of, log_of, m1, msop, turning
from tests.formats.test_velodyne_pcap import gps_ns, posix_ns

MODELS = list(BLOCK_US)
RADIUS_M = {
    "RS-LiDAR-16": 0.03825, "RS-LiDAR-32": 0.03997, "Bpearl": 0.01473, "Helios": 0.03498, "Ruby": 0.03615,
    "Ruby Plus": 0.02892,
}  # fmt: skip
FIRED_US = {
    "RS-LiDAR-16": {(0, 1): 2.8, (0, 17): 55.5 + 2.8, (3, 15): 3 * 111 + 42.0},
    "RS-LiDAR-32": {(0, 15): 44.64, (1, 16): 55.52 + 1.44, (0, 31): 46.08},
    "Bpearl": {(0, 8): 25.68, (0, 15): 43.6, (2, 31): 2 * 55.52 + 44.88},
    "Helios": {(0, 1): 1.57, (1, 31): 55.56 + 45.15},
    "Ruby": {(0, 4): 3.236, (0, 64): 0.0, (2, 127): 2 * 55.55 + 48.54},
    "Ruby Plus": {(0, 4): 1.217, (0, 64): 25.278, (1, 127): 55.56 + 53.771},
}
"""Firing (µs) of slot c in block b: rs_driver's tables, and the Helios manual's."""


def options_of(model: str) -> dict[str, Any]:
    return {"model": model} if model.startswith("Ruby") else {}


def read_log(folder: Path, model: str, payloads: list[bytes]) -> Readings:
    return read("robosense_pcap", log_of(folder, payloads, difop(model)), options_of(model))


@pytest.mark.parametrize("model", MODELS)
def test_returns_are_those_of_the_description(tmp_path: Path, model: str) -> None:
    """Time, range, elevation and azimuth of each return, and the lens beside the axis."""
    log = read_log(tmp_path, model, turning(model, 40))
    assert format_of(tmp_path / "a.pcap").name == "robosense_pcap"
    assert log.rejected == 0
    assert log.attributes["model"] == model
    blocks, slots = (3, 128) if lasers_of(model) == 128 else (12, 32)
    assert len(log) == 40 * blocks * slots
    np.testing.assert_array_equal(log["laser"][:slots], np.arange(slots) % lasers_of(model))
    for (block, slot), fired_us in FIRED_US[model].items():
        row = block * slots + slot
        assert log.epochs[row] - gps_ns(MOMENT) == pytest.approx(fired_us * 1e3, abs=2)
        elevation, own = (np.radians(a[log["laser"][row]]) for a in angles_of(model))
        head = np.radians(20 + 3_600e-6 * fired_us)
        far = 2_000 * (0.0025 if model == "Helios" else 0.005)
        expected = (
            far * np.cos(elevation) * np.cos(head + own) + RADIUS_M[model] * np.cos(head),
            -far * np.cos(elevation) * np.sin(head + own) - RADIUS_M[model] * np.sin(head),
            far * np.sin(elevation) + (0.09427 if model == "Bpearl" else 0.0),
        )
        # Azimuths of 0.01° are good to 0.9 mm at 10 m.
        np.testing.assert_allclose(log.xyz_sensor_m[row], expected, atol=1.2e-3)
    assert set(log["intensity"]) == {7 * 257}


@pytest.mark.parametrize("model", MODELS)
def test_both_returns_of_a_firing_have_one_time_and_equal_ones_count_once(tmp_path: Path, model: str) -> None:
    blocks, slots = (3, 128) if lasers_of(model) == 128 else (12, 32)
    far = np.full((blocks, slots), 1_000)
    if model == "RS-LiDAR-16":
        far[:, 17:] = 2_000
    elif slots == 32:
        far[1::2, 1:] = 2_000
    log = read_log(tmp_path, model, turning(model, 8, both=True, far=far))
    assert log.attributes["returns"] == 2
    firings = 8 * (blocks if model == "RS-LiDAR-16" else blocks / 2)
    lasers = lasers_of(model)
    assert len(log) == firings * (2 * lasers - 1 if slots == 32 else lasers)
    first = log.epochs[log["laser"] == 1]
    period_us = 55.5 if model == "RS-LiDAR-16" else BLOCK_US[model]
    np.testing.assert_allclose(np.diff(np.unique(first)), period_us * 1e3, atol=1_000)


def test_an_m1_says_its_own_angles(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    low, high = (0, 31_500, 27_000, 0), (4_000, 34_000, 38_000, 255)
    points = [rng.integers(low, high, (25, 5, 4)) for _ in range(3)]
    log = read("robosense_pcap", log_of(tmp_path, [m1(s, 200 * k, points[k]) for k, s in enumerate((629, 630, 1))]))
    distance, pitch, yaw, bright = np.concatenate([p.reshape(-1, 4) for p in points]).T
    seen = distance > 0
    far, up, left = distance * 0.005, np.radians((pitch - 32_768) / 100), np.radians((yaw - 32_768) / 100)
    xyz = np.stack([far * np.cos(up) * np.cos(left), far * np.cos(up) * np.sin(left), far * np.sin(up)], axis=1)
    np.testing.assert_allclose(log.xyz_sensor_m, xyz[seen], atol=1e-5)
    np.testing.assert_array_equal(log["intensity"], (bright * 257)[seen])
    late_us = np.repeat(np.arange(3) * 200, 125) + np.tile(np.repeat(np.arange(25), 5), 3)
    np.testing.assert_array_equal(log.epochs - gps_ns(MOMENT), late_us[seen] * 1000)
    np.testing.assert_array_equal(np.unique(log["sweep"]), [0, 1])


def test_the_gap_of_a_view_is_waited_for(tmp_path: Path) -> None:
    """The blocks behind the gap are fired when the head is there; the packet is not taken for damage."""
    payloads = []
    for turn in range(3):
        for first, us in ((8_600, 0), (8_840, 666), (27_000, 51_000)):
            azimuths = [first + 20 * b for b in range(12)]
            if first == 8_840:
                azimuths[6:] = [26_880 + 20 * b for b in range(6)]
            payloads.append(msop("Helios", azimuths, 100_000 * turn + us))
    log = read_log(tmp_path, "Helios", payloads)
    assert log.rejected == 0
    block = log.epochs[384:768][::32] - gps_ns(MOMENT)
    assert block[6] - block[5] == pytest.approx((26_880 - 8_940) / 36_000 * 1e8, rel=0.05)
    assert block[11] - block[6] == pytest.approx(5 * 55_560, abs=10)


def test_damage_costs_the_packet(tmp_path: Path) -> None:
    payloads = turning("RS-LiDAR-32", 9)
    payloads[2] = payloads[2][:42] + b"\xfe" + payloads[2][43:]
    payloads[4] = payloads[4][:21] + b"\x0d" + payloads[4][22:]
    payloads[6] = payloads[5]
    log = read_log(tmp_path, "RS-LiDAR-32", payloads)
    assert log.reasons == {
        "a block does not begin with 0xFFEE",
        "date or time are impossible",
        "the packet stands twice in the log",
    }
    assert log.rejected == 3
    assert len(log) == 6 * 12 * 32


def test_what_is_not_known_is_asked_for(tmp_path: Path) -> None:
    helios = turning("Helios", 4)
    with pytest.raises(ConfigError, match="no DIFOP packet") as raised:
        read("robosense_pcap", log_of(tmp_path, helios))
    assert "Helios-16P" in str(raised.value)
    rows = "\n".join(f"{e},{a}" for e, a in zip(*angles_of("Helios"), strict=True))
    (tmp_path / "angle.csv").write_text(rows)
    assert len(read("robosense_pcap", log_of(tmp_path, helios), {"angles": "angle.csv"})) == 4 * 12 * 32
    with pytest.raises(FormatError, match="Ruby or Ruby Plus"):
        read("robosense_pcap", log_of(tmp_path, turning("Ruby", 4), difop("Ruby")))
    with pytest.raises(ConfigError, match="the packets are of a Helios"):
        read("robosense_pcap", log_of(tmp_path, helios, difop("Helios")), {"model": "Bpearl"})
    with pytest.raises(TimeSystemError, match="date and time"):
        read("robosense_pcap", log_of(tmp_path, helios, difop("Helios"), late_s=-37.0))


def test_a_model_with_other_figures_is_not_read(tmp_path: Path) -> None:
    """A Bpearl V4 has the head of older ones, and an RS-80 that of a Ruby with 80 channels a block."""
    newer = [p[:31] + b"\x03\x04" + p[33:] for p in turning("Bpearl", 4)]
    blocks = b"".join((b"\xfe\x01" + bytes(242)) for _ in range(4))
    eighty = [(turning("Ruby", 1)[0][:80] + blocks).ljust(1248, b"\0")] * 4
    for payloads in (newer, eighty):
        with pytest.raises(FormatError, match="no MSOP packet of a known RoboSense lidar"):
            read("robosense_pcap", log_of(tmp_path, payloads))


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_packets_in_a_bag(tmp_path: Path, kind: str) -> None:
    """The driver's topic holds both kinds of packets; older ones hold messages of a turn, without angles."""
    payloads = turning("Helios", 6)
    begin = posix_ns(MOMENT) + 1_000_000
    new = bag(tmp_path, kind)
    plain = read_log(tmp_path, "Helios", payloads)
    assert format_of(new).name == "robosense_scans"
    np.testing.assert_array_equal(read("robosense_scans", new).xyz_sensor_m, plain.xyz_sensor_m)
    packets = [{"stamp": ros_files.stamp(begin), "data": np.frombuffer(p, np.uint8)} for p in payloads]
    rows = [(begin, {"header": ros_files.header(begin), "packets": packets})]
    old = ros_files.write_bag(tmp_path / "old", kind, {"/packets": ("rslidar_msgs/msg/rslidarScan", rows)})
    (old.parent / "a.csv").write_text("\n".join(f"{e},{a}" for e, a in zip(*angles_of("Helios"), strict=True)))
    angles = {"angles": str((old.parent / "a.csv").resolve())}
    np.testing.assert_array_equal(read("robosense_scans", old, angles).epochs, plain.epochs)
