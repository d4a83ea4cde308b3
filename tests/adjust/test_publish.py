"""What of a solution is published, and what is left of observations by it."""

from __future__ import annotations

import numpy as np

from roadscan.adjust.observations import FIXED, Observations
from roadscan.adjust.tasks.publication import left_after, published
from roadscan.poses.trajectory import Corrections

KNOTS = np.arange(5, dtype=np.int64) * 10**9


def corrections(down_m: np.ndarray, roll_rad: float = 0.0, epochs: np.ndarray = KNOTS) -> Corrections:
    zero = np.zeros(epochs.size)
    turn = np.column_stack([np.full(epochs.size, roll_rad), zero, zero])
    return Corrections(epochs, np.column_stack([zero, zero, down_m]), turn, np.full((epochs.size, 6), 0.001))


def test_what_does_not_move_stays_to_the_bit() -> None:
    before = corrections(np.array([0.0, 0.01, 0.02, 0.03, 0.04]))
    near = corrections(before.north_east_down_m[:, 2] + 0.00009)
    assert published(before, near, 0.0001, 5.0) is before
    assert published(None, near, 0.0001, 5.0) is near


def test_only_knots_that_move_are_replaced() -> None:
    before = corrections(np.array([0.0, 0.01, 0.02, 0.03, 0.04]))
    after = corrections(before.north_east_down_m[:, 2] + [0.00005, -0.00005, 0.0, 0.002, 0.00002])
    found = published(before, after, 0.0001, 5.0)
    assert found.north_east_down_m[:, 2].tolist() == [0.0, 0.01, 0.02, after.north_east_down_m[3, 2], 0.04]
    at = np.linspace(0, 4e9, 401).astype(np.int64)
    assert np.abs(found.at(at)[0] - after.at(at)[0]).max() <= 0.0001


def test_a_sigma_that_was_widened_is_published_though_no_pose_moves() -> None:
    before = corrections(np.zeros(5))
    after = corrections(np.full(5, 0.00001))
    assert after.sigma is not None
    after.sigma[1] *= 1.04
    assert published(before, after, 0.0001, 5.0) is before
    after.sigma[2] = 0.050
    found = published(before, after, 0.0001, 5.0)
    assert found.sigma is not None
    assert found.sigma[:, 2].tolist() == [0.001, 0.001, 0.050, 0.001, 0.001]
    assert found.north_east_down_m[:, 2].tolist() == [0.0] * 5


def test_a_turn_counts_at_its_arm() -> None:
    before = corrections(np.zeros(5))
    assert published(before, corrections(np.zeros(5), 0.000019), 0.0001, 5.0) is before
    assert published(before, corrections(np.zeros(5), 0.000021), 0.0001, 5.0) is not before


def test_knots_at_other_epochs_are_replaced_as_a_whole() -> None:
    before = corrections(np.zeros(5))
    after = corrections(np.zeros(5), epochs=KNOTS + 1)
    assert published(before, after, 0.0001, 5.0) is after


def test_what_is_left_is_what_the_corrections_do_not_explain() -> None:
    """Run 0 is raised by 10 mm, run 1 by 4 mm: a tie of 6 mm is explained, and 10 mm of a control point."""
    partials = np.zeros((2, 2, 6))
    partials[0, 0, 2], partials[0, 1, 2], partials[1, 0, 2] = -1.0, 1.0, -1.0
    observations = Observations(
        np.array([0, 3], np.uint8), np.array([[0, 1], [0, FIXED]], np.int32),
        np.array([[10**9, 2 * 10**9], [10**9, 0]]), partials, np.array([0.006, 0.012]), np.full(2, 0.001),
        np.arange(2), np.arange(2),
    )  # fmt: skip
    held = {"a": corrections(np.full(5, -0.010)), "b": corrections(np.full(5, -0.004))}
    assert np.allclose(left_after(observations, held, ["a", "b"]), [0.0, 0.002], atol=1e-15)
