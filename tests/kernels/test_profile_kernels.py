"""Kernels that roll over a longitudinal profile, against SciPy's solution of the car and shapes known by hand."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import cont2discrete

from roadscan.condition.kernels.quarter_car import roll
from roadscan.condition.kernels.steps import roll_beam, roll_wheel
from roadscan.condition.profiles.profiles import GOLDEN_CAR, RULES, SPEED_M_PER_S

K1, K2, C, MU = 653.0, 63.3, 6.0, 0.15
MOTION = np.array([[0, 1, 0, 0], [-K2, -C, K2, C], [0, 0, 0, 1], [K2 / MU, C / MU, -(K1 + K2) / MU, -C / MU]])
ROAD = np.array([[0], [0], [0], [K1 / MU]])


@pytest.mark.slow
def test_against_scipy_step_by_step() -> None:
    """`lsim` of the same equations, input held over each step, at two spacings and an irregular one."""
    rng = np.random.default_rng(3)
    irregular = np.concatenate([[0.0], np.cumsum(rng.uniform(0.02, 0.3, 500))])
    for x in (np.arange(0, 60, 0.25), np.arange(0, 40, 0.05), irregular):
        h = np.cumsum(rng.normal(0, 0.002, x.size))
        response, measured = np.empty((1, x.size)), np.empty((1, x.size))
        roll(x, h[None], GOLDEN_CAR, RULES, False, response, measured)
        start = (np.interp(11.0, x, h) - h[0]) / 11.0
        state, felt = np.array([start, 0.0, start, 0.0]), []
        for a, b in pairwise(x):
            ends = np.clip([0.5 * (a + b) - 0.125, 0.5 * (a + b) + 0.125], x[0], x[-1])
            ends = np.array([a, b]) if b - a >= 0.25 else ends
            slope = np.diff(np.interp(ends, x, h))[0] / np.diff(ends)[0]
            step, push, *_ = cont2discrete((MOTION, ROAD, np.eye(4), np.zeros((4, 1))), (b - a) / SPEED_M_PER_S)
            state = step @ state + push[:, 0] * slope
            felt.append(abs(state[0] - state[2]) * (b - a))
        assert response[0, 1:] == pytest.approx(np.cumsum(felt), rel=1e-9)
        assert measured[0] == pytest.approx(x - x[0], abs=1e-9)


def test_squares_and_gaps() -> None:
    """Behind a gap the sums stand still; a second profile of the same stations is summed by itself."""
    x = np.arange(0.0, 60.0, 0.1)
    h = 0.01 * np.sin(x)
    heights = np.stack([h, np.where((x > 20) & (x < 30), np.nan, h), np.where(x < 55, np.nan, h)])
    response, measured = np.empty(heights.shape), np.empty(heights.shape)
    roll(x, heights, GOLDEN_CAR, RULES, True, response, measured)
    assert measured[:, -1] == pytest.approx([59.9, 59.9 - 10.0, 0.0], abs=0.11)
    inside = (x > 20) & (x < 30)
    assert (response[1, inside] == response[1, np.argmax(inside) - 1]).all()
    assert np.array_equal(response[0, x < 19.8], response[1, x < 19.8]) and not response[2].any()
    absolute = np.empty(heights.shape)
    roll(x, heights, GOLDEN_CAR, RULES, False, absolute, measured)
    assert np.diff(response[0]) == pytest.approx(np.diff(absolute[0]) ** 2 / 0.1, rel=1e-6, abs=1e-15)


def test_a_wheel_on_an_edge_and_a_beam_over_it() -> None:
    x = np.arange(0.0, 6.0, 0.01)
    h = np.where(x < 3.0 - 1e-9, 0.0, 0.02)
    wheel, deviation = np.empty(x.size), np.empty(x.size)
    roll_wheel(x, h, 0.1, wheel)
    k = 297  # 3 cm before the edge
    assert wheel[k] == pytest.approx(0.02 + np.sqrt(0.01 - 0.03**2) - 0.1)
    roll_wheel(x, h, 0.0, wheel)
    assert np.array_equal(wheel, h)
    roll_beam(x, wheel, 2.0, 0.3048, deviation)
    assert deviation[250] == pytest.approx(-0.01) and deviation[350] == pytest.approx(0.01)
    assert np.isnan(deviation[:100]).all() and np.isfinite(deviation[100:500]).all()
