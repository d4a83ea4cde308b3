"""What sight lines tell of a plate: whether it stands free, is a part of a wall, or has something close behind it."""

import numpy as np
import pytest

from benchmarks.drawn_streets import street_of_plates
from benchmarks.judge_sign import of_street
from roadscan.assets.kinds.sign import JUDGE
from roadscan.assets.scene import Box, GroundModel, Returns, Scene
from roadscan.assets.upright.plate_beams import sight_at

PLATE = np.array([[0.0, 8.0, 2.5, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.4, 0.3]])
"""A plate of 0.8 m by 0.6 m, 8 m north of the sensor, that faces south."""


def scene_of(ends_m: np.ndarray) -> Scene:
    """A scene of returns (n, 3) that a sensor at (0, 0, 2) saw."""
    n, box = len(ends_m), Box(-30.0, -30.0, 30.0, 30.0)
    small, zeros = np.zeros(n, np.uint8), np.zeros(n)
    returns = Returns(
        (0.0, 0.0), *ends_m.T.copy(), np.ones(n, np.float32), np.arange(n), np.zeros(n, np.uint16), small,
        np.zeros(n, np.uint16), small + np.uint8(1), small + np.uint8(1), zeros, zeros, zeros + 2.0,
    )  # fmt: skip
    flat = GroundModel(-30.0, -30.0, 1.0, np.zeros((60, 60), np.float32), np.ones((60, 60), np.bool_))
    return Scene(returns, box, box, flat, ends_m[:, 2].astype(np.float32), small, np.zeros((0, 4)))


def lines(depth_m: float, *, left: bool = True) -> Scene:
    """Lines to a grid about the plate: beside it they go on so far behind its plane, or not on its left.

    Its left, as seen from the front, is west.
    """
    u, v = (w.ravel() for w in np.meshgrid(np.arange(-1.0, 1.0, 0.04) + 0.01, np.arange(-0.9, 0.9, 0.04) + 0.01))
    beside = (np.abs(u) > 0.4) | (np.abs(v) > 0.3)
    sensor, way = np.array([0.0, 0.0, 2.0]), np.column_stack([u, np.full(u.size, 8.0), 0.5 + v])
    past = np.where(beside & (left | (u > -0.4)), depth_m, 0.0)
    return scene_of(sensor + way * (1.0 + past / 8.0)[:, None])


@pytest.mark.parametrize(
    ("depth_m", "expected"),
    [
        (6.0, {"open_more": 1.0, "open_less": 1.0, "open_top": 1.0, "open_below": 1.0, "backed": 0.0, "level": 0.0}),
        (0.4, {"open_more": 0.0, "open_less": 0.0, "open_top": 0.0, "open_below": 0.0, "level": 0.0}),
        (0.0, {"open_more": 0.0, "open_less": 0.0, "open_top": 0.0, "open_below": 0.0, "backed": 0.0, "level": 1.0}),
    ],
)
def test_sight_tells_a_free_plate_from_a_window_and_from_a_wall(depth_m: float, expected: dict[str, float]) -> None:
    told = sight_at(lines(depth_m), PLATE)
    assert {name: float(told[name][0]) for name in expected} == expected
    if depth_m == 0.4:
        assert told["backed"][0] > 0.5


def test_a_plate_that_goes_on_at_one_side_is_open_at_the_other() -> None:
    told = sight_at(lines(6.0, left=False), PLATE)
    assert (told["open_less"][0], told["open_more"][0], told["open_top"][0]) == (0.0, 1.0, 1.0)


def test_lines_that_pass_where_a_plate_was_show_that_it_moved() -> None:
    """A lorry's side that was met once, and the road behind it twice as often: its place is passed by two thirds."""
    side, gone = lines(6.0).returns, lines(6.0)
    met = np.column_stack([side.x_m, side.y_m, side.height_m])
    sensor = np.array([0.0, 0.0, 2.0])
    beyond = sensor + (met - sensor) * (14.0 / met[:, 1])[:, None]
    seen = sight_at(scene_of(np.concatenate([met, beyond, beyond])), PLATE)
    assert seen["passed"][0] == pytest.approx(2.0 / 3.0, abs=0.01)
    assert sight_at(gone, PLATE)["passed"][0] == 0.0


def test_lines_beside_a_triangle_do_not_pass_it() -> None:
    """Lines in the corners of the rectangle about a triangle end behind it."""
    u, v = (w.ravel() for w in np.meshgrid(np.arange(-0.39, 0.4, 0.02), np.arange(-0.29, 0.3, 0.02)))
    inside = np.abs(u) / 0.4 <= (0.3 - v) / 0.6
    sensor, way = np.array([0.0, 0.0, 2.0]), np.column_stack([u, np.full(u.size, 8.0), 0.5 + v])
    seen = sight_at(scene_of(sensor + way * np.where(inside, 1.0, 2.0)[:, None]), PLATE)
    assert seen["passed"][0] == 0.0


def test_too_few_lines_tell_nothing() -> None:
    told = sight_at(scene_of(np.array([[0.0, 8.0, 2.5], [0.6, 12.0, 2.5]])), PLATE)
    assert all(np.isnan(values).all() for values in told.values())


@pytest.mark.slow
def test_fronts_boards_and_vans_of_a_street_are_no_signs() -> None:
    """A street that the judge has not seen, with what is like signs; what each return met is the simulator's truth."""
    seen = of_street("plates 640", street_of_plates(640))
    named = JUDGE.probability(seen.features) >= 0.5
    assert (~seen.true).sum() >= 15
    assert seen.true[named].mean() >= 0.9
    assert named[seen.true].mean() >= 0.7
