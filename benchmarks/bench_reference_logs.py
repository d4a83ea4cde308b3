"""The reference site through raw logs: 3.3 km, 12 runs, painted control each 300 m or 825 m, 500 painted check points.

The logs are simulated, and the stages from ingest to adjustment run as for any survey. What counts is the height of the
adjusted surface at the check points against the true one. Beside it stands what the best linear unbiased estimate makes
of the same ties and sightings with the true statistics (dense covariances, no code of the adjustment): the few control
points of a site err by chance, and both have the same luck. Then the evidence itself is held against the true poses.

The survey of control is of the road without its macrotexture, as a prism on a plate is, and so is the true height.

Sizes are settings: each seed takes 3 bytes a reading for its logs, which are removed once they are ingested, and about
as much for the store. `reference_m=1000 reference_spacing_mm=5 reference_readings=2000 reference_seeds=1` is a
kilometre at full density.
"""

from __future__ import annotations

import csv
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from benchmarks.bench_reference_site import BARS, REPEATABILITY_MM, SITE, pose_covariance, survey_covariance
from benchmarks.settings import Settings
from benchmarks.timing import Figure
from roadscan.adjust.control import Sighting
from roadscan.adjust.observations import KINDS, Observations
from roadscan.adjust.tasks import adjustment
from roadscan.adjust.tasks.solution import Evidence, Solution
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_of
from roadscan.navigation.tasks.trajectories import load_recorded
from roadscan.run.engine.compute_on import compute_on
from roadscan.run.session import Reporter, Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.path import Earth
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from roadscan.survey.run import run_stages

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

STAGES = ("ingest", "navigate", "footprints", "adjust")
CHECKS_PER_M = 500 / 3300
EDGE_M = 3.2
"""Control lies at the edge of the pavement, on the right of the lane that all runs drive."""
CHECKS_M = (0.8, 1.9, 2.9)
"""Offsets of check points in turns: over the whole lane."""
SURVEY_M = (0.003, 0.003, 0.002)
"""1 σ of the survey of control: easting, northing, height."""
_EACH = 10
"""Of every so-manieth sighting the expected error is computed."""
_HEIGHTS = (KINDS.index("height_tie"), KINDS.index("control_height"))
_OFF = {"on": False}


@dataclass(frozen=True)
class Adjusted:
    """A site that went through the stages."""

    session: Session
    evidence: Evidence
    solution: Solution

    def true_heights_m(self) -> Float64:
        """True height of the road at each sighted point, without macrotexture."""
        known = truth.load(self.session.survey.folder)
        points = [one.point for one in self.evidence.sightings]
        east, north = np.array([[p.easting_m, p.northing_m] for p in points]).T
        return known.surface.height_m(east, north, texture=False)


@dataclass(frozen=True)
class Outcome:
    """Heights at the check points, n sightings."""

    point: Int64
    """(n,) number of the check point."""
    error: Float64
    """(n,) true height minus that of the adjusted surface (m)."""
    best: Float64
    """(n,) the same of the best linear unbiased estimate from the same evidence."""
    expected: float
    """Mean absolute error that this estimate has by its own covariance (m)."""

    @property
    def repeatability(self) -> float:
        """Mean over the points of the standard deviation between runs (m)."""
        own = [self.error[self.point == one] for one in np.unique(self.point)]
        return float(np.mean([values.std(ddof=1) for values in own if values.size > 1]))


def figures(folder: Path) -> Iterator[Figure]:
    """Of each seed, by spacing of the control and mode: mean absolute height error, best estimate, repeatability, and
    the evidence; then mean and spread over the seeds."""
    size = Settings.current()
    seen: dict[str, list[tuple[float, float | None]]] = {}
    for seed in range(size.reference_seeds):
        began, own = time.perf_counter(), folder / f"seed-{seed}"
        survey_file = simulate(scene(size, seed), own).survey_file
        for spacing in BARS:
            survey_control(survey_file.parent, spacing, seed)
            for figure in of_site(survey_file, spacing):
                seen.setdefault(figure.what, []).append((figure.value, figure.other))
                yield replace(figure, what=f"seed {seed}: {figure.what}")
        yield Figure(f"seed {seed}: wall time of all", (time.perf_counter() - began) / 60.0, "min", 30.0, "bar")
        shutil.rmtree(own)
    if size.reference_seeds > 1:
        for what, values in seen.items():
            mean, spread = np.mean([v for v, _ in values]), np.std([v for v, _ in values], ddof=1)
            yield Figure(f"mean of {len(values)} seeds, {what}", float(mean), "mm", float(spread), "spread")


