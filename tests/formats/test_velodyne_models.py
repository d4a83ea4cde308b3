"""VLP-32C and VLS-128: hand-made packets by the manuals, velodyne-decoder, calibration files, a bag's sweep, a gap."""

from __future__ import annotations

import datetime as dt
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import velodyne_decoder
import yaml
from scipy.spatial import cKDTree

from roadscan.core.errors import ConfigError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.formats.ros.bag import Bag, packets
from roadscan.ingest.reading.format import Reject, format_of
from tests.formats.readings import Readings, read
from tests.formats.test_hesai import polar, sweep_of
from tests.formats.test_velodyne_pcap import (
    CLOCK,
    DUAL,
    HOUR_9,
    HOUR_9_GPS,
    STRONGEST,
    Packets,
    capture,
    frame,
    posix_ns,
)

VLP_32C, VLS_128 = 0x28, 0xA1
THEIRS = {
    VLP_32C: (velodyne_decoder.Model.VLP32C, "VLP-32C.yml"),
    VLS_128: (velodyne_decoder.Model.VLS128, "Alpha Prime.yml"),
}
"""Models and calibrations of velodyne-decoder, from the files of VeloView."""
FLAGS = (0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF)
CYCLE_US = {VLP_32C: 55.296, VLS_128: 53.3}
RATE = 0.36  # 0.01° a µs, at 600 turns a minute


def packet(product: int, begin_us: float, far: np.ndarray, *, mode: int = STRONGEST) -> bytes:
    """A packet of an even turn whose first sequence begins at `begin_us`; distances (12, 32)."""
    dual = mode == DUAL
    out = b""
    for block in range(12):
        firing = block // (1 + dual)
        sequence, bank = divmod(firing, 4) if product == VLS_128 else (firing, 0)
        flag = FLAGS[bank]
        azimuth = round(RATE * (begin_us + sequence * CYCLE_US[product])) % 36_000
        if product == VLS_128 and dual and block >= 8:
            flag, azimuth = 0, 0  # filler
        out += struct.pack("<HH", flag, azimuth)
        out += b"".join(struct.pack("<HB", int(far[block, j]), 1 + j + 32 * firing % 7) for j in range(32))
    stamp_us = round(begin_us + (8.7 if product == VLS_128 else 0))
    return out + struct.pack("<IBB", stamp_us, mode, product)


def drive(product: int, count: int, *, mode: int = STRONGEST, seed: int = 3) -> Packets:
    rng = np.random.default_rng(seed)
    dual = mode == DUAL
    sequences = (1 if dual else 3) if product == VLS_128 else 12 // (1 + dual)
    packets = []
    for k in range(count):
        begin_us = 1_000_000 + k * sequences * CYCLE_US[product]
        far = rng.integers(500, 20_000, (12, 32))
        far[rng.random((12, 32)) < 0.1] = 0
        if dual:
            far[1::2, :4] = far[::2, :4]
        packets.append((posix_ns(HOUR_9) + round(begin_us * 1e3), frame(packet(product, begin_us, far, mode=mode))))
    return packets


def read_drive(folder: Path, packets: Packets, **options: Any) -> Readings:
    path = capture(folder / "a.pcap", packets, nanoseconds=True)
    return read("velodyne_pcap", path, {"hour": 9, **options}, clock=CLOCK)


