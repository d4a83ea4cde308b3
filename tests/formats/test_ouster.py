"""Ouster: every profile against ouster-sdk, recordings pixel by pixel, damage, clocks, metadata, IMU packets."""

from __future__ import annotations

import hashlib
import json
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.formats.lidars.ouster_metadata import metadata_of, read_metadata
from roadscan.formats.lidars.ouster_packets import is_lidar_packet, optics_of
from roadscan.ingest.inspect.inspect import inspect
from roadscan.ingest.reading.format import LogSource, Rows, format_named, format_of
from tests.formats import ouster_files as files
from tests.formats.readings import Readings, read
from tests.formats.test_velodyne_pcap import capture, frame

FREE = Clock(TimeSystem.FREE)
OPTIONS = {"metadata": "a.json"}

SDK: dict[str, tuple[int, list[float]]] = {
    "LEGACY": (5478, [1805040.97, 1804771.58, 567754.33]),
    "RNG19_RFL8_SIG16_NIR16": (5478, [902748.15, 902620.48, 283942.18]),
    "RNG19_RFL8_SIG16_NIR16_DUAL": (10932, [1791277.7, 1783972.33, 557541.97]),
    "RNG15_RFL8_NIR8": (5478, [454583.41, 454553.91, 142975.59]),
    "RNG15_RFL8_NIR8_DUAL": (10922, [909329.58, 901585.62, 283655.73]),
    "FUSA_RNG15_RFL8_NIR8_DUAL": (10922, [909329.58, 901585.62, 283655.73]),
    "FIVE_WORD_PIXEL": (10932, [1791277.7, 1783972.33, 557541.97]),
    "RNG15_RFL8_NIR8_ZONE16": (5478, [454583.41, 454553.91, 142975.59]),
    "RNG19_RFL8_SIG16_NIR16_ZONE16": (5478, [902748.15, 902620.48, 283942.18]),
    "RNG15_RFL8_WIN8": (5478, [454583.41, 454553.91, 142975.59]),
    "RNG19_RFL8_SIG16_ZONE16_DUAL": (10932, [1791277.7, 1783972.33, 557541.97]),
    "RNG19_RFL8_SIG16_NIR16_RGB16": (5478, [902748.15, 902620.48, 283942.18]),
    "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": (10932, [1791277.7, 1783972.33, 557541.97]),
}
"""Returns of `files.turns(profile)`, and Σ|x|, Σ|y|, Σ|z| (m): computed with ouster-sdk 1.0.1 from the same bytes and
metadata (PacketFormat.packet_field of RANGE and RANGE2, and XYZLut without extrinsics)."""

SDK_SWEEPS_M = [
    [1081754.911, 1080852.341, 272779.355],
    [1078603.813, 1079590.989, 272128.883],
    [1084872.323, 1086632.017, 273520.156],
]
"""Σ|x|, Σ|y|, Σ|z| (m) of the sweeps of a recording, likewise."""


def read_ouster(path: Path, clock: Clock = FREE, **options: Any) -> Readings:
    return read("ouster_pcap", path, OPTIONS | options, clock=clock)


def ranges_mm(found: Readings, metadata: Path) -> np.ndarray:
    """Ranges (n,) in whole millimetres of rows, by their distance from where their beam begins."""
    known = read_metadata(metadata)
    optics = optics_of(known)
    stamps = found.epochs - files.FIRST_NS
    columns = (stamps % 100_000_000) // (100_000_000 // files.COLUMNS)
    way_m = np.linalg.norm(found.xyz_sensor_m.astype(float) - optics.origins_m[columns], axis=1)
    return np.rint(way_m * 1e3 + float(optics.origin_mm)).astype(np.int64)


