"""Gauss–Markov processes at knots, and between them, against their covariance in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.adjust.adjustment import adjust
from roadscan.adjust.observations import (
    GaussMarkov,
    Observations,
    RunPrior,
    StatedSigma,
    knots_of,
    line_variance,
    precision_of,
)
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.core.errors import ConfigError

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


def test_a_line_between_knots_of_unlike_sigma() -> None:
    share, step_s, tau_s, sigma = 0.3, 2.0, 50.0, np.array([0.01, 0.013, 0.02])
    three = np.array([0.0, share * step_s, step_s])
    combination = np.array([share - 1.0, 1.0, -share]) * sigma
    expected = combination @ covariance(three, tau_s) @ combination
    found = line_variance(np.array(share), np.array(step_s), tau_s, (sigma[0], sigma[2]))
    assert found == pytest.approx(expected, rel=1e-8)


def outage(rise_s: float = 0.1) -> RunPrior:
    """σ of the height is 15 mm, and in the middle 10 s of 100 s 150 mm."""
    since = np.array([0.0, 45.0 - rise_s, 45.0, 55.0, 55.0 + rise_s, 100.0])
    sigma = np.full((6, 6), np.nan)
    sigma[:, 2] = [0.015, 0.015, 0.15, 0.15, 0.015, 0.015]
    stated = StatedSigma(10**18 + (since * S).astype(np.int64), sigma)
    return RunPrior("one", 10**18, 10**18 + 100 * S, (PROCESS,) * 6, stated)


def test_an_outage_has_an_error_of_its_own() -> None:
    """Its σ is as stated, and at 15 mm of it the error goes on as it was."""
    one = outage()
    epochs = 10**18 + np.array([10, 50, 90]) * S
    np.testing.assert_allclose(one.sigma_at(epochs)[:, 2], [0.015, 0.15, 0.015])
    np.testing.assert_allclose(one.sigma_at(epochs)[:, 0], 0.015)
    parts = one.parts_at(epochs)
    assert parts.shape == (3, 12)
    np.testing.assert_allclose(np.hypot(parts[:, 2], parts[:, 8]), [0.015, 0.15, 0.015])
    np.testing.assert_allclose(parts[:, 2], 0.015)
    assert not parts[:, 6:8].any()


def test_an_outage_drifts() -> None:
    """The error while σ grows is a sum of independent steps, and what is left when σ has shrunk tells nothing of it."""
    tau_s, sigma, since = 50.0, np.array([0.01, 0.1, 0.4, 0.2]), np.array([0.0, 1.0, 3.0, 4.5])
    expected = np.empty((4, 4))
    for i in range(4):
        for k in range(4):
            way = sigma[min(i, k) : max(i, k) + 1]
            step = np.prod(np.minimum(way[1:], way[:-1]) / np.maximum(way[1:], way[:-1]))
            expected[i, k] = step * np.exp(-abs(since[i] - since[k]) / tau_s)
    diagonal, beside = precision_of((since * S).astype(np.int64), tau_s, sigma)
    found = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
    np.testing.assert_allclose(np.linalg.inv(found), expected, rtol=1e-9)


def test_how_the_error_grows_in_an_outage_does_not_tell_the_one_beside_it() -> None:
    """Differences of the height, every 0.25 s to 0.5 mm, as pictures measure them: the height itself stays unknown."""
    one = outage(3.0)
    since = np.arange(0.0, 100.1, 0.25)
    epochs = 10**18 + (since * S).astype(np.int64)
    n = epochs.size - 1
    partials = np.zeros((n, 2, 6))
    partials[:, 0, 2], partials[:, 1, 2] = 1.0, -1.0
    ways = Observations(
        np.zeros(n, np.uint8), np.zeros((n, 2), np.int32), np.stack([epochs[1:], epochs[:-1]], axis=1), partials,
        np.zeros(n), np.full(n, 5e-4), np.arange(n), np.arange(n),
    )  # fmt: skip
    found = adjust(ways, [one], AdjustmentSettings(mode="vertical"))
    sigma = found.sigma_of(0, epochs[[0, 100, 300]], np.tile(np.eye(6)[2], (3, 1)))
    # Three correlation times hold less than two independent errors, and the outage parts them.
    assert (sigma > 0.8 * 0.015).all()


@pytest.mark.parametrize("ends", [(0.1, 0.3), (0.3, 0.1), (0.2, 0.2)])
def test_a_line_between_knots_of_an_outage(ends: tuple[float, float]) -> None:
    share, step_s, tau_s = 0.3, 2.0, 50.0
    sigma = np.array([ends[0], 0.7 * ends[0] + 0.3 * ends[1], ends[1]])
    since = np.array([0.0, share * step_s, step_s])
    own = np.minimum(sigma[:, None], sigma) ** 2 * np.exp(-np.abs(since[:, None] - since) / tau_s)
    weights = np.array([share - 1.0, 1.0, -share])
    found = line_variance(np.array(share), np.array(step_s), tau_s, ends, True)
    assert found == pytest.approx(weights @ own @ weights, rel=1e-8)


def test_knots_are_closer_in_an_outage_and_bounded() -> None:
    one = outage()
    knots = (knots_of(one, 0.1) - 10**18) / S
    assert (np.diff(knots) > 0).all()
    assert (knots[0], knots[-1]) == (0.0, 100.0)
    assert np.diff(knots)[(knots[:-1] > 46) & (knots[1:] < 54)].max() < 0.01
    assert np.diff(knots)[knots[1:] < 44].min() == pytest.approx(0.1, rel=1e-3)
    assert knots.size < 5 * 1000 + 1


@pytest.mark.parametrize("wrong", [0.0, -1.0])
def test_a_stated_sigma_that_is_none_is_refused(wrong: float) -> None:
    with pytest.raises(ConfigError, match="not positive"):
        StatedSigma(np.array([10**18]), np.full((1, 6), wrong))
