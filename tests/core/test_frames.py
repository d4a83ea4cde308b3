"""Rotations against SciPy, and the local level against PROJ."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError
from roadscan.core.frames import (
    BODY_FROM_AXES,
    ENU_FROM_NED,
    body_from_axes,
    ecef_from_ned,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rph,
    rph_from_rotation,
)

ANGLE = st.floats(-np.pi, np.pi)
PITCH = st.floats(-1.5, 1.5)


@pytest.mark.slow
@given(roll=ANGLE, pitch=PITCH, heading=ANGLE)
@settings(max_examples=100, deadline=None)
def test_rotation_agrees_with_scipy_and_returns(roll: float, pitch: float, heading: float) -> None:
    ours = rotation_from_rph(roll, pitch, heading)
    np.testing.assert_allclose(ours, Rotation.from_euler("ZYX", [heading, pitch, roll]).as_matrix(), atol=1e-14)
    r, p, h = rph_from_rotation(ours)
    assert 0.0 <= h < 2 * np.pi
    np.testing.assert_allclose(
        np.exp(1j * np.array([r, p, h])), np.exp(1j * np.array([roll, pitch, heading])), atol=1e-12
    )


@pytest.mark.parametrize(
    ("rph_deg", "body", "level"),
    [
        ((0, 0, 90), (1, 0, 0), (0, 1, 0)),  # heading 90°: forward is east
        ((0, 90, 0), (1, 0, 0), (0, 0, -1)),  # nose up
        ((90, 0, 0), (0, 1, 0), (0, 0, 1)),  # right side down
        ((0, 0, 270), (0, 1, 0), (1, 0, 0)),  # heading west: right is north
    ],
)
def test_directions_in_words(rph_deg: tuple[float, ...], body: tuple[float, ...], level: tuple[float, ...]) -> None:
    np.testing.assert_allclose(rotation_from_rph(*np.radians(rph_deg)) @ body, level, atol=1e-15)


def test_rotations_in_bulk_equal_single_ones() -> None:
    angles = np.random.default_rng(7).uniform(-1.4, 1.4, (3, 20))
    many = rotation_from_rph(*angles)
    assert many.shape == (20, 3, 3)
    for one, rph in zip(many, angles.T, strict=True):
        np.testing.assert_array_equal(one, rotation_from_rph(*rph))
    roll, pitch, _ = rph_from_rotation(many)
    np.testing.assert_allclose([roll, pitch], angles[:2], atol=1e-14)


@given(
    raw=arrays(np.float64, (5, 4), elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q, axis=1).min() > 1e-3)
)
@settings(max_examples=100, deadline=None)
def test_quaternions_agree_with_scipy_and_return(raw: np.ndarray) -> None:
    theirs = Rotation.from_quat(raw, scalar_first=True)
    ours = rotation_from_quaternion(raw)
    np.testing.assert_allclose(ours, theirs.as_matrix(), atol=1e-14)
    back = quaternion_from_rotation(ours)
    assert (back[:, 0] >= 0).all()
    unit = raw / np.linalg.norm(raw, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.sum(back * unit, axis=1)), 1.0, atol=1e-14)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_quaternions_of_half_turns(axis: int) -> None:
    turn = -np.ones(3)
    turn[axis] = 1.0
    expected = np.zeros(4)
    expected[axis + 1] = 1.0
    np.testing.assert_allclose(np.abs(quaternion_from_rotation(np.diag(turn))), expected, atol=1e-15)


@pytest.mark.parametrize(("lat", "lon"), [(52.1, 11.6), (-33.9, 151.2), (40.7, -74.0), (0.0, 180.0)])
def test_local_level_axes_by_differences_of_positions(lat: float, lon: float) -> None:
    ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)

    def position(dlat: float, dlon: float, dh: float) -> np.ndarray:
        return np.array(ecef.transform(lon + dlon, lat + dlat, 100.0 + dh))

    step = 1e-4
    ahead = [(step, 0, 0), (0, step, 0), (0, 0, -10.0)]
    columns = [position(*d) - position(*(-x for x in d)) for d in ahead]
    expected = np.stack([c / np.linalg.norm(c) for c in columns], axis=1)
    np.testing.assert_allclose(ecef_from_ned(np.radians(lat), np.radians(lon)), expected, atol=1e-9)


def test_local_level_in_bulk() -> None:
    many = ecef_from_ned(np.radians([10.0, 20.0]), np.radians([30.0, 40.0]))
    np.testing.assert_array_equal(many[1], ecef_from_ned(np.radians(20.0), np.radians(40.0)))


def test_east_north_up() -> None:
    np.testing.assert_array_equal(ENU_FROM_NED @ [1, 2, 3], [2, 1, -3])


LETTERS = {"f": (1, 0, 0), "b": (-1, 0, 0), "r": (0, 1, 0), "l": (0, -1, 0), "d": (0, 0, 1), "u": (0, 0, -1)}


@pytest.mark.parametrize("axes", ["frd", "flu", "rfu", "bru"])
def test_axes_letters_name_where_each_axis_points(axes: str) -> None:
    matrix = body_from_axes(axes)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    np.testing.assert_array_equal(matrix.T, [LETTERS[letter] for letter in axes])


def test_unknown_axes() -> None:
    with pytest.raises(ConfigError, match="axes 'xyz'; expected one of frd, "):
        body_from_axes("xyz")


def test_axes_are_the_24_rotations_of_a_cube() -> None:
    """SciPy's octahedral group, found by another way, holds the same matrices."""
    cube = {tuple(np.rint(turn.as_matrix()).astype(int).ravel()) for turn in Rotation.create_group("O")}
    assert len(BODY_FROM_AXES) == len(cube) == 24
    assert {tuple(matrix.astype(int).ravel()) for matrix in BODY_FROM_AXES.values()} == cube
    assert all(np.linalg.det(matrix) == pytest.approx(1.0) for matrix in BODY_FROM_AXES.values())


def test_each_letter_says_where_its_axis_points() -> None:
    towards = {"f": (1, 0, 0), "b": (-1, 0, 0), "r": (0, 1, 0), "l": (0, -1, 0), "d": (0, 0, 1), "u": (0, 0, -1)}
    for axes, body_from_sensor in BODY_FROM_AXES.items():
        for letter, axis in zip(axes, np.eye(3), strict=True):
            np.testing.assert_array_equal(body_from_sensor @ axis, towards[letter])
    # As docs/real-data.md states a robot's upright scanner: x up, y right, z ahead.
    np.testing.assert_array_equal(body_from_axes("urf"), [[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
