"""Control whose places are off, told by its heights on a road that slopes."""

from __future__ import annotations

import numpy as np

from roadscan.adjust.adjustment import AdjustmentSettings
from roadscan.adjust.control_test import SurveyErrors, judged

SHIFT_M = np.array([0.1, 0.36])


def surveyed(rng: np.random.Generator, shift_m: np.ndarray, slope: float = 0.025, points: int = 10) -> SurveyErrors:
    """Heights of points on both sides of a crowned road with a bend; σ 2 mm of the survey, 1 mm of the measurement, and
    5 mm of the poses that all have in common.
    """
    heading = np.linspace(0.2, 1.4, points)
    lean = (
        slope * np.where(np.arange(points) % 2, 1.0, -1.0)[:, None] * np.stack([np.sin(heading), -np.cos(heading)], 1)
    )
    away = lean @ shift_m + np.hypot(0.002, 0.001) * rng.standard_normal(points) + 0.005 * rng.standard_normal()
    covariance = 1e-6 * np.eye(points) + 25e-6
    return SurveyErrors(np.arange(points), np.full(points, 2), away, covariance, np.full(points, 4e-6), lean)


def test_a_shift_of_the_control_is_told_by_slopes_with_its_sigma() -> None:
    normalised = []
    for seed in range(40):
        errors = surveyed(np.random.default_rng(seed), SHIFT_M)
        shift = judged([errors], errors, AdjustmentSettings()).shift
        if shift.sigmas:
            off = shift.shift_m - SHIFT_M
            normalised.append(off @ np.linalg.solve(shift.covariance_m2, off) / 2.0)
    assert len(normalised) > 30
    assert 0.6 < np.mean(normalised) < 1.5


def test_right_control_is_not_shifted() -> None:
    told = [
        bool(judged([errors], errors, AdjustmentSettings()).shift.sigmas)
        for seed in range(200)
        for errors in [surveyed(np.random.default_rng(seed), np.zeros(2))]
    ]
    assert sum(told) <= 10


def test_a_wrong_height_is_no_shift() -> None:
    errors = surveyed(np.random.default_rng(0), np.zeros(2))
    errors.away_m[3] += 0.1
    found = judged([errors], errors, AdjustmentSettings())
    assert [one.point for one in found.wrong] == [3]
    assert not found.shift.sigmas


def test_a_road_that_falls_to_one_side_tells_of_no_shift() -> None:
    """It cannot be told from an offset of the heights."""
    errors = surveyed(np.random.default_rng(0), np.zeros(2))
    errors.lean[:] = [0.02, -0.01]
    errors.away_m[:] += errors.lean @ SHIFT_M
    assert not judged([errors], errors, AdjustmentSettings()).shift.sigmas
