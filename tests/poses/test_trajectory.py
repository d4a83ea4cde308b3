"""Poses against SciPy, closed forms, and two instruments bolted together."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S
from roadscan.poses.trajectory import Corrections, Trajectory


def drive(times_s: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """A smooth drive in closed form: positions (m) and attitudes, heading through 360° again and again."""
    position = np.stack([4e6 + 12 * times_s, 5e5 + 3 * np.sin(times_s), 4.8e6 + np.cos(0.7 * times_s)], axis=1)
    angles = np.stack([0.8 * times_s, 0.05 * np.cos(2 * times_s), 0.08 * np.sin(3 * times_s)], axis=1)
    return position, Rotation.from_euler("ZYX", angles)


def trajectory(times_s: np.ndarray, max_gap_s: float = 1.0) -> Trajectory:
    position, attitude = drive(times_s)
    epochs = np.round(times_s * NS_PER_S).astype(np.int64)
    return Trajectory.of("local", epochs, position, attitude.as_quat(scalar_first=True), max_gap_s)


def test_poses_follow_the_drive_between_knots() -> None:
    knots = np.arange(0, 20, 0.01)
    times = np.sort(np.random.default_rng(1).uniform(0.05, 19.9, 5000))
    poses = trajectory(knots).poses(np.round(times * NS_PER_S).astype(np.int64), strict=True)
    position, attitude = drive(poses.epochs_gps_ns / NS_PER_S)
    assert np.abs(poses.position_world_m - position).max() < 1e-8
    turned = attitude.inv() * Rotation.from_matrix(poses.world_from_body)
    assert turned.magnitude().max() < 1e-8


def test_error_falls_with_the_fourth_power_of_the_step() -> None:
    def worst(step: float) -> float:
        times = np.linspace(1, 9, 4001)
        poses = trajectory(np.arange(0, 10 + step, step), max_gap_s=2).poses((times * NS_PER_S).astype(np.int64))
        position, _ = drive(poses.epochs_gps_ns / NS_PER_S)
        return float(np.abs(poses.position_world_m - position).max())

    assert worst(0.2) / worst(0.1) > 10


def test_heading_has_no_jump_at_360_degrees() -> None:
    headings = np.radians([358.0, 359.0, 0.0, 1.0, 2.0])
    attitude = Rotation.from_rotvec(headings[:, None] * [0, 0, 1]).as_quat(scalar_first=True)
    attitude[3] *= -1  # the other quaternion of the same attitude
    epochs = np.arange(5, dtype=np.int64) * NS_PER_S
    path = Trajectory.of("local", epochs, np.zeros((5, 3)), attitude)
    at = np.linspace(0, 4, 401)
    poses = path.poses((at * NS_PER_S).astype(np.int64), strict=True)
    heading = np.degrees(np.arctan2(poses.world_from_body[:, 1, 0], poses.world_from_body[:, 0, 0]))
    assert np.abs((heading + 180) % 360 - 180 - (at - 2)).max() < 1e-6


def test_gap_has_no_pose_and_is_named() -> None:
    times = np.concatenate([np.arange(0, 5, 0.1), np.arange(8, 12, 0.1)])
    path = trajectory(times, max_gap_s=0.5)
    asked = (np.array([4.0, 6.0, 9.0, 13.0]) * NS_PER_S).astype(np.int64)
    assert path.poses(asked).found.tolist() == [True, False, True, False]
    assert len(path.gaps()) == 1
    with pytest.raises(NavigationError, match=r"2 epochs have no pose.*gap of 3\.10 s.*max_gap_s"):
        path.poses(asked, strict=True)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 300), st.integers(10, 90), st.integers(0, 2**31))
def test_poses_do_not_depend_on_how_much_was_loaded(start: int, length: int, seed: int) -> None:
    knots = np.sort(np.random.default_rng(seed).choice(40_000, 400, replace=False)) * 1e-4
    whole = trajectory(knots, max_gap_s=0.05)
    part = trajectory(knots[start : start + length], max_gap_s=0.05)
    inner = whole.epochs_gps_ns[start + 3 : min(start + length, 400) - 3]
    if inner.size < 2:
        return
    asked = np.linspace(inner[0], inner[-1], 50).astype(np.int64)
    a, b = whole.poses(asked), part.poses(asked)
    assert np.array_equal(a.found, b.found)
    assert np.array_equal(a.position_world_m, b.position_world_m, equal_nan=True)
    assert np.array_equal(a.world_from_body, b.world_from_body, equal_nan=True)


def test_unsorted_and_repeated_epochs_are_put_in_order() -> None:
    times = np.arange(0, 3, 0.1)
    position, attitude = drive(times)
    quaternion = attitude.as_quat(scalar_first=True)
    shuffled = np.random.default_rng(0).permutation(np.repeat(np.arange(30), 2))
    epochs = np.round(times * NS_PER_S).astype(np.int64)
    path = Trajectory.of("local", epochs[shuffled], position[shuffled], quaternion[shuffled])
    assert np.array_equal(path.epochs_gps_ns, epochs)
    assert np.array_equal(path.position_world_m, position)


def test_corrections_move_and_turn_in_the_stated_axes() -> None:
    epochs = np.arange(0, 11, dtype=np.int64) * NS_PER_S
    level = np.tile(Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]]).as_quat(scalar_first=True), (11, 1))
    path = Trajectory.of("local", epochs, np.zeros((11, 3)), level)
    knots = Corrections(epochs[[0, 10]], np.array([[0.0, 0, 0], [1.0, 2.0, 3.0]]), np.array([[0.0, 0, 0], [0, 0, 0.1]]))
    moved = path.corrected(knots)
    # Local frame: north is y, east is x, down is −z; linear in time.
    assert moved.position_world_m[5] == pytest.approx([1.0, 0.5, -1.5])
    turned = Rotation.from_quat(moved.quaternion_world_from_body[10], scalar_first=True).as_matrix()
    heading = np.arctan2(turned[0, 0], turned[1, 0])  # clockwise from y
    assert heading == pytest.approx(0.1)


def test_corrections_reach_the_level_frame_of_the_earth() -> None:
    from pyproj import Transformer

    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    start = np.array(to_ecef.transform(11.0, 48.0, 500.0))
    epochs = np.arange(2, dtype=np.int64) * NS_PER_S
    path = Trajectory.of("EPSG:4978", epochs, np.tile(start, (2, 1)), np.tile([1.0, 0, 0, 0], (2, 1)))
    shift = Corrections(epochs, np.tile([30.0, 0.0, -2.0], (2, 1)), np.zeros((2, 3)))
    lon, lat, height = to_ecef.transform(*path.corrected(shift).position_world_m[0], direction="INVERSE")
    assert height == pytest.approx(502.0, abs=1e-3)
    assert lon == pytest.approx(11.0, abs=1e-10)
    assert (lat - 48.0) * 111_200 == pytest.approx(30.0, abs=0.05)


def test_lever_arm_of_two_instruments_bolted_together(recordings) -> None:
    """Lidar poses interpolated to the radar's epochs: 0.2100 m, st.dev. ≤ 0.15 mm, worst ≤ 1.2 mm (Boreas)."""
    lidar = pd.read_csv(recordings / "two_pass" / "pass1_lidar_poses.csv.gz")
    radar = pd.read_csv(recordings / "two_pass" / "pass1_radar_poses.csv.gz")
    axes = ["easting", "northing", "altitude"]
    epochs = lidar["GPSTime"].to_numpy() * 1000 - 315_964_800 * NS_PER_S
    path = Trajectory.of("local", epochs, lidar[axes].to_numpy(), np.tile([1.0, 0, 0, 0], (len(lidar), 1)))
    asked = radar["GPSTime"].to_numpy() - 315_964_800 * NS_PER_S
    poses = path.poses(asked)
    arm = np.linalg.norm(poses.position_world_m - radar[axes].to_numpy(), axis=1)[poses.found]
    assert poses.found.sum() > 4400
    assert np.median(arm) == pytest.approx(0.2100, abs=1e-4)
    assert arm.std() <= 0.15e-3
    assert np.abs(arm - 0.2100).max() <= 1.2e-3
