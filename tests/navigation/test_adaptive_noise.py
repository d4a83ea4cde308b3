"""Noise that is measured on the run: σ of walks and of a recorded drive against what they miss where GNSS is masked."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from roadscan.navigation.inertial.adaptive import lasting_sigma, solve_adaptively, withheld
from roadscan.navigation.inertial.readings import Solution
from roadscan.navigation.inertial.smoother import solve
from tests.navigation.inertial_drives import (
    DRIVE_CONFIG,
    INSTANT,
    NO_GAPS,
    recorded,
    simulated,
    urban,
)
from tests.navigation.walks import WALKER, Walked, walked

SEEDS = (1, 2, 3, 5)


def outliers(solution: Solution) -> float:
    """Share of updates by GNSS that count less than stated."""
    innovations = solution.innovations
    assert innovations is not None
    gnss = np.char.startswith(innovations.kind.astype(str), "gnss")
    return float((innovations.weight[gnss] < 1.0).mean())


def honesty(walk: Walked, solution: Solution) -> np.ndarray:
    """Squares of the errors and of the σ in the outages: horizontal, down."""
    horizontal, down, over, under = walk.ratios(solution)
    errors = np.array([horizontal, down])
    return np.stack([errors**2, (errors / [over, under]) ** 2])


@cache
def adapted(seed: int, sigma_factor: float = 1.0) -> tuple[Walked, Solution]:
    walk = walked(seed, sigma_factor=sigma_factor)
    return walk, solve_adaptively(walk.imu, walk.masked, None, walk.vehicle, WALKER).solution


@pytest.mark.slow
@pytest.mark.parametrize("sigma_factor", [1.0, 3.0])
def test_sigma_of_a_walk_is_honest_in_outages(sigma_factor: float) -> None:
    """The settings of a vehicle, a lever arm wrong by 3 cm, errors of the IMU beyond its data sheet; receivers that
    state their σ rightly, and three times too small. Four outages of 10 s each.
    """
    seeds = [adapted(seed, sigma_factor) for seed in SEEDS]
    squares = np.sum([honesty(*one) for one in seeds], axis=0)
    ratios = np.sqrt(squares[0] / squares[1])
    assert (ratios > 0.5).all() and (ratios < 1.5).all()
    assert all(outliers(solution) < 0.05 for _, solution in seeds)
    for walk, solution in seeds:
        one = honesty(walk, solution)
        assert np.sqrt(one[0] / one[1]).max() < 1.6
        assert np.sqrt(one[0]).max() < 0.1


@pytest.mark.slow
def test_stated_noise_is_not_honest_on_a_walk() -> None:
    """What the tests above hold against: the constraints of a vehicle, and a receiver that is believed."""
    walk = walked(1)
    stated = solve(walk.imu, walk.masked, None, walk.vehicle, WALKER)
    assert walk.ratios(stated)[2] > 2.0
    believed = walked(1, sigma_factor=3.0)
    assert outliers(solve(believed.imu, believed.masked, None, believed.vehicle, WALKER)) > 0.2


@pytest.mark.slow
def test_sigma_of_a_recorded_drive_is_honest_in_outages(recordings: Path) -> None:
    """Eleven outages of 15 s of a car; withheld solutions that are not fixed say nothing (theirs err by 0.25 m).

    The bars of the errors themselves are what the page of navigation states.
    """
    drive = recorded(recordings)
    found = solve_adaptively(drive.imu, drive.masked, None, drive.vehicle, DRIVE_CONFIG)
    solution = found.solution
    own = solution.states["antenna_lever_arm_body_m"][0][-1]
    error, sigma, outage = drive.errors(solution, own)
    inside = outage >= 0
    for columns in ([0, 1], [2]):
        ratio = np.sqrt((error[inside][:, columns] ** 2).sum() / (sigma[inside][:, columns] ** 2).sum())
        assert 0.5 < ratio < 1.5
    error, sigma, outage = drive.errors(solution, drive.vehicle.antenna_lever_arm_body_m)
    worst = [np.hypot(*error[outage == k, :2].T).max() for k in range(11)]
    assert np.median(worst) < 0.165
    assert max(worst) < 0.255
    assert outliers(solution) < 0.05
    assert "imu_factor_vertical" in found.measured
    assert "sideways_m_per_s" not in found.measured and "upwards_m_per_s" not in found.measured


def test_noise_that_is_stated_rightly_is_left_as_it_is() -> None:
    """A simulated car whose noise is that of the rig file: the same bits as without."""
    made = simulated(urban("tactical", NO_GAPS))
    config = INSTANT.model_copy(update={"poses_per_s": 10.0})
    found = solve_adaptively(made.imu, made.gnss, made.odometer, made.vehicle, config)
    assert found.measured == {} and found.notes == ()
    plain = solve(made.imu, made.gnss, made.odometer, made.vehicle, config)
    assert plain.position_world_m.tobytes() == found.solution.position_world_m.tobytes()


def test_measuring_can_be_switched_off() -> None:
    walk = walked(1)
    config = WALKER.model_copy(update={"measure_noise": False})
    found = solve_adaptively(walk.imu, walk.masked, None, walk.vehicle, config)
    assert found.config == config and found.measured == {}


@pytest.mark.parametrize("kept", [0.0, 0.6])
def test_a_lasting_error_is_worth_less_than_a_new_one(kept: float) -> None:
    """A Gauss–Markov series of σ 2: the mean of n values has σ √((1 + φ) / (1 − φ)) · 2 / √n."""
    rng = np.random.default_rng(5)
    values = np.zeros((20_000, 1))
    for k in range(1, len(values)):
        values[k] = kept * values[k - 1] + np.sqrt(1.0 - kept**2) * 2.0 * rng.standard_normal()
    assert lasting_sigma(values) == pytest.approx(2.0 * np.sqrt((1.0 + kept) / (1.0 - kept)), rel=0.08)


def test_what_is_withheld() -> None:
    """Stretches as long as the run's own outages, five seconds of GNSS to both sides, none at the beginning."""
    seconds = np.arange(0.0, 600.0, 0.25)
    outage = (seconds >= 100.0) & (seconds % 100.0 < 14.0)
    epochs = (seconds[~outage] * 1e9).astype(np.int64)
    number = withheld(epochs)
    begins, ends = (np.array([pick(epochs[number == k]) for k in range(number.max() + 1)]) / 1e9 for pick in (min, max))
    assert number.max() > 10
    assert ends - begins == pytest.approx(np.full(begins.size, 14.0), abs=0.6)
    assert begins[0] > 30.0 and (begins[1:] - ends[:-1]).min() > 5.0
    for edge in np.arange(100.0, 600.0, 100.0):
        assert not ((begins < edge + 19.0) & (ends > edge - 5.0)).any()
    assert (withheld(epochs[:40]) < 0).all()
