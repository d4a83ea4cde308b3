"""Writes the captures of lidars of three makers: packets as each sends them, with the files that belong to them.

Writes the capture of a PandarXT-32, and its angle file.

A packet has a head of 12 bytes, 8 blocks of an azimuth (0.01°) and 32 distances (4 mm) with reflectivities, a tail with
date and time, and its number (PandarXT user manual, 3.1). Channel c of block b is fired at the packet's time + 5.632 µs
− 50 µs · (7 − b) + 0.368 µs + 1.512 µs · c (appendix II), and a block's azimuth holds 5.632 µs before its channels'
times count: both are laid so that channel 0 has the time and the azimuth of the simulated firing.

Writes the capture of an Ouster: lidar packets of the profile RNG19_RFL8_SIG16_NIR16, and the sensor's metadata.

A packet has a header of 32 bytes, 16 columns of a header (stamp in ns, number of the column in the turn, status) and a
pixel of 12 bytes a beam, and a footer of 32 bytes, which firmware 2 leaves empty (Ouster sensor documentation, "Lidar
data packet format"). Stamps are those of a PTP master that serves UTC. The simulated beams begin on the sensor's axis,
in the plane of its origin, as the metadata say.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Self, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq

from roadscan.compute.array_types import Int64
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S, TimeSystem, leap_seconds_at_gps, utc_from_gps_ns
from roadscan.simulate.caster import World
from roadscan.simulate.drive import Drive
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.scene import Scene
from roadscan.simulate.sensors import lidar
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.lidar import PACKET_COLUMNS, Packets

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


METADATA: Final = "lidar.json"
"""File of the metadata, beside the capture."""
LIDAR_PORT: Final = 7502  # UDP port of lidar packets
_SERIAL: Final = 992_300_000_001  # serial number of the simulated sensor
_START: Final = 4_107  # number of the sensor's start
_SIGNAL: Final = 8  # photons for one unit of reflectivity
_FRAMES: Final = 1 << 16  # numbers of frames before they start again
_BEHIND: Final = 2
"""Half of a turn is one part in so many: column 0 looks along the lidar's x, which is the sensor's −x."""


def _packet(rows: int) -> np.dtype[np.void]:
    pixel = [("range", "<u4"), ("reflectivity", "u1"), ("_", "u1"), ("signal", "<u2"), ("near_ir", "<u2"), ("__", "V2")]
    column = [("stamp_ns", "<u8"), ("number", "<u2"), ("status", "<u2"), ("pixels", pixel, rows)]
    header = [("type", "<u2"), ("frame", "<u2"), ("start", "V3"), ("serial", "V5"), ("rest", "V20")]
    return np.dtype([*header, ("columns", column, PACKET_COLUMNS), ("footer", "V32")])


class OusterCapture:
    """Writes the packets of one pass."""

    def __init__(self, stream: BinaryIO, clock: SensorClock) -> None:
        self._stream, self._clock = stream, clock
        self._turn, self._last = 0, -1

    def write(self, block: Packets) -> None:
        """Append a block, whose columns fill whole packets."""
        figures = block.model.figures
        turn = figures.columns or 0
        packets = np.zeros(block.ranges.shape[0] * figures.cycles // PACKET_COLUMNS, _packet(block.model.lasers))
        shape = packets.size, PACKET_COLUMNS
        forward_deg = block.azimuth_deg[:, :, 0] - block.model.azimuth_deg[0]
        numbers = (np.rint(forward_deg * turn / 360.0).astype(np.int64) - turn // _BEHIND) % turn
        firsts = numbers.reshape(shape)[:, 0]
        turns = self._turn + np.cumsum(np.diff(firsts, prepend=self._last) < 0)
        self._turn, self._last = int(turns[-1]), int(firsts[-1])
        packets["type"], packets["frame"] = 1, turns % _FRAMES
        packets["start"] = np.void(_START.to_bytes(3, "little"))
        packets["serial"] = np.void(_SERIAL.to_bytes(5, "little"))
        columns = packets["columns"]
        stamps = self._clock.stamps_ns(block.stamped_gps_ns()[:, :, 0].ravel())
        columns["stamp_ns"], columns["number"], columns["status"] = stamps.reshape(shape), numbers.reshape(shape), 1
        pixels, bright = columns["pixels"], block.intensity.reshape(*shape, -1)
        pixels["range"], pixels["reflectivity"] = block.ranges.reshape(*shape, -1), bright
        pixels["signal"] = _SIGNAL * bright.astype(np.uint16)
        whole = block.firing_gps_ns()[:, :, 0].reshape(shape)[:, -1] + figures.cycle_ns
        self._stream.write(framed(packets, whole, LIDAR_PORT))


def write_metadata(scene: Scene, file: Path) -> None:
    """Write the metadata in the sections of firmware 2.4 and later."""
    model = lidar_model(scene.lidar.model)
    columns, even = model.figures.columns or 0, [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    sections: dict[str, Any] = {
        "sensor_info": {
            "build_date": "2023-06-01T00:00:00Z", "build_rev": "v2.5.3", "initialization_id": _START,
            "image_rev": "ousteros-image-prod-aries-v2.5.3+20230601000000",
            "prod_line": f"OS-1-{model.lasers}", "prod_pn": "840-103575-06", "prod_sn": str(_SERIAL),
            "status": "RUNNING",
        },
        "config_params": {
            "lidar_mode": f"{columns}x{scene.lidar.turns_per_s:.0f}", "timestamp_mode": "TIME_FROM_PTP_1588",
            "udp_port_lidar": LIDAR_PORT, "udp_port_imu": LIDAR_PORT + 1, "udp_profile_lidar": "RNG19_RFL8_SIG16_NIR16",
        },
        "beam_intrinsics": {
            "beam_altitude_angles": model.elevation_deg.tolist(), "beam_azimuth_angles": model.azimuth_deg.tolist(),
            "beam_to_lidar_transform": even, "lidar_origin_to_beam_origin_mm": 0.0,
        },
        "lidar_intrinsics": {"lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, *even[6:]]},
        "imu_intrinsics": {"imu_to_sensor_transform": even},
        "lidar_data_format": {
            "column_window": [0, columns - 1], "columns_per_frame": columns, "columns_per_packet": PACKET_COLUMNS,
            "pixel_shift_by_row": np.rint(model.azimuth_deg * columns / 360.0).astype(int).tolist(),
            "pixels_per_column": model.lasers, "udp_profile_lidar": "RNG19_RFL8_SIG16_NIR16",
            "udp_profile_imu": "LEGACY", "fps": round(scene.lidar.turns_per_s),
        },
        "calibration_status": {}, "user_data": "",
    }  # fmt: skip
    file.write_text(json.dumps(sections, indent=1), encoding="utf-8")


ANGLES: Final = "lidar_angles.csv"
"""File of the channels' angles, beside the capture."""
PORT: Final = 2_368  # UDP port of data packets
_HEAD: Final = bytes([0xEE, 0xFF, 6, 1, 0, 0, 32, 8, 0, 4, 1, 1])
"""Protocol 6.1, 32 lasers, 8 blocks, 4 mm, one return, with numbers."""
_BEFORE_FIRST_NS: Final = 5_632 + 368
"""From the packet's time to the first firing of its last block, and from a block's azimuth to that of its first one."""
_STRONGEST: Final = 0x37  # return mode of the strongest return
_CHANNEL: Final = np.dtype([("distance", "<u2"), ("reflectivity", "u1"), ("_", "u1")])
_BLOCK_32: Final = np.dtype([("azimuth", "<u2"), ("channels", _CHANNEL, 32)])  # azimuth in 0.01°
_PACKET: Final = np.dtype([
    ("head", "V12"), ("blocks", _BLOCK_32, 8), ("reserved", "V10"), ("mode", "u1"), ("speed", "<u2"), ("date", "u1", 6),
    ("stamp_us", "<u4"), ("factory", "u1"), ("number", "<u4"),
])  # fmt: skip