# --- profiles ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", files.PIXELS)
def test_each_profile_gives_the_returns_that_were_written_and_the_positions_of_ouster_sdk(
    profile: str, tmp_path: Path
) -> None:
    packets = files.turns(profile)
    path = files.write(tmp_path, packets, files.metadata(profile))
    assert all(is_lidar_packet(packet) for packet in packets)
    assert format_of(path).name == "ouster_pcap"
    found = read_ouster(path)
    assert found.rejects == []
    assert found.findings == []
    count, sums_m = SDK[profile]
    assert len(found) == count
    np.testing.assert_allclose(np.abs(found.xyz_sensor_m.astype(float)).sum(axis=0), sums_m, rtol=1e-7)

    written: dict[str, list[np.ndarray]] = {"range": [], "bright": [], "laser": [], "epoch": []}
    for k in range(len(packets)):
        fields = files.pixels(profile, k)
        names = [name for name in ("RANGE", "RANGE2") if name in fields]
        ranges = np.stack([fields[name] for name in names], axis=-1) * (8 if "RNG15" in profile else 1)
        bright = np.stack([fields["REFLECTIVITY" + name[5:]] for name in names], axis=-1)
        at = np.nonzero(ranges)
        written["range"].append(ranges[at])
        written["bright"].append(bright[at] * 257)
        written["laser"].append(at[1])
        written["epoch"].append(files.stamps_of(k * files.PACKET_COLUMNS, 0)[at[0]])
    assert np.array_equal(found.epochs, np.concatenate(written["epoch"]))
    assert np.array_equal(found["laser"], np.concatenate(written["laser"]))
    assert np.array_equal(found["intensity"], np.concatenate(written["bright"]))
    assert np.array_equal(ranges_mm(found, tmp_path / "a.json"), np.concatenate(written["range"]))


def test_signal_is_kept_as_recorded(tmp_path: Path) -> None:
    profile = "RNG19_RFL8_SIG16_NIR16_DUAL"
    path = files.write(tmp_path, files.turns(profile)[:1], files.metadata(profile))
    fields = files.pixels(profile, 0)
    ranges = np.stack([fields["RANGE"], fields["RANGE2"]], axis=-1)
    signal = np.stack([fields["SIGNAL"], fields["SIGNAL2"]], axis=-1)
    assert np.array_equal(read_ouster(path, intensity="signal")["intensity"], signal[ranges > 0])


def test_low_bandwidth_has_no_signal(tmp_path: Path) -> None:
    path = files.write(tmp_path, files.turns("RNG15_RFL8_NIR8"), files.metadata("RNG15_RFL8_NIR8"))
    with pytest.raises(ConfigError, match="has no signal"):
        read_ouster(path, intensity="signal")


def test_firmware_before_2_1_writes_reflectivity_of_16_bits(tmp_path: Path) -> None:
    old = files.metadata("LEGACY", image_rev="ousteros-image-prod-aries-v2.0.0+20201023")
    assert metadata_of(json.dumps(old), tmp_path).reflectivity_bits == 16
    assert metadata_of(json.dumps(files.metadata("LEGACY")), tmp_path).reflectivity_bits == 8


def test_flat_metadata_of_firmware_2_are_the_same(tmp_path: Path) -> None:
    sections = files.metadata("LEGACY")
    packets = files.turns("LEGACY")
    path = files.write(tmp_path, packets, sections)
    expected = read_ouster(path)
    files.write(tmp_path, packets, files.flat(sections))
    found = read("ouster_pcap", path, OPTIONS, clock=FREE)
    assert found.attributes["timestamp_mode"] == ""
    assert found.table.equals(expected.table)


def test_firmware_1_12_states_neither_format_nor_beam_origin(tmp_path: Path) -> None:
    """Keys of a file of 2019 (64 pixels a column, 16 columns a packet): what it lacks is as the maker's tables say."""
    root = {
        "beam_altitude_angles": [16.5 - k / 2 for k in range(64)],
        "beam_azimuth_angles": [3.0] * 64,
        "build_rev": "v1.12.0",
        "lidar_mode": "1024x10",
        "prod_line": "OS-1-64",
        "prod_sn": "991913000010",
    }
    known = metadata_of(json.dumps(root), tmp_path)
    assert (known.rows, known.columns, known.packet_columns, known.profile_name) == (64, 1024, 16, "LEGACY")
    assert known.beam_to_lidar_mm[0, 3] == 15.806
    assert known.lidar_to_sensor_mm[2, 3] == 36.18


# --- recordings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "capture_name", "counts"),
    [
        ("OS-0-128-U1_v2.3.0_1024x10", "OS-0-128-U1_v2.3.0_1024x10", [97_299]),
        ("OS-1-128_v2.3.0_1024x10", "OS-1-128_v2.3.0_1024x10_lb_n3", [107_647, 107_357, 107_532]),
    ],
)
def test_recordings_hold_the_returns_of_ouster_sdk(
    name: str, capture_name: str, counts: list[int], recordings: Path
) -> None:
    folder = recordings / "lidars" / "ouster"
    found = read_ouster(folder / f"{capture_name}.pcap", metadata=str(folder / f"{name}.json"))
    assert np.bincount(found["sweep"]).tolist() == counts
    assert found.rejects == []
    assert found.findings == []


