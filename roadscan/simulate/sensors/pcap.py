"""Writes Velodyne captures: data packets of 1,206 bytes, position packets of 512, in UDP, IP, Ethernet and PCAP."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S, TimeSystem, leap_seconds_at_gps
from roadscan.simulate.drive import Drive
from roadscan.simulate.scene import Scene
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.lidar import Packets

DATA_BYTES: Final = 1_206  # bytes of a data packet
POSITION_BYTES: Final = 512  # bytes of a position packet
DATA_PORT: Final = 2_368  # UDP port of data packets
POSITION_PORT: Final = 8_308  # UDP port of position packets
UPPER_BLOCK: Final = 0xEEFF  # flag of a block of the upper lasers
STRONGEST_RETURN: Final = 0x37  # mode byte of the strongest return
HDL_32E: Final = 0x21  # product byte
HOUR_NS: Final = 3_600 * NS_PER_S  # nanoseconds of an hour
POSITION_DELAY_NS: Final = 120_000_000
"""Time from a full second to the position packet that names it (ns)."""
_CAPTURE_DELAY_NS: Final = 600_000
"""Time from a packet's first firing to its arrival at the computer (ns)."""
_SENSOR_ADDRESS: Final = bytes([192, 168, 3, 43])  # IP address of the sensor
_BROADCAST_ADDRESS: Final = bytes([255, 255, 255, 255])  # IP address of a broadcast
FILE_HEADER: Final = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262_144, 1)
"""Begin of a capture of Ethernet frames with stamps of microseconds."""
_ETHERNET: Final = bytes.fromhex("ffffffffffff6076880000000800")
_FIRING: Final = np.dtype([("range", "<u2"), ("intensity", "u1")])
_BLOCK: Final = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("firings", _FIRING, 32)])  # block of a data packet
_RECORD: Final = np.dtype(  # PCAP record of a data packet
    [
        ("captured_s", "<u4"),
        ("captured_us", "<u4"),
        ("stored", "<u4"),
        ("sent", "<u4"),
        ("headers", "V42"),
        ("blocks", _BLOCK, 12),
        ("hour_us", "<u4"),
        ("mode", "u1"),
        ("product", "u1"),
    ]
)


