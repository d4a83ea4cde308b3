"""The Boreas poses: what their angles mean, and the trap in their stamps."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import Log
from tests.formats.log_reading import read_ellipsoidal as read_log

MICROSECONDS = Clock(TimeSystem.UNIX_UTC, unit="us")
NANOSECONDS = Clock(TimeSystem.UNIX_UTC, unit="ns")
NAMES = "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,angvel_z,angvel_y,angvel_x"
CONVERGENCE_DEG = 1.061  # of UTM zone 17 at 79.466° W, 43.782° N, by pyproj

# Points of the published route of the same streets (pyboreas, figs/glen_shields.html): latitude, longitude.
ROUTE = (
    (43.78215527, -79.46599875),
    (43.78383057, -79.46946011),
    (43.78671149, -79.47000477),
    (43.79115059, -79.47104676),
    (43.79242680, -79.47352578),
    (43.79135461, -79.47932000),
)


@cache
def boreas(folder: Path, name: str, axes: str, heading: str = "grid") -> Log:
    clock = NANOSECONDS if "radar" in name else MICROSECONDS
    path = folder / "two_pass" / f"{name}_poses.csv.gz"
    assert format_of(path).name == "pospac"
    log = read_log("pospac", path, {"axes": axes, "heading": heading}, clock=clock, crs="EPSG:32617")
    assert log.rejects == []
    return log


def lever_arms(lidar: Log, other: Log) -> np.ndarray:
    """Positions (n, 3) of the other sensor in the lidar's body axes, at the other's epochs."""
    inside = (other.epochs > lidar.epochs[0]) & (other.epochs < lidar.epochs[-1])
    start = lidar.epochs[0]
    t = (lidar.epochs - start) / 1e9
    at = (other.epochs[inside] - start) / 1e9
    offset = other.positions[inside] - CubicSpline(t, lidar.positions)(at)
    return Slerp(t, lidar.attitudes)(at).inv().apply(offset)


def test_the_radar_sits_above_the_lidar_by_one_vector(recordings: Path) -> None:
    lidar = boreas(recordings, "pass1_lidar", "flu")
    arms = lever_arms(lidar, boreas(recordings, "pass1_radar", "frd"))
    published = np.loadtxt(recordings / "two_pass" / "T_radar_lidar.txt")
    assert published[2, 3] == 0.21  # the radar looks down: 0.21 m above the lidar
    np.testing.assert_allclose(arms.mean(axis=0), [0.0, 0.0, -0.21], atol=2e-5)
    length = np.linalg.norm(arms, axis=1)
    assert length.mean() == pytest.approx(0.2100, abs=5e-5)
    assert length.std() < 1.5e-4
    assert np.abs(length - 0.21).max() < 1.2e-3
    tilt = np.degrees(np.arccos(np.clip(-arms[:, 2] / length, -1, 1)))
    assert np.sqrt(np.mean(tilt**2)) < 0.2  # 0.13°; with the order of angles reversed it is 2° and more


def test_the_camera_is_bolted_to_the_lidar(recordings: Path) -> None:
    """Its lever arm has parts in all three axes, so a wrong sign of any angle would smear it."""
    arms = lever_arms(boreas(recordings, "pass1_lidar", "flu"), boreas(recordings, "pass1_camera", "flu"))
    # 0.6759 m on the grid, where the poses were made; metres are longer by its scale of 0.99979.
    assert np.linalg.norm(arms.mean(axis=0)) == pytest.approx(0.6759 / 0.99979, abs=5e-5)
    assert arms.std(axis=0).max() < 5e-4
    assert np.abs(arms.mean(axis=0)).min() > 0.2


def test_positions_are_on_the_utm_grid(recordings: Path) -> None:
    """The published latitudes and longitudes lie on the driven line, within a lane's width."""
    xyz = boreas(recordings, "pass1_lidar", "flu").positions
    lon, lat, height = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*xyz.T)
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    line = CubicSpline(np.arange(len(lon)), np.stack(to_ecef.transform(lon, lat, np.zeros_like(height)), axis=-1))
    tree = cKDTree(line(np.arange(0, len(lon) - 1, 0.1)))
    published = np.array([to_ecef.transform(b, a, 0.0) for a, b in ROUTE])
    assert tree.query(published)[0].max() < 1.5


@pytest.mark.parametrize(("heading", "expected_deg"), [("grid", 0.0), ("true", CONVERGENCE_DEG)])
def test_heading_counts_from_grid_north(recordings: Path, heading: str, expected_deg: float) -> None:
    """On straight road the car moves along its forward axis (the radar's x, as its poses are made)."""
    log = boreas(recordings, "pass1_radar", "frd", heading)
    t = (log.epochs - log.epochs[0]) / 1e9
    velocity = log.attitudes.inv().apply(CubicSpline(t, log.positions)(t, 1))
    turn = np.abs((log.attitudes[2:] * log.attitudes[:-2].inv()).magnitude()) / (t[2:] - t[:-2])
    straight = np.flatnonzero((turn < np.radians(0.8)) & (np.linalg.norm(velocity[1:-1], axis=1) > 6)) + 1
    assert straight.size > 500
    crab_deg = np.degrees(np.median(np.arctan2(velocity[straight, 1], velocity[straight, 0])))
    assert crab_deg == pytest.approx(expected_deg, abs=0.35)