def test_ranges_and_stamps_of_a_recording_have_the_makers_digests(recordings: Path) -> None:
    """`…_digest.json` holds MD5 of the channels as ouster-sdk decoded them, by row and column."""
    folder = recordings / "lidars" / "ouster"
    metadata = folder / "OS-0-128-U1_v2.3.0_1024x10.json"
    found = read_ouster(metadata.with_suffix(".pcap"), metadata=str(metadata))
    (scan,) = json.loads((folder / "OS-0-128-U1_v2.3.0_1024x10_digest.json").read_text())["scans"]
    stamps = np.unique(found.epochs)
    assert stamps.size == 1024
    assert hashlib.md5(stamps.astype("<u8").tobytes(), usedforsecurity=False).hexdigest() == scan["TIMESTAMP"]
    columns = np.searchsorted(stamps, found.epochs)
    optics = optics_of(read_metadata(metadata))
    way_m = np.linalg.norm(found.xyz_sensor_m.astype(float) - optics.origins_m[columns], axis=1)
    ranges, bright = np.zeros((128, 1024), "<u4"), np.zeros((128, 1024), "u1")
    ranges[found["laser"], columns] = np.rint(way_m * 1e3 + float(optics.origin_mm))
    bright[found["laser"], columns] = found["intensity"] // 257
    assert hashlib.md5(ranges.tobytes(), usedforsecurity=False).hexdigest() == scan["RANGE"]
    measured = ranges > 0
    assert bright[measured].any()


def test_positions_of_a_recording_are_those_of_ouster_sdk(recordings: Path) -> None:
    """Σ|x|, Σ|y|, Σ|z| (m) of each sweep: XYZLut of ouster-sdk 1.0.1 without extrinsics, on its ranges above 0."""
    folder = recordings / "lidars" / "ouster"
    metadata = folder / "OS-1-128_v2.3.0_1024x10.json"
    found = read_ouster(folder / "OS-1-128_v2.3.0_1024x10_lb_n3.pcap", metadata=str(metadata))
    sums = [np.abs(found.xyz_sensor_m[found["sweep"] == k].astype(float)).sum(axis=0) for k in range(3)]
    np.testing.assert_allclose(sums, SDK_SWEEPS_M, rtol=1e-6)


def test_decodes_millions_of_returns_a_second(recordings: Path) -> None:
    """20 million a second are measured on one core of 2020, with the capture's reading; a machine of tests is busy."""
    folder = recordings / "lidars" / "ouster"
    options = {"metadata": str(folder / "OS-1-128_v2.3.0_1024x10.json")}
    log_format = format_named("ouster_pcap")
    source = LogSource(folder / "OS-1-128_v2.3.0_1024x10_lb_n3.pcap", log_format.options.parse(options), FREE)
    header = log_format.header(source)
    best_s = 10.0
    for _ in range(5):
        begin = time.thread_time()
        count = sum(item.batch.num_rows for item in log_format.read(source, header) if isinstance(item, Rows))
        best_s = min(best_s, time.thread_time() - begin)
    assert count / best_s > 4e6


# --- damage -----------------------------------------------------------------------------------------


def test_a_wrong_checksum_costs_its_packet(tmp_path: Path) -> None:
    profile = "RNG19_RFL8_SIG16_NIR16"
    packets = files.turns(profile, checksum=True)
    whole = read_ouster(files.write(tmp_path, packets, files.metadata(profile)))
    assert whole.attributes["checksum"] is True
    packets[3] = packets[3][:200] + bytes([packets[3][200] ^ 1]) + packets[3][201:]
    found = read_ouster(files.write(tmp_path, packets, files.metadata(profile)))
    assert [(r.reason, r.record) for r in found.rejects] == [("the packet's checksum (CRC-64) is wrong", 3)]
    lost = np.isin(whole.epochs, files.stamps_of(3 * files.PACKET_COLUMNS, 0))
    assert found.table.equals(whole.table.filter(~lost))


