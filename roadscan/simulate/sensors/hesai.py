"""Writes the capture of a PandarXT-32, and its angle file.

A packet has a head of 12 bytes, 8 blocks of an azimuth (0.01°) and 32 distances (4 mm) with reflectivities, a tail with
date and time, and its number (PandarXT user manual, 3.1). Channel c of block b is fired at the packet's time + 5.632 µs
− 50 µs · (7 − b) + 0.368 µs + 1.512 µs · c (appendix II), and a block's azimuth holds 5.632 µs before its channels'
times count: both are laid so that channel 0 has the time and the azimuth of the simulated firing.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from roadscan.core.gpstime import NS_PER_S
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.scene import Scene
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.lidar import Packets
from roadscan.simulate.sensors.pcap import framed

ANGLES: Final = "lidar_angles.csv"
"""File of the channels' angles, beside the capture."""
PORT: Final = 2_368  # UDP port of data packets
_HEAD: Final = bytes([0xEE, 0xFF, 6, 1, 0, 0, 32, 8, 0, 4, 1, 1])
"""Protocol 6.1, 32 lasers, 8 blocks, 4 mm, one return, with numbers."""
_BEFORE_FIRST_NS: Final = 5_632 + 368
"""From the packet's time to the first firing of its last block, and from a block's azimuth to that of its first one."""
_STRONGEST: Final = 0x37  # return mode of the strongest return
_CHANNEL: Final = np.dtype([("distance", "<u2"), ("reflectivity", "u1"), ("_", "u1")])
_BLOCK: Final = np.dtype([("azimuth", "<u2"), ("channels", _CHANNEL, 32)])  # azimuth in 0.01°
_PACKET: Final = np.dtype([
    ("head", "V12"), ("blocks", _BLOCK, 8), ("reserved", "V10"), ("mode", "u1"), ("speed", "<u2"), ("date", "u1", 6),
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
