"""Writes Ouster packets and metadata by the maker's description, bit by bit as the documentation's tables say."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.formats.test_velodyne_pcap import capture, frame

ROWS, COLUMNS, PACKET_COLUMNS = 16, 512, 16
SERIAL, START = 122_200_000_123, 77
POSIX_NS = 1_650_000_000 * 10**9
FIRST_NS = 5_000_000_000

Fields = dict[str, tuple[int, int]]
"""First bit and bits of a pixel's fields."""

_SINGLE = {"RANGE": (0, 19), "REFLECTIVITY": (32, 8), "SIGNAL": (48, 16), "NEAR_IR": (64, 16)}
_BOTH = {"RANGE": (0, 19), "REFLECTIVITY": (24, 8), "RANGE2": (32, 19), "REFLECTIVITY2": (56, 8)}
_DUAL = _BOTH | {"SIGNAL": (64, 16), "SIGNAL2": (80, 16)}
_LOW = {"RANGE": (0, 15), "REFLECTIVITY": (16, 8), "NEAR_IR": (24, 8)}
_LOW_DUAL = _LOW | {"RANGE2": (32, 15), "REFLECTIVITY2": (48, 8)}
PIXELS: dict[str, tuple[int, Fields]] = {
    "LEGACY": (12, {"RANGE": (0, 20), "REFLECTIVITY": (32, 8), "SIGNAL": (48, 16), "NEAR_IR": (64, 16)}),
    "RNG19_RFL8_SIG16_NIR16": (12, _SINGLE),
    "RNG19_RFL8_SIG16_NIR16_DUAL": (16, _DUAL | {"NEAR_IR": (96, 16)}),
    "RNG15_RFL8_NIR8": (4, _LOW),
    "RNG15_RFL8_NIR8_DUAL": (8, _LOW_DUAL),
    "FUSA_RNG15_RFL8_NIR8_DUAL": (8, _LOW_DUAL),
    "FIVE_WORD_PIXEL": (20, _DUAL | {"NEAR_IR": (96, 16)}),
    "RNG15_RFL8_NIR8_ZONE16": (8, _LOW | {"ZONE_MASK": (32, 16)}),
    "RNG19_RFL8_SIG16_NIR16_ZONE16": (12, _SINGLE | {"ZONE_MASK": (80, 16)}),
    "RNG15_RFL8_WIN8": (4, {"RANGE": (0, 15), "REFLECTIVITY": (16, 8), "WINDOW": (24, 8)}),
    "RNG19_RFL8_SIG16_ZONE16_DUAL": (16, _DUAL | {"ZONE_MASK": (96, 16)}),
    "RNG19_RFL8_SIG16_NIR16_RGB16": (
        16,
        {"RANGE": (0, 19), "REFLECTIVITY": (24, 8), "SIGNAL": (32, 16), "NEAR_IR": (48, 16), "R": (64, 16)},
    ),
    "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": (20, _DUAL | {"NEAR_IR": (96, 16), "R": (112, 16)}),
}
"""Bytes of a pixel, and its fields, by profile."""


