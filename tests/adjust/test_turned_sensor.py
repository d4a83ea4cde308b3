"""A sensor that is turned for good, and attitudes that are worse than stated: which of the two one drive shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from roadscan.adjust.adjustment import Adjustment
from roadscan.adjust.observations import FIXED, KINDS, MOUNTED, GaussMarkov, MountingPrior, Observations, RunPrior
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.adjust.tasks.mountings import Cause, rolls_in_words
from roadscan.adjust.tasks.solution import JointEvidence, rolled, turned_for_good
from roadscan.adjust.ties.plane import Lean

PITCH = 4  # of poses, and of mountings
STATED_RAD = math.radians(0.01)
SECONDS = 60
SETTINGS = AdjustmentSettings(knot_spacing_s=1.0)
MOUNTING = MountingPrior("lidar", np.where(np.arange(len(MOUNTED)) == PITCH, STATED_RAD, 0.0))
ATTITUDE, LEVEL, HELD = GaussMarkov(STATED_RAD, 30.0), GaussMarkov(0.01, 30.0), GaussMarkov(0.0, 30.0)
DRIVE = RunPrior("drive", 0, SECONDS * 10**9, (HELD, HELD, LEVEL, HELD, ATTITUDE, HELD))


def ties(mounted_rad: float, poses_rad: npt.NDArray[np.float64]) -> Observations:
    """Heights of road that a lidar saw from 5 to 20 m before it, and again from as far behind it."""
    rng, n, sigma_m = np.random.default_rng(2), 2000, 0.005
    arm_m = rng.uniform(5.0, 20.0, n)
    first = rng.uniform(0.0, SECONDS - 5.0, n)
    epochs = np.stack([first, first + arm_m / 5.0], axis=-1)
    arms, sign = np.stack([arm_m, -arm_m], axis=-1), np.array([1.0, -1.0])
    partials, mounts = np.zeros((n, 2, 6)), np.zeros((n, 2, len(MOUNTED)))
    partials[:, :, 2] = sign
    # A pitch lifts what is ahead: down falls by the arm.
    partials[:, :, PITCH] = mounts[:, :, PITCH] = -arms * sign
    turn = mounted_rad + np.interp(epochs, np.arange(SECONDS + 1.0), poses_rad)
    away = -(partials[:, :, PITCH] * turn).sum(axis=1) + rng.normal(0.0, sigma_m, n)
    return Observations(
        np.full(n, KINDS.index("plane_tie"), np.uint8), np.zeros((n, 2), np.int32), (1e9 * epochs).astype(np.int64),
        partials, away, np.full(n, sigma_m), np.arange(n), np.arange(n), sensor=np.zeros((n, 2), np.int32),
        mount_partials=mounts,
    )  # fmt: skip


def every(observed: Observations) -> JointEvidence:
    return JointEvidence(observed, [DRIVE], SETTINGS, (), np.zeros(1, bool))


def adjusted(observed: Observations, prior: MountingPrior) -> Adjustment:
    return every(observed).adjusted([prior])


def test_a_sensor_that_is_turned_for_good_explains_what_attitudes_would_be_blamed_for() -> None:
    observed = ties(math.radians(0.4), np.zeros(SECONDS + 1))
    found = adjusted(observed, MOUNTING)
    assert abs(np.degrees(found.mountings.error[0, PITCH])) < 0.3  # the stated σ hold it back
    blamed = replace(found, variance_factors={**found.variance_factors, "pitch_rad": 80.0})
    asked = turned_for_good(every(observed), [MOUNTING], blamed)
    assert asked is not None
    turned = adjusted(observed, asked[0])
    assert turned.variance_factors["pitch_rad"] == 1.0
    assert np.degrees(turned.mountings.error[0, PITCH]) == pytest.approx(-0.4, abs=0.03)
    # A camera has evidence of its own.
    assert turned_for_good(replace(every(observed), filmed=np.ones(1, bool)), [MOUNTING], blamed) is None


def test_attitudes_that_wander_more_than_stated_are_no_turn_of_the_sensor() -> None:
    wander = np.random.default_rng(4).normal(0.0, 20.0 * STATED_RAD, SECONDS + 1)
    observed = ties(0.0, wander - wander.mean())
    found = adjusted(observed, MOUNTING)
    assert found.variance_factors["pitch_rad"] > 4.0
    assert turned_for_good(every(observed), [MOUNTING], found) is None


def test_attitudes_as_stated_ask_nothing() -> None:
    observed = ties(0.0, np.zeros(SECONDS + 1))
    found = adjusted(observed, MOUNTING)
    assert turned_for_good(every(observed), [MOUNTING], found) is None
    assert abs(np.degrees(found.mountings.error[0, PITCH])) < 0.01


ROLL = 3
ROLLED = MountingPrior("lidar", np.where(np.arange(len(MOUNTED)) == ROLL, STATED_RAD, 0.0))


def control(
    roll_rad: float, shift_m: tuple[float, float], beside_m: npt.NDArray[np.float64], fall: float = 0.025
) -> Observations:
    """Heights of control on a road to the north that falls from its crown to both sides, as a lidar on it sees them."""
    rng, n = np.random.default_rng(8), beside_m.size
    normal = np.stack([0.03 * rng.choice([-1.0, 1.0], n), fall * np.sign(beside_m), -np.ones(n)], axis=-1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    arm = np.stack([np.zeros(n), beside_m, np.full(n, 2.0)], axis=-1)
    partials, mounts = np.zeros((n, 2, 6)), np.zeros((n, 2, len(MOUNTED)))
    partials[:, 0, :3], partials[:, 0, 3:] = normal, np.cross(arm, normal)
    mounts[:, 0, 3:6] = partials[:, 0, 3:]
    away = partials[:, 0, ROLL] * roll_rad + normal[:, :2] @ shift_m + rng.normal(0.0, 0.003, n)
    return Observations(
        np.full(n, KINDS.index("control_height"), np.uint8), np.tile(np.array([0, FIXED], np.int32), (n, 1)),
        np.stack([np.linspace(1, SECONDS - 1, n) * 1e9, np.zeros(n)], axis=-1).astype(np.int64), partials, away,
        np.full(n, 0.002), np.arange(n), np.arange(n), np.full(n, 0.002),
        sensor=np.tile(np.array([0, -1], np.int32), (n, 1)), mount_partials=mounts,
    )  # fmt: skip


BESIDE_M = np.tile([-6.0, -2.0, 1.5, 5.0, -4.0, 3.0], 3)
ON_GOOD_POSES = RunPrior("drive", 0, SECONDS * 10**9, (HELD, HELD, GaussMarkov(0.002, 600.0), HELD, HELD, HELD))


def asked(
    observed: Observations, walls: Sequence[tuple[int, Lean]] = ()
) -> tuple[tuple[MountingPrior, ...] | None, tuple[Cause, ...]]:
    settings = SETTINGS.model_copy(update={"estimate_variance_components": False})
    every = JointEvidence(observed, [ON_GOOD_POSES], settings, (), np.zeros(1, bool), tuple(walls))
    return rolled(every, [ROLLED], every.adjusted([ROLLED]))


def test_a_roll_is_found_where_it_explains_control_better_than_a_shift_of_it() -> None:
    priors, rolls = asked(control(math.radians(0.4), (0.0, 0.0), BESIDE_M))
    assert priors is not None and rolls == ()
    assert np.degrees(priors[0].sigma[ROLL]) == pytest.approx(0.4, abs=0.05)


def test_control_that_lies_aside_is_no_roll() -> None:
    assert asked(control(0.0, (0.5, -0.6), BESIDE_M)) == (None, ())


def test_a_roll_that_explains_control_as_well_as_a_shift_does_is_told() -> None:
    # All points lie as far to the side: their heights say the same of a roll and of a shift across.
    priors, [roll] = asked(control(0.0, (0.0, 0.6), np.tile([-3.5, 3.5], 9)))
    assert priors is None and roll.sensor == ("*", "lidar") and roll.component == ROLL
    assert "boresight roll of lidar that is off by" in rolls_in_words([roll])


def test_walls_decide_between_a_roll_and_control_that_lies_aside() -> None:
    observed = control(0.0, (0.0, 0.6), np.tile([-3.5, 3.5], 9))
    _, [roll] = asked(observed)
    leaning = Lean(0, "lidar", 40, -roll.error, math.radians(0.04))
    priors, rolls = asked(observed, [(0, leaning)])
    assert priors is not None and rolls == ()
    assert asked(observed, [(0, leaning._replace(roll_rad=0.0))]) == (None, ())


def test_right_control_asks_for_no_roll() -> None:
    assert asked(control(0.0, (0.0, 0.0), BESIDE_M)) == (None, ())