def test_columns_that_were_not_measured_and_short_ranges_are_no_returns(tmp_path: Path) -> None:
    profile = "RNG19_RFL8_SIG16_NIR16"
    fields = files.pixels(profile, 0)
    fields["RANGE"][:, 0] = 10  # mm
    states = np.ones(files.PACKET_COLUMNS, np.int64)
    states[5] = 0
    packet = files.lidar_packet(profile, fields, 0, 1, files.stamps_of(0, 0), status=states)
    found = read_ouster(files.write(tmp_path, [packet], files.metadata(profile)))
    usable = fields["RANGE"][states > 0] > 10
    assert len(found) == usable.sum()
    assert files.stamps_of(0, 0)[5] not in found.epochs
    assert found.rejects == []
    assert [f.left_out for f in found.findings] == [files.PACKET_COLUMNS - 1]


@pytest.mark.witness("ouster_ranges_inside")
def test_ranges_inside_the_sensor_are_named(tmp_path: Path) -> None:
    fields = files.pixels("LEGACY", 0)
    fields["RANGE"][2, 3] = 16  # the beam's own way is √(15.806² + 2.5²) mm
    fields["RANGE"][2, 4] = 17
    packet = files.lidar_packet("LEGACY", fields, 0, 1, files.stamps_of(0, 0))
    found = read_ouster(files.write(tmp_path, [packet], files.metadata("LEGACY")))
    (finding,) = found.findings
    assert "1 ranges are shorter than the 16.0 mm" in finding.text


@pytest.mark.witness("ouster_packets_twice")
def test_packets_that_stand_twice_count_once_and_others_are_put_in_order(tmp_path: Path) -> None:
    profile = "RNG15_RFL8_NIR8"
    packets = files.turns(profile, 2)
    whole = read_ouster(files.write(tmp_path, packets, files.metadata(profile)))
    mixed = [*packets[:5], packets[6], packets[5], packets[6], *packets[7:]]
    found = read_ouster(files.write(tmp_path, mixed, files.metadata(profile)))
    assert [(r.reason, r.record) for r in found.rejects] == [("the packet stands twice in the log", 7)]
    assert "1 packets stand out of order" in found.findings[0].text
    assert found.table.equals(whole.table)
    assert np.unique(whole["sweep"]).tolist() == [0, 1]  # over the end of 16 bits


@pytest.mark.witness("ouster_packets_lost")
def test_missing_packets_are_counted(tmp_path: Path) -> None:
    profile = "RNG15_RFL8_NIR8"
    packets = files.turns(profile, 2)
    kept = [packet for k, packet in enumerate(packets) if k not in {4, 5, 40}]
    (finding,) = read_ouster(files.write(tmp_path, kept, files.metadata(profile))).findings
    assert finding.text.startswith("3 packets are missing between the 61 that are there")


def test_a_window_of_columns_is_no_loss(tmp_path: Path) -> None:
    profile = "RNG15_RFL8_NIR8"
    sent = [packet for k, packet in enumerate(files.turns(profile, 2)) if k % 32 < 9]
    found = read_ouster(files.write(tmp_path, sent, files.metadata(profile, column_window=[1, 140])))
    assert found.findings == []


# --- which sensor, which metadata --------------------------------------------------------------------


@pytest.mark.witness("ouster_metadata_of_another")
def test_packets_of_another_sensor_are_left_out(tmp_path: Path) -> None:
    profile = "RNG15_RFL8_NIR8"
    own, other = files.turns(profile), files.turns(profile, serial=files.SERIAL + 1)
    mixed = [packet for pair in zip(own, other, strict=True) for packet in pair]
    found = read_ouster(files.write(tmp_path, mixed, files.metadata(profile)))
    assert len(found) == SDK[profile][0]
    assert sum(r.records for r in found.rejects) == len(other)
    with pytest.raises(FormatError, match="of another sensor"):
        read_ouster(files.write(tmp_path, other, files.metadata(profile)))


def test_another_start_of_the_sensor_is_named(tmp_path: Path) -> None:
    profile = "RNG15_RFL8_NIR8"
    path = files.write(tmp_path, files.turns(profile, start=files.START + 1), files.metadata(profile))
    (finding,) = read_ouster(path).findings
    assert "32 packets are of another start" in finding.text


