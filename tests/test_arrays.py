"""Surveys from arrays: what the writers of `roadscan.arrays` wrote lies, after a run, where NumPy puts it."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pyproj
import pytest
from scipy.spatial.transform import Rotation, Slerp
from typer.testing import CliRunner

from roadscan.arrays import Quaternions, write_profiles, write_returns, write_trajectory
from roadscan.cli import app

CELL_M = 0.05
QUANTUM_M = 2e-4
FIRST_NS = 1_461_922_218_000_000_000
MAP = "EPSG:25832"
PROFILER_ARM, LIDAR_ARM = np.array([0.4, -0.3, -1.9]), np.array([-0.5, 0.2, -2.1])
BODY_FROM_FLU = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Drive:
    """Poses along a bend, uphill, with roll and pitch; 50 a second for 2 s."""

    epochs: np.ndarray
    enh: np.ndarray
    """(n, 3) on the map, ellipsoidal heights; the same numbers in a local frame."""
    rph_deg: np.ndarray
    """(n, 3), heading from grid north."""


def drive() -> Drive:
    t = np.arange(100) / 50
    enh = np.stack([571_600.0 + 4.0 * t, 5_539_000.0 + 3.0 * t + 0.2 * t**2, 300.0 + 0.2 * t], axis=-1)
    rph = np.stack([2.0 + 0.5 * t, -1.5 + 0.3 * t, 350.0 + 10.0 * t], axis=-1)  # over north
    return Drive(FIRST_NS + np.rint(t * 1e9).astype(np.int64), enh, rph)


def ned_from_body(rph_deg: np.ndarray) -> Rotation:
    return Rotation.from_euler("ZYX", rph_deg[:, ::-1], degrees=True)


ENU_FROM_NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])


def ecef_from_ned(lonlat_deg: np.ndarray) -> Rotation:
    lon, lat = np.radians(lonlat_deg[:, :2].T)
    return Rotation.from_euler("ZY", np.stack([lon, -lat - np.pi / 2], axis=-1))


def geodetic(enh: np.ndarray) -> np.ndarray:
    to = pyproj.Transformer.from_crs(pyproj.CRS(MAP).to_3d(), "EPSG:4937", always_xy=True)
    return np.stack(to.transform(*enh.T), axis=-1)


def convergence_deg(lonlat: np.ndarray) -> np.ndarray:
    return np.asarray(pyproj.Proj(MAP).get_factors(lonlat[:, 0], lonlat[:, 1]).meridian_convergence)


def true_rph(d: Drive) -> np.ndarray:
    """Angles with the heading from true north."""
    return d.rph_deg + np.outer(convergence_deg(geodetic(d.enh)), [0.0, 0.0, 1.0])


def ecef(enh: np.ndarray) -> np.ndarray:
    to = pyproj.Transformer.from_crs(pyproj.CRS(MAP).to_3d(), "EPSG:4936", always_xy=True)
    return np.stack(to.transform(*enh.T), axis=-1)


def write_geodetic(d: Drive, path: Path) -> None:
    """Degrees, radians and times of UTC, in a DataFrame."""
    degrees, angles = geodetic(d.enh), np.radians(true_rph(d))
    utc = pd.to_datetime(d.epochs + 315_964_800 * 10**9 - 18 * 10**9, unit="ns", utc=True)  # 18 leap seconds since 1980
    table = pd.DataFrame({"time": utc, "lon_deg": degrees[:, 0], "lat_deg": degrees[:, 1]})
    table = table.assign(height_mm=1e3 * degrees[:, 2], sigma_down_m=0.01)
    table[["roll_rad", "pitch_rad", "heading_rad"]] = angles
    write_trajectory(table, path, "EPSG:4937")


def write_geocentric(d: Drive, path: Path) -> None:
    """Quaternions into the axes of ECEF of vehicle axes forward, left, up; seconds of the GPS week."""
    turned = ecef_from_ned(geodetic(d.enh)) * ned_from_body(true_rph(d)) * Rotation.from_matrix(BODY_FROM_FLU)
    x, y, z = ecef(d.enh).T
    qx, qy, qz, qw = turned.as_quat().T
    table = {"time": (d.epochs % (604_800 * 10**9)) / 1e9, "x_m": x, "y_m": y, "z_m": z}
    table |= {"qw": qw, "qx": qx, "qy": qy, "qz": qz}
    clock = {"system": "gps_week_seconds", "week": FIRST_NS // (604_800 * 10**9)}
    write_trajectory(table, path, "EPSG:4936", clock=clock, quaternions=Quaternions("world", "flu"))


def write_projected(d: Drive, path: Path) -> None:
    """Easting and northing under other names, headings from grid north, GPS nanoseconds."""
    table = {"epoch_gps_ns": d.epochs, "E": d.enh[:, 0], "N": d.enh[:, 1], "height_m": d.enh[:, 2]}
    table |= dict(zip(("roll_deg", "pitch_deg", "heading_deg"), d.rph_deg.T, strict=True))
    columns = {"easting": {"name": "E", "unit": "m"}, "northing": {"name": "N", "unit": "m"}}
    write_trajectory(table, path, MAP, heading="grid", columns=columns)


def write_local(d: Drive, path: Path) -> None:
    """Quaternions into the axes of a local frame."""
    qx, qy, qz, qw = (ENU_FROM_NED * ned_from_body(d.rph_deg)).as_quat().T
    table = {"epoch_gps_ns": d.epochs, "x_m": d.enh[:, 0], "y_m": d.enh[:, 1], "z_m": d.enh[:, 2]}
    table |= {"qw": qw, "qx": qx, "qy": qy, "qz": qz}
    write_trajectory(table, path, "local", quaternions=Quaternions("world", "frd"))


def placed(d: Drive, epochs: np.ndarray, body_m: np.ndarray, *, local: bool) -> np.ndarray:
    """(n, 3) map coordinates of points of the vehicle's frame: straight lines between poses, turns by Slerp."""
    world = d.enh if local else ecef(d.enh)
    turn = ENU_FROM_NED * ned_from_body(d.rph_deg)
    if not local:
        turn = ecef_from_ned(geodetic(d.enh)) * ned_from_body(true_rph(d))
    t, known = (epochs - FIRST_NS) / 1e9, (d.epochs - FIRST_NS) / 1e9
    origin = np.stack([np.interp(t, known, axis) for axis in world.T], axis=-1)
    found = origin + Slerp(known, turn)(t).apply(body_m)
    if local:
        return found
    back = pyproj.Transformer.from_crs("EPSG:4936", pyproj.CRS(MAP).to_3d(), always_xy=True)
    return np.stack(back.transform(*found.T), axis=-1)


