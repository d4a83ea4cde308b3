"""The adjustment against dense least squares, a Kalman smoother, drawn truth and false matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from benchmarks.bench_reference_site import BestEstimate, errors
from benchmarks.drawn_road import Road, control, drawn_errors, ties
from roadscan.adjust.adjustment import Adjustment, AdjustmentSettings, adjust
from roadscan.adjust.observations import (
    COMPONENTS,
    FIXED,
    KINDS,
    GaussMarkov,
    MountingPrior,
    Observations,
    RunPrior,
    knots_of,
    partials,
)
from roadscan.adjust.sparse_normal import NormalEquations
from roadscan.core.errors import ConfigError

S = 10**9
START = 10**18
ALL_COUNT = AdjustmentSettings(
    knot_spacing_s=0.5, full_weight_within=1e6, reject_beyond=2e6, estimate_variance_components=False, false_alarm=0.0,
    datum_offset="follow", datum_false_alarm=0.0,
)  # fmt: skip
PROCESSES = (
    GaussMarkov(0.010, 100.0), GaussMarkov(0.012, 80.0), GaussMarkov(0.015, 120.0),
    GaussMarkov(1e-4, 60.0), GaussMarkov(1e-4, 60.0), GaussMarkov(2e-4, 30.0),
)  # fmt: skip


def priors(runs: int = 3, seconds: int = 10) -> list[RunPrior]:
    return [RunPrior(f"r{i}", START + i * 7 * S, START + (i * 7 + seconds + i) * S, PROCESSES) for i in range(runs)]


def scattered(seed: int = 1, ties_: int = 150, seen: int = 30) -> Observations:
    """Ties of any two runs or of one with itself, and control, in any direction, at any epoch."""
    rng = np.random.default_rng(seed)
    n = ties_ + seen
    run = rng.integers(0, 3, (n, 2)).astype(np.int32)
    run[ties_:, 1] = FIXED
    first, last = (np.array([getattr(p, k) for p in priors()]) for k in ("first_gps_ns", "last_gps_ns"))
    epoch = first[run] + (rng.uniform(size=(n, 2)) * (last - first)[run]).astype(np.int64)
    direction = rng.standard_normal((n, 3))
    direction[ties_:] = np.eye(3)[rng.integers(0, 3, seen)]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rows = [
        partials(direction, Rotation.random(n, rng=rng).as_matrix(), rng.uniform(-3.0, 3.0, (n, 3))) for _ in range(2)
    ]
    rows[1] *= -1.0
    rows[1][ties_:], epoch[ties_:, 1] = 0.0, 0
    kind = np.where(np.arange(n) < ties_, KINDS.index("plane_tie"), KINDS.index("control_position"))
    upright = np.abs(direction[:, 2]) == 1.0
    kind[ties_:][upright[ties_:]] = KINDS.index("control_height")
    place = np.where(np.arange(n) < ties_, np.arange(n), np.arange(n) % 4)
    survey = np.where(np.arange(n) < ties_, 0.0, np.where(upright, 0.002, 0.003))
    return Observations(
        kind.astype(np.uint8), run, epoch, np.stack(rows, axis=1), 0.01 * rng.standard_normal(n),
        rng.uniform(0.001, 0.004, n), np.arange(n), place, survey,
    )  # fmt: skip


def dense(
    observations: Observations, knots: list[np.ndarray], mountings: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean and covariance of all knots' corrections (run, knot, component), and covariance of the predictions.

    By the conditional distribution of jointly normal numbers, from covariances alone: no normal equations.
    """
    sizes = [6 * k.size for k in knots]
    first = np.concatenate([[0], np.cumsum(sizes)])
    prior = np.zeros((first[-1], first[-1]))
    a = np.zeros((observations.size, first[-1]))
    noise = np.diag(observations.sigma_m**2)
    for r, k in enumerate(knots):
        times = (k - START) / S
        for c, p in enumerate(PROCESSES):
            at = np.arange(first[r] + c, first[r + 1], 6)
            prior[np.ix_(at, at)] = p.sigma**2 * np.exp(-np.abs(times[:, None] - times) / p.tau_s)
            for end in (0, 1):
                for n in np.flatnonzero(observations.run[:, end] == r):
                    t = (observations.epoch_gps_ns[n, end] - START) / S
                    hats = np.array([np.interp(t, times, e) for e in np.eye(times.size)])
                    a[n, at] += observations.partials[n, end, c] * hats
                    own = np.concatenate([[t], times])
                    full = p.sigma**2 * np.exp(-np.abs(own[:, None] - own) / p.tau_s)
                    leaves = np.concatenate([[1.0], -hats])
                    noise[n, n] += observations.partials[n, end, c] ** 2 * (leaves @ full @ leaves)
    for point in np.unique(observations.place[observations.survey_sigma_m > 0]):
        seen = np.flatnonzero((observations.place == point) & (observations.survey_sigma_m > 0))
        d = observations.partials[seen, 0, :3] * observations.survey_sigma_m[seen][:, None]
        noise[np.ix_(seen, seen)] += d @ d.T
    if mountings is not None:
        by = by_mountings(observations, len(mountings))
        noise += by @ covariance_of(mountings) @ by.T
    gain = np.linalg.solve(a @ prior @ a.T + noise, a @ prior).T
    after = prior - gain @ a @ prior
    return gain @ observations.observed_m, after, a @ after @ a.T