def test_metadata_of_another_mode_are_refused(tmp_path: Path) -> None:
    profile = "RNG15_RFL8_NIR8"
    packets = files.turns(profile, 3)
    coarse = files.metadata(profile, columns_per_frame=256, column_window=[0, 255])
    found = read_ouster(files.write(tmp_path, packets, coarse))
    assert {r.reason for r in found.rejects} == {"a column's number is not below 256, as the metadata say"}
    fine = files.metadata(profile, columns_per_frame=2048, column_window=[0, 2047])
    with pytest.raises(FormatError, match=r"the turns end at column 511, by the metadata at 2,047"):
        read_ouster(files.write(tmp_path, packets, fine))


def test_metadata_of_another_profile_are_refused(tmp_path: Path) -> None:
    path = files.write(tmp_path, files.turns("RNG15_RFL8_NIR8"), files.metadata("LEGACY"))
    with pytest.raises(FormatError, match=r"no packet has the 3,392 bytes of OS-1-16 in LEGACY .*32 of 1,280"):
        read_ouster(path)


def test_two_sensors_under_one_port_are_told_apart_by_their_address(tmp_path: Path) -> None:
    packets = files.turns("RNG15_RFL8_NIR8")
    sent = [(k, frame(packet, 7502, sender)) for k, packet in enumerate(packets) for sender in ("10.0.0.1", "10.0.0.2")]
    path = capture(tmp_path / "a.pcap", sent)
    (tmp_path / "a.json").write_text(json.dumps(files.metadata("RNG15_RFL8_NIR8")))
    with pytest.raises(FormatError, match=r"options\.sender"):
        read_ouster(path)
    assert len(read_ouster(path, sender="10.0.0.2")) == SDK["RNG15_RFL8_NIR8"][0]


def test_the_serial_number_tells_two_addresses_apart(tmp_path: Path) -> None:
    profile = "RNG15_RFL8_NIR8"
    own, other = files.turns(profile), files.turns(profile, serial=files.SERIAL + 1)
    sent = [(k, frame(p, 7502, "10.0.0.1")) for k, p in enumerate(own)]
    sent += [(k, frame(p, 7502, "10.0.0.2")) for k, p in enumerate(other)]
    capture(tmp_path / "a.pcap", sorted(sent))
    (tmp_path / "a.json").write_text(json.dumps(files.metadata(profile)))
    found = read_ouster(tmp_path / "a.pcap")
    assert (len(found), found.rejects, found.attributes["sender"]) == (SDK[profile][0], [], "10.0.0.1")


@pytest.mark.parametrize("broken", ["{", "[1]", '{"beam_altitude_angles": 3}', '{"sensor_info": {}}'])
def test_what_is_no_metadata_is_refused(broken: str, tmp_path: Path) -> None:
    path = files.write(tmp_path, files.turns("LEGACY"), files.metadata("LEGACY"))
    (tmp_path / "a.json").write_text(broken)
    with pytest.raises(FormatError, match="metadata"):
        read_ouster(path)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"beam_azimuth_angles": [1.0]}, "1 azimuth angles, and a column 16 pixels"),
        ({"lidar_to_sensor_transform": [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "no rotation"),
        ({"udp_profile_lidar": "RNG23"}, "RNG23"),
        ({"columns_per_frame": 0}, "columns_per_frame is 0"),
        ({"column_window": [0, 512]}, "column_window"),
    ],
)
def test_metadata_that_contradict_themselves_are_refused(changed: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=message):
        metadata_of(json.dumps(files.metadata("LEGACY", **changed)), tmp_path)


def test_inspect_proposes_the_metadata_beside_the_capture(tmp_path: Path) -> None:
    path = files.write(tmp_path, files.turns("RNG15_RFL8_NIR8"), files.metadata("RNG15_RFL8_NIR8"))
    (tmp_path / "a_other.json").write_text(json.dumps(files.metadata("RNG15_RFL8_NIR8", prod_sn="5")))
    (tmp_path / "notes.json").write_text("{}")
    found = inspect(path)
    assert found.readable
    lines = [need.line for need in found.log.opened.needs] if found.log else []
    assert 'options.metadata = "a.json"' in lines
    assert 'clock = { system = "free", unit = "ns", offset_s = ???? }' in lines


