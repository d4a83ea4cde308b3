"""A long HDL-32E capture: three simulated seconds of a street's packets, repeated with the time running on."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.course import LEAP_S, START_GPS_NS
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S
from roadscan.simulate import Scene, simulate

PACKETS_PER_S = 1e6 / (12 * 46.08)
_PIECE_S = 3.0
_FIRING = np.dtype([("range", "<u2"), ("intensity", "u1")])
_BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("firings", _FIRING, 32)])
_RECORD = np.dtype(
    [
        ("captured_s", "<u4"),
        ("captured_us", "<u4"),
        ("sizes", "<u4", 2),
        ("headers", "V42"),
        ("blocks", _BLOCK, 12),
        ("hour_us", "<u4"),
        ("factory", "<u2"),
    ]
)
"""A data packet with its PCAP record header and 42 bytes of Ethernet, IPv4 and UDP."""
_FILE_HEADER_BYTES = 24

Mount = tuple[tuple[float, float, float], str, str]


def write_capture(file: Path, seconds: float, kept: Path) -> tuple[int, Mount]:
    """Write `seconds` of packets; returns the returns in them and the head's lever arm, boresight and axes.

    kept : folder that keeps the simulated drive, which takes half a minute to make.
    """
    scene = Scene.load("urban_street").changed(
        profilers={"on": False}, camera={"on": False}, sick={"on": False}, imu={"on": False}, gnss={"on": False},
        encoder={"on": False}, lidar={"range_max_m": 60.0}, length_m=60.0,
        vehicle={"speed_m_per_s": 10.0}, passes=[{"lane": 2}],
    )  # fmt: skip
    street = kept / "street.pcap"
    if not street.exists():
        with tempfile.TemporaryDirectory() as folder:
            simulate(scene, Path(folder))
            shutil.copyfile(next(Path(folder).rglob("lidar.pcap")), street)
    returns = repeat_capture(street, file, seconds)
    mount = scene.lidar.mount.nominal()
    turned = f"{{ roll_deg = {mount.roll_deg}, pitch_deg = {mount.pitch_deg}, heading_deg = {mount.heading_deg} }}"
    return returns, (mount.lever_arm_body_m, turned, "flu")


def repeat_capture(source: Path, file: Path, seconds: float) -> int:
    """Repeat at most three seconds of a capture's data packets, from its middle, for `seconds`; returns the returns."""
    header, piece = _packets(source)
    total, done, returns = round(seconds * PACKETS_PER_S), 0, 0
    with file.open("wb") as stream:
        stream.write(header)
        while done < total:
            part = piece[: total - done].copy()
            _stamp(part, done)
            stream.write(part.tobytes())
            returns += int(np.count_nonzero(part["blocks"]["firings"]["range"]))
            done += part.size
    return returns


def _packets(capture: Path) -> tuple[bytes, npt.NDArray[np.void]]:
    """The file header, and the data packets of a piece from the middle of the drive."""
    data = capture.read_bytes()
    at, found = _FILE_HEADER_BYTES, bytearray()
    while at < len(data):
        size = int.from_bytes(data[at + 8 : at + 12], "little")
        if size + 16 == _RECORD.itemsize:  # position packets are shorter
            found += data[at : at + _RECORD.itemsize]
        at += 16 + size
    records = np.frombuffer(bytes(found), _RECORD)
    count = round(_PIECE_S * PACKETS_PER_S)
    first = max((records.size - count) // 2, 0)
    return data[:_FILE_HEADER_BYTES], records[first : first + count]


def _stamp(part: npt.NDArray[np.void], first: int) -> None:
    """Put packets `first`, `first` + 1 … on time."""
    since_us = np.round((first + np.arange(part.size)) * (1e6 / PACKETS_PER_S)).astype(np.int64)
    utc_us = START_GPS_NS // 1000 + (GPS_EPOCH_UNIX_S - LEAP_S) * 1_000_000 + since_us
    part["hour_us"] = utc_us % 3_600_000_000
    part["captured_s"], part["captured_us"] = utc_us // 1_000_000, utc_us % 1_000_000
