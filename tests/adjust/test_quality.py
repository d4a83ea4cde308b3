"""Figures of accuracy against a published example, by hand, and against drawn errors."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.adjust.adjustment import ControlErrors
from roadscan.adjust.quality import (
    accuracy_by_distance,
    horizontal_accuracy,
    leave_one_out,
    nearest_m,
    relative_accuracy,
    vertical_accuracy,
)
from roadscan.core.errors import ConfigError


def test_vertical_figures_by_hand() -> None:
    found = vertical_accuracy(np.array([0.03, -0.01, 0.02, np.nan, -0.04]), 0.01)
    assert found.count == 4
    assert found.mean == pytest.approx(0.0)
    assert found.mean_absolute == pytest.approx(0.025)
    assert found.rmse == pytest.approx(np.sqrt(0.003 / 4))
    assert found.standard_deviation == pytest.approx(np.sqrt(0.003 / 3))
    assert found.largest == pytest.approx(0.04)
    assert found.nssda_95 == pytest.approx(1.96 * np.sqrt(0.003 / 4))
    assert found.asprs_rmse == pytest.approx(np.sqrt(0.003 / 4 + 0.0001))


def test_95_of_100_normal_errors_lie_within_what_nssda_states() -> None:
    rng = np.random.default_rng(1)
    upright, level = 0.004 * rng.standard_normal(200_000), 0.01 * rng.standard_normal((200_000, 2))
    assert np.mean(np.abs(upright) <= vertical_accuracy(upright).nssda_95) == pytest.approx(0.95, abs=0.002)
    assert np.mean(np.hypot(*level.T) <= horizontal_accuracy(level).nssda_95) == pytest.approx(0.95, abs=0.002)
    # Mean absolute and mean length of normal errors: σ √(2/π) and σ √(π/2).
    assert vertical_accuracy(upright).mean_absolute == pytest.approx(0.004 * np.sqrt(2 / np.pi), rel=0.01)
    assert horizontal_accuracy(level).mean_absolute == pytest.approx(0.01 * np.sqrt(np.pi / 2), rel=0.01)


def test_horizontal_figures_by_hand() -> None:
    found = horizontal_accuracy(np.array([[0.03, 0.04], [-0.03, 0.04], [np.nan, 0.0]]), 0.002)
    assert (found.count, found.mean_north, found.mean_east) == (2, pytest.approx(0.0), pytest.approx(0.04))
    assert (found.rmse_north, found.rmse_east, found.rmse_r) == pytest.approx((0.03, 0.04, 0.05))
    assert found.mean_absolute == pytest.approx(0.05)
    assert found.asprs_rmse == pytest.approx(np.sqrt(0.05**2 + 2 * 0.002**2))


def test_no_check_point_is_no_figure() -> None:
    with pytest.raises(ConfigError, match="no check point"):
        vertical_accuracy(np.array([np.nan]))


def test_leave_one_out_leaves_the_rejected_out_of_its_figures() -> None:
    nan = np.nan
    control = ControlErrors(
        np.arange(3), np.full(3, -1), np.array([[0.0, 0.0, 0.002]] * 3), np.array([[nan, nan, 0.001]] * 3),
        np.array([[nan, nan, 1.0], [nan, nan, 1.0], [nan, nan, 0.0]]),
        np.array([[nan, nan, 0.003], [nan, nan, -0.005], [nan, nan, 0.05]]),
        np.array([[nan, nan, 0.004], [nan, nan, 0.005], [nan, nan, 0.005]]),
    )  # fmt: skip
    found = leave_one_out(control)
    assert found.horizontal is None
    assert found.vertical is not None
    # A point surveyed too low (down too large) has the surface above it.
    assert (found.vertical.count, found.vertical.mean) == (2, pytest.approx(-0.001))
    np.testing.assert_allclose(found.normalised[:, 2], [0.75, -1.0, 10.0])
    assert np.isnan(found.normalised[:, :2]).all()


def test_a_point_that_several_passes_saw_counts_once() -> None:
    error, point = np.array([0.03, -0.03, 0.01, 0.02]), np.array([7, 7, 7, 9])
    found = vertical_accuracy(error, 0.01, point)
    assert found.count == 2
    assert found.mean == pytest.approx((0.01 / 3 + 0.02) / 2)
    assert found.mean_absolute == pytest.approx((0.07 / 3 + 0.02) / 2)
    assert found.rmse == pytest.approx(np.sqrt((0.0019 / 3 + 0.0004) / 2))
    level = horizontal_accuracy(np.stack([error, 0 * error], axis=-1), 0.01, point)
    assert (level.count, level.rmse_r) == (2, pytest.approx(found.rmse))


def test_passes_agree_by_section() -> None:
    station = np.array([-20.0, 5.0, 99.9, 100.0, 350.0])
    found = relative_accuracy(station, np.array([0.02, 0.03, 0.04, 0.01, 0.05]), np.full(5, 0.001))
    assert found.first_station_m.tolist() == [-100.0, 0.0, 100.0, 300.0]
    assert found.count.tolist() == [1, 2, 1, 1]
    np.testing.assert_allclose(found.rms_before_m, [0.02, np.sqrt(0.0025 / 2), 0.01, 0.05])
    np.testing.assert_allclose(found.rms_after_m, 0.001)


def test_errors_are_told_by_the_distance_to_control() -> None:
    distance = np.array([0.0, 24.9, 25.0, 150.0, 2000.0, np.nan, 30.0])
    error = np.array([0.001, -0.003, 0.004, -0.005, 0.02, 0.5, np.nan])
    found = accuracy_by_distance(distance, error)
    assert [(one.from_m, one.to_m, one.accuracy.count) for one in found] == [
        (0.0, 25.0, 2), (25.0, 50.0, 1), (100.0, 200.0, 1), (1600.0, np.inf, 1),
    ]  # fmt: skip
    assert found[0].mean_distance_m == pytest.approx(12.45)
    assert found[0].accuracy.mean_absolute == pytest.approx(0.002)
    assert found[0].accuracy.rmse == pytest.approx(np.sqrt(5.0) * 1e-3)


def test_a_point_is_not_its_own_control() -> None:
    control, numbers = np.array([0.0, 300.0, 310.0]), np.array([4, 5, 6])
    away = nearest_m(np.array([0.0, 300.0, 120.0]), np.array([4, 5, 9]), control, numbers)
    assert away.tolist() == [300.0, 10.0, 120.0]
    assert np.isnan(nearest_m(np.array([7.0]), np.array([4]), control[:1], numbers[:1])).all()
