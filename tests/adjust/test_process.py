"""Gauss–Markov processes at knots, and between them, against their covariance in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.adjust.process import GaussMarkov, RunPrior, knots_of, line_variance, precision_of
from roadscan.model.errors import ConfigError
from roadscan.model.settings.adjustment import AdjustmentSettings

PROCESS = GaussMarkov(0.015, 120.0)
S = 10**9


def prior(seconds: float, *processes: GaussMarkov) -> RunPrior:
    return RunPrior("one", 10**18, 10**18 + round(seconds * S), (*processes, *[PROCESS] * (6 - len(processes))))  # type: ignore[arg-type]


def covariance(times_s: np.ndarray, tau_s: float) -> np.ndarray:
    return np.exp(-np.abs(times_s[:, None] - times_s) / tau_s)


@pytest.mark.parametrize("tau_s", [0.3, 60.0, 1e6])
def test_precision_is_the_inverse_of_the_covariance(tau_s: float) -> None:
    epochs = np.array([0, 1, 2, 5, 9, 9.5, 30]) * S
    diagonal, beside = precision_of(epochs.astype(np.int64), tau_s)
    dense = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
    np.testing.assert_allclose(dense @ covariance(epochs / S, tau_s), np.eye(7), atol=1e-6 if tau_s > 1e5 else 1e-11)


@pytest.mark.parametrize(("share", "step_s", "tau_s"), [(0.5, 0.25, 120.0), (0.2, 1.0, 60.0), (0.7, 50.0, 20.0)])
def test_how_far_a_process_leaves_a_line(share: float, step_s: float, tau_s: float) -> None:
    three = np.array([0.0, share * step_s, step_s])
    combination = np.array([share - 1.0, 1.0, -share])
    expected = combination @ covariance(three, tau_s) @ combination
    assert line_variance(np.array(share), np.array(step_s), tau_s) == pytest.approx(expected, rel=1e-8)


def test_the_stated_error_of_lines_between_knots() -> None:
    """Settings state 0.25 mm for σ 15 mm, τ 120 s and knots each 0.1 s."""
    shares = np.linspace(0.0, 1.0, 1001)
    mean = line_variance(shares, np.array(AdjustmentSettings().knot_spacing_s), 120.0).mean()
    assert 15.0 * np.sqrt(mean) == pytest.approx(0.25, abs=0.005)


def test_knots_are_evenly_spaced_from_end_to_end() -> None:
    knots = knots_of(prior(10.1), 0.25)
    assert (knots[0], knots[-1]) == (10**18, 10**18 + 10_100_000_000)
    steps = np.diff(knots)
    assert steps.max() <= 0.25 * S
    assert np.ptp(steps) <= 1
    assert knots.size == 42
    assert knots_of(prior(0.0), 0.25).tolist() == [10**18]
    assert knots_of(prior(0.1), 0.25).size == 2


def test_a_process_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match="east_m of run 'one'"):
        prior(1.0, PROCESS, GaussMarkov(0.01, 0.0))
    with pytest.raises(ConfigError, match="ends"):
        RunPrior("one", 5, 4, (PROCESS,) * 6)
