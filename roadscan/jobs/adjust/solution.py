"""From evidence to corrections: what enters, what is solved, what of the control is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.adjustment import Adjustment, ControlErrors, adjust
from roadscan.adjust.control import Sighting, observations_of
from roadscan.adjust.control_faults import WrongPoint, datum_fault, far_in_height, listed, swapped
from roadscan.adjust.helmert import RigidFit, rigid_fit
from roadscan.adjust.level import level_poses
from roadscan.adjust.observations import FIXED, Observations
from roadscan.adjust.patches import level_from_map
from roadscan.adjust.process import GaussMarkov, RunPrior, StatedSigma, knots_of
from roadscan.adjust.quality import LeaveOneOut, leave_one_out
from roadscan.jobs.adjust.near import Sources
from roadscan.jobs.adjust.tie_work import KnownTies
from roadscan.jobs.adjust.tracks import span_of
from roadscan.jobs.navigate.pose_sigma import stated_pose_sigma
from roadscan.jobs.plan.plan import SurveyPlan
from roadscan.jobs.readings import TrajectorySource, load_recorded
from roadscan.model.settings.adjust import PosePriors
from roadscan.model.settings.adjustment import AdjustmentSettings
from roadscan.navigation.trajectory import Corrections

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

_NONE: Final = (GaussMarkov(0.0, 1.0),) * 6


@dataclass(frozen=True)
class Evidence:
    """All that the adjustment knows."""

    runs: tuple[str, ...]
    """Of the survey; observations count them so."""
    priors: tuple[RunPrior, ...]
    """Of each of them; without σ where a run is not adjusted."""
    ties: KnownTies
    sightings: tuple[Sighting, ...]


@dataclass(frozen=True)
class PointFigures:
    """What the adjustment says of a control point, or of one in one run where each run is adjusted alone."""

    weight_height: float
    weight_horizontal: float
    left_out_height_m: float
    """Surveyed height minus what all others say."""
    left_out_horizontal_m: Float64
    """(2,) surveyed minus the others, north and east."""
    left_out_sigma_m: Float64
    """(3,) 1 σ, north, east, down."""


@dataclass(frozen=True)
class Solution:
    """Corrections, and what they say of the evidence."""

    corrections: Mapping[str, Corrections]
    """Of the runs that evidence reaches."""
    tie_weight: Float64
    """(t,) of each tie that could be measured."""
    points: Mapping[tuple[int, int], PointFigures]
    """By number of the point and run, −1 for all runs."""
    control: Observations
    """Of all sightings, check points too."""
    notes: tuple[str, ...]
    """What is wrong with the control."""
    variance_factors: Mapping[str, float]
    rounds: int
    left_out: LeaveOneOut | None = None

    def point(self, number: int, run: int) -> PointFigures | None:
        """Figures of a point as a run saw it."""
        return self.points.get((number, -1)) or self.points.get((number, run))


def priors_of(plan: SurveyPlan, sources: Sources, runs: Sequence[str]) -> tuple[RunPrior, ...]:
    """Errors of the recorded poses of each run; of a run without readings there are none."""
    config, found = plan.survey.config.adjust.priors, []
    for run in runs:
        own = [(s, files) for s, files in sources if s.run == run]
        trajectory = own[0][0].trajectory if own else None
        if trajectory is None:
            found.append(RunPrior(run, 0, 0, _NONE))
            continue
        spans = [span_of(s, files) for s, files in own]
        stated = _stated(plan, trajectory) if config.source == "sigma" else None
        first, last = min(a for a, _ in spans), max(b for _, b in spans)
        found.append(RunPrior(run, first, last, _processes(config, stated), stated))
    return tuple(found)


def _stated(plan: SurveyPlan, trajectory: TrajectorySource) -> StatedSigma | None:
    epochs, sigma = stated_pose_sigma(plan.store, plan.records, trajectory)
    return StatedSigma(epochs, sigma) if epochs.size else None


def _processes(
    config: PosePriors, stated: StatedSigma | None
) -> tuple[GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov]:
    """Those of the settings, with the median of the σ that the logs state of a component."""
    assumed = np.array(
        [
            config.sigma_horizontal_m,
            config.sigma_horizontal_m,
            config.sigma_down_m,
            config.sigma_roll_pitch_deg,
            config.sigma_roll_pitch_deg,
            config.sigma_heading_deg,
        ]
    )
    assumed[3:] = np.radians(assumed[3:])
    usual = np.full(assumed.size, np.nan) if stated is None else np.median(stated.sigma, axis=0)
    sigma = np.where(np.isfinite(usual), usual, assumed)
    times = (config.position_time_s,) * 3 + (config.attitude_time_s,) * 3
    n, e, d, r, p, h = (GaussMarkov(float(s), t) for s, t in zip(sigma, times, strict=True))
    return n, e, d, r, p, h


def solve(plan: SurveyPlan, evidence: Evidence) -> Solution:
    """Corrections of all runs that evidence reaches.

    Raises
    ------
    ConfigError
        where a Helmert transformation has too few points.
    """
    config = plan.survey.config.adjust
    control = observations_of(evidence.sightings)
    role = np.array([one.point.role == "gcp" for one in _by_observation(evidence.sightings)], bool)
    datum = datum_fault(evidence.sightings, config.control.largest_m)
    far = {} if datum else far_in_height(evidence.sightings, config.control.largest_m)
    names = np.array([one.point.name for one in _by_observation(evidence.sightings)], dtype=object)
    entering = role & ~np.isin(names, list(far)) & (config.control.on and not datum)
    notes = [datum] if datum else []
    notes += _far_notes(far, evidence)
    if config.mode == "helmert":
        fit = _rigid_fit(evidence, entering)
        points = _points(fit.control, 0)
        notes += _wrong_notes(evidence.sightings, points)
        return Solution(
            _rigid_corrections(plan, evidence, fit), np.zeros(evidence.ties.observations.size), points, control,
            tuple(notes), {}, 0, leave_one_out(fit.control),
        )  # fmt: skip
    accepted = evidence.ties.accepted
    first_point = int(evidence.ties.observations.place.max(initial=-1)) + 1
    points_apart = replace(control, place=control.place + first_point).chosen(entering)
    joined = Observations.joined([evidence.ties.observations.chosen(accepted), points_apart])
    settings = AdjustmentSettings(mode=config.mode, **config.solver.model_dump())
    found = adjust(joined, evidence.priors, settings)
    weight = np.zeros(accepted.size)
    weight[accepted] = found.weight[: int(accepted.sum())]
    points = _points(found.control, first_point)
    notes += _wrong_notes(evidence.sightings, points)
    reached = {int(run) for run in np.unique(joined.run) if run != FIXED and _moves(evidence.priors[int(run)])}
    corrections = {evidence.runs[k]: _with_sigma(found, k) for k in sorted(reached)}
    return Solution(
        corrections, weight, points, control, tuple(notes), found.variance_factors, found.rounds,
        leave_one_out(found.control) if found.control.place.size else None,
    )  # fmt: skip


def _by_observation(sightings: Sequence[Sighting]) -> list[Sighting]:
    """The sighting of each observation of :func:`observations_of`."""
    return [one for one in sightings for _ in range(one.observed)]


def _moves(prior: RunPrior) -> bool:
    return any(process.sigma > 0.0 for process in prior.processes)


def _with_sigma(found: Adjustment, run: int) -> Corrections:
    own = found.corrections(found.runs[run])
    return replace(own, sigma=found.sigma[run])


def _points(control: ControlErrors, first: int) -> dict[tuple[int, int], PointFigures]:
    """Figures by number of the point and run; `first` : place that stands for point 0."""
    points: dict[tuple[int, int], PointFigures] = {}
    for k, (place, run) in enumerate(zip(control.place.tolist(), control.run.tolist(), strict=True)):
        points[place - first, run] = PointFigures(
            float(control.weight[k, 2]), float(control.weight[k, :2].min()),
            # Down is the height's negative.
            -float(control.left_out_m[k, 2]), control.left_out_m[k, :2], control.left_out_sigma_m[k],
        )  # fmt: skip
    return points


def _far_notes(far: Mapping[str, float], evidence: Evidence) -> list[str]:
    if not far:
        return []
    words = [f"{name} ({away:+.3f} m)" for name, away in sorted(far.items())]
    notes = [
        f"{len(far)} control points lie far above or below the road that was measured, and are not used: "
        f"{listed(words)}; they are in another height datum or CRS, or under a bridge"
    ]
    surveyed = {one.point.name: one.point.height_m for one in evidence.sightings}
    # The poses are as they were recorded.
    sigma = max(
        (float(evidence.priors[one.run].sigma_at(_epoch(one))[0, 2]) for one in evidence.sightings), default=0.0
    )
    points = [WrongPoint(name, away, float("nan"), sigma, surveyed[name]) for name, away in sorted(far.items())]
    return notes + _swapped_notes(points)


def _swapped_notes(points: Sequence[WrongPoint]) -> list[str]:
    return [f"the heights of {one} and {other} look exchanged" for one, other in swapped(points)]


def _wrong_notes(
    sightings: Sequence[Sighting], points: Mapping[tuple[int, int], PointFigures]
) -> list[str]:  # fmt: skip
    by_number = {one.point.number: one.point for one in sightings}
    wrong: dict[str, WrongPoint] = {}
    for (number, _), figures in points.items():
        point = by_number[number]
        height = figures.left_out_height_m if figures.weight_height == 0.0 else float("nan")
        away = float(np.hypot(*figures.left_out_horizontal_m)) if figures.weight_horizontal == 0.0 else float("nan")
        if np.isfinite(height) or np.isfinite(away):
            sigma = float(figures.left_out_sigma_m[2])
            wrong[point.name] = WrongPoint(point.name, height, away, sigma, point.height_m)
    if not wrong:
        return []
    ordered = sorted(wrong.values(), key=lambda one: one.name)
    notes = [
        f"{len(ordered)} control points contradict all other evidence and do not count: "
        f"{listed([one.told() for one in ordered])}; their survey, or what stands for them, is wrong"
    ]
    return notes + _swapped_notes(ordered)


def _rigid_fit(evidence: Evidence, entering: Bool) -> RigidFit:
    """The one rigid movement of the survey onto its targets."""
    sightings = _by_observation(evidence.sightings)
    own = {id(sightings[k]): sightings[k] for k in np.flatnonzero(entering)}.values()
    seen = [one for one in own if one.is_placed and np.isfinite(one.height_m)]
    sigma = np.array([evidence.priors[one.run].sigma_at(_epoch(one))[0, :3] for one in seen]).reshape(-1, 3)
    return rigid_fit(seen, sigma)


def _epoch(one: Sighting) -> Int64:
    return np.array([one.epoch_gps_ns], np.int64)


def _rigid_corrections(plan: SurveyPlan, evidence: Evidence, fit: RigidFit) -> dict[str, Corrections]:
    """A rigid movement as corrections of each run."""
    corrections: dict[str, Corrections] = {}
    for prior in evidence.priors:
        source = next((s for s, _ in plan.sources if s.run == prior.run and s.trajectory is not None), None)
        if source is None or source.trajectory is None or not _moves(prior):
            continue
        knots = knots_of(prior, plan.survey.config.adjust.solver.knot_spacing_s)
        recorded = load_recorded(
            plan.store, source.trajectory, [(int(knots[0]), int(knots[-1]))], plan.ground.max_gap_s
        )
        poses = level_poses(recorded, plan.ground.map, knots)
        if poses.epoch_gps_ns.size:
            places = level_from_map(poses.body_m - fit.origin_m, fit.convergence_rad)
            corrections[prior.run] = fit.helmert.corrections(poses.epoch_gps_ns, places, poses.level_from_body)
    return corrections
