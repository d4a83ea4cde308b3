"""The reference site from drawn observations: 3.3 km, 12 runs, control each 300 m or 825 m, 500 check points.

What the adjustment reaches is held against the best linear unbiased estimate from the true statistics. That is
computed here by the conditional distribution of jointly normal numbers, with dense covariances of the processes at the
epochs of the observations: no knots, no normal equations, no code of the adjustment. The best estimate is of heights,
which level poses separate from the rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2

from benchmarks.drawn_road import DOWN, Drawn, Road, control, derivatives, drawn_errors, ties
from benchmarks.settings import Settings
from benchmarks.timing import Figure
from roadscan.adjust.adjustment import Adjustment, AdjustmentSettings, adjust
from roadscan.adjust.observations import FIXED, Observations

Float64 = npt.NDArray[np.float64]

SITE = Road(3300.0, 12, 5.0, 300.0)
CHECKS = 500
CHECK_ROW = derivatives(DOWN, 0.0)
"""Check points lie on the track."""
BARS = {300.0: (2.6, 1.5), 825.0: (4.0, 1.9)}
"""Mean absolute height error (mm), each run alone and all together, by spacing of the control."""
REPEATABILITY_MM = 0.5
CURVE_M = (150.0, 300.0, 825.0, 1650.0)
"""Spacings of the control that the error is drawn against."""


def figures(_: Path) -> Iterator[Figure]:
    """By spacing of the control and mode: errors, repeatability, best estimate, honesty of σ; then the curve."""
    seeds = Settings.current().adjustment_seeds
    for spacing, (alone, together) in BARS.items():
        road = replace(SITE, control_spacing_m=spacing)
        for mode, bar in (("each_pass", alone), ("joint", together)):
            yield from of_mode(road, mode, bar, seeds)
    for mode in ("each_pass", "joint"):
        for spacing in CURVE_M:
            yield curve_point(replace(SITE, control_spacing_m=spacing), mode, seeds)


def curve_point(road: Road, mode: str, seeds: int) -> Figure:
    """Mean absolute height error at the check points for a spacing of the control, beside the best of those draws."""
    checks = np.linspace(0.0, road.length_m, CHECKS + 2)[1:-1]
    best = BestEstimate.of(road, checks, joint=mode == "joint")
    settings = AdjustmentSettings.model_validate({"mode": mode})
    found, limit = [], []
    for seed in range(seeds):
        rng = np.random.default_rng(1000 + seed)
        drawn = drawn_errors(road, np.concatenate([road.ties_m, road.control_m, checks]), rng)
        observations = Observations.joined([ties(road, drawn, rng), control(road, drawn, rng)])
        solved = adjust(observations, road.priors(), settings)
        found.append(np.abs(errors(solved, road, drawn, checks)[0]).mean())
        limit.append(np.abs(best.errors(observations, drawn)).mean())
    runs = "all runs" if mode == "joint" else "each run alone"
    name = f"control each {road.control_spacing_m:,.0f} m, {runs}: mean absolute height error"
    against = f"best; expected {1e3 * best.expected:.2f} mm"
    return Figure(name, 1e3 * float(np.mean(found)), "mm", 1e3 * float(np.mean(limit)), against)


def of_mode(road: Road, mode: str, bar: float, seeds: int) -> Iterator[Figure]:
    """One spacing, one mode."""
    checks = np.linspace(0.0, road.length_m, CHECKS + 2)[1:-1]
    best = BestEstimate.of(road, checks, joint=mode == "joint")
    settings = AdjustmentSettings.model_validate({"mode": mode})
    here, there, repeated, nees, loo = [], [], [], [], []
    for seed in range(seeds):
        rng = np.random.default_rng(1000 + seed)
        drawn = drawn_errors(road, np.concatenate([road.ties_m, road.control_m, checks]), rng)
        observations = Observations.joined([ties(road, drawn, rng), control(road, drawn, rng)])
        found = adjust(observations, road.priors(), settings)
        error, sigma = errors(found, road, drawn, checks)
        here.append(np.abs(error).mean())
        there.append(np.abs(best.errors(observations, drawn)).mean())
        repeated.append(error.std(axis=0, ddof=1).mean())
        nees.append(independent_nees(error, sigma, mode))
        loo.append(np.nanmean(np.square(found.control.left_out_m / found.control.left_out_sigma_m)))
    name = f"{road.control_spacing_m:.0f} m, {'all runs' if mode == 'joint' else 'each run alone'}"
    mean, spread = 1e3 * np.mean(here), 1e3 * np.std(here, ddof=1)
    yield Figure(f"{name}: mean absolute height error (bar {bar})", mean, "mm", 1e3 * float(np.mean(there)), "best")
    yield Figure(f"{name}: its spread over {seeds} seeds", spread, "mm", 1e3 * float(np.std(there, ddof=1)), "best")
    yield Figure(f"{name}: expected of the best estimate", 1e3 * best.expected, "mm")
    if mode == "joint":
        yield Figure(f"{name}: repeatability (bar {REPEATABILITY_MM})", 1e3 * float(np.mean(repeated)), "mm")
    low, high = nees_bounds(road, seeds, mode, best.runs_alike)
    yield Figure(f"{name}: normalised squared error", float(np.mean(nees)), "", None, f"95 %: {low:.2f} to {high:.2f}")
    yield Figure(f"{name}: the same of control left out", float(np.mean(loo)), "")


def errors(found: Adjustment, road: Road, drawn: Drawn, checks: Float64) -> tuple[Float64, Float64]:
    """Height errors (runs, checks) at the check points and their stated σ."""
    epochs, error, sigma = road.epochs(checks), [], []
    rows = np.tile(CHECK_ROW, (checks.size, 1))
    for run, name in enumerate(found.runs):
        shift, turn = found.corrections(name).at(epochs)
        error.append((drawn.at(run, checks) - np.hstack([shift, turn])) @ CHECK_ROW)
        sigma.append(found.sigma_of(run, epochs, rows))
    return np.array(error), np.array(sigma)


def spaced(mode: str) -> tuple[slice, slice]:
    """Check points a kilometre apart, whose errors are all but independent; one run where all are tied."""
    return slice(0, 1) if mode == "joint" else slice(None), slice(CHECKS // 6, None, CHECKS // 3)


def independent_nees(error: Float64, sigma: Float64, mode: str) -> float:
    """Mean normalised squared error."""
    return float(np.mean((error / sigma)[spaced(mode)] ** 2))


def nees_bounds(road: Road, seeds: int, mode: str, runs_alike: float) -> tuple[float, float]:
    """Its 95 % bounds; runs that share the errors of the control's survey count for fewer."""
    runs, stations = np.zeros((road.runs, CHECKS))[spaced(mode)].shape
    count = seeds * stations * runs / (1.0 + (runs - 1) * runs_alike**2)
    low, high = chi2.ppf([0.025, 0.975], count) / count
    return float(low), float(high)


