"""Control points: when passes come by, what they see of a point, and what observations follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from roadscan.adjust.control import (
    ControlPoint,
    WrongPoint,
    datum_fault,
    far_in_height,
    moved_m,
    observations_of,
    passes_by,
    sight,
    swapped,
)
from roadscan.adjust.places import PassReadings, Track
from roadscan.adjust.settings import TargetSettings
from roadscan.adjust.tasks.publication import left_after
from roadscan.core.frames import rotation_from_rph
from roadscan.poses.trajectory import Corrections

TARGETS = TargetSettings()
SLOPE = (0.02, -0.03)
"""Rise of the road to the east and to the north."""
POINT = ControlPoint(7, "G7", "gcp", "", 1000.0, 2000.0, 50.0, 0.003, 0.002, None)


def track(run: int = 0, heading_rad: float = 0.0, stand_s: float = 0.0) -> Track:
    """20 m north past the point at 10 m/s, two metres to its left; and back after a minute."""
    north = np.concatenate([np.linspace(-10, 10, 81), np.linspace(10, -10, 81)])
    epochs = np.concatenate([np.arange(81), np.arange(81) + 2400]) * 25_000_000 + run
    heading = np.concatenate([np.zeros(81), np.full(81, np.pi)]) + heading_rad
    n = north.size
    return Track(run, "head", epochs, np.full(n, 998.0), 2000.0 + north, np.full(n, 50.0), heading, 1.0, 2.5)


def test_a_pass_is_seen_each_time_that_it_comes_by_on_the_right_side() -> None:
    found = passes_by(track(), 1000.0, 2000.0, 0.3, 30.0)
    assert len(found) == 1  # on the way back the point lies to the left, beyond what is seen there
    middle = (found[0].first_gps_ns + found[0].last_gps_ns) / 2
    assert middle == pytest.approx(40 * 25_000_000, abs=25_000_000)
    assert found[0].last_gps_ns - found[0].first_gps_ns >= 2 * 0.3 / 10 * 1e9
    assert len(passes_by(track(), 997.5, 2000.0, 0.3, 30.0)) == 2
    assert passes_by(track(), 1001.5, 2000.0, 0.3, 30.0) == []


def readings(lift_m: float = 0.0, heading_rad: float = 0.4, convergence_rad: float = 0.01) -> PassReadings:
    """A sloping road around the point, seen from 2 m above it and 1.5 m beside."""
    step = np.arange(-0.4, 0.401, 0.01)
    east, north = (a.ravel() for a in np.meshgrid(step, step))
    height = 50.0 + lift_m + SLOPE[0] * east + SLOPE[1] * north
    n = east.size
    turned = rotation_from_rph(0.01, -0.02, heading_rad + convergence_rad)
    return PassReadings(
        0, "head", 1000.0 + east, 2000.0 + north, height, np.full(n, 100, np.uint16), np.zeros(n, np.int32),
        np.array([5 * 10**9]), np.array([[998.5, 2000.0, 52.0]]), np.asarray(turned).reshape(1, 3, 3), convergence_rad,
    )  # fmt: skip


def shifted(east_m: float, north_m: float, up_m: float, convergence_rad: float) -> Corrections:
    """Corrections that move the map by so much: true north lies that far anticlockwise of grid north."""
    c, s = np.cos(convergence_rad), np.sin(convergence_rad)
    true_north, true_east = c * north_m - s * east_m, s * north_m + c * east_m
    epochs = np.array([0, 10**10])
    return Corrections(epochs, np.tile([true_north, true_east, -up_m], (2, 1)), np.zeros((2, 3)))


def test_a_point_without_a_target_gives_its_height_along_the_normal() -> None:
    one = sight(POINT, [readings(0.013)], TARGETS, 0.02)
    assert (one.status, one.why_not) == ("height", "")
    assert one.height_m == pytest.approx(50.013, abs=1e-6)
    assert (one.slope_east, one.slope_north) == pytest.approx(SLOPE, abs=1e-6)
    found = observations_of([one])
    lift = 1 / np.sqrt(1 + SLOPE[0] ** 2 + SLOPE[1] ** 2)
    assert found.observed_m == pytest.approx([-0.013 * lift], abs=1e-7)
    # Its place is surveyed with a σ of its own, which the slope makes one of height.
    steep = np.hypot(*SLOPE) * POINT.sigma_horizontal_m
    assert found.survey_sigma_m == pytest.approx([np.hypot(0.002, steep)])
    # A pass that is moved east by 0.1 m sees the road there lower by the slope: no height is left.
    held = {"a": shifted(0.1, 0.0, -0.013 + 0.1 * SLOPE[0], one.convergence_rad)}
    assert left_after(found, held, ["a"]) == pytest.approx([0.0], abs=1e-9)
    assert moved_m(one, held["a"])[2] == pytest.approx(-0.013, abs=1e-9)


def test_a_picked_place_gives_two_components_of_one_group() -> None:
    from roadscan.adjust.control import PickedPlace

    one = sight(POINT, [readings()], TARGETS, 0.02, PickedPlace(1000.02, 1999.99, 0.004))
    assert one.status == "picked"
    found = observations_of([one, one])
    assert found.size == 6
    assert found.group.tolist() == [0, 1, 1, 2, 3, 3]
    held = {"a": shifted(-0.02, 0.01, 50.0 - one.height_m, one.convergence_rad)}
    assert np.abs(left_after(found, held, ["a"])).max() < 1e-9
    assert moved_m(one, held["a"])[:2] == pytest.approx([-0.02, 0.01])


def test_a_turn_moves_what_it_says() -> None:
    one = sight(POINT, [readings()], TARGETS, 0.02)
    turn = np.array([0.001, -0.0005, 0.0008])
    held = Corrections(np.array([0, 10**10]), np.zeros((2, 3)), np.tile(turn, (2, 1)))
    level = one.level_from_body
    moved = level @ (np.asarray(rotation_of(turn)) - np.eye(3)) @ one.arm_body_m
    c, s = np.cos(one.convergence_rad), np.sin(one.convergence_rad)
    east, north = c * moved[1] - s * moved[0], c * moved[0] + s * moved[1]
    expected = [east, north, -moved[2] - SLOPE[0] * east - SLOPE[1] * north]
    assert moved_m(one, held) == pytest.approx(expected, abs=3e-6)


def test_a_lidar_that_saw_a_point_from_before_and_from_behind_moves_it_by_the_mean_of_its_arms() -> None:
    """A pitch lifts what is ahead and lowers what is behind: of readings of both, 3 : 1, half of the arm is left."""
    here = readings(0.0, heading_rad=0.0, convergence_rad=0.0)
    n = here.easting_m.size
    pose = (np.arange(n) % 4 == 0).astype(np.int32)  # three of four from 10 m before it, one from 10 m behind
    body = np.array([[1000.0, 1990.0, 52.0], [1000.0, 2010.0, 52.0]])
    turned = np.broadcast_to(np.asarray(rotation_from_rph(0.0, 0.0, 0.0)).reshape(1, 3, 3), (2, 3, 3))
    moving = replace(
        here, pose=pose, epoch_gps_ns=np.array([5, 7]) * 10**9, body_m=body, level_from_body=turned,
        height_m=np.full(n, 50.0),
    )  # fmt: skip
    one = sight(POINT, [moving], TARGETS, 0.02)
    share = float((pose == 0).mean())
    assert one.arm_body_m == pytest.approx([10.0 * (2.0 * share - 1.0), 0.0, 2.0], abs=0.1)
    pitch = np.array([0.0, 0.001, 0.0])
    held = Corrections(np.array([0, 10**10]), np.zeros((2, 3)), np.tile(pitch, (2, 1)))
    assert moved_m(one, held)[2] == pytest.approx(0.001 * 10.0 * (2.0 * share - 1.0), abs=1e-4)


def rotation_of(vector: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vector).as_matrix()


def test_no_reading_near_is_said() -> None:
    none = replace(readings(), **{
        name: getattr(readings(), name)[:0] for name in ("easting_m", "northing_m", "height_m", "intensity", "pose")
    })  # fmt: skip
    one = sight(POINT, [none], TARGETS, 0.02)
    assert one.status == "unseen"
    assert observations_of([one]).size == 0


def test_another_datum_shows_in_the_median_and_one_point_by_itself() -> None:
    near = [sight(POINT, [readings(0.01 * k)], TARGETS, 0.02) for k in range(3)]
    assert datum_fault(near, 0.5) == ""
    below = [replace(one, point=replace(POINT, height_m=50.0 - 45.3)) for one in near]
    assert "-45.310 m" in datum_fault(below, 0.5)
    others = [replace(one, point=replace(POINT, name="G8")) for one in near]
    assert far_in_height([*others, below[0]], 0.5) == {"G7": pytest.approx(-45.3)}
    # One pass of three that lies far above the others does not condemn the point.
    assert far_in_height([*near[:2], replace(near[2], height_m=near[2].height_m + 45.3)], 0.5) == {}


def test_exchanged_heights_are_told_by_what_the_exchange_would_leave() -> None:
    nan = float("nan")
    one = WrongPoint("A", -0.301, nan, 0.002, 50.0)
    other = WrongPoint("B", 0.299, nan, 0.002, 50.3)
    third = WrongPoint("C", 0.050, nan, 0.002, 50.3)
    assert swapped([one, other, third]) == [("A", "B")]


def test_a_wrong_point_whose_difference_is_not_known_is_told() -> None:
    nan = float("nan")
    told = WrongPoint("P2", nan, nan, nan, 500.0, 4.1, 3.8, ("P3",)).in_words()
    assert told.startswith("its survey lies elsewhere from what all other evidence says (4.1 σ")
    assert told.endswith("none of their surveys counts")
