"""Poses on the map against pyproj and SciPy, and the strip that a sensor sees."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from roadscan.adjust.tasks.tracks import swath_of
from roadscan.core.crs import MapFrame, grid_convergence_rad
from roadscan.poses.trajectory import LevelPoses, Trajectory, level_poses

LON, LAT = 11.4, 48.2
HEADING = np.radians([37.0, 37.5, 38.0, 38.5, 39.0])
EPOCHS = np.arange(5, dtype=np.int64) * 10**8


def drive() -> Trajectory:
    """Five poses 2 m apart, rolling, with stated headings from true north."""
    lat = LAT + np.arange(5) * 1.4e-5
    ecef = np.stack(
        Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(
            np.full(5, LON), lat, np.full(5, 500.0)
        ),
        axis=-1,
    )
    level = Rotation.from_euler("ZY", np.column_stack([np.full(5, np.radians(LON)), -np.pi / 2 - np.radians(lat)]))
    body = Rotation.from_euler("ZYX", np.column_stack([HEADING, np.full(5, 0.02), np.full(5, -0.03)]))
    return Trajectory.of("EPSG:4978", EPOCHS, ecef, (level * body).as_quat(scalar_first=True))


def test_attitude_is_against_true_north_and_heading_against_grid_north() -> None:
    found = level_poses(drive(), MapFrame(crs="EPSG:32632"), EPOCHS)
    expected = grid_convergence_rad("EPSG:32632", np.array([[LON, LAT]] * 5))
    assert expected[0] > 0.03  # a site where it matters
    assert found.convergence_rad == pytest.approx(expected, abs=1e-6)
    assert found.heading_rad == pytest.approx(HEADING - expected, abs=1e-6)
    turns = Rotation.from_matrix(found.level_from_body).as_euler("ZYX")
    assert turns == pytest.approx(np.column_stack([HEADING, np.full(5, 0.02), np.full(5, -0.03)]), abs=1e-9)
    to_map = Transformer.from_crs("EPSG:4979", "EPSG:32632", always_xy=True)
    east, north = to_map.transform(LON, LAT)
    assert found.body_m[0] == pytest.approx([east, north, 500.0], abs=1e-4)


def test_epochs_without_a_pose_are_left_out() -> None:
    found = level_poses(drive(), MapFrame(crs="EPSG:32632"), np.array([-5, 10**8, 10**12]))
    assert found.epoch_gps_ns.tolist() == [10**8]


def test_the_strip_lies_beside_the_way() -> None:
    """Readings 3 m ahead, from 0.5 m to 2.5 m to the right, 2 m below, of a vehicle that drives east."""
    turned = Rotation.from_euler("ZYX", [np.pi / 2, 0.0, 0.0]).as_matrix()
    poses = LevelPoses(np.array([0]), np.array([[100.0, 200.0, 52.0]]), turned[None], np.zeros(1))
    right = np.linspace(0.5, 2.5, 1001)
    points = np.column_stack([np.full(1001, 103.0), 200.0 - right, np.full(1001, 50.0)])
    found = swath_of(points, poses, np.zeros(1001, np.int64))
    assert (found.forward_m, found.right_m, found.below_m) == pytest.approx((3.0, 1.5, 2.0))
    assert found.half_width_m == pytest.approx(0.96, abs=0.01)  # without the outermost 2 % on each side
    assert found.half_length_m == pytest.approx(0.0, abs=1e-9)