def metadata(profile: str = "RNG19_RFL8_SIG16_NIR16", **changed: Any) -> dict[str, Any]:
    """Metadata in sections, as firmware 3 writes them; `changed` keys replace those of any section."""
    sections: dict[str, dict[str, Any]] = {
        "sensor_info": {
            "prod_line": "OS-1-16",
            "prod_sn": str(SERIAL),
            "image_rev": "ousteros-image-prod-bootes-v3.1.0+20240425071533",
            "initialization_id": START,
            "status": "RUNNING",
        },
        "config_params": {
            "lidar_mode": f"{COLUMNS}x10",
            "timestamp_mode": "TIME_FROM_INTERNAL_OSC",
            "udp_port_lidar": 7502,
            "udp_port_imu": 7503,
        },
        "beam_intrinsics": {
            "beam_altitude_angles": [round(21.0 - 2.8 * k, 2) for k in range(ROWS)],
            "beam_azimuth_angles": [(4.2, 1.4, -1.4, -4.2)[k % 4] for k in range(ROWS)],
            "beam_to_lidar_transform": [1, 0, 0, 15.806, 0, 1, 0, 0, 0, 0, 1, 2.5, 0, 0, 0, 1],
            "lidar_origin_to_beam_origin_mm": 15.806,
        },
        "lidar_intrinsics": {"lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 38.195, 0, 0, 0, 1]},
        "imu_intrinsics": {"imu_to_sensor_transform": [1, 0, 0, -2.441, 0, 1, 0, -9.725, 0, 0, 1, 7.533, 0, 0, 0, 1]},
        "lidar_data_format": {
            "column_window": [0, COLUMNS - 1],
            "columns_per_frame": COLUMNS,
            "columns_per_packet": PACKET_COLUMNS,
            "pixel_shift_by_row": [0] * ROWS,
            "pixels_per_column": ROWS,
            "udp_profile_lidar": profile,
            "udp_profile_imu": "LEGACY",
        },
        "calibration_status": {},
    }
    for section in sections.values():
        section |= {key: changed[key] for key in section.keys() & changed.keys()}
    sections["imu_data_format"] = {k: v for k, v in changed.items() if k.startswith("imu_")}
    return sections


def flat(sections: dict[str, Any]) -> dict[str, Any]:
    """The same as firmware 2 writes them: no sections but `data_format`, and nothing of the settings but the mode."""
    out: dict[str, Any] = {
        "data_format": sections["lidar_data_format"],
        "lidar_mode": sections["config_params"]["lidar_mode"],
    }
    for name in ("sensor_info", "beam_intrinsics", "lidar_intrinsics", "imu_intrinsics"):
        out |= sections[name]
    return out


def crc64(data: bytes) -> int:
    """CRC-64 of ECMA-182 with reversed bits (as XZ has it), bit by bit."""
    register = (1 << 64) - 1
    for octet in data:
        register ^= octet
        for _ in range(8):
            register = register >> 1 ^ (0xC96C5795D7870F42 if register & 1 else 0)
    return register ^ (1 << 64) - 1


def pixels(profile: str, seed: int, columns: int = PACKET_COLUMNS, rows: int = ROWS) -> dict[str, np.ndarray]:
    """Random fields (columns, rows) of a packet; a third of the pixels has no return."""
    random = np.random.default_rng(seed)
    fields = {}
    for name, (_, bits) in PIXELS[profile][1].items():
        fields[name] = random.integers(1 if "RANGE" in name else 0, 1 << bits, (columns, rows), dtype=np.int64)
        if "RANGE" in name:
            fields[name][random.random((columns, rows)) < 1 / 3] = 0
            fields[name][fields[name] > 0] |= 256  # beyond the sensor's own radius
    return fields


def lidar_packet(
    profile: str,
    fields: dict[str, np.ndarray],
    first_column: int,
    frame_id: int,
    stamps_ns: np.ndarray,
    *,
    status: np.ndarray | None = None,
    serial: int = SERIAL,
    start: int = START,
    checksum: bool = False,
    header_type: str | None = None,
) -> bytes:
    """A packet; `fields` (columns, rows) by name, stamps and status (columns,)."""
    legacy, size = profile == "LEGACY", PIXELS[profile][0]
    fusa = (header_type or profile[:4]) == "FUSA"
    states = np.ones(len(stamps_ns), np.int64) if status is None else status
    out = b""
    if not legacy:
        head = (
            struct.pack("<BBHIBBBBI", 1, start & 0xFF, start >> 8, frame_id, 0, 0, 0, serial & 0xFF, serial >> 8)
            if fusa
            else struct.pack("<HHHBBI", 1, frame_id, start & 0xFFFF, start >> 16, serial & 0xFF, serial >> 8)
        )
        out += head.ljust(32, b"\0")
    for c, stamp in enumerate(stamps_ns.tolist()):
        if legacy:
            out += struct.pack("<QHHI", stamp, first_column + c, frame_id, (first_column + c) * 88)
        else:
            out += struct.pack("<QHH", stamp, first_column + c, int(states[c]))
        rows = next(iter(fields.values())).shape[1]
        for row in range(rows):
            word = sum(int(fields[name][c, row]) << first for name, (first, _) in PIXELS[profile][1].items())
            out += word.to_bytes(size, "little")
        if legacy:
            out += (0xFFFFFFFF if states[c] else 0).to_bytes(4, "little")
    if legacy:
        return out
    out += bytes(24)
    return out + (crc64(out) if checksum else 0).to_bytes(8, "little")


def stamps_of(first_column: int, sweep: int, columns: int = PACKET_COLUMNS) -> np.ndarray:
    """Stamps (columns,) of a head that turns ten times a second."""
    return FIRST_NS + sweep * 100_000_000 + (first_column + np.arange(columns)) * (100_000_000 // COLUMNS)


def turns(profile: str, count: int = 1, first_frame: int = 65_535, **packet: Any) -> list[bytes]:
    """The packets of whole turns, with the seeds 0, 1 …"""
    out = []
    for k in range(count * COLUMNS // PACKET_COLUMNS):
        sweep, column = divmod(k * PACKET_COLUMNS, COLUMNS)
        numbers = 1 << (32 if profile[:4] == "FUSA" else 16)
        stamps = stamps_of(column, sweep)
        out.append(lidar_packet(profile, pixels(profile, k), column, (first_frame + sweep) % numbers, stamps, **packet))
    return out


def imu_packet(
    stamp_ns: int, force_g: tuple[float, ...] = (0.0, 0.0, 1.0), rate: tuple[float, ...] = (1.0, 2.0, 3.0)
) -> bytes:
    """An IMU packet of the profile LEGACY: g, degrees a second."""
    return struct.pack("<QQQ6f", stamp_ns - 2000, stamp_ns - 1000, stamp_ns, *force_g, *rate)


def write(
    folder: Path, packets: list[bytes], sections: dict[str, Any], *, imu: list[bytes] | None = None, **form: Any
) -> Path:
    """Write a capture a.pcap and its metadata a.json."""
    (folder / "a.json").write_text(json.dumps(sections))
    sent = [(POSIX_NS + k * 1_000_000, frame(packet, 7502)) for k, packet in enumerate(packets)]
    sent += [(POSIX_NS + k * 1_000_000, frame(packet, 7503)) for k, packet in enumerate(imu or [])]
    return capture(folder / "a.pcap", sorted(sent), **form)


def ouster(profile: str, *, checksum: bool = False, imu: bool = False) -> Callable[[Path], Path]:
    """A maker of small captures: four columns a packet, sixteen a turn; or of IMU packets alone."""
    turn = {"columns_per_frame": 16, "column_window": [0, 15], "columns_per_packet": 4}

    def make(folder: Path) -> Path:
        packets = []
        for k in range(0 if imu else 10):
            fields, column = pixels(profile, k, 4), 4 * k % 16
            fields |= {name: values | 256 for name, values in fields.items() if "RANGE" in name}  # a return everywhere
            stamps = stamps_of(column, k // 4, 4)
            packets.append(lidar_packet(profile, fields, column, k // 4, stamps, checksum=checksum))
        readings = [imu_packet(FIRST_NS + k * 10_000_000) for k in range(10)] if imu else None
        return write(folder, packets, metadata(profile, **turn), imu=readings)

    return make