def logs(folder: Path, d: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Write profiles and returns; epochs (n,) and places in the vehicle's frame (n, 3) of all that is a reading."""
    rng = np.random.default_rng(4)
    epochs = d.epochs[3] + np.arange(30) * 60_000_000
    across = np.linspace(-1.5, 1.5, 31)
    heights = -1.9 - 0.02 * across**2 + 0.01 * rng.standard_normal((30, 31))
    heights[rng.random(heights.shape) < 0.1] = np.nan
    written = write_profiles(folder / "profiles.parquet", epochs, heights, across, quantum=QUANTUM_M)
    assert written.largest_error_m <= QUANTUM_M / 2 * 1.000001
    assert written.missing == np.isnan(heights).sum() > 0
    y, z = np.broadcast_arrays(across, -heights)
    whole = ~np.isnan(heights).ravel()
    of_profiles = PROFILER_ARM + np.stack([np.zeros(y.size), y.ravel(), z.ravel()], axis=-1)[whole]
    flu = rng.uniform([-3, -5, -2.3], [3, -2, -2.0], (400, 3)).astype(np.float32).astype(np.float64)
    later = np.sort(rng.integers(d.epochs[2], d.epochs[-3], 400))
    write_returns(folder / "returns.parquet", later, flu, intensity=np.arange(400), laser=np.arange(400) % 32)
    every = np.concatenate([np.repeat(epochs, 31)[whole], later])
    return every, np.concatenate([of_profiles, LIDAR_ARM + flu @ BODY_FROM_FLU.T])


SURVEY = f"""
id = "arrays"
map = {{ %s }}
tiles = {{ cell_m = {CELL_M} }}
products = {{ make = ["tile_table"] }}

[rig.sensors]
profiler = {{ kind = "profiler", lever_arm_body_m = {PROFILER_ARM.tolist()} }}
roof = {{ kind = "lidar", axes = "flu", lever_arm_body_m = {LIDAR_ARM.tolist()} }}

[[runs]]
id = "drive"
logs = [
  {{ path = "poses.parquet" }},
  {{ path = "profiles.parquet", sensor = "profiler" }},
  {{ path = "returns.parquet", sensor = "roof" }},
]
"""


@pytest.mark.parametrize("write", [write_geodetic, write_geocentric, write_projected, write_local])
def test_readings_lie_where_numpy_puts_them(tmp_path: Path, write: Any) -> None:
    d, local = drive(), write is write_local
    write(d, tmp_path / "poses.parquet")
    epochs, body_m = logs(tmp_path, d)
    (tmp_path / "SURVEY.toml").write_text(SURVEY % ('local = { name = "site" }' if local else f'crs = "{MAP}"'))
    outcome = CliRunner().invoke(app, ["run", str(tmp_path / "SURVEY.toml"), "--workers", "0"])
    assert outcome.exit_code == 0, outcome.output

    found = {}
    for file in (tmp_path / "store" / "survey=arrays" / "tiles" / "cells").glob("*.parquet"):
        column, row = (int(part) * round(10 / CELL_M) for part in file.stem.split("_"))
        cells = pq.read_table(file).to_pandas()
        found |= {
            (column + c, row + r): (n, h)
            for c, r, n, h in zip(cells.column, cells.row, cells["count"], cells.height_robust_m, strict=True)
        }
    expected = defaultdict(list)
    enh = placed(d, epochs, body_m, local=local)
    for (e, n), h in zip(enh[:, :2] / CELL_M, enh[:, 2], strict=True):
        expected[int(np.floor(e)), int(np.floor(n))].append(h)
    assert sum(n for n, _ in found.values()) == len(epochs)
    # Cubic interpolation between poses 20 ms apart, and a quantum of the height, move few readings over a border.
    assert len(found.keys() ^ expected.keys()) < 0.01 * len(expected)
    single = [cell for cell, heights in expected.items() if len(heights) == 1 and found.get(cell, (0, 0))[0] == 1]
    assert len(single) > 800
    errors = np.array([found[cell][1] - expected[cell][0] for cell in single])
    assert np.abs(errors).max() < QUANTUM_M / 2 + 1e-4
    assert np.abs(np.mean(errors)) < 1e-5