@dataclass(frozen=True)
class BestEstimate:
    """Best linear unbiased estimate of the heights at the check points."""

    used: npt.NDArray[np.bool_]
    """Of the observations, those of height (and of control, where each run stands alone)."""
    factor: tuple[Float64, bool]
    """Cholesky factor of the covariance of those."""
    across: Float64
    """(runs · checks, used) covariance of the wanted heights with them."""
    checks: Float64
    runs_alike: float
    """Correlation of the errors of two runs that are estimated alone, at one check point half-way."""
    expected: float
    """Mean absolute error that it has by its own covariance at every tenth check point (m)."""

    @classmethod
    def of(cls, road: Road, checks: Float64, *, joint: bool) -> BestEstimate:
        """From the true statistics."""
        rng = np.random.default_rng(0)
        drawn = drawn_errors(road, np.concatenate([road.ties_m, road.control_m, checks]), rng)
        observations = Observations.joined([ties(road, drawn, rng), control(road, drawn, rng)])
        is_control = (observations.run == FIXED).any(axis=1)
        used = (observations.partials[:, 0, 2] != 0.0) & (joint | is_control)
        chosen = observations.chosen(used)
        own = pose_covariance(road, chosen, chosen)
        survey = chosen.survey_sigma_m
        own += np.diag(chosen.sigma_m**2) + survey_covariance(chosen, joint=joint)
        wanted = cls._wanted(road, checks)
        across = pose_covariance(road, wanted, chosen)
        factor = cho_factor(own, overwrite_a=True, lower=True)
        some = across[:: max(1, checks.size // 50)]
        prior = sum(p.sigma**2 * d**2 for p, d in zip(road.processes, CHECK_ROW, strict=True))
        variance = prior - np.einsum("ij,ji->i", some, cho_solve(factor, some.T))
        halfway = across[[checks.size // 2, checks.size // 2 + checks.size]]
        first, second = cho_solve(factor, halfway.T).T
        same_point = (chosen.place[:, None] == chosen.place) & (survey[:, None] > 0.0) & (survey > 0.0)
        alike = first @ np.where(same_point, survey[:, None] * survey, 0.0) @ second
        alike /= prior - halfway[0] @ first
        return cls(used, factor, across, checks, float(alike), float(np.sqrt(2.0 / np.pi * variance).mean()))

    def errors(self, observations: Observations, drawn: Drawn) -> Float64:
        """Its errors (runs · checks) for drawn observations."""
        estimate = self.across @ cho_solve(self.factor, observations.observed_m[self.used])
        runs = len(self.across) // self.checks.size
        true = np.concatenate([drawn.at(run, self.checks) @ CHECK_ROW for run in range(runs)])
        return np.asarray(true - estimate)

    @staticmethod
    def _wanted(road: Road, checks: Float64) -> Observations:
        """Check points of all runs as if they were observed."""
        size = road.runs * checks.size
        rows = np.zeros((size, 2, 6))
        rows[:, 0] = CHECK_ROW
        run = np.stack([np.repeat(np.arange(road.runs), checks.size), np.full(size, FIXED)], axis=1)
        epochs = np.stack([np.tile(road.epochs(checks), road.runs), np.zeros(size, np.int64)], axis=1)
        zeros = np.zeros(size, np.int64)
        return Observations(
            zeros.astype(np.uint8), run.astype(np.int32), epochs, rows, np.zeros(size), np.ones(size), zeros, zeros
        )


def pose_covariance(road: Road, one: Observations, two: Observations) -> Float64:
    """Of what the errors of the poses make of two sets of observations."""
    total = np.zeros((one.size, two.size))
    for run, a, b in itertools.product(range(road.runs), (0, 1), (0, 1)):
        i, j = np.flatnonzero(one.run[:, a] == run), np.flatnonzero(two.run[:, b] == run)
        apart = np.abs(one.epoch_gps_ns[i, a, None] - two.epoch_gps_ns[j, b]) / 1e9
        for c, p in enumerate(road.processes):
            first, second = one.partials[i, a, c], two.partials[j, b, c]
            if first.any() and second.any():
                total[np.ix_(i, j)] += first[:, None] * second * p.sigma**2 * np.exp(-apart / p.tau_s)
    return total


def survey_covariance(observations: Observations, *, joint: bool) -> Float64:
    """Of what the errors of the survey of the control make of them: one error a point, or a point and run."""
    survey = observations.survey_sigma_m
    shared = (observations.place[:, None] == observations.place) & (survey[:, None] > 0.0)
    if not joint:
        shared &= observations.run[:, None, 0] == observations.run[:, 0]
    return np.where(shared, survey[:, None] * survey, 0.0)
