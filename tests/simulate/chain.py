"""From an SBET to the ground by pyproj and SciPy alone: no code of roadscan takes part."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pyproj
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

WEEK_NS = 604_800 * 10**9


def read_sbet(file: Path) -> np.ndarray:
    raw = file.read_bytes()
    assert len(raw) % 136 == 0
    return np.array([struct.unpack_from("<17d", raw, at) for at in range(0, len(raw), 136)])


class Chain:
    """Poses of an SBET in ECEF, by pyproj and SciPy alone."""

    def __init__(self, file: Path, crs: str) -> None:
        rows = read_sbet(file)
        self.rows = rows
        lat, lon = rows[:, 1], rows[:, 2]
        to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
        position = np.stack(to_ecef.transform(np.degrees(lon), np.degrees(lat), rows[:, 3]), axis=-1)
        # North-east-down axes as columns, from the derivatives of the position on the ellipsoid's normal.
        north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
        east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
        level = Rotation.from_matrix(np.stack([north, east, np.cross(north, east)], axis=-1))
        body = Rotation.from_euler("ZYX", np.stack([rows[:, 9] - rows[:, 10], rows[:, 8], rows[:, 7]], axis=-1))
        self.position = CubicSpline(rows[:, 0], position)
        self.attitude = RotationSpline(rows[:, 0], level * body)
        self.to_map = pyproj.Transformer.from_crs("EPSG:4978", pyproj.CRS(crs).to_3d(), always_xy=True)

    def to_ground(self, seconds: np.ndarray, sensor: dict, points: np.ndarray) -> np.ndarray:
        """Map coordinates of points (n, 3) in a sensor's frame at seconds of the week (n,)."""
        b = sensor["boresight"]
        mounting = Rotation.from_euler("ZYX", [b["heading_deg"], b["pitch_deg"], b["roll_deg"]], degrees=True)
        if sensor["axes"] == "flu":
            points = points * [1.0, -1.0, -1.0]
        body = mounting.apply(points) + np.array(sensor["lever_arm_body_m"])
        ecef = self.position(seconds) + self.attitude(seconds).apply(body)
        return np.stack(self.to_map.transform(*ecef.T), axis=-1)