class HesaiCapture:
    """Writes the packets of one pass."""

    def __init__(self, stream: BinaryIO, clock: SensorClock, scene: Scene) -> None:
        self._stream, self._clock, self._turns_per_s = stream, clock, scene.lidar.turns_per_s
        self._written = 0

    def write(self, block: Packets) -> None:
        """Append the packets of a block."""
        firings, per_ns = block.stamped_gps_ns()[:, :, 0], self._turns_per_s * 36_000.0 / NS_PER_S
        packets = np.zeros(len(firings), _PACKET)
        packets["head"], packets["mode"], packets["factory"] = np.void(_HEAD), _STRONGEST, 0x42
        packets["speed"] = round(self._turns_per_s * 60.0)
        packets["number"] = self._written + np.arange(len(firings))
        self._written += len(firings)
        blocks = packets["blocks"]
        blocks["azimuth"] = np.rint(100.0 * block.azimuth_deg[:, :, 0] - per_ns * _BEFORE_FIRST_NS) % 36_000
        blocks["channels"]["distance"], blocks["channels"]["reflectivity"] = block.ranges, block.intensity
        stamps_us = (self._clock.stamps_ns(firings[:, -1] - _BEFORE_FIRST_NS) + 500) // 1_000
        moments = stamps_us.astype("datetime64[us]")
        for packet, moment in zip(packets, moments.tolist(), strict=True):
            packet["date"] = moment.year - 1900, moment.month, moment.day, moment.hour, moment.minute, moment.second
        packets["stamp_us"] = stamps_us % 1_000_000
        self._stream.write(framed(packets, block.firing_gps_ns()[:, -1, -1], PORT))


