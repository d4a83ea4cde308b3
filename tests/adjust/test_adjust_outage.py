"""An outage of one drive, stated in its accuracy log: the good drives beside it stay as good as they were."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from benchmarks.bench_reference_logs import true_corrections
from roadscan.adjust.observations import Observations
from roadscan.adjust.tasks import adjustment
from roadscan.adjust.tasks.solution import Evidence, Solution
from roadscan.core.gpstime import NS_PER_S
from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate
from roadscan.store.query.sql import query
from tests.surveys import Simulated

pytestmark = pytest.mark.nightly

OFF = {"on": False}
ROLES = {2.0: "gcp", 40.0: "gcp", 80.0: "gcp", 112.0: "gcp"}
SPEED_M_S = 5.0
OUTAGE_S = (7.0, 17.0)
"""Since the beginning of the run: the vehicle is beside the points at 40 m and at 80 m then."""
HUMP_M = 0.100
USUAL_M = 0.006
BAD = "run-4"
TAU_S = 120.0
SEED = 1


def hump(since_s: np.ndarray) -> np.ndarray:
    """0 outside of the outage, 1 in its middle."""
    share = (since_s - OUTAGE_S[0]) / (OUTAGE_S[1] - OUTAGE_S[0])
    return np.where((share > 0.0) & (share < 1.0), np.sin(np.pi * share) ** 2, 0.0)


def site() -> Scene:
    targets = [{"station_m": s, "offset_m": 3.2, "role": role} for s, role in ROLES.items()]
    bare: dict[str, Any] = {
        k: [] for k in ("joints", "cracks", "alligators", "potholes", "patches", "stains", "tyre_marks")
    }
    return Scene.load("reference_site").changed(
        road={"targets": targets, "alignment": [{"kind": "straight", "length_m": 320.0}], **bare},
        length_m=120.0, lidar=OFF, imu=OFF, gnss=OFF, encoder=OFF, camera=OFF,
        profilers={"spacing_m": 0.05, "readings": 300, "head_imus": None},
        passes=[{"lane": 2, "offset_m": offset} for offset in (-0.2, 0.0, 0.2, 0.1)],
        noise={"position_m": USUAL_M, "attitude_deg": 0.002, "time_constant_s": TAU_S, "control_m": 0.001},
        vehicle={"speed_m_per_s": SPEED_M_S, "standstill_s": 0.0}, roadside={"poles": [], "trees": []},
    )  # fmt: skip


def drift_covariance(
    one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray], peak_m: float
) -> np.ndarray:  # fmt: skip
    """Returns the covariance of an error that is a random walk while its σ grows, and another, backwards, from then on.

    Parameters
    ----------
    one, two : time since σ was largest (n,) and σ (n,); where that is 0, there is no drift.
    peak_m : largest σ.
    """
    ways = []
    for since_s, sigma in (one, two):
        way = np.log(peak_m / np.where(sigma > 0.0, sigma, peak_m))
        ways.append(np.where(since_s < 0.0, -way, way))
    return np.outer(one[1], two[1]) * np.exp(-np.abs(np.subtract.outer(*ways)))


def drift_m(since_s: np.ndarray) -> np.ndarray:
    """Returns a drawn error of heights (n,) whose σ is that of the outage."""
    sigma, drift = HUMP_M * hump(since_s), np.zeros(since_s.size)
    here = np.flatnonzero(sigma > 0.0)[::10]  # each 50 ms, straight between
    covariance = drift_covariance(*[(since_s[here] - sum(OUTAGE_S) / 2.0, sigma[here])] * 2, HUMP_M)
    covariance *= np.exp(-np.abs(np.subtract.outer(since_s[here], since_s[here])) / TAU_S)
    root = np.linalg.cholesky(covariance + 1e-12 * np.eye(here.size))
    drift[sigma > 0.0] = np.interp(
        since_s[sigma > 0.0], since_s[here], root @ np.random.default_rng(SEED).normal(size=here.size)
    )
    return drift


def hump_m(since_s: np.ndarray) -> np.ndarray:
    """Returns an error of heights (n,) as large as its σ: an evenly bent one, as most inertial drift is."""
    return HUMP_M * hump(since_s)


def with_outage(folder: Path, error_m: Callable[[np.ndarray], np.ndarray]) -> None:
    """Heights of one drive drift in an outage, and its SMRMSG says how far."""
    logs = folder / "raw" / BAD
    poses = np.fromfile(logs / "trajectory.sbet", "<f8").reshape(-1, 17)
    since = poses[:, 0] - poses[0, 0]
    poses[:, 3] += error_m(since)
    poses.tofile(logs / "trajectory.sbet")
    accuracy = np.fromfile(logs / "trajectory.smrmsg", "<f8").reshape(-1, 10)
    accuracy[:, 3] += HUMP_M * hump(accuracy[:, 0] - poses[0, 0])
    accuracy.tofile(logs / "trajectory.smrmsg")


@dataclass(frozen=True)
class Run:
    """A survey that was run, with what its adjustment was given and found."""

    session: Session
    evidence: Evidence
    solution: Solution

    def errors_mm(self, run: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Errors of the heights of a run's poses each 0.25 s as recorded and as corrected, their σ, and the epochs."""
        prior = next(one for one in self.evidence.priors if one.run == run)
        epochs = np.arange(prior.first_gps_ns, prior.last_gps_ns, NS_PER_S // 4)
        true = true_corrections(self.session, run, epochs)[:, 2]
        own = self.solution.corrections[run]
        sigma = own.sigma_ned_m(epochs)
        assert sigma is not None
        return 1e3 * true, 1e3 * (true - own.at(epochs)[0][:, 2]), 1e3 * sigma[:, 2], epochs


@pytest.fixture(scope="module")
def outage(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run_of(tmp_path_factory.mktemp("outage") / "survey", hump_m)


def run_of(folder: Path, error_m: Callable[[np.ndarray], np.ndarray]) -> Run:
    """Returns the survey with such an error in the outage, run."""
    raw = Simulated(simulate(site(), folder).survey_file)
    with_outage(folder, error_m)
    kept: list[tuple[Evidence, Solution]] = []
    solve = adjustment.solve

    def noted(plan: Any, evidence: Evidence) -> Solution:
        kept.append((evidence, solve(plan, evidence)))
        return kept[-1][1]

    circles = {"shape": "circle", "size_m": 0.30, "centre_m": 0.06}
    with mock.patch.object(adjustment, "solve", noted):
        session = raw.run(
            adjust__targets=circles, adjust__ties={"cell_m": 0.05}, products__make=["tile_table"],
        )  # fmt: skip
    return Run(session, *kept[-1])


def test_an_outage_that_the_logs_state_costs_the_good_drives_nothing(outage: Run) -> None:
    for run in outage.evidence.runs:
        before, after, sigma, _ = outage.errors_mm(run)
        rms = [float(np.sqrt(np.mean(np.square(values)))) for values in (before, after)]
        honest = float(np.sqrt(np.mean((after / sigma) ** 2)))
        if run != BAD:
            assert rms[1] <= rms[0]
            assert honest >= 0.5  # in the outage σ is that of a drift, and an evenly bent error is less
        assert rms[1] <= 2.5
        assert honest <= 1.5
    weights = query(
        outage.session.store, "SELECT name, run, weight_height FROM control_residuals WHERE role = 'gcp'"
    ).to_pylist()
    assert len(weights) == 4 * len(ROLES)
    assert min(row["weight_height"] for row in weights) > 0.9


def test_sigma_of_a_drift_is_that_of_its_errors(tmp_path: Path) -> None:
    drifting = run_of(tmp_path / "survey", drift_m)
    for run in drifting.evidence.runs:
        _, after, sigma, _ = drifting.errors_mm(run)
        assert 0.5 <= float(np.sqrt(np.mean((after / sigma) ** 2))) <= 1.5


def test_its_sigma_is_that_of_the_dense_estimate(outage: Run) -> None:
    """The best linear unbiased estimate from the covariance of the errors of poses, surveys and mountings at the
    observations themselves.
    """
    evidence, solution = outage.evidence, outage.solution
    gcp = np.array([one.point.role == "gcp" for one in evidence.sightings for _ in range(one.observed)])
    every = Observations.joined([evidence.ties.observations, solution.control.chosen(gcp)])
    counts = np.append(solution.tie_weight, np.ones(int(gcp.sum())))
    used = every.chosen(counts > 0.0)
    ends = _ends(used)
    shared = (
        (used.survey_sigma_m[:, None] > 0.0) & (used.place[:, None] == used.place) & (used.kind[:, None] == used.kind)
    )
    shared &= (used.run[:, None, 1] < 0) & (used.run[:, 1] < 0)
    direction = used.partials[:, 0, :3]
    survey = np.where(shared, used.survey_sigma_m[:, None] * used.survey_sigma_m * (direction @ direction.T), 0.0)
    own = _covariance(outage, ends, ends) + survey + np.diag(used.sigma_m**2 / counts[counts > 0.0])
    own += _of_mountings(outage, used)
    for number, run in enumerate(evidence.runs):
        found = solution.corrections[run]
        knots = found.epochs_gps_ns[::12]
        wanted = [[(number, int(epoch), np.eye(6)[2])] for epoch in knots]
        across = _covariance(outage, wanted, ends)
        prior = np.diag(_covariance(outage, wanted, wanted))
        best = across @ np.linalg.solve(own, used.observed_m)
        sigma = np.sqrt(prior - np.einsum("ij,ji->i", across, np.linalg.solve(own, across.T)))
        assert found.sigma is not None
        ratio = found.sigma[::12, 2] / sigma
        away = 1e3 * (found.north_east_down_m[::12, 2] - best)
        half = (OUTAGE_S[1] - OUTAGE_S[0]) / 2.0
        drifts = np.abs(knots - _largest(outage)) / NS_PER_S < half if run == BAD else np.zeros(knots.size, bool)
        assert np.abs(ratio[~drifts] - 1.0).max() < 0.05
        assert np.abs(away).max() < 0.3
        if run == BAD:
            assert np.median(np.abs(ratio[drifts] - 1.0)) < 0.01
            # Observations between the same two knots share the drift's way off the line; each counts as having its own.
            assert ratio[drifts].min() > 0.7


def _largest(outage: Run) -> int:
    """Returns when the stated σ of the drive with the outage is largest (GPS ns)."""
    stated = next(prior.stated for prior in outage.evidence.priors if prior.run == BAD)
    assert stated is not None
    return int(stated.epochs_gps_ns[stated.sigma[:, 2].argmax()])


def _ends(observations: Observations) -> list[list[tuple[int, int, np.ndarray]]]:
    """Run, epoch and derivatives of each end of each observation that poses move."""
    o = observations
    return [
        [(int(o.run[k, end]), int(o.epoch_gps_ns[k, end]), o.partials[k, end]) for end in (0, 1) if o.run[k, end] >= 0]
        for k in range(o.size)
    ]


def _covariance(
    outage: Run, one: list[list[tuple[int, int, np.ndarray]]], two: list[list[tuple[int, int, np.ndarray]]]
) -> np.ndarray:
    """Of what the errors of the poses make of two lists: in an outage a part of the error is a drift of that outage."""
    flat = [[(k, *end) for k, ends in enumerate(each) for end in ends] for each in (one, two)]
    total = np.zeros((len(one), len(two)))
    row, column = (np.array([entry[0] for entry in entries]) for entries in flat)
    run = [np.array([entry[1] for entry in entries]) for entries in flat]
    at = [np.array([entry[2] for entry in entries], np.int64) for entries in flat]
    slope = [np.array([entry[3] for entry in entries]) for entries in flat]
    parts = [_usual_and_extra(outage, r, t) for r, t in zip(run, at, strict=True)]
    since = [(t - _largest(outage)) / NS_PER_S for t in at]
    alike = run[0][:, None] == run[1]
    peak_m = np.sqrt((USUAL_M + HUMP_M) ** 2 - USUAL_M**2)
    for c in range(6):
        tau = outage.evidence.priors[0].processes[c].tau_s
        own = np.exp(-np.abs(at[0][:, None] - at[1]) / NS_PER_S / tau) * alike
        (usual, extra), (other, more) = ([part[:, c] for part in one] for one in parts)
        own *= np.outer(usual, other) + drift_covariance((since[0], extra), (since[1], more), peak_m)
        np.add.at(total, (row[:, None], column), own * np.outer(slope[0][:, c], slope[1][:, c]))
    return total


def _of_mountings(outage: Run, used: Observations) -> np.ndarray:
    """Covariance (n, n) by the mountings that were estimated; an error of height that all have in common is none."""
    assert outage.solution.mountings is not None
    is_estimated = outage.solution.mountings.error.any(axis=1)
    sigma = np.array([one.sigma for one in outage.evidence.mounted.priors]) * is_estimated[:, None]
    slope = np.zeros((used.size, *sigma.shape))
    for end in (0, 1):
        seen = np.flatnonzero(used.sensor[:, end] >= 0)
        np.add.at(slope, (seen, used.sensor[seen, end]), used.mount_partials[seen, end])
    each = (slope * sigma).reshape(used.size, sigma.size)
    covariance = np.eye(sigma.size)
    if is_estimated.all():
        common = np.zeros(sigma.shape)
        common[:, 2] = 1.0 / sigma[:, 2]
        covariance -= np.outer(common, common) / (common**2).sum()
    return np.asarray(each @ covariance @ each.T)


def _usual_and_extra(outage: Run, run: np.ndarray, epochs_gps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parts (n, 6) of the σ of poses that their process has: the usual one, and what an outage adds."""
    usual, extra = np.empty((run.size, 6)), np.zeros((run.size, 6))
    for number, prior in enumerate(outage.evidence.priors):
        here = run == number
        parts = prior.parts_at(epochs_gps_ns[here])
        usual[here] = parts[:, :6]
        if parts.shape[1] > 6:
            extra[here] = parts[:, 6:]
    return usual, extra
