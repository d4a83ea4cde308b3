"""A sensor that is turned for good, and attitudes that are worse than stated: which of the two one drive shows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from roadscan.adjust.adjustment import Adjustment, adjust
from roadscan.adjust.observations import KINDS, MOUNTED, GaussMarkov, MountingPrior, Observations, RunPrior
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.adjust.tasks.solution import turned_for_good

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


def adjusted(observed: Observations, prior: MountingPrior) -> Adjustment:
    return adjust(observed, [DRIVE], SETTINGS, [prior], [])


def test_a_sensor_that_is_turned_for_good_explains_what_attitudes_would_be_blamed_for() -> None:
    observed = ties(math.radians(0.4), np.zeros(SECONDS + 1))
    found = adjusted(observed, MOUNTING)
    assert abs(np.degrees(found.mountings.error[0, PITCH])) < 0.3  # the stated σ hold it back
    blamed = replace(found, variance_factors={**found.variance_factors, "pitch_rad": 80.0})
    asked = turned_for_good(observed, [DRIVE], SETTINGS, [MOUNTING], [], blamed, np.zeros(1, bool))
    assert asked is not None
    turned = adjusted(observed, asked[0])
    assert turned.variance_factors["pitch_rad"] == 1.0
    assert np.degrees(turned.mountings.error[0, PITCH]) == pytest.approx(-0.4, abs=0.03)
    # A camera has evidence of its own.
    assert turned_for_good(observed, [DRIVE], SETTINGS, [MOUNTING], [], blamed, np.ones(1, bool)) is None


def test_attitudes_that_wander_more_than_stated_are_no_turn_of_the_sensor() -> None:
    wander = np.random.default_rng(4).normal(0.0, 20.0 * STATED_RAD, SECONDS + 1)
    observed = ties(0.0, wander - wander.mean())
    found = adjusted(observed, MOUNTING)
    assert found.variance_factors["pitch_rad"] > 4.0
    assert turned_for_good(observed, [DRIVE], SETTINGS, [MOUNTING], [], found, np.zeros(1, bool)) is None


def test_attitudes_as_stated_ask_nothing() -> None:
    observed = ties(0.0, np.zeros(SECONDS + 1))
    found = adjusted(observed, MOUNTING)
    assert turned_for_good(observed, [DRIVE], SETTINGS, [MOUNTING], [], found, np.zeros(1, bool)) is None
    assert abs(np.degrees(found.mountings.error[0, PITCH])) < 0.01