def covariance_of(mountings: np.ndarray) -> np.ndarray:
    """Covariance (7 s, 7 s) of mountings whose σ (s, 7) are given and whose heights have no error in common.

    It is that of independent errors under the condition that the weighted mean of the heights is 0, to a thousandth.
    """
    covariance = np.diag(mountings.ravel() ** 2)
    height = np.zeros(mountings.shape)
    height[:, 2] = 1.0 / mountings[:, 2]
    mean = height.ravel() / mountings.ravel().clip(1e-30) / (height[:, 2] @ height[:, 2])
    with_mean = covariance @ mean
    return covariance - np.outer(with_mean, with_mean) / (mean @ with_mean) * (1.0 - 1e-6)


def by_mountings(observations: Observations, sensors: int) -> np.ndarray:
    """Derivatives (n, 7 s) by the mountings of sensors."""
    rows = np.zeros((observations.size, sensors, 7))
    for n in range(observations.size):
        for end in (0, 1):
            if observations.sensor[n, end] >= 0:
                rows[n, observations.sensor[n, end]] += observations.mount_partials[n, end]
    return rows.reshape(observations.size, -1)


def all_values(found: Adjustment) -> np.ndarray:
    return np.concatenate([v.ravel() for v in found.values])


def test_solution_and_covariance_are_those_of_dense_least_squares() -> None:
    observations = scattered()
    found = adjust(observations, priors(), ALL_COUNT)
    knots = [knots_of(p, 0.5) for p in priors()]
    mean, covariance, _ = dense(observations, knots)
    scale = np.tile([p.sigma for p in PROCESSES], mean.size // 6)
    np.testing.assert_allclose(all_values(found) / scale, mean / scale, atol=1e-9)
    begin = 0
    for r, k in enumerate(knots):
        own = covariance[begin : begin + 6 * k.size, begin : begin + 6 * k.size]
        blocks = own.reshape(k.size, 6, k.size, 6)
        unit = np.outer(scale[:6], scale[:6])
        at = np.arange(k.size)
        np.testing.assert_allclose(found.covariance[r] / unit, blocks[at, :, at] / unit, atol=1e-9)
        np.testing.assert_allclose(found.covariance_with_next[r] / unit, blocks[at[:-1], :, at[1:]] / unit, atol=1e-9)
        np.testing.assert_allclose(found.sigma[r], np.sqrt(np.diag(own)).reshape(-1, 6), rtol=1e-7)
        begin += 6 * k.size
    assert found.settled
    assert (found.weight == 1.0).all()


def test_mountings_are_those_of_dense_least_squares() -> None:
    """Of two sensors; the second one's heading is not estimated, and some ends were seen by a third one."""
    rng = np.random.default_rng(5)
    observations = scattered(4)
    sensor = rng.integers(-1, 2, (observations.size, 2)).astype(np.int32)
    sensor[observations.run == FIXED] = -1
    by = rng.standard_normal((observations.size, 2, 7))
    observations = replace(observations, sensor=sensor, mount_partials=by)
    sigma = np.array([[0.002, 0.003, 0.002, 2e-4, 1e-4, 3e-4, 5e-4], [0.001, 0.002, 0.004, 2e-4, 3e-4, 0.0, 1e-3]])
    known = [MountingPrior(name, own) for name, own in zip("ab", sigma, strict=True)]
    found = adjust(observations, priors(), ALL_COUNT, known)
    knots = [knots_of(p, 0.5) for p in priors()]
    mean, covariance, _ = dense(observations, knots, sigma)
    scale = np.tile([p.sigma for p in PROCESSES], mean.size // 6)
    np.testing.assert_allclose(all_values(found) / scale, mean / scale, atol=1e-9)
    np.testing.assert_allclose(
        np.concatenate([s.ravel() for s in found.sigma]), np.sqrt(np.diag(covariance)), rtol=1e-7
    )
    rows, prior = by_mountings(observations, 2), covariance_of(sigma)
    gain = np.linalg.solve(_total(observations, knots) + rows @ prior @ rows.T, rows @ prior).T
    np.testing.assert_allclose(found.mountings.error.ravel(), gain @ observations.observed_m, atol=1e-9)
    after = np.sqrt(np.maximum(np.diag(prior - gain @ rows @ prior), 0.0)).reshape(2, 7)
    # What the heights have in common stays as well known as it was.
    after[:, 2] = np.hypot(after[:, 2], 1.0 / np.sqrt((1.0 / sigma[:, 2] ** 2).sum()))
    after = after.ravel()
    np.testing.assert_allclose(found.mountings.sigma.ravel(), after, rtol=1e-6)
    assert found.mountings.error[1, 5] == found.mountings.sigma[1, 5] == 0.0


def _total(observations: Observations, knots: list[np.ndarray]) -> np.ndarray:
    """Covariance of the observations by poses, survey and their own σ."""
    prior, a = [], _rows(observations, knots)
    for k in knots:
        times = (k - START) / S
        whole = np.zeros((times.size, 6, times.size, 6))
        for c, p in enumerate(PROCESSES):
            whole[:, c, :, c] = p.sigma**2 * np.exp(-np.abs(times[:, None] - times) / p.tau_s)
        prior.append(whole.reshape(6 * times.size, -1))
    total = a @ block_diag(*prior) @ a.T
    lines = [_line_variance(observations, n) for n in range(observations.size)]
    total += np.diag(observations.sigma_m**2 + np.array(lines))
    for point in np.unique(observations.place[observations.survey_sigma_m > 0]):
        seen = np.flatnonzero((observations.place == point) & (observations.survey_sigma_m > 0))
        d = observations.partials[seen, 0, :3] * observations.survey_sigma_m[seen][:, None]
        total[np.ix_(seen, seen)] += d @ d.T
    return total


def test_each_observation_left_out_is_predicted_as_without_it() -> None:
    """The normalised residual, and control left out, by taking the observation away and solving densely."""
    observations = scattered(2, ties_=60, seen=12)
    found = adjust(observations, priors(), ALL_COUNT)
    knots = [knots_of(p, 0.5) for p in priors()]
    for n in (3, 17, 59):  # ties
        others = np.arange(observations.size) != n
        # A tie of no weight has the row that predicts it.
        mean, _, variance = dense(replace(observations, sigma_m=np.where(others, observations.sigma_m, 1e4)), knots)
        _, _, with_it = dense(observations, knots)
        predicted = _rows(observations, knots)[n] @ mean
        line = _line_variance(observations, n)
        own = observations.sigma_m[n] ** 2 + line
        expected = (observations.observed_m[n] - predicted) / np.sqrt(own + variance[n, n])
        assert found.normalised_residual[n] == pytest.approx(expected, rel=1e-5)
        assert found.redundancy[n] == pytest.approx(1.0 - with_it[n, n] / own, rel=1e-6)


def _rows(observations: Observations, knots: list[np.ndarray]) -> np.ndarray:
    rows = []
    for n in range(observations.size):
        parts = []
        for r, k in enumerate(knots):
            hats = np.zeros((k.size, 6))
            for end in (0, 1):
                if observations.run[n, end] == r:
                    t = float(observations.epoch_gps_ns[n, end] - START)
                    values = [np.interp(t, (k - START).astype(float), e) for e in np.eye(k.size)]
                    hats += np.outer(values, observations.partials[n, end])
            parts.append(hats.ravel())
        rows.append(np.concatenate(parts))
    return np.array(rows)


def _line_variance(observations: Observations, n: int) -> float:
    total = 0.0
    for end in (0, 1):
        r = observations.run[n, end]
        if r == FIXED:
            continue
        knots = (knots_of(priors()[r], 0.5) - START) / S
        t = (observations.epoch_gps_ns[n, end] - START) / S
        for c, p in enumerate(PROCESSES):
            hats = np.array([np.interp(t, knots, e) for e in np.eye(knots.size)])
            own = np.concatenate([[t], knots])
            leaves = np.concatenate([[1.0], -hats])
            full = p.sigma**2 * np.exp(-np.abs(own[:, None] - own) / p.tau_s)
            total += observations.partials[n, end, c] ** 2 * (leaves @ full @ leaves)
    return total


def test_a_control_point_left_out_is_as_without_its_survey() -> None:
    observations = scattered(3, ties_=60, seen=24)
    found = adjust(observations, priors(), ALL_COUNT).control
    point = 2
    here = (observations.place == point) & (observations.survey_sigma_m > 0)
    for axis in range(3):
        along = here & (np.abs(observations.partials[:, 0, axis]) == 1.0)
        if not along.any():
            assert np.isnan(found.left_out_m[point, axis])
            continue
        free = replace(observations, survey_sigma_m=np.where(along, 1e3, observations.survey_sigma_m))
        without = adjust(free, priors(), ALL_COUNT).control
        stated = observations.survey_sigma_m[along][0]
        assert found.left_out_m[point, axis] == pytest.approx(without.error_m[point, axis], rel=1e-5)
        assert found.left_out_sigma_m[point, axis] > stated


def test_one_run_under_observations_at_knots_is_a_kalman_smoother() -> None:
    """Rauch, Tung & Striebel (1965) for the height of one run, whose knots are where it is observed."""
    rng = np.random.default_rng(5)
    p, sigma, n = PROCESSES[2], 0.002, 41
    only_height = tuple(GaussMarkov(q.sigma if c == 2 else 0.0, q.tau_s) for c, q in enumerate(PROCESSES))
    epochs = START + np.arange(n) * S
    seen = np.arange(n) % 7 == 3
    observed = 0.015 * rng.standard_normal(n)
    rows = np.zeros((n, 2, 6))
    rows[:, 0, 2] = 1.0
    observations = Observations(
        np.full(n, 3, np.uint8), np.tile(np.array([0, FIXED], np.int32), (n, 1)),
        np.stack([epochs, 0 * epochs], axis=1), rows, observed, np.full(n, sigma), np.arange(n), np.arange(n),
    ).chosen(seen)  # fmt: skip
    run = RunPrior("one", int(epochs[0]), int(epochs[-1]), only_height)  # type: ignore[arg-type]
    found = adjust(observations, [run], ALL_COUNT.model_copy(update={"knot_spacing_s": 1.0}))
    keep, q = np.exp(-1.0 / p.tau_s), p.sigma**2 * -np.expm1(-2.0 / p.tau_s)
    mean, variance = np.zeros(n), np.zeros(n)
    m, v = 0.0, p.sigma**2
    for k in range(n):
        if k:
            m, v = keep * m, keep**2 * v + q
        if seen[k]:
            gain = v / (v + sigma**2)
            m, v = m + gain * (observed[k] - m), (1.0 - gain) * v
        mean[k], variance[k] = m, v
    for k in range(n - 2, -1, -1):
        ahead = keep**2 * variance[k] + q
        back = keep * variance[k] / ahead
        mean[k] += back * (mean[k + 1] - keep * mean[k])
        variance[k] += back**2 * (variance[k + 1] - ahead)
    np.testing.assert_allclose(found.values[0][:, 2], mean, atol=1e-12)
    np.testing.assert_allclose(found.sigma[0][:, 2], np.sqrt(variance), rtol=1e-9)
    assert (found.values[0][:, [0, 1, 3, 4, 5]] == 0.0).all()


def test_the_order_of_arrival_changes_no_bit() -> None:
    observations = scattered(6)
    observations.observed_m[:20] += 0.2
    settings = AdjustmentSettings(knot_spacing_s=0.5, estimate_variance_components=True)
    found = adjust(observations, priors(), settings)
    order = np.random.default_rng(7).permutation(observations.size)
    other = adjust(replace(observations.chosen(order), group=1_000 - observations.group[order]), priors(), settings)
    for name in ("values", "covariance", "covariance_with_next"):
        for one, two in zip(getattr(found, name), getattr(other, name), strict=True):
            np.testing.assert_array_equal(one, two)
    for name in ("residual_m", "weight", "redundancy", "normalised_residual"):
        np.testing.assert_array_equal(getattr(found, name)[order], getattr(other, name))
    assert found.variance_factors == other.variance_factors


ROAD = Road(1000.0, 3, 5.0, 250.0, lane_m=3.5)


def drawn(road: Road, seed: int) -> tuple[Observations, np.ndarray, np.ndarray]:
    """Observations of a road, stations and the true corrections (runs, n, 6) there."""
    rng = np.random.default_rng(seed)
    stations = np.linspace(0.0, road.length_m, 101)
    truth = drawn_errors(road, np.concatenate([road.ties_m, road.control_m, stations]), rng)
    observations = Observations.joined([ties(road, truth, rng), control(road, truth, rng)])
    return observations, stations, np.stack([truth.at(r, stations) for r in range(road.runs)])


def heights_off(found: Adjustment, road: Road, stations: np.ndarray, truth: np.ndarray) -> np.ndarray:
    shifts = [found.corrections(run).at(road.epochs(stations))[0][:, 2] for run in found.runs]
    return np.array(shifts) - truth[:, :, 2]


@pytest.mark.parametrize("mode", ["joint", "each_pass"])
def test_heights_are_as_good_as_the_best_linear_estimate(mode: str) -> None:
    """The benchmark finds it from dense covariances of the processes at the observations themselves, without knots."""
    road, checks = Road(900.0, 4, 10.0, 300.0), np.linspace(0.0, 900.0, 52)[1:-1]
    best = BestEstimate.of(road, checks, joint=mode == "joint")
    ours, theirs = [], []
    for seed in range(6):
        rng = np.random.default_rng(300 + seed)
        truth = drawn_errors(road, np.concatenate([road.ties_m, road.control_m, checks]), rng)
        observations = Observations.joined([ties(road, truth, rng), control(road, truth, rng)])
        found = adjust(observations, road.priors(), ALL_COUNT.model_copy(update={"mode": mode, "knot_spacing_s": 0.1}))
        error, sigma = errors(found, road, truth, checks)
        ours.append(np.abs(error).mean())
        theirs.append(np.abs(best.errors(observations, truth)).mean())
    assert np.mean(ours) == pytest.approx(np.mean(theirs), rel=0.03)
    # And its σ, which does not depend on what was drawn, is that of the best estimate.
    assert np.sqrt(2.0 / np.pi) * sigma.mean() == pytest.approx(best.expected, rel=0.05)


def test_false_matches_do_not_bend_a_road() -> None:
    """20 % of the ties replaced by false ones, most of them to one side: the heights are as good as before."""
    clean, bent = [], []
    for seed in range(4):
        observations, stations, truth = drawn(ROAD, seed)
        before = adjust(observations, ROAD.priors(), AdjustmentSettings())
        rng = np.random.default_rng(100 + seed)
        is_tie = observations.run[:, 1] != FIXED
        false = is_tie & (rng.uniform(size=observations.group.max() + 1) < 0.2)[observations.group]
        observations.observed_m[false] = rng.uniform(-0.02, 0.10, int(false.sum()))
        after = adjust(observations, ROAD.priors(), AdjustmentSettings())
        clean.append(heights_off(before, ROAD, stations, truth))
        bent.append(heights_off(after, ROAD, stations, truth))
        assert after.settled
        gross = false & (np.abs(observations.observed_m) > 0.04)
        assert (after.weight[gross] == 0.0).mean() > 0.99
        assert (after.weight[is_tie & ~false] > 0.0).mean() > 0.99
    rms = [np.sqrt(np.mean(np.square(e))) for e in (clean, bent)]
    assert rms[1] < 1.1 * rms[0]


@pytest.mark.slow
def test_stated_sigmas_are_honest() -> None:
    """Normalised squared errors at stations 10 s apart, 12 draws, within their 99 % bounds."""
    road, settings = replace(ROAD, length_m=1500.0), AdjustmentSettings(knot_spacing_s=0.25)
    squares, relative = [], []
    for seed in range(12):
        observations, stations, truth = drawn(road, 200 + seed)
        found = adjust(observations, road.priors(), settings)
        off = heights_off(found, road, stations, truth)
        row = np.tile(np.eye(6)[2], (stations.size, 1))
        sigma = np.array([found.sigma_of(r, road.epochs(stations), row) for r in range(road.runs)])
        squares.append(((off / sigma) ** 2)[:, ::20].mean())
        relative.append(np.nanmean(found.normalised_residual**2))
    assert 0.75 < np.mean(squares) < 1.3
    assert 0.95 < np.mean(relative) < 1.05


def test_a_wrong_control_point_is_named_and_not_absorbed() -> None:
    observations, stations, truth = drawn(ROAD, 11)
    before = adjust(observations, ROAD.priors(), AdjustmentSettings())
    wrong = (observations.place == 2) & (observations.kind == KINDS.index("control_height"))
    observations.observed_m[wrong] += 0.05
    found = adjust(observations, ROAD.priors(), AdjustmentSettings())
    assert found.control.place[found.control.weight[:, 2] == 0.0].tolist() == [2]
    assert (found.control.weight[:, :2] > 0.5).all()
    assert found.control.left_out_m[2, 2] == pytest.approx(0.05, abs=3 * found.control.left_out_sigma_m[2, 2])
    # The other runs saw the same, so no observation of the target is to blame.
    assert (found.weight[wrong] > 0.5).all()
    rms = [np.sqrt(np.mean(heights_off(f, ROAD, stations, truth) ** 2)) for f in (before, found)]
    assert rms[1] < 1.5 * rms[0]


@pytest.mark.parametrize("offset_m", [0.06, -0.3, 0.5])
def test_control_that_is_wrong_as_a_whole_does_not_move_the_road(offset_m: float) -> None:
    """An offset between two height datums, which no single point contradicts: it is estimated, and σ holds it."""
    observations, stations, truth = drawn(ROAD, 21)
    right = adjust(observations, ROAD.priors(), AdjustmentSettings())
    assert right.verdict.doubted == ()
    height = observations.kind == KINDS.index("control_height")
    observations.observed_m[height] += offset_m
    found = adjust(observations, ROAD.priors(), AdjustmentSettings())
    assert found.verdict.doubted == ("height",)
    assert not found.verdict.wrong
    sigma = found.verdict.offset.sigma_m("height")
    assert found.verdict.offset.offset_m[2] == pytest.approx(offset_m, abs=3 * sigma)
    # Three independent drives know their mean height to 15 mm over the root of three, about.
    assert sigma == pytest.approx(0.015 / np.sqrt(3), rel=0.25)
    off = heights_off(found, ROAD, stations, truth)
    assert np.abs(off).max() < 3 * found.sigma[0][:, 2].mean()
    assert found.sigma[0][:, 2].mean() == pytest.approx(sigma, rel=0.2)
    # The shape is that of the control: the error is the same everywhere.
    assert off.std() < 1.2 * heights_off(right, ROAD, stations, truth).std() + 1e-4
    # Of the user who trusts it, it is followed, and σ holds the offset.
    followed = adjust(observations, ROAD.priors(), AdjustmentSettings(datum_offset="follow"))
    assert heights_off(followed, ROAD, stations, truth).mean() == pytest.approx(offset_m, abs=0.005)
    assert np.abs(offset_m) < 1.5 * followed.sigma[0][:, 2].min()
    refused = adjust(observations, ROAD.priors(), AdjustmentSettings(datum_offset="leave_out"))
    assert (refused.control.weight[:, 2] == 0.0).all()
    assert (refused.control.weight[:, :2] == 1.0).all()
    # Who states the σ of the datum gets the weighted mean of both.
    stated = adjust(observations, ROAD.priors(), AdjustmentSettings(sigma_datum_m=abs(offset_m)))
    assert stated.verdict.doubted == ()
    assert np.abs(heights_off(stated, ROAD, stations, truth)).max() < 3 * stated.sigma[0][:, 2].mean()


def test_a_target_that_one_run_saw_wrongly_costs_that_one() -> None:
    observations, _, _ = drawn(ROAD, 12)
    wrong = (observations.place == 1) & (observations.kind == KINDS.index("control_height"))
    wrong &= observations.run[:, 0] == 0
    observations.observed_m[wrong] += 0.05
    found = adjust(observations, ROAD.priors(), AdjustmentSettings())
    assert found.weight[wrong].tolist() == [0.0]
    assert (found.control.weight > 0.5).all()


def test_modes() -> None:
    observations, stations, truth = drawn(ROAD, 13)
    joint = adjust(observations, ROAD.priors(), AdjustmentSettings())
    alone = adjust(observations, ROAD.priors(), AdjustmentSettings(mode="each_pass"))
    upright = adjust(observations, ROAD.priors(), AdjustmentSettings(mode="vertical"))
    is_tie = observations.run[:, 1] != FIXED
    np.testing.assert_array_equal(alone.used, ~is_tie)
    assert np.isnan(alone.normalised_residual[is_tie]).all()
    # Passes agree better with ties than alone, and control of each is its own.
    assert np.std(joint.residual_m[is_tie]) < 0.7 * np.std(alone.residual_m[is_tie])
    assert sorted(set(alone.control.run.tolist())) == [0, 1, 2]
    # One run of another survey changes nothing of those that are adjusted alone.
    first = observations.chosen(np.flatnonzero((observations.run[:, 0] == 0) & ~is_tie))
    single = adjust(first, ROAD.priors()[:1], AdjustmentSettings(mode="each_pass"))
    np.testing.assert_allclose(single.values[0], alone.values[0], atol=1e-9)
    heights = [c == "down_m" for c in COMPONENTS]
    assert (upright.values[0][:, ~np.array(heights)] == 0.0).all()
    assert set(observations.kind[upright.used].tolist()) == {0, 3}
    off = heights_off(upright, ROAD, stations, truth)
    assert np.sqrt(np.mean(off**2)) < 0.004


def test_wrong_statistics_are_found_by_variance_components() -> None:
    """σ of ties and of the heights' process stated three times too small and too large."""
    road = Road(2500.0, 3, 5.0, 500.0, lane_m=3.5, height_tie_sigma_m=0.001)
    observations, _, _ = drawn(road, 14)
    stated = replace(
        observations, sigma_m=np.where(observations.kind == 0, observations.sigma_m / 3.0, observations.sigma_m)
    )
    processes = list(road.processes)
    processes[2] = GaussMarkov(processes[2].sigma * 3.0, processes[2].tau_s)
    given = [replace(p, processes=tuple(processes)) for p in road.priors()]
    found = adjust(stated, given, AdjustmentSettings(estimate_variance_components=True))
    factors = found.variance_factors
    assert found.settled
    assert factors["height_tie"] == pytest.approx(9.0, rel=0.25)
    assert factors["down_m"] == pytest.approx(1 / 9.0, rel=0.25)
    assert factors["shift_tie"] == pytest.approx(1.0, rel=0.1)


@pytest.mark.slow
def test_a_component_stated_too_small_counts_beside_one_stated_far_smaller() -> None:
    """σ of heights stated fifteen times too small, and of places to the east three times: a factor of 225, and of 9."""
    road = Road(2500.0, 3, 5.0, 50.0, lane_m=3.5)
    observations, _, _ = drawn(road, 15)
    processes = list(road.processes)
    for component, times in ((0, 3.0), (2, 15.0)):
        processes[component] = GaussMarkov(processes[component].sigma / times, processes[component].tau_s)
    given = [replace(p, processes=tuple(processes)) for p in road.priors()]
    factors = adjust(observations, given, AdjustmentSettings()).variance_factors
    assert factors[COMPONENTS[0]] == pytest.approx(9.0, rel=0.5)
    assert factors[COMPONENTS[2]] == pytest.approx(225.0, rel=0.5)
    assert factors[COMPONENTS[1]] == 1.0


def test_no_observation_gives_the_prior() -> None:
    found = adjust(Observations.none(), priors(), AdjustmentSettings(knot_spacing_s=1.0))
    assert (all_values(found) == 0.0).all()
    np.testing.assert_allclose(found.sigma[1], np.tile([p.sigma for p in PROCESSES], (12, 1)), rtol=1e-9)
    epochs = START + np.array([7.3, 8.5]).astype(np.int64) * S
    np.testing.assert_allclose(found.sigma_of(1, epochs, np.tile(np.eye(6)[2], (2, 1))), 0.015, rtol=1e-3)


def test_nothing_to_correct_is_refused() -> None:
    with pytest.raises(ConfigError, match="no component of any run"):
        adjust(Observations.none(), [], AdjustmentSettings())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"run": np.full((180, 2), 3, np.int32)}, "run number 3"),
        ({"epoch_gps_ns": np.full((180, 2), START - 1)}, "run 'r"),
        ({"sigma_m": np.zeros(180)}, "σ 0 m"),
        ({"observed_m": np.full(180, np.nan)}, "observation of nan m"),
    ],
)
def test_what_no_run_explains_is_refused(change: dict[str, np.ndarray], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        adjust(replace(scattered(), **change), priors(), ALL_COUNT)


def test_a_survey_of_control_whose_sigma_is_ten_times_too_small_is_not_taken_for_many_wrong_points() -> None:
    road = Road(1500.0, 8, 10.0, 75.0, lane_m=3.5, survey_height_sigma_m=0.02, survey_place_sigma_m=0.03)
    observations, stations, truth = drawn(road, 31)
    stated = replace(observations, survey_sigma_m=observations.survey_sigma_m / 10.0)
    found = adjust(stated, road.priors(), AdjustmentSettings(knot_spacing_s=0.5))
    # A median of 42 squares errs by a third (1 σ), and so the σ by a sixth.
    assert np.sqrt(found.variance_factors["control_survey"]) == pytest.approx(10.0, rel=0.4)
    assert len(found.verdict.wrong) <= 1
    off = heights_off(found, road, stations, truth)
    assert np.sqrt(np.mean(off**2)) < 2.0 * np.mean([s[:, 2].mean() for s in found.sigma])


@pytest.mark.slow
@pytest.mark.parametrize("runs", [1, 3])
def test_one_wrong_height_is_named_and_no_right_one_beyond_the_stated_chance(runs: int) -> None:
    """Five points of 600 m, one of them wrong, in 14 draws, and 60 draws of right control."""
    road = Road(600.0, runs, 10.0, 150.0, lane_m=3.5 if runs > 1 else 0.0, speed_m_s=25.0)
    settings = AdjustmentSettings(knot_spacing_s=0.5)

    def of_seed(seed: int, wrong_m: float) -> Adjustment:
        rng = np.random.default_rng(seed)
        truth = drawn_errors(road, np.concatenate([road.ties_m, road.control_m]), rng)
        parts = ([ties(road, truth, rng)] if runs > 1 else []) + [control(road, truth, rng)]
        observations = Observations.joined(parts)
        wrong = (observations.place == 2) & (observations.kind == KINDS.index("control_height"))
        observations.observed_m[wrong & (observations.run[:, 1] == FIXED)] += wrong_m
        return adjust(observations, road.priors(), settings)

    named = {0.02: 0, 0.05: 0, 0.1: 0, 1.0: 0}
    right = 0
    for wrong_m in named:
        for seed in range(14):
            found = of_seed(seed, wrong_m).verdict.left_out
            named[wrong_m] += (2, "height") in found
            right += bool(found - {(2, "height")})
    assert [named[w] for w in (0.05, 0.1, 1.0)] == [14, 14, 14]
    # Of one drive, which knows the height between neighbours to 4 mm, 20 mm are five σ.
    assert named[0.02] >= 12
    right += sum(bool(of_seed(100 + seed, 0.0).verdict.left_out) for seed in range(60))
    # 116 draws, of which one in a hundred may name a right point: more than five have a chance of 0.1 %.
    assert right <= 5


@pytest.mark.slow
def test_three_thousand_points_are_judged_by_their_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wrong ones are named, no others, and no covariance is of more than 200 points."""
    road = Road(30_000.0, 1, 20.0, 10.0, speed_m_s=25.0)
    rng = np.random.default_rng(1)
    observations = control(road, drawn_errors(road, road.control_m, rng), rng)
    wrong = {3: 0.05, 1500: -0.03, 1501: 0.05, 2998: 1.0}
    for place, by_m in wrong.items():
        own = (observations.place == place) & (observations.kind == KINDS.index("control_height"))
        observations.observed_m[own] += by_m
    sizes: list[int] = []
    whole = NormalEquations.covariances

    def covariances(self: NormalEquations, groups: Sequence[np.ndarray]) -> list[np.ndarray]:
        sizes.extend(own.size for own in groups)
        return whole(self, groups)

    monkeypatch.setattr(NormalEquations, "covariances", covariances)
    found = adjust(observations, road.priors(), AdjustmentSettings(knot_spacing_s=1.0))
    assert found.verdict.left_out == {(place, "height") for place in wrong}
    assert not found.verdict.doubted
    assert max(sizes) <= 600
    assert len(sizes) >= 60


def _drawn(seed: int, factor: float) -> tuple[Adjustment, np.ndarray]:
    """Three runs of 400 m, σ of the second one's poses stated so many times as large; and its true errors of height."""
    rng, road = np.random.default_rng(seed), Road(400.0, 3, 10.0, 100.0)
    drawn = drawn_errors(road, np.concatenate([road.ties_m, road.control_m]), rng)
    known = road.priors()
    known[1] = known[1].wider(np.full(6, factor))
    seen = Observations.joined([ties(road, drawn, rng), control(road, drawn, rng)])
    found = adjust(seen, known, AdjustmentSettings(knot_spacing_s=1.0))
    station = (found.epochs_gps_ns[1] - known[1].first_gps_ns) / 1e9 * road.speed_m_s
    return found, found.values[1][:, 2] - np.interp(station, drawn.station_m, drawn.error[1, :, 2])


def test_sigmas_that_one_run_states_too_small_are_told_and_made_larger() -> None:
    """Times 0.19: where the poses are off by what their true σ makes likely, the run is told, and no other one."""
    for seed in (1, 5, 7, 10):
        found, error = _drawn(seed, 0.19)
        assert 2.0 < np.sqrt(found.run_factors[1, 2]) < 12.0
        assert (np.delete(found.run_factors, 1, axis=0) == 1.0).all()
        assert np.sqrt(np.mean(error**2)) < 2.0 * found.sigma[1][:, 2].mean()
        assert not found.verdict.doubted


def test_right_sigmas_of_runs_stay() -> None:
    assert all((_drawn(seed, 1.0)[0].run_factors == 1.0).all() for seed in range(20, 26))