def test_the_trap_of_the_nanoseconds(recordings: Path) -> None:
    path = recordings / "two_pass" / "pass1_radar_poses.csv.gz"
    with pytest.raises(TimeSystemError) as caught:
        read_log("pospac", path, {"axes": "frd"}, clock=MICROSECONDS, crs="EPSG:32617")
    message = str(caught.value)
    assert message.startswith(f"{path}, record 0: stamp 16281848865515")
    assert 'set clock.unit = "ns"' in message
    other = recordings / "two_pass" / "pass1_lidar_poses.csv.gz"
    with pytest.raises(TimeSystemError, match=r"pass1_lidar_poses\.csv\.gz, record 0: .* falls outside 1980–2080"):
        read_log("pospac", other, {"axes": "flu"}, clock=Clock(TimeSystem.UNIX_UTC, unit="ms"), crs="EPSG:32617")


def test_stamps_are_exact_to_the_nanosecond(recordings: Path) -> None:
    log = boreas(recordings, "pass1_radar", "frd")
    assert log.epochs[0] == 1628184886551599081 - 315964800 * 10**9 + 18 * 10**9


def line(**changed: object) -> str:
    fields: dict[str, object] = dict.fromkeys(NAMES.split(","), 0.1)
    fields |= {"GPSTime": 1628184886518266, "easting": 623425.5, "northing": 4848821.0, "altitude": 153.9} | changed
    return ",".join(map(str, fields.values()))


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join([NAMES, *lines, ""]))
    return path


def test_a_level_sensor_that_looks_north_of_the_grid(tmp_path: Path) -> None:
    """Zero angles: x is east, y north, z up; a heading turns y clockwise."""
    path = write(tmp_path / "a.csv", line(roll=0, pitch=0, heading=0), line(roll=0, pitch=0, heading=np.pi / 2))
    north, east = read_log("pospac", path, {"axes": "rfu"}, clock=MICROSECONDS, crs="local").attitudes
    np.testing.assert_allclose(north.apply([[1, 0, 0], [0, 1, 0], [0, 0, 1]]), [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-15)  # fmt: skip  # noqa: E501
    np.testing.assert_allclose(east.apply([1, 0, 0]), [1, 0, 0], atol=1e-15)


def test_the_order_of_the_angles(tmp_path: Path) -> None:
    """East-north-up from sensor = (R1(roll) R2(pitch) R3(heading)), rotations of the frame (Barfoot 2017, 6.2)."""
    path = write(tmp_path / "a.csv", line(roll=0.2, pitch=-0.3, heading=0.4))
    found = read_log("pospac", path, {"axes": "rfu"}, clock=MICROSECONDS, crs="local").attitudes[0]
    c, s = np.cos, np.sin
    r1 = np.array([[1, 0, 0], [0, c(0.2), s(0.2)], [0, -s(0.2), c(0.2)]])
    r2 = np.array([[c(-0.3), 0, -s(-0.3)], [0, 1, 0], [s(-0.3), 0, c(-0.3)]])
    r3 = np.array([[c(0.4), s(0.4), 0], [-s(0.4), c(0.4), 0], [0, 0, 1]])
    rfu_from_body = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert (found * Rotation.from_matrix(r1 @ r2 @ r3 @ rfu_from_body).inv()).magnitude() < 1e-12


def test_damage(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.csv",
        line(),
        line(easting="6234x"),
        line(GPSTime="16281848865"),
        line(northing=1e12),
        line(heading="inf"),
        line(GPSTime=1628184887518266),
    )
    log = read_log("pospac", path, {"axes": "flu"}, clock=MICROSECONDS, crs="EPSG:32617")
    assert log.table.num_rows == 2
    assert {r.record for r in log.rejects} == {1, 2, 3, 4}


@pytest.mark.parametrize(
    ("options", "stated", "error", "says"),
    [
        ({}, {"clock": MICROSECONDS, "crs": "EPSG:32617"}, ConfigError, "axes of the poses are not stated"),
        ({"axes": "flu"}, {"crs": "EPSG:32617"}, TimeSystemError, "time system is not stated"),
        ({"axes": "flu"}, {"clock": MICROSECONDS}, ConfigError, "CRS of the log's positions is not stated"),
        ({"axes": "flu"}, {"clock": MICROSECONDS, "crs": "EPSG:4979"}, ConfigError, "is not projected"),
        ({"axes": "flu"}, {"clock": MICROSECONDS, "crs": "EPSG:32617", "height": "orthometric"}, CrsError, "no geoid"),
        ({"axes": "flu", "names": ["GPSTime"]}, {"clock": MICROSECONDS, "crs": "EPSG:32617"}, FormatError, "'easting'"),
    ],
)
def test_nothing_is_guessed(tmp_path: Path, options: Any, stated: Any, error: type, says: str) -> None:
    with pytest.raises(error, match=says):
        read_log("pospac", write(tmp_path / "a.csv", line()), options, **stated)
