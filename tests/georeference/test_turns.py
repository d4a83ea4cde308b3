"""Limits of readings in turns, against circles that are driven exactly."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.rig import Mounting, Mountings, ScanGeometry
from roadscan.core.settings.segmentation import RangeFilter, RoadSegmentation
from roadscan.georeference.road_profiles import OVERLAPPING, WINDOW_NS, RoadFinder, turn_limits
from roadscan.poses.trajectory import Trajectory

RADIUS_M, SPEED_M_PER_S, KNOT_NS = 6.0, 4.0, 5_000_000
START = 1_400_000_000 * 10**9
ARM_M = (1.3, 0.4, -0.5)


def drive(turn: int, way: int = 1) -> Trajectory:
    """8 m straight, half a circle to the right (`turn` 1) or left, 8 m straight; backwards with `way` −1."""
    seconds = np.arange(0.0, (16.0 + np.pi * RADIUS_M) / SPEED_M_PER_S, KNOT_NS * 1e-9)
    driven = way * SPEED_M_PER_S * seconds
    turned = turn * way * np.clip(np.abs(driven) - 8.0, 0.0, np.pi * RADIUS_M) / RADIUS_M
    heading = 2.0 + turned
    step = np.diff(driven, prepend=driven[0])
    middle = heading - 0.5 * np.diff(heading, prepend=heading[0])
    chord = step * np.sinc(np.diff(heading, prepend=heading[0]) / (2 * np.pi))
    place = np.cumsum(np.stack([chord * np.sin(middle), chord * np.cos(middle), 0.0 * chord], axis=-1), axis=0)
    sine, cosine, zero = np.sin(heading), np.cos(heading), np.zeros_like(heading)
    axes = [[sine, cosine, zero], [cosine, -sine, zero], [zero, zero, zero - 1.0]]
    matrices = np.moveaxis(np.array(axes), -1, 0).transpose(0, 2, 1)
    quaternion = Rotation.from_matrix(matrices).as_quat()[:, [3, 0, 1, 2]]
    epochs = START + np.round(seconds * 1e9).astype(np.int64)
    return Trajectory.of(LOCAL_WORLD, epochs, place, quaternion)


def in_turn(trajectory: Trajectory) -> np.ndarray:
    """Epochs well within the turn, at no multiple of anything."""
    first = trajectory.epochs_gps_ns[0] + round((8.0 + 2.0) / SPEED_M_PER_S * 1e9)
    return first + np.arange(0, 3_000_000_000, 13_333_333)


@pytest.mark.parametrize(("turn", "way"), [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_profiles_cross_at_the_centre_of_the_turn(turn: int, way: int) -> None:
    trajectory = drive(turn, way)
    limits = turn_limits(trajectory, ARM_M, in_turn(trajectory), RangeFilter())
    inner, outer = (1, 0) if turn > 0 else (0, 1)
    assert np.isinf(limits[:, outer]).all()
    # Eq. 3 over 1 m of path: Δs / sin Δθ, where Δs is that of a sensor aside.
    own = RADIUS_M - turn * ARM_M[1]
    angle = 1.0 / own
    assert limits[:, inner] == pytest.approx(own * angle / np.sin(angle), rel=0.01)


def test_straight_slow_and_unknown_pieces_are_no_turns() -> None:
    trajectory = drive(1)
    before = trajectory.epochs_gps_ns[0] + np.arange(0, 1_500_000_000, 10_000_000)
    beyond = np.array([before[0] - 60 * 10**9, trajectory.epochs_gps_ns[-1] + 60 * 10**9])
    assert np.isinf(turn_limits(trajectory, ARM_M, np.concatenate([beyond, before]), RangeFilter())).all()
    slow = Trajectory.of(
        LOCAL_WORLD,
        START + 40 * (trajectory.epochs_gps_ns - START),
        trajectory.position_world_m,
        trajectory.quaternion_world_from_body,
    )
    assert np.isinf(turn_limits(slow, ARM_M, START + 40 * (in_turn(trajectory) - START), RangeFilter())).all()
    assert turn_limits(trajectory, ARM_M, before[:0], RangeFilter()).shape == (0, 2)


def test_limits_have_the_same_bits_whatever_is_at_hand() -> None:
    whole = drive(1)
    epochs = START + np.arange(0, 8_000_000_000, 13_333_333)
    expected = turn_limits(whole, ARM_M, epochs, RangeFilter())
    assert np.isfinite(expected).any()
    for rows in (slice(170, 171), slice(200, 260), slice(300, 420)):
        first, last = epochs[rows][[0, -1]]
        pad = WINDOW_NS + 10_000_000 + 3 * KNOT_NS
        near = (whole.epochs_gps_ns >= first - pad) & (whole.epochs_gps_ns <= last + pad)
        part = Trajectory.of(
            LOCAL_WORLD,
            whole.epochs_gps_ns[near],
            whole.position_world_m[near],
            whole.quaternion_world_from_body[near],
        )
        assert np.array_equal(turn_limits(part, ARM_M, epochs[rows][::-1], RangeFilter())[::-1], expected[rows])


def test_readings_beyond_the_crossing_overlap() -> None:
    geometry = ScanGeometry(kind="polar", readings=181, first=np.pi / 2, step=-np.radians(1.0), range_step_m=0.001)
    angle = geometry.first + geometry.step * np.arange(geometry.readings)
    with np.errstate(divide="ignore"):
        exact = np.where(np.cos(angle) > 0.05, 2.5 / np.cos(angle), 0.0)
    trajectory = drive(1)
    epochs = np.concatenate([in_turn(trajectory)[::20], [START + 600 * 10**9]])
    ranges = np.tile(np.round(exact * 1000).astype(np.uint16), (epochs.size, 1))
    mounting = Mountings.one(Mounting(ARM_M, tuple(map(tuple, np.eye(3)))))
    plain, turned = (
        RoadFinder(RoadSegmentation(turns=t), trajectory, mounting, 0.0, np.inf).profiles(epochs, ranges, geometry)
        for t in (None, RangeFilter())
    )
    assert (plain.classes[:-1] == 0).mean() > 0.8
    limits = turn_limits(trajectory, ARM_M, epochs, RangeFilter())
    across = ranges * 0.001 * np.sin(angle)
    beyond = (plain.classes == 0) & (across > limits[:, 1:]) & (ranges > 0)
    assert beyond.any() and (limits[:-1, 1] < 6.0).all()
    assert np.array_equal(turned.classes == OVERLAPPING, beyond)
    assert np.array_equal(turned.classes[~beyond], plain.classes[~beyond])
    assert np.array_equal(turned.ranges, np.where(turned.classes >= 9, 0, ranges))
    assert np.array_equal(turned.counts, [(turned.classes == kind).sum() for kind in (9, 10, 11, 12, 13)])
    assert np.array_equal(turned.ranges[-1], ranges[-1])  # no pose: left alone
