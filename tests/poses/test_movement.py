"""Room for corrections: steps that cover them, and what is no correction."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.poses.trajectory import NO_CORRECTION, Allowance, Corrections, allowance_for


def corrections(north_m: float, down_m: float, roll_rad: float) -> Corrections:
    return Corrections(
        np.array([0, 10**9]),
        np.array([[0.0, 0.0, 0.0], [north_m, 0.0, down_m]]),
        np.array([[0.0, 0, 0], [roll_rad, 0, 0]]),
    )


def test_the_first_step_is_always_left_room_for() -> None:
    assert allowance_for(None) == (0.05, 0.0005)
    assert allowance_for(corrections(0.0, 5.0, 0.0)) == (0.05, 0.0005)  # straight down moves no place on the map
    assert NO_CORRECTION.is_none
    assert not allowance_for(None).is_none


@pytest.mark.parametrize(
    ("north_m", "roll_rad", "room"),
    [
        (0.01, 0.0, (0.05, 0.0005)),
        (0.05, 0.0005, (0.05, 0.0005)),
        (0.051, 0.0006, (0.2, 0.002)),
        (1.0, 0.1, (3.2, 0.128)),
    ],
)
def test_room_grows_in_steps_of_four(north_m: float, roll_rad: float, room: tuple[float, float]) -> None:
    found = allowance_for(corrections(north_m, 0.0, roll_rad))
    assert found == pytest.approx(room)
    assert found.shift_m >= north_m
    assert found.turn_rad >= roll_rad


def test_a_point_moves_by_shift_and_turn() -> None:
    assert Allowance(0.05, 0.002).moved_m(10.0) == pytest.approx(2 * (0.05 + 0.02))


def test_what_is_beyond_all_reason_is_refused() -> None:
    with pytest.raises(ValueError, match="5000"):
        allowance_for(corrections(5000.0, 0.0, 0.0))
