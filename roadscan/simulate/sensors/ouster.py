"""Writes the capture of an Ouster: lidar packets of the profile RNG19_RFL8_SIG16_NIR16, and the sensor's metadata.

A packet has a header of 32 bytes, 16 columns of a header (stamp in ns, number of the column in the turn, status) and a
pixel of 12 bytes a beam, and a footer of 32 bytes, which firmware 2 leaves empty (Ouster sensor documentation, "Lidar
data packet format"). Stamps are those of a PTP master that serves UTC. The simulated beams begin on the sensor's axis,
in the plane of its origin, as the metadata say.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.scene import Scene
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.lidar import PACKET_COLUMNS, Packets
from roadscan.simulate.sensors.pcap import framed

METADATA: Final = "lidar.json"
"""File of the metadata, beside the capture."""
PORT: Final = 7502  # UDP port of lidar packets
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
        self._stream.write(framed(packets, whole, PORT))


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
            "udp_port_lidar": PORT, "udp_port_imu": PORT + 1, "udp_profile_lidar": "RNG19_RFL8_SIG16_NIR16",
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