def write_angles(scene: Scene, file: Path) -> None:
    """Write the angles of the channels as the maker's programs export them."""
    model = lidar_model(scene.lidar.model)
    rows = zip(model.elevation_deg.tolist(), model.azimuth_deg.tolist(), strict=True)
    lines = [f"{channel},{elevation:.3f},{azimuth:.3f}\n" for channel, (elevation, azimuth) in enumerate(rows, 1)]
    file.write_text("".join(["Channel,Elevation,Azimuth\n", *lines]), encoding="ascii")


FILE: Final = "lidar.pcap"
FORMATS: Final = {"velodyne": "velodyne_pcap", "ouster": "ouster_pcap", "hesai": "hesai_pcap"}
"""Format that reads the packets of a maker."""
_Writer: TypeAlias = PcapWriter | OusterCapture | HesaiCapture


def write_capture(scene: Scene, world: World, drive: Drive, folder: Path, hits_file: Path | None) -> Iterator[int]:
    """Write the capture of one pass, a block of packets a step; yields the returns of each."""
    maker = _maker(scene)
    if maker == "ouster":
        write_metadata(scene, folder / METADATA)
    if maker == "hesai":
        write_angles(scene, folder / ANGLES)
    with ExitStack() as stack:
        hits = None
        if hits_file is not None:
            hits = stack.enter_context(pq.ParquetWriter(hits_file, lidar.HITS_SCHEMA, use_dictionary=False))
        writer: _Writer
        if maker == "velodyne":
            writer = stack.enter_context(PcapWriter(folder / FILE, scene, drive))
        else:
            stream = stack.enter_context((folder / FILE).open("wb"))
            stream.write(FILE_HEADER)
            clock = _clock(scene)
            is_ouster = maker == "ouster"
            writer = OusterCapture(stream, clock) if is_ouster else HesaiCapture(stream, clock, scene)
        for block in lidar.measure(scene, world, drive):
            writer.write(block)
            if hits is not None:
                hits.write_batch(lidar.hits_of(block))
            yield int(np.count_nonzero(block.ranges))


def stated(scene: Scene, drive: Drive) -> tuple[str, str, str | None]:
    """Return format, clock and options of the survey file's entry."""
    maker, first = _maker(scene), lidar.starts_gps_ns(drive)
    if maker == "ouster":
        return FORMATS[maker], _clock(scene).toml("ns", first), f'{{ metadata = "{METADATA}" }}'
    if maker == "hesai":
        return FORMATS[maker], _clock(scene).toml(None, first), f'{{ angles = "{ANGLES}" }}'
    clock = SensorClock.of(scene, scene.lidar.clock, TimeSystem.UTC_HOUR)
    hour = None
    if drive.earth.is_local:  # no GNSS receiver is attached that would give the hour
        hour = f"{{ hour = {utc_from_gps_ns(int(clock.shown_gps_ns(np.array([first]))[0])).hour} }}"
    return FORMATS[maker], clock.toml(None, first), hour


def _maker(scene: Scene) -> str:
    return lidar_model(scene.lidar.model).figures.capture or ""


def _clock(scene: Scene) -> SensorClock:
    """Return the clock of a sensor that PTP or a GNSS receiver sets to UTC."""
    return SensorClock.of(scene, scene.lidar.clock.model_copy(update={"system": None}), TimeSystem.UNIX_UTC)