def of_site(survey_file: Path, spacing: float) -> Iterator[Figure]:
    """Figures of a simulated site with the control of one spacing."""
    for mode, bar in zip(("each_pass", "joint"), BARS[spacing], strict=True):
        one = adjusted(survey_file, mode, spacing)
        found = outcome(one, joint=mode == "joint")
        what = f"{spacing:.0f} m, {'all runs' if mode == 'joint' else 'each run alone'}, from raw logs"
        mean, best = (1e3 * float(np.abs(values).mean()) for values in (found.error, found.best))
        yield Figure(f"{what}: mean absolute height error (bar {bar})", mean, "mm", best, "best, same evidence")
        yield Figure(f"{what}: expected of the best estimate", 1e3 * found.expected, "mm")
    yield Figure(f"{what}: repeatability (bar {REPEATABILITY_MM})", 1e3 * found.repeatability, "mm")
    yield from of_evidence(one, f"{spacing:.0f} m")


def control_stations(spacing_m: float, length_m: float) -> Float64:
    """Stations of the control points, the ends of the site among them."""
    return np.clip(np.arange(0.0, length_m + 0.1, spacing_m), 1.0, length_m - 4.0)


def scene(size: Settings, seed: int) -> Scene:
    """The reference site, longer: profilers alone, a post-processor's errors, control without errors."""
    length = size.reference_m
    gcps = np.unique(np.concatenate([control_stations(spacing, length) for spacing in BARS]))
    checks = (np.arange(round(CHECKS_PER_M * length)) + 0.5) / CHECKS_PER_M
    checks = checks[np.abs(checks[:, None] - gcps).min(axis=1) > 1.0]
    points = [(s, EDGE_M, "gcp") for s in gcps.tolist()]
    points += [(s, CHECKS_M[k % len(CHECKS_M)], "check") for k, s in enumerate(checks.tolist())]
    targets = [{"station_m": s, "offset_m": offset, "role": role} for s, offset, role in points]
    bare: dict[str, Any] = {
        k: [] for k in ("joints", "cracks", "alligators", "potholes", "patches", "stains", "tyre_marks")
    }
    return Scene.load("reference_site").changed(
        seed=7201 + seed,
        length_m=length,
        road={"alignment": [{"kind": "straight", "length_m": length + 200.0}], "targets": targets, **bare},
        passes=[{"lane": 2, "offset_m": (-0.2, 0.0, 0.2)[k % 3]} for k in range(size.reference_runs)],
        roadside={"poles": [], "trees": []},
        profilers={
            "spacing_m": size.reference_spacing_mm / 1e3, "readings": size.reference_readings, "head_imus": None,
        },
        lidar=_OFF, imu=_OFF, gnss=_OFF, encoder=_OFF, camera=_OFF,
        vehicle={"speed_m_per_s": 100 / 3.6, "standstill_s": 0.0},
        noise={
            "profiler_range_m": 0.0005, "position_m": 0.010, "down_m": 0.015, "time_constant_s": 120.0,
            "attitude_deg": 0.004, "heading_deg": 0.008, "attitude_time_constant_s": 60.0, "control_m": 0.0,
        },
    )  # fmt: skip