def test_a_capture_stated_as_velodynes_is_told_whose_it_is(tmp_path: Path) -> None:
    path = files.write(tmp_path, files.turns("RNG15_RFL8_NIR8"), files.metadata("RNG15_RFL8_NIR8"))
    with pytest.raises(FormatError, match=r"ouster_pcap"):
        read("velodyne_pcap", path, {}, clock=FREE)


def test_a_capture_of_nobody_known_is_told_what_was_looked_for(tmp_path: Path) -> None:
    path = capture(tmp_path / "a.pcap", [(k, frame(bytes(700), 5555)) for k in range(20)])
    found = inspect(path)
    assert "by its name it may be" in found.error
    assert "no lidar packet of an Ouster is among the capture's first packets" in found.error
    assert "no Velodyne data packet was sent to port 2368" in found.error


# --- clocks -----------------------------------------------------------------------------------------


def test_a_count_from_the_sensors_start_needs_a_free_clock(tmp_path: Path) -> None:
    path = files.write(tmp_path, files.turns("LEGACY"), files.metadata("LEGACY"))
    for clock in (None, Clock(TimeSystem.UNIX_UTC)):
        with pytest.raises(TimeSystemError, match="TIME_FROM_INTERNAL_OSC: stamps count from its start"):
            read("ouster_pcap", path, OPTIONS, clock=clock)
    found = read_ouster(path, Clock(TimeSystem.FREE, offset_s=1e9, drift_ppm=-10.0, reference_s=5.0))
    elapsed_ns = np.rint((found.epochs - 10**18 - files.FIRST_NS) / (1 - 1e-5)).astype(np.int64)
    assert set(elapsed_ns.tolist()) <= set((files.stamps_of(0, 0, files.COLUMNS) - files.FIRST_NS).tolist())


@pytest.mark.parametrize("mode", ["TIME_FROM_PTP_1588", "TIME_FROM_SYNC_PULSE_IN"])
def test_the_scale_of_a_master_has_to_be_stated(mode: str, tmp_path: Path) -> None:
    path = files.write(tmp_path, files.turns("LEGACY"), files.metadata("LEGACY", timestamp_mode=mode))
    with pytest.raises(TimeSystemError, match=mode):
        read("ouster_pcap", path, OPTIONS)
    with pytest.raises(TimeSystemError, match="1980"):  # 5 s of 1970
        read_ouster(path, Clock(TimeSystem.UNIX_TAI))


# --- fragments --------------------------------------------------------------------------------------