@pytest.mark.parametrize("product", [VLP_32C, VLS_128])
def test_single_returns_decode_as_the_manual_says(tmp_path: Path, product: int) -> None:
    """VLP-32C manual 63-9325, 9.4 and 9.5; VLS-128 manual 63-9483, 9.4: pairs, and eights with a pause after eight."""
    packets = drive(product, 4)
    log = read_drive(tmp_path, packets)
    assert log.rejected == 0
    calibration = yaml.safe_load(velodyne_decoder.get_bundled_calibration(THEIRS[product][1]).to_string())
    lens_m = 0.0424 if product == VLP_32C else 0.05863
    expected = []
    for _, content in packets:
        payload = content[42:]
        stamp_us = struct.unpack_from("<I", payload, 1200)[0]
        for block in range(12):
            azimuth = struct.unpack_from("<H", payload, 100 * block + 2)[0] / 100
            for slot in range(32):
                units, bright = struct.unpack_from("<HB", payload, 100 * block + 4 + 3 * slot)
                if not units:
                    continue
                if product == VLP_32C:
                    laser, after_us = slot, 2.304 * (slot // 2)
                    fired_us = stamp_us + 55.296 * block + after_us
                else:
                    laser = 32 * (block % 4) + slot
                    after_us = 2.665 * (laser // 8 + laser // 64)
                    fired_us = stamp_us - 8.7 + 53.3 * (block // 4) + after_us
                own = calibration["lasers"][laser]
                alpha = math.radians(azimuth + RATE / 100 * after_us) - own["rot_correction"]
                rising, far = own["vert_correction"], units * 0.004
                level, rise = far * math.cos(rising), far * math.sin(rising) - lens_m * math.tan(rising)
                expected.append((fired_us, level * math.cos(alpha), -level * math.sin(alpha), rise, bright, laser))
    fired_us, x, y, z, bright, laser = np.array(expected).T
    np.testing.assert_allclose(log.epochs - HOUR_9_GPS, fired_us * 1e3, atol=1)
    np.testing.assert_array_equal(log["laser"], laser)
    np.testing.assert_array_equal(log["intensity"], bright * 257)
    # Azimuths of 0.01° give the head's rate to 1.5 %, which counts for 0.17° at most.
    np.testing.assert_allclose(log.xyz_sensor_m, np.stack([x, y, z], axis=1), atol=5e-3)


@pytest.mark.parametrize("product", [VLP_32C, VLS_128])
@pytest.mark.parametrize("mode", [STRONGEST, DUAL])
def test_returns_against_velodyne_decoder(tmp_path: Path, product: int, mode: int) -> None:
    """Count and height of each return, and of a VLP-32C its position and time: that program turns no VLS-128 on.

    It rounds azimuths to 0.01°, and gives groups of a VLS-128 2.89 µs where the manual has 2.665.
    """
    packets = drive(product, 6, mode=mode)
    log = read_drive(tmp_path, packets)
    assert log.rejected == 0
    config = velodyne_decoder.Config(
        model=THEIRS[product][0], min_range=0, max_range=1_000, timestamp_first_packet=True
    )
    data = [velodyne_decoder.VelodynePacket(ns / 1e9, content[42:]) for ns, content in packets]
    _, points = velodyne_decoder.ScanDecoder(config).decode(data, as_pcl_structs=True)
    assert len(points) == len(log)
    theirs, mine = np.stack([points[a] for a in "xyz"], axis=1).astype(float), log.xyz_sensor_m
    far = np.linalg.norm(theirs, axis=1)
    np.testing.assert_allclose(np.sort(far), np.sort(np.linalg.norm(mine, axis=1)), atol=1e-4)
    np.testing.assert_allclose(np.sort(theirs[:, 2]), np.sort(mine[:, 2]), atol=1e-4)
    if product == VLP_32C:
        off, nearest = cKDTree(mine).query(theirs)
        assert (off < 1e-4 + np.radians(0.0055) * far).all()
        assert np.unique(nearest).size == len(mine)
        passed = (log.epochs[nearest] - log.epochs[0]) / 1e9
        np.testing.assert_allclose(points["time"] - points["time"].min(), passed - passed.min(), atol=1e-6)


def test_a_vls_128_turns_on_between_packets_of_dual_return(tmp_path: Path) -> None:
    """A packet of dual return has one azimuth: the head's rate is that from packet to packet."""
    far = np.full((12, 32), 2_500)
    far[1::2] = 5_000
    packets = []
    for k in range(10):
        begin_us = 1_000_000 + k * 53.3
        content = frame(packet(VLS_128, begin_us, far, mode=DUAL))
        packets.append((posix_ns(HOUR_9) + round(begin_us * 1e3), content))
    log = read_drive(tmp_path, packets)
    assert len(log) == 10 * 256
    _, azimuth, _ = polar(log)
    laser = log["laser"].astype(int)
    own = np.array([6.354, 4.548, 2.732, 0.911, -0.911, -2.732, -4.548, -6.354])[laser % 8]
    after_us = 2.665 * (laser // 8 + laser // 64)
    begin = np.repeat([round(RATE * (1_000_000 + k * 53.3)) / 100 for k in range(10)], 256)
    off = (azimuth - own - begin - RATE / 100 * after_us + 180) % 360 - 180
    assert np.abs(off).max() < 0.01


def test_a_wrong_bank_costs_the_packet(tmp_path: Path) -> None:
    packets = drive(VLS_128, 6)
    time_ns, content = packets[3]
    packets[3] = time_ns, content[:142] + b"\xff\xcc" + content[144:]
    log = read_drive(tmp_path, packets)
    assert [r.record for r in log.rejects] == [3]
    assert log.reasons == {"a block does not begin with 0xEEFF 0xDDFF 0xCCFF 0xBBFF"}


def test_a_calibration_file_moves_and_turns_beams(tmp_path: Path) -> None:
    """velodyne_pointcloud's model: the offsets are at right angles to the beam, and to its vertical plane."""
    rows = [
        f"- {{laser_id: {k}, rot_correction: 0.1, vert_correction: 0.2, vert_offset_correction: 0.05, "
        "horiz_offset_correction: 0.03, dist_correction: 0.5}"
        for k in range(32)
    ]
    (tmp_path / "unit.yaml").write_text("\n".join(["num_lasers: 32", "distance_resolution: 0.004", "lasers:", *rows]))
    log = read_drive(tmp_path, drive(VLP_32C, 2), calibration="unit.yaml", azimuth="driver")
    plain = read_drive(tmp_path, drive(VLP_32C, 2))
    first = math.hypot(*plain.xyz_sensor_m[0, :2]) / math.cos(math.radians(25)) + 0.5  # laser 0 points 25° down
    alpha = math.radians(round(RATE * 1_000_000) % 36_000 / 100) - 0.1
    level = first * math.cos(0.2) - 0.05 * math.sin(0.2)
    x, y = level * math.cos(alpha) + 0.03 * math.sin(alpha), -level * math.sin(alpha) + 0.03 * math.cos(alpha)
    expected = [x, y, first * math.sin(0.2) + 0.05 * math.cos(0.2)]
    np.testing.assert_allclose(log.xyz_sensor_m[0], expected, atol=1e-4)


@pytest.mark.parametrize("text", ["", "lasers: 5", "lasers: []", "lasers:\n- {laser_id: 0, vert_correction: x}", "{"])
def test_a_calibration_file_that_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "unit.yaml").write_text(text)
    with pytest.raises(ConfigError, match="calibration"):
        read_drive(tmp_path, drive(VLP_32C, 2), calibration="unit.yaml")


# --- a recording --------------------------------------------------------------------------------------


def test_the_bag_against_the_sweep_of_another_program(recordings: Path) -> None:
    """Each point of the sweep within 5 mm, and as many returns.

    The sweep is the bag's first message, and of it blocks with azimuths from 270° to 90°. tier4/nebula (606ac41) treats
    the lasers of a VLP-32C as fired one by one: `azimuth = "driver"`.
    """
    folder = recordings / "lidars" / "velodyne_vlp32"
    options = {"hour": "capture", "azimuth": "driver", "calibration": folder / "VLP32.yaml"}
    log = read("velodyne_scans", folder / "bag", options)
    assert format_of(folder / "bag").name == "velodyne_scans"
    assert log.rejected == 0
    assert log.attributes["view_gap_centideg"] == pytest.approx([9_100, 27_000], abs=60)
    sweep = sweep_of(folder)
    with Bag.open(folder / "bag") as bag:
        sent = [p.payload for p in packets(bag, next(iter(bag.topics))) if not isinstance(p, Reject)]
    messages = sent[:76]
    blocks = np.frombuffer(b"".join(p[:1200] for p in messages), np.uint8).reshape(76, 12, 100)
    azimuth, units = blocks[:, :, 2] + 256 * blocks[:, :, 3].astype(int), blocks[:, :, 4:]
    measured = (units.reshape(76, 12, 32, 3)[..., :2] != 0).any(axis=3)
    wide = (azimuth <= 9_000) | (azimuth >= 27_000)
    rows = np.broadcast_to(wide[:, :, None], measured.shape)[measured]
    turn = log.xyz_sensor_m[: rows.size][rows]
    assert len(turn) == len(sweep)
    assert cKDTree(turn).query(sweep)[0].max() < 0.005
    assert cKDTree(sweep).query(turn)[0].max() < 0.005
    assert log.epochs.min() > 0


def test_the_gap_of_the_bags_view_is_waited_for(recordings: Path) -> None:
    """Blocks behind the gap are as far from the next packet as all blocks are from the next: 55.296 µs."""
    folder = recordings / "lidars" / "velodyne_vlp32"
    log = read("velodyne_scans", folder / "bag", {"hour": "capture"})
    firings = np.unique(log.epochs)
    steps = np.diff(firings)
    pauses = steps[steps > 10_000_000]
    assert pauses.size == 5
    np.testing.assert_allclose(pauses, 49.8e6, rtol=5e-3)
    near = steps[steps < 1_000_000]
    assert near.max() < 80_000


def test_a_bag_without_an_hour_asks_for_it(recordings: Path) -> None:
    with pytest.raises(TimeSystemError, match="the hour is not known"):
        read("velodyne_scans", recordings / "lidars" / "velodyne_vlp32" / "bag")
    clock = Clock(TimeSystem.UTC_HOUR, date=dt.date(2024, 4, 19))
    log = read("velodyne_scans", recordings / "lidars" / "velodyne_vlp32" / "bag", {"hour": 2}, clock=clock)
    capture_time = read("velodyne_scans", recordings / "lidars" / "velodyne_vlp32" / "bag", {"hour": "capture"})
    np.testing.assert_array_equal(log.epochs, capture_time.epochs)


def test_a_hi_res_has_its_own_angles(tmp_path: Path) -> None:
    """Elevations of velodyne-decoder's file; beams rise from where those of a VLP-16 cross the axis, within 1 mm."""
    packets = [(ns, content[:-1] + b"\x24") for ns, content in drive(VLP_32C, 2)]
    log = read_drive(tmp_path, packets)
    assert log.attributes["model"] == "VLP-16 Hi-Res"
    calibration = yaml.safe_load(velodyne_decoder.get_bundled_calibration("Puck Hi-Res.yml").to_string())
    elevation = np.array([laser["vert_correction"] for laser in calibration["lasers"]])[log["laser"]]
    x, y, z = log.xyz_sensor_m.T
    np.testing.assert_allclose(z - np.hypot(x, y) * np.tan(elevation), -0.0418 * np.tan(elevation), atol=1e-3)