def survey_control(folder: Path, spacing_m: float, seed: int) -> None:
    """Write the control of one spacing, with the errors of its survey; the points of the other spacing are checks.

    Both spacings have one survey, so that what was seen of a check point is seen once.
    """
    known = truth.load(folder)
    rng = np.random.default_rng(seed)
    own = control_stations(spacing_m, known.scene.length_m)
    with (folder / "control.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row, target in zip(rows, known.scene.road.targets, strict=True):
        is_own = target.role == "gcp" and bool(np.abs(own - target.station_m).min() < 1e-6)
        row["role"] = "gcp" if is_own else "check"
        for axis, sigma in zip(("easting_m", "northing_m", "height_m"), SURVEY_M, strict=True):
            row[axis] = f"{float(row[axis]) + sigma * rng.standard_normal():.4f}"
        row["sigma_horizontal_m"], row["sigma_height_m"] = f"{SURVEY_M[0]}", f"{SURVEY_M[2]}"
    with control_file(folder, spacing_m).open("w", newline="") as stream:
        out = csv.DictWriter(stream, list(rows[0]))
        out.writeheader()
        out.writerows(rows)


def control_file(folder: Path, spacing_m: float) -> Path:
    """Where the control of one spacing stands."""
    return folder / f"control-{spacing_m:.0f}.csv"


def adjusted(survey_file: Path, mode: str, spacing_m: float) -> Adjusted:
    """The site after its stages, with what the adjustment was given; the logs of the profilers are gone then."""
    survey = Survey.load(survey_file)
    values = survey.config.model_dump() | {"rig": survey.rig.model_dump()}
    values["adjust"] |= {"mode": mode}
    values["adjust"]["targets"] |= {"shape": "circle"}
    values["control"][0]["path"] = control_file(survey.folder, spacing_m).name
    values["adjust"]["places"]["per_km"] = 100.0
    if Settings.current().reference_spacing_mm > 20.0:
        values["adjust"]["ties"]["cell_m"] = 0.05
    store = Store(str(survey_file.parent / "store"), survey.config.id)
    kept: list[tuple[Evidence, Solution]] = []
    original = adjustment.solve

    def solve(plan: Any, evidence: Evidence) -> Solution:
        solution = original(plan, evidence)
        kept.append((evidence, solution))
        return solution

    with compute_on(Settings.current().workers) as compute, mock.patch.object(adjustment, "solve", solve):
        session = Session(Survey.parse(values, folder=survey.folder), store, compute, None, Reporter())
        run_stages(session, [stage_named(STAGES[0])])
        for log in survey.folder.glob("raw/*/profiler_*.parquet"):
            log.unlink()
        run_stages(session, [stage_named(name) for name in STAGES[1:]])
    evidence, solution = kept[-1]
    return Adjusted(Session(session.survey, store), evidence, solution)


def outcome(one: Adjusted, *, joint: bool) -> Outcome:
    """Errors at the check points, of the adjusted surface and of the best estimate from the same evidence."""
    evidence, solution = one.evidence, one.solution
    statement = "SELECT point, run, height_after_m FROM control_residuals WHERE role = 'check'"
    left = {(r["point"], r["run"]): r["height_after_m"] for r in query(one.session.store, statement).to_pylist()}
    sightings = of_observations(evidence.sightings)
    upright = solution.control.kind == KINDS.index("control_height")
    is_check = upright & np.array([s.point.role == "check" for s in sightings])
    true = dict(zip(map(id, evidence.sightings), one.true_heights_m().tolist(), strict=True))
    checks = [sightings[k] for k in np.flatnonzero(is_check)]
    off = np.array([true[id(s)] - s.point.height_m for s in checks])
    after = np.array([left[s.point.number, evidence.runs[s.run]] for s in checks])
    said = [solution.point(s.point.number, s.run) for s in sightings]
    counting = np.array([one_said is not None and one_said.weight_height > 0.0 for one_said in said])
    used = solution.control.chosen(upright & counting)
    if joint:
        ties = evidence.ties.observations
        by = Observations.joined([ties.chosen(np.isin(ties.kind, _HEIGHTS) & (solution.tie_weight > 0.0)), used])
    else:
        by = used
    road = replace(SITE, runs=len(evidence.runs))
    wanted = solution.control.chosen(is_check)
    own = pose_covariance(road, by, by) + np.diag(by.sigma_m**2) + survey_covariance(by, joint=joint)
    across = pose_covariance(road, wanted, by)
    factor = cho_factor(own, overwrite_a=True, lower=True)
    some = np.arange(0, wanted.size, _EACH)
    prior = np.diag(pose_covariance(road, wanted.chosen(some), wanted.chosen(some)))
    variance = prior - np.einsum("ij,ji->i", across[some], cho_solve(factor, across[some].T))
    best = wanted.observed_m + off - across @ cho_solve(factor, by.observed_m)
    number = np.array([s.point.number for s in checks], np.int64)
    return Outcome(number, off + after, best, float(np.sqrt(2.0 / np.pi * variance).mean()))


def of_observations(sightings: tuple[Sighting, ...]) -> list[Sighting]:
    """The sighting of each observation of the control."""
    return [one for one in sightings for _ in range(one.observed)]


def of_evidence(one: Adjusted, what: str) -> Iterator[Figure]:
    """Height ties and heights read at control, against what the true poses say."""
    evidence, solution = one.evidence, one.solution
    ties = evidence.ties.observations
    own = ties.chosen((ties.kind == KINDS.index("height_tie")) & (solution.tie_weight > 0.0))
    error = own.observed_m - explained(one, own)
    stated = 1e3 * rms(own.sigma_m)
    yield Figure(f"{what}: error of {own.size} height ties, absolute mean", 1e3 * abs(float(error.mean())), "mm")
    yield Figure(f"{what}: the same, RMS", 1e3 * rms(error), "mm", stated, "stated")
    control = solution.control.chosen(solution.control.kind == KINDS.index("control_height"))
    sightings = [s for s in evidence.sightings if np.isfinite(s.height_m)]
    surveyed = np.array([s.point.height_m for s in evidence.sightings]) - one.true_heights_m()
    surveyed = surveyed[[np.isfinite(s.height_m) for s in evidence.sightings]]
    read = control.observed_m - explained(one, control) - surveyed
    yield Figure(
        f"{what}: error of {len(sightings)} heights read at points, absolute mean", 1e3 * abs(float(read.mean())), "mm"
    )
    yield Figure(f"{what}: the same, RMS", 1e3 * rms(read), "mm", 1e3 * rms(control.sigma_m), "stated")
    gcp = np.array([s.point.role == "gcp" for s in sightings])
    once = np.unique([s.point.number for s in sightings if s.point.role == "gcp"], return_index=True)[1]
    yield Figure(
        f"{what}: error of the survey of {once.size} GCPs, RMS", 1e3 * rms(surveyed[gcp][once]), "mm", 2.0, "σ"
    )


def rms(values: Float64) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def explained(one: Adjusted, observations: Observations) -> Float64:
    """What observations (n,) would be if they told of the errors of the recorded poses and of nothing else (m)."""
    total = np.zeros(observations.size)
    for number, run in enumerate(one.evidence.runs):
        for end in (0, 1):
            own = np.flatnonzero(observations.run[:, end] == number)
            if own.size:
                true = true_corrections(one.session, run, observations.epoch_gps_ns[own, end])
                total[own] += np.einsum("ni,ni->n", observations.partials[own, end], true)
    return total


def true_corrections(session: Session, run: str, epochs_gps_ns: Int64) -> Float64:
    """(n, 6) from the recorded to the true poses: north, east, down (m), turn about the body's axes (rad)."""
    true = pq.read_table(truth.load(session.survey.folder).trajectory_file(run)).to_pandas()
    known = true["epoch_gps_ns"].to_numpy()
    source = next(s for s, _ in plan_of(session).sources if s.run == run)
    recorded = load_recorded(session.store, source.trajectory, [(int(known.min()), int(known.max()))], 1.0)
    poses = recorded.poses(known)
    position = true[["x_world_m", "y_world_m", "z_world_m"]].to_numpy()
    turned = Rotation.from_quat(true[["qw", "qx", "qy", "qz"]].to_numpy(), scalar_first=True)
    position, turned, known = position[poses.found], turned[poses.found], known[poses.found]
    here = poses.position_world_m[poses.found]
    level = Earth(session.survey.config.map.crs).ecef_from_level(here).inv()
    turn = (Rotation.from_matrix(poses.world_from_body[poses.found]).inv() * turned).as_rotvec()
    six = np.hstack([level.apply(position - here), turn])
    since, at = ((e - known[0]).astype(np.float64) for e in (epochs_gps_ns, known))
    return np.stack([np.interp(since, at, six[:, k]) for k in range(6)], axis=1)