def fragments(packet: bytes, number: int, mtu: int = 1480) -> list[bytes]:
    """IPv4 frames of a UDP packet that is longer than a frame (RFC 791)."""
    whole = frame(packet, 7502)
    link, ip, body = whole[:14], whole[14:34], whole[34:]
    out = []
    for at in range(0, len(body), mtu):
        part = body[at : at + mtu]
        more = at + mtu < len(body)
        head = ip[:2] + struct.pack(">HHH", 20 + len(part), number, (at // 8) | (0x2000 if more else 0)) + ip[8:]
        out.append(link + head + part)
    return out


def test_packets_in_fragments_are_put_together(tmp_path: Path) -> None:
    profile = "RNG19_RFL8_SIG16_NIR16_DUAL"
    packets = files.turns(profile)
    whole = read_ouster(files.write(tmp_path, packets, files.metadata(profile)))
    frames = [part for k, packet in enumerate(packets) for part in fragments(packet, k)]
    capture(tmp_path / "a.pcap", [(k, part) for k, part in enumerate(frames)])
    assert format_of(tmp_path / "a.pcap").name == "ouster_pcap"
    found = read_ouster(tmp_path / "a.pcap")
    assert found.table.equals(whole.table)
    del frames[4]
    capture(tmp_path / "a.pcap", [(k, part) for k, part in enumerate(frames)])
    found = read_ouster(tmp_path / "a.pcap")
    assert [(r.reason, r.records) for r in found.rejects] == [("fragments of the packet are missing", 2)]
    assert len(found) < len(whole)


def test_fragments_of_ipv6_are_put_together(tmp_path: Path) -> None:
    """Frames by RFC 8200: a fragment header (next header, offset and M flag, identification) behind that of IPv6."""
    profile = "RNG19_RFL8_SIG16_NIR16_DUAL"
    packets = files.turns(profile)
    whole = read_ouster(files.write(tmp_path, packets, files.metadata(profile)))
    frames = []
    for number, packet in enumerate(packets):
        body = struct.pack(">HHHH", 443, 7502, 8 + len(packet), 0) + packet
        for at in range(0, len(body), 1448):
            part, more = body[at : at + 1448], at + 1448 < len(body)
            head = struct.pack(">IHBB", 6 << 28, 8 + len(part), 44, 64) + bytes(15) + b"\x01" + bytes(15) + b"\x02"
            frames.append(bytes(12) + b"\x86\xdd" + head + struct.pack(">BBHI", 17, 0, at | more, number) + part)
    capture(tmp_path / "a.pcap", list(enumerate(frames)))
    assert read_ouster(tmp_path / "a.pcap").table.equals(whole.table)


# --- IMU --------------------------------------------------------------------------------------------


def test_imu_packets_of_the_old_profile(tmp_path: Path) -> None:
    imu = [files.imu_packet(files.FIRST_NS + k * 10_000_000) for k in range(5)]
    path = files.write(tmp_path, files.turns("LEGACY"), files.metadata("LEGACY"), imu=imu)
    found = read("ouster_imu", path, OPTIONS, clock=FREE, sensor=Sensor(kind="imu"))
    assert found.epochs.tolist() == [files.FIRST_NS + k * 10_000_000 for k in range(5)]
    np.testing.assert_allclose(found["specific_force_z_m_per_s2"], 9.80665)
    np.testing.assert_allclose(found["angular_rate_y_rad_per_s"], np.radians(2.0))
    assert found.attributes["imu_in_sensor_m"] == [-0.002441, -0.009725, 0.007533]


def test_imu_packets_with_several_samples(tmp_path: Path) -> None:
    sections = files.metadata(
        udp_profile_imu="ACCEL32_GYRO32_NMEA", imu_measurements_per_packet=4, imu_packets_per_frame=8
    )
    packets = []
    for k in range(3):
        stamps = [files.FIRST_NS + (4 * k + j) * 1_000_000 for j in range(4)]
        samples = [struct.pack("<QHH6f", s, 4 * k + j, int(j != 2), 1, 2, 3, 4, 5, 6) for j, s in enumerate(stamps)]
        packets.append(bytes(132) + b"".join(samples) + bytes(32))
    path = files.write(tmp_path, files.turns("RNG19_RFL8_SIG16_NIR16"), sections, imu=packets)
    found = read("ouster_imu", path, OPTIONS, clock=FREE, sensor=Sensor(kind="imu"))
    assert found.epochs.tolist() == [files.FIRST_NS + k * 1_000_000 for k in range(12) if k % 4 != 2]
    row = found.table.slice(0, 1).to_pylist()[0]
    assert [row[f"specific_force_{a}_m_per_s2"] for a in "xyz"] == [1, 2, 3]
    assert [row[f"angular_rate_{a}_rad_per_s"] for a in "xyz"] == [4, 5, 6]


def test_a_capture_of_imu_packets_alone_is_known(tmp_path: Path) -> None:
    imu = [files.imu_packet(files.FIRST_NS + k * 10_000_000) for k in range(5)]
    assert format_of(files.write(tmp_path, [], files.metadata(), imu=imu)).name == "ouster_imu"
    samples = [struct.pack("<QHH6f", files.FIRST_NS + j * 1_000_000, j, 1, 0, 0, 9.8, 0, 0, 0) for j in range(8)]
    newer = bytes(132) + b"".join(samples) + bytes(32)
    assert format_of(files.write(tmp_path, [], files.metadata(), imu=[newer])).name == "ouster_imu"


def test_imu_packets_of_a_recording_read_gravity(recordings: Path) -> None:
    folder = recordings / "lidars" / "ouster"
    path, metadata = folder / "OS-1-128_v2.3.0_1024x10_lb_n3.pcap", folder / "OS-1-128_v2.3.0_1024x10.json"
    found = read("ouster_imu", path, {"metadata": str(metadata)}, clock=FREE, sensor=Sensor(kind="imu"))
    assert len(found) == 30
    force = np.stack([found[f"specific_force_{a}_m_per_s2"] for a in "xyz"], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(force, axis=1).mean(), 10.5, atol=0.7)