class PcapWriter:
    """Writes one capture: data packets, and a position packet at the start and after each full second.

    Stamps within the packets are of the sensor's clock, those of the capture itself of a computer's that is right.
    """

    def __init__(self, file: Path, scene: Scene, drive: Drive) -> None:
        self._drive = drive
        self._clock = SensorClock.of(scene, scene.lidar.clock, TimeSystem.UTC_HOUR)
        self._stream = file.open("wb")
        self._stream.write(FILE_HEADER)
        self._next_position_gps_ns: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()

    def write(self, block: Packets) -> None:
        """Append data packets."""
        epoch_gps_ns = block.epoch_gps_ns
        shown = self._clock.shown_gps_ns(epoch_gps_ns)
        records = _data_packets(block, shown)
        done = 0
        while not self._drive.earth.is_local and self._position_due(shown[-1], int(shown[0])):
            due = self._next_position_gps_ns or 0
            upto = int(np.searchsorted(shown, due))
            self._stream.write(records[done:upto].tobytes())
            at = min(upto, shown.size - 1)
            self._stream.write(self._position_packet(due, due - int(shown[at] - epoch_gps_ns[at])))
            self._next_position_gps_ns = (due // NS_PER_S + 1) * NS_PER_S + POSITION_DELAY_NS
            done = upto
        self._stream.write(records[done:].tobytes())

    def _position_due(self, last_gps_ns: int, first_gps_ns: int) -> bool:
        if self._next_position_gps_ns is None:
            self._next_position_gps_ns = first_gps_ns
        return self._next_position_gps_ns <= last_gps_ns

    def _position_packet(self, shown_gps_ns: int, epoch_gps_ns: int) -> bytes:
        """Return the PCAP record of a position packet: µs past the hour at byte 198, PPS state at 202, GPRMC at 206.

        shown_gps_ns : what the sensor's clock shows at the true epoch.
        """
        utc = int(posix_ns(np.array([shown_gps_ns]))[0])
        sentence = self._gprmc(epoch_gps_ns, utc // NS_PER_S)
        payload = bytearray(POSITION_BYTES)
        struct.pack_into("<IB", payload, 198, utc % HOUR_NS // 1_000, 2)
        payload[206 : 206 + len(sentence)] = sentence
        frame = udp_headers(POSITION_BYTES, POSITION_PORT) + bytes(payload)
        captured = int(posix_ns(np.array([epoch_gps_ns]))[0]) + _CAPTURE_DELAY_NS
        seconds, rest = divmod(captured, NS_PER_S)
        return struct.pack("<IIII", seconds, rest // 1_000, len(frame), len(frame)) + frame

    def _gprmc(self, epoch_gps_ns: int, utc_s: int) -> bytes:
        """Return the recommended minimum sentence of the full UTC second `utc_s` (NMEA 0183)."""
        about = np.array([epoch_gps_ns - 500_000_000, epoch_gps_ns])
        position = self._drive.poses(about).position_ecef_m
        lon, lat, _ = self._drive.earth.geographic_from_ecef(position)[1]
        knots = float(np.linalg.norm(position[1] - position[0])) / 0.5 * 3600.0 / 1852.0
        moment = np.datetime64(utc_s, "s").item()
        body = (
            f"GPRMC,{moment:%H%M%S}.00,A,{_degrees_minutes(lat, 2)},{'N' if lat >= 0 else 'S'},"
            f"{_degrees_minutes(lon, 3)},{'E' if lon >= 0 else 'W'},{knots:05.1f},000.0,{moment:%d%m%y},,,A"
        )
        check = 0
        for byte in body.encode():
            check ^= byte
        return f"${body}*{check:02X}\r\n".encode()


def _data_packets(block: Packets, shown_gps_ns: Int64) -> npt.NDArray[np.void]:
    epoch_gps_ns = block.epoch_gps_ns
    captured = posix_ns(epoch_gps_ns) + _CAPTURE_DELAY_NS
    records = np.zeros(epoch_gps_ns.size, dtype=_RECORD)
    records["captured_s"], records["captured_us"] = captured // NS_PER_S, captured % NS_PER_S // 1_000
    records["stored"] = records["sent"] = 42 + DATA_BYTES
    records["headers"] = np.frombuffer(udp_headers(DATA_BYTES, DATA_PORT), dtype="V42")
    records["blocks"]["flag"] = UPPER_BLOCK
    records["blocks"]["azimuth"] = block.block_azimuth
    records["blocks"]["firings"]["range"] = block.ranges
    records["blocks"]["firings"]["intensity"] = block.intensity
    records["hour_us"] = (posix_ns(shown_gps_ns + block.late_ns) + 500) // 1_000 % (HOUR_NS // 1_000)
    records["mode"], records["product"] = STRONGEST_RETURN, HDL_32E
    return records


def framed(payloads: npt.NDArray[np.void], whole_gps_ns: Int64, port: int) -> bytes:
    """Return the records of data packets (p,) that were whole at epochs (p,) and sent to a port."""
    size = payloads.dtype.itemsize
    headers = udp_headers(size, port)
    fields = [("captured_s", "<u4"), ("captured_us", "<u4"), ("stored", "<u4"), ("sent", "<u4")]
    records = np.zeros(payloads.size, [*fields, ("headers", f"V{len(headers)}"), ("payload", payloads.dtype)])
    captured = posix_ns(whole_gps_ns) + _CAPTURE_DELAY_NS
    records["captured_s"], records["captured_us"] = captured // NS_PER_S, captured % NS_PER_S // 1_000
    records["stored"] = records["sent"] = len(headers) + size
    records["headers"] = np.frombuffer(headers, records.dtype["headers"])
    records["payload"] = payloads
    return records.tobytes()


def posix_ns(epoch_gps_ns: Int64) -> Int64:
    """Return POSIX nanoseconds of GPS epochs."""
    leap = leap_seconds_at_gps(epoch_gps_ns // NS_PER_S)
    out: Int64 = epoch_gps_ns + (GPS_EPOCH_UNIX_S - leap) * NS_PER_S
    return out


def udp_headers(payload_bytes: int, port: int) -> bytes:
    """Return Ethernet, IPv4 and UDP headers (42 bytes) of a broadcast of `payload_bytes` to `port`."""
    udp = struct.pack(">HHHH", 443 if port == DATA_PORT else port, port, 8 + payload_bytes, 0)
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp) + payload_bytes, 0, 0, 64, 17, 0)
    ip += _SENSOR_ADDRESS + _BROADCAST_ADDRESS
    total = sum(struct.unpack(">10H", ip))
    folded = (total & 0xFFFF) + (total >> 16)
    checksum = ~((folded & 0xFFFF) + (folded >> 16)) & 0xFFFF
    return _ETHERNET + ip[:10] + struct.pack(">H", checksum) + ip[12:] + udp


def _degrees_minutes(degrees: float, digits: int) -> str:
    """Return ``4806.12345``: whole degrees of `digits` figures and minutes."""
    whole, rest = divmod(math.floor(abs(degrees) * 60 * 1e5), 60 * 100_000)
    return f"{whole:0{digits}d}{rest // 100_000:02d}.{rest % 100_000:05d}"
