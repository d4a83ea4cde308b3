"""A drive with an HDL-32E down one long street, simulated from end to end: what it sees again is still where it was.

The shipped `urban_street`, whose things come again along the road, seen with more errors than a good rig has: poses
that wander by 3 cm and 0.02°, lasers that are off for good, mixed ranges at edges, lost and false returns, drops of
rain, traffic.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.course import CRS, START_GPS_NS
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.simulate import Scene, simulate

SPEED_M_PER_S: Final = 10.0
PACKETS_PER_S: Final = 1e6 / (12 * 46.08)
_PERIOD_M: Final = 160.0
"""Length of the shipped street; what stands on it comes again after this."""
_BEYOND_M: Final = 40.0
"""Things stand so far beyond the drive's end: half a beam's reach."""
_STATIONS: Final = ("station_m", "start_m", "end_m")
_OFF: Final = {key: {"on": False} for key in ("profilers", "camera", "sick", "imu", "gnss", "encoder")}
_ERRORS: Final[dict[str, Any]] = {
    "noise": {"position_m": 0.03, "down_m": 0.04, "attitude_deg": 0.02, "heading_deg": 0.05, "time_constant_s": 30.0},
    "lidar": {
        "range_max_m": 60.0, "errors": "model", "divergence_deg": "data sheet", "laser_range_m": 0.01,
        "laser_gain": 0.2, "dark_m": 40.0, "false_returns": 0.002,
    },
}  # fmt: skip
_BYTES: Final = 1264
"""A data packet with its PCAP record header and 42 bytes of Ethernet, IPv4 and UDP."""
_FILE_HEADER_BYTES: Final = 24

Mount = tuple[tuple[float, float, float], str, str]


def street(seconds: float) -> Scene:
    """Return the scene of a drive of so many seconds."""
    shipped, length_m = Scene.load("urban_street"), seconds * SPEED_M_PER_S
    copies = int((length_m + _BEYOND_M) // _PERIOD_M) + 1
    things = {
        kind: [moved for k in range(copies) for one in listed if (moved := _moved(one.model_dump(), k, length_m))]
        for kind, listed in shipped.roadside
    }
    cars = [{"station_m": 180.0 * k + 150.0, "offset_m": -1.6, "speed_m_per_s": -8.0} for k in range(2 * copies)]
    ahead = {"station_m": 22.0, "offset_m": 1.6, "speed_m_per_s": SPEED_M_PER_S, "shade": 60.0}
    return shipped.changed(
        id="bench", length_m=length_m, start=utc_from_gps_ns(START_GPS_NS), passes=[{"lane": 2}],
        map={"crs": CRS, "easting_m": 563_210.0, "northing_m": 5_934_870.0, "height_m": 87.0},
        road={
            "repeat_m": _PERIOD_M,
            "grades": [{"station_m": 60.0 + 80.0 * k, "grade": 0.03 * (-1) ** k} for k in range(2 * copies)],
        },
        roadside=things | {"moving_cars": [*cars, ahead]},
        vehicle={"speed_m_per_s": SPEED_M_PER_S, "standstill_s": 0.0}, **_ERRORS, **_OFF,
    )  # fmt: skip


def _moved(thing: dict[str, Any], copy: int, length_m: float) -> dict[str, Any]:
    """Return a thing farther along the road, empty where it would begin beyond the drive; fronts end with the road."""
    moved = {key: value + copy * _PERIOD_M if key in _STATIONS else value for key, value in thing.items()}
    if min(moved[key] for key in _STATIONS if key in moved) > length_m + _BEYOND_M:
        return {}
    if "end_m" in moved:
        moved["end_m"] = min(moved["end_m"], length_m + _BEYOND_M)
    return moved


def write_drive(place: Path, seconds: float) -> tuple[int, Mount]:
    """Write `lidar.pcap` of exactly so many seconds, `poses.sbet` and their σ, `poses.smrmsg`.

    Returns
    -------
    Number of returns, and the head's lever arm, boresight and axes. A second of drive takes three of a core.
    """
    scene = street(seconds)
    with tempfile.TemporaryDirectory() as folder:
        simulate(scene, Path(folder))
        raw = Path(folder) / "raw" / "run-1"
        for kind in ("sbet", "smrmsg"):
            shutil.copyfile(raw / f"trajectory.{kind}", place / f"poses.{kind}")
        returns = cut_capture(raw / "lidar.pcap", place / "lidar.pcap", seconds)
    mount = scene.lidar.mount.nominal()
    turned = f"{{ roll_deg = {mount.roll_deg}, pitch_deg = {mount.pitch_deg}, heading_deg = {mount.heading_deg} }}"
    return returns, (mount.lever_arm_body_m, turned, "flu")


def cut_capture(source: Path, file: Path, seconds: float) -> int:
    """Write the first data packets of a capture that last so long; returns the number of their returns."""
    data, at, left, returns = source.read_bytes(), _FILE_HEADER_BYTES, round(seconds * PACKETS_PER_S), 0
    with file.open("wb") as stream:
        stream.write(data[:at])
        while at < len(data) and left:
            size = 16 + int.from_bytes(data[at + 8 : at + 12], "little")
            if size == _BYTES:  # position packets are shorter
                blocks = np.frombuffer(data, np.uint8, 1200, at + 58).reshape(12, 100)[:, 4:].reshape(-1, 3)
                returns += int(np.count_nonzero(blocks[:, 0] | blocks[:, 1]))
                stream.write(data[at : at + size])
                left -= 1
            at += size
    if left:
        raise ValueError(f"{source}: {left} packets too few for {seconds:g} s")
    return returns
