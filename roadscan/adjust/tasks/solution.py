"""From evidence to corrections: selection of the evidence, the adjustment, and wrong control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from roadscan.adjust.adjustment import Adjustment, CameraErrors, CommonErrors, ControlErrors, MountingErrors, adjust
from roadscan.adjust.bundle.edge_boresight import edge_observations, widened
from roadscan.adjust.bundle.outcome import FreeCameras, PictureOutcome, free_cameras, outcome_of
from roadscan.adjust.bundle.solve import Approached, PictureEvidence, approached
from roadscan.adjust.control import (
    ControlPoint,
    SeenBy,
    Sighting,
    WrongPoint,
    datum_fault,
    far_in_height,
    observations_of,
)
from roadscan.adjust.control_test import APART, HEIGHT, PLACE
from roadscan.adjust.control_test import COMPONENTS as _AXES
from roadscan.adjust.helmert import RigidFit, rigid_fit
from roadscan.adjust.observations import (
    FIXED,
    MOUNTED,
    TURNS,
    CameraPrior,
    GaussMarkov,
    MountingPrior,
    Observations,
    RunPrior,
    StatedSigma,
    knots_of,
)
from roadscan.adjust.places import level_from_map
from roadscan.adjust.quality import LeaveOneOut, leave_one_out
from roadscan.adjust.settings import AdjustConfig, AdjustmentSettings, ControlRules, PosePriors
from roadscan.adjust.targets.shapes import SurveyedLine
from roadscan.adjust.tasks.cameras import exposure_epochs, exposure_span
from roadscan.adjust.tasks.control_work import line_findings
from roadscan.adjust.tasks.doubts import (
    CONTROL,
    CONTROL_DATUM,
    HELMERT_TURN,
    datum_figures,
    exchanged,
    far_points,
    fixed_findings,
    fixed_line,
    not_held,
    offset_findings,
    offset_line,
    power_line,
    run_findings,
    shift_findings,
    solver_findings,
    solver_line,
    time_line,
    wrong_points,
)
from roadscan.adjust.tasks.hand_ties import wrong_hand_ties
from roadscan.adjust.tasks.mountings import (
    DOUBTED,
    Cause,
    Mounted,
    cause_line,
    causes,
    contradicted,
    disproved,
    rolls_in_words,
)
from roadscan.adjust.tasks.near import Sources
from roadscan.adjust.tasks.tie_work import KnownTies
from roadscan.adjust.tasks.tracks import span_of
from roadscan.adjust.ties.plane import Lean
from roadscan.compute.array_types import Bool, Float64, Int32, Int64
from roadscan.core.witness import Finding
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_recorded, stated_pose_sigma
from roadscan.poses.trajectory import NO_SEAT, Corrections, level_poses

_CHANGED: Final = 6
"""Changes of the σ of mountings, at most, until nothing contradicts them: a turn, axes in which control is doubted, and
components that are off, each of which may show the next."""
_MUCH_TOO_SMALL: Final = 4.0
"""Variance factor of attitudes from which on a turn of the sensors is asked instead: σ is half of what it should be."""
_ROLL: Final = MOUNTED.index("roll_rad")
_SEVERAL: Final = 2
"""Wrong control points from which on a roll of the sensors is asked instead: one point alone is no sign of it."""
_WIDE_RAD: Final = float(np.radians(5.0))
"""1 σ of a turn that is free: an error of the hand, not of an adjustment."""
_SOUND: Final = 0.1
"""Share of a run with GNSS, at least: a drive with less of it, or none, is all alike."""
_IN_OUTAGE: Final = 3.0  # Factor of σ above that of the best part of a run from which on there is no GNSS.
_NONE: Final = (GaussMarkov(0.0, 1.0),) * 6  # processes of a run without readings


@dataclass(frozen=True)
class Evidence:
    """All evidence of the adjustment."""

    runs: tuple[str, ...]
    """Runs of the survey, by which observations number them."""
    priors: tuple[RunPrior, ...]
    """Of each of them; without σ where a run is not adjusted."""
    ties: KnownTies
    sightings: tuple[Sighting, ...]
    mounted: Mounted
    useless: frozenset[int] = frozenset()
    """Runs whose readings are misplaced: neither their ties nor their control counts."""
    pictures: PictureEvidence | None = None
    """Tie points and control in pictures."""
    points: tuple[ControlPoint, ...] = ()
    """Control points of the survey, by number."""
    leans: tuple[Lean, ...] = ()
    """Of the walls that lidars saw."""

    def seen_by(self, one: Sighting) -> SeenBy:
        """Returns the sensor that saw a point."""
        if one.status == "unseen":
            return SeenBy(-1, NO_SEAT)
        seat = self.mounted.seats(self.runs[one.run], one.sensor, one.epoch_gps_ns)
        return SeenBy(self.mounted.number(self.runs[one.run], one.sensor), seat)


@dataclass(frozen=True)
class JointEvidence:
    """What is adjusted together; σ of mountings are changed, and it is adjusted again."""

    observations: Observations
    poses: Sequence[RunPrior]
    settings: AdjustmentSettings
    cameras: tuple[CameraPrior, ...]
    filmed: Bool
    """(s,) mountings that are those of cameras."""
    walls: tuple[tuple[int, Lean], ...] = ()
    """Leans of the walls that a lidar saw, with its number among the mountings; −1: it is none of them."""

    def adjusted(self, mountings: Sequence[MountingPrior]) -> Adjustment:
        """Returns the adjustment with some σ of mountings."""
        return adjust(self.observations, self.poses, self.settings, mountings, self.cameras)


@dataclass(frozen=True)
class PointFigures:
    """Figures of a control point, or of one in one run where each run is adjusted alone."""

    weight_height: float
    weight_horizontal: float
    left_out_height_m: float
    """Surveyed height minus its prediction without the point."""
    left_out_horizontal_m: Float64
    """(2,) surveyed place minus that prediction, north and east."""
    left_out_sigma_m: Float64
    """(3,) 1 σ, north, east, down."""


@dataclass(frozen=True)
class Solution:
    """Corrections, and figures of the evidence."""

    corrections: Mapping[str, Corrections]
    """Of the runs that evidence reaches."""
    tie_weight: Float64
    """(t,) of each tie that could be measured."""
    points: Mapping[tuple[int, int], PointFigures]
    """By number of the point and run, −1 for all runs."""
    control: Observations
    """Of all sightings, check points too."""
    findings: tuple[Finding, ...]
    """Findings on control, runs and stated σ."""
    lines: tuple[str, ...]
    """Lines that describe the solution."""
    left_out: LeaveOneOut | None = None
    datum: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Poses minus control as a whole, and 1 σ of the datum (m): see :func:`datum_figures`."""
    mountings: MountingErrors | None = None
    """Errors of the sensors' mountings; None where they are not estimated."""
    common: CommonErrors | None = None
    """Errors that ties of lidars have in common; None where they are not estimated."""
    cameras: CameraErrors | None = None
    """Errors of lenses and clocks; None where no picture takes part."""
    pictures: PictureOutcome | None = None
    """What is left in pictures."""
    free: FreeCameras | None = None
    """What they say of lenses and clocks without what is stated of these."""

    def point(self, number: int, run: int) -> PointFigures | None:
        """Returns figures of a point as a run saw it."""
        return self.points.get((number, -1)) or self.points.get((number, run))


def priors_of(plan: SurveyPlan, sources: Sources, runs: Sequence[str]) -> tuple[RunPrior, ...]:
    """Returns errors of the recorded poses of each run; of a run without readings there are none."""
    config, found, filmed = AdjustConfig.of(plan.survey).priors, [], exposure_epochs(plan)
    for run in runs:
        own = [(s, files) for s, files in sources if s.run == run]
        trajectory = own[0][0].trajectory if own else None
        if trajectory is None and run in filmed:
            trajectory = trajectory_source(run, plan.records)
        if trajectory is None:
            found.append(RunPrior(run, 0, 0, _NONE))
            continue
        taken = filmed.get(run, np.zeros(0, np.int64))
        spans = [span_of(s, files) for s, files in own] + ([exposure_span(taken)] if taken.size else [])
        stated = _stated(plan, trajectory) if config.source == "sigma" else None
        first, last = min(a for a, _ in spans), max(b for _, b in spans)
        held = run in AdjustConfig.of(plan.survey).fixed
        found.append(RunPrior(run, first, last, _processes(config, stated), stated, held, taken))
    return tuple(found)


def _stated(plan: SurveyPlan, trajectory: TrajectorySource) -> StatedSigma | None:
    epochs, sigma = stated_pose_sigma(plan.store, plan.records, trajectory)
    return StatedSigma(epochs, sigma) if epochs.size else None


def _processes(
    config: PosePriors, stated: StatedSigma | None
) -> tuple[GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov, GaussMarkov]:
    """Returns the processes of the settings, with the median of the σ that the logs state of a component."""
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
    usual = np.full(assumed.size, np.nan) if stated is None else _usual(stated.sigma)
    sigma = np.where(np.isfinite(usual), usual, assumed)
    times = (config.position_time_s,) * 3 + (config.attitude_time_s,) * 3
    n, e, d, r, p, h = (GaussMarkov(float(s), t) for s, t in zip(sigma, times, strict=True))
    return n, e, d, r, p, h


def _usual(sigma: Float64) -> Float64:
    """Returns the median (6,) of stated σ (k, 6); of a run that is an outage for the most part, that of the rest."""
    every, limit = np.median(sigma, axis=0), _IN_OUTAGE * np.quantile(sigma, _SOUND, axis=0)
    sound = [np.median(own[own <= most]) if most > 0.0 else np.nan for own, most in zip(sigma.T, limit, strict=True)]
    return np.where(every > limit, sound, every)


def solve(plan: SurveyPlan, evidence: Evidence) -> Solution:
    """Returns corrections of all runs that evidence reaches.

    Raises
    ------
    ConfigError
        where a Helmert transformation has too few points.
    """
    config = AdjustConfig.of(plan.survey)
    control = observations_of(evidence.sightings, [evidence.seen_by(one) for one in evidence.sightings])
    sightings = _by_observation(evidence.sightings)
    role = np.array([one.point.role == "gcp" for one in sightings], bool)
    datum = datum_fault(evidence.sightings, config.control.largest_m)
    recorded = [
        0.0 if one.status == "unseen" else float(evidence.priors[one.run].sigma_at(_epoch(one))[0, 2])
        for one in evidence.sightings
    ]
    far = {} if datum else far_in_height(evidence.sightings, config.control.largest_m, recorded)
    names = np.array([one.point.name for one in sightings], dtype=object)
    entering = role & ~np.isin(names, list(far)) & (config.control.on and not datum)
    entering &= ~np.isin(control.run.max(axis=1), list(evidence.useless))
    found = [CONTROL_DATUM.finds(CONTROL, datum, left_out=len(set(names.tolist())))] if datum else []
    found += _far_findings(far, evidence)
    if config.mode == "helmert":
        return _rigid_solution(plan, evidence, control, entering, found)
    entering_ties = _entering(evidence)
    adjusted, first, (named, rolls), approach = _adjusted(config, evidence, control.chosen(entering), config.mode)
    wrong_ties, said = wrong_hand_ties(evidence.ties, entering_ties, adjusted, config.control.false_alarm)
    if wrong_ties:
        found += said
        evidence = replace(evidence, ties=evidence.ties.refused(np.isin(evidence.ties.columns["name"], wrong_ties)))
        entering_ties = _entering(evidence)
        adjusted, first, (named, rolls), approach = _adjusted(config, evidence, control.chosen(entering), config.mode)
    weight = np.zeros(entering_ties.size)
    weight[entering_ties] = adjusted.weight[: int(entering_ties.sum())]
    points = _points(adjusted.control, first)
    wrong = _wrong(evidence.points, adjusted, first)
    of_lines = {one.point.name for one in evidence.sightings if one.point.is_of_line}
    found += wrong_points([one for one in wrong if one.name not in of_lines])
    found += line_findings([one for one in wrong if one.name in of_lines], evidence.sightings)
    counting = len(_counting_points(adjusted.control))
    found += offset_findings(adjusted.verdict, adjusted.applied, counting)
    found += shift_findings(adjusted.verdict.shift, rolls_in_words(rolls)) + run_findings(
        evidence.runs, adjusted.run_factors
    )
    outcome, free = None, None
    if approach is not None:
        outcome = outcome_of(approach, adjusted, evidence.points)
        free = free_cameras(approach, adjusted, _settings(config, "joint"), evidence.mounted.priors)
    joined = evidence.ties.observations.chosen(weight > 0.0)
    found += _not_held(evidence, joined.run, control.chosen(entering), points)
    found += fixed_findings(adjusted.fixed, config.control.false_alarm)
    found += solver_findings(adjusted.variance_factors, adjusted.rounds, settled=adjusted.settled)
    reached = {
        int(run) for run in np.unique([*joined.run.ravel(), *control.chosen(entering).run.ravel()]) if run != FIXED
    }
    reached |= set() if approach is None else set(approach.rows.observations.run[:, 0].tolist())
    moved = sorted(run for run in reached if _moves(evidence.priors[run]))
    corrections = {evidence.runs[k]: _with_sigma(adjusted, k) for k in moved}
    lines = [
        solver_line(adjusted.variance_factors, adjusted.rounds, settled=adjusted.settled),
        fixed_line(adjusted.fixed), time_line(evidence.priors, adjusted.priors),
        offset_line(adjusted.verdict, adjusted.applied),
        power_line(adjusted.verdict, adjusted.control.left_out_sigma_m[:, 2].tolist()), cause_line(named),
    ]  # fmt: skip
    return Solution(
        corrections, weight, points, control, tuple(found), tuple(line for line in lines if line),
        _left_out(adjusted.control, first, evidence), datum_figures(adjusted.verdict, adjusted.applied),
        adjusted.mountings if adjusted.mountings.sensors else None,
        adjusted.common if adjusted.common.number.size else None,
        adjusted.cameras if approach else None, outcome, free,
    )  # fmt: skip


def _left_out(control: ControlErrors, first: int, evidence: Evidence) -> LeaveOneOut | None:
    """Returns the accuracy at each GCP from all others; a line, which binds across it alone, is no GCP."""
    lines = {one.point.number for one in evidence.sightings if one.point.is_of_line}
    own = control.chosen(~np.isin(control.place - first, list(lines)))
    return leave_one_out(own) if own.place.size else None


def _entering(evidence: Evidence) -> Bool:
    """Ties (t,) that enter: those that passed their tests, and for mountings those between heads of one pass."""
    ties = evidence.ties
    useful = ~np.isin(ties.observations.run, list(evidence.useless)).any(axis=1)
    return useful & (ties.accepted | ties.of_heads if evidence.mounted.priors else ties.accepted)


def _adjusted(
    config: AdjustConfig, evidence: Evidence, control: Observations, mode: Literal["joint", "each_pass", "vertical"]
) -> tuple[Adjustment, int, tuple[tuple[Cause, ...], tuple[Cause, ...]], Approached | None]:
    """Returns the adjustment of ties, control and pictures, the place that stands for point 0, possible faults of
    mountings and rolls of them that would explain a shift of the control as well, and how pictures entered.

    A mounting that is off by more than its stated σ allows would be drawn back by it: such a σ is taken to be larger
    than what was found, and the adjustment is made once more. Control that is off as a whole looks like lever arms of
    all sensors that are off: they are not estimated then, and the control is what is doubted. A sensor whose mounting
    nothing contradicts keeps the stated one: what would be estimated is the noise of the evidence.
    """
    ties = evidence.ties.observations
    first = int(ties.place.max(initial=-1)) + 1
    joined = Observations.joined([ties.chosen(_entering(evidence)), replace(control, place=control.place + first)])
    settings = _settings(config, mode)
    priors, cameras, approach = evidence.mounted.priors, list[CameraPrior](), None
    if evidence.pictures is not None and mode == "joint":
        joined = Observations.joined([joined, edge_observations(evidence.pictures.edges)])
        priors = widened(priors, evidence.pictures.edges)
        approach = approached(evidence.pictures, (joined, first), evidence.priors, settings, priors)
        more = [] if approach.depths is None else [approach.depths.observations]
        joined = Observations.joined([joined, *more, approach.rows.observations])
        cameras = list(evidence.pictures.cameras)
    filmed = np.array([one.sensor in evidence.mounted.cameras for one in priors], bool)
    walls = tuple((evidence.mounted.number(evidence.runs[one.run], one.sensor), one) for one in evidence.leans)
    every = JointEvidence(joined, evidence.priors, settings, tuple(cameras), filmed, walls)
    found, rolls = every.adjusted(priors), tuple[Cause, ...]()
    is_roll_asked = False
    for _ in range(_CHANGED):
        changed = turned_for_good(every, priors, found)
        if changed is None and not is_roll_asked:
            changed, rolls = rolled(every, priors, found)
            is_roll_asked = True
        changed = _better_stated(priors, found, filmed) if changed is None else changed
        if changed is None:
            break
        priors = changed
        found = every.adjusted(priors)
    stated = np.array([one.sigma for one in evidence.mounted.priors]).reshape(-1, len(MOUNTED))
    estimated, wrong = found.mountings, filmed.copy()  # pictures show a mounting whether or not it contradicts
    wrong[~filmed] = contradicted(found.mountings.of(~filmed))
    named = causes(found.mountings.of(~filmed))
    if priors and not wrong.all():
        priors = tuple(
            replace(one, sigma=one.sigma if is_wrong else np.zeros(len(MOUNTED)))
            for one, is_wrong in zip(priors, wrong, strict=True)
        )
        found = every.adjusted(priors)
        estimated = replace(
            estimated,
            error=np.where(wrong[:, None], found.mountings.error, 0.0),
            sigma=np.where(wrong[:, None], found.mountings.sigma, estimated.sigma),
        )
    return replace(found, mountings=replace(estimated, prior_sigma=stated)), first, (named, rolls), approach


def _better_stated(
    priors: Sequence[MountingPrior], found: Adjustment, filmed: Bool
) -> tuple[MountingPrior, ...] | None:
    """Returns priors of mountings that the adjustment does not contradict; None where it contradicts none."""
    shared = [axis for name in found.verdict.doubted for axis in _AXES[name]]
    # Where a camera stands beside the others is no error that all sensors have in common.
    own = zip(priors, filmed.tolist(), strict=True)
    kept = tuple(one if is_camera else replace(one, sigma=_without(one.sigma, shared)) for one, is_camera in own)
    if any((one.sigma != other.sigma).any() for one, other in zip(priors, kept, strict=True)):
        return kept
    off = disproved(found.mountings) & ~filmed[:, None]
    if not off.any():
        return None
    # A turn that was found was drawn back by its stated σ: what is off is larger. Two heads share a lever arm that is
    # off, and wider σ would let both drift.
    times = np.where(np.isin(np.arange(len(MOUNTED)), list(TURNS.values())), DOUBTED, 1.0)
    sigma = np.where(off, times * np.abs(found.mountings.error), found.mountings.prior_sigma)
    return tuple(replace(one, sigma=own) for one, own in zip(priors, sigma, strict=True))


def turned_for_good(
    every: JointEvidence, priors: Sequence[MountingPrior], found: Adjustment
) -> tuple[MountingPrior, ...] | None:
    """Returns priors of mountings that allow a sensor to be turned about each axis whose stated σ of the poses would be
    much too small, where the poses are as stated once it is turned; None where they are not.

    The same evidence has two explanations: a sensor that is turned for good, which is one unknown, or attitudes whose
    σ are all too small. The first is asked first, as it is the simpler one. Variance components alone never find it:
    they widen the process of the poses until this takes up the turn.
    """
    wide = [axis for name, axis in TURNS.items() if found.variance_factors[name] > _MUCH_TOO_SMALL]
    free = _free(priors, wide, every.filmed)
    if free is None:
        return None
    turned = every.adjusted(free)
    if any(turned.variance_factors[name] > 1.0 for name, axis in TURNS.items() if axis in wide):
        return None
    return _allowed(priors, free, turned)


def rolled(
    every: JointEvidence, priors: Sequence[MountingPrior], found: Adjustment
) -> tuple[tuple[MountingPrior, ...] | None, tuple[Cause, ...]]:
    """Returns priors of mountings that allow a roll, where a roll of the sensors explains much better what control says
    than a shift of it in the plane, wrong points or a bad survey do; else None, and the rolls that explain it about as
    well.

    On a road that falls to its sides, control that lies aside and a sensor that is rolled change heights alike. What
    counts are the weighted squares of the surveys, of the errors that ties have in common, which would have to hide the
    roll, and of the leans of walls, which would not be upright.
    """
    none = tuple[Cause, ...]()
    verdict = found.verdict
    if not verdict.shift.sigmas and len(verdict.wrong) < _SEVERAL and verdict.survey_factor == 1.0:
        return None, none
    free = _free(priors, [_ROLL], every.filmed)
    if free is None:
        return None, none
    other = every.adjusted(free)
    gain = _contradiction(found, every.walls) - _contradiction(other, every.walls)
    contradicted_still = other.verdict.faults or other.verdict.shift.sigmas or other.verdict.survey_factor > 1.0
    if contradicted_still or gain < -APART:
        return None, none
    if gain > APART:
        return _allowed(priors, free, other), none
    errors = other.mountings
    return None, tuple(
        Cause(errors.sensors[k], _ROLL, float(errors.error[k, _ROLL]), float(errors.sigma[k, _ROLL]))
        for k in np.flatnonzero((errors.prior_sigma[:, _ROLL] >= _WIDE_RAD) & ~every.filmed).tolist()
    )


def _contradiction(found: Adjustment, walls: Sequence[tuple[int, Lean]]) -> float:
    """Returns the weighted squares of surveys against poses and ties, of the errors that ties have in common, and of
    what walls still lean.
    """
    roll = found.mountings.error[:, _ROLL]
    lean = sum(((one.roll_rad + roll[number]) / one.sigma_rad) ** 2 for number, one in walls if number >= 0)
    return found.verdict.squares + float(found.common.error @ found.common.error) + float(lean)


def _free(priors: Sequence[MountingPrior], axes: Sequence[int], filmed: Bool) -> tuple[MountingPrior, ...] | None:
    """Returns priors that leave turns of sensors about some axes free; None where no such σ becomes larger."""
    asked = np.isin(np.arange(len(MOUNTED)), axes)
    free = tuple(
        one if is_camera else replace(one, sigma=np.where(asked & (one.sigma > 0.0), _WIDE_RAD, one.sigma))
        for one, is_camera in zip(priors, filmed.tolist(), strict=True)
    )
    is_wider = any((one.sigma < other.sigma).any() for one, other in zip(priors, free, strict=True))
    return free if is_wider else None


def _allowed(
    priors: Sequence[MountingPrior], free: Sequence[MountingPrior], found: Adjustment
) -> tuple[MountingPrior, ...]:
    """Returns priors whose σ are as large as the turns that were found where these were free."""
    return tuple(
        replace(one, sigma=np.where(one.sigma < other.sigma, np.maximum(np.abs(error), one.sigma), one.sigma))
        for one, other, error in zip(priors, free, found.mountings.error, strict=True)
    )


def _settings(config: AdjustConfig, mode: Literal["joint", "each_pass", "vertical"]) -> AdjustmentSettings:
    rules = {name: getattr(config.control, name) for name in ControlRules.model_fields}
    return AdjustmentSettings(mode=mode, **config.solver.model_dump(), **rules)


def _without(sigma: Float64, axes: Sequence[int]) -> Float64:
    """Returns σ (7,) of a mounting, with 0 for components that are not to be estimated."""
    return np.where(np.isin(np.arange(sigma.size), axes), 0.0, sigma)


def _counting_points(control: ControlErrors) -> set[int]:
    """Returns points of which a survey counts."""
    return set(control.place[(control.weight > 0.0).any(axis=1)].tolist())


def _not_held(
    evidence: Evidence, links: Int32, control: Observations, points: Mapping[tuple[int, int], PointFigures]
) -> list[Finding]:
    """Returns runs that nothing determines, by ties and points that count."""
    right = {number for (number, _), own in points.items() if own.weight_height != 0.0 or own.weight_horizontal != 0.0}
    held = {int(run) for run, point in zip(control.run.max(axis=1), control.place, strict=True) if int(point) in right}
    held |= {number for number, prior in enumerate(evidence.priors) if prior.fixed}
    moving = [number for number, prior in enumerate(evidence.priors) if _moves(prior)]
    return not_held(evidence.runs, moving, np.asarray(links, np.int64), held)


def _by_observation(sightings: Sequence[Sighting]) -> list[Sighting]:
    """Returns the sighting of each observation of :func:`observations_of`."""
    return [one for one in sightings for _ in range(one.observed)]


def _moves(prior: RunPrior) -> bool:
    return not prior.fixed and any(process.sigma > 0.0 for process in prior.processes)


def _with_sigma(found: Adjustment, run: int) -> Corrections:
    own = found.corrections(found.runs[run])
    return replace(own, sigma=found.sigma[run])


def _points(control: ControlErrors, first: int) -> dict[tuple[int, int], PointFigures]:
    """Returns figures by number of the point and run; `first` : place that stands for point 0."""
    points: dict[tuple[int, int], PointFigures] = {}
    for k, (place, run) in enumerate(zip(control.place.tolist(), control.run.tolist(), strict=True)):
        points[place - first, run] = PointFigures(
            float(control.weight[k, 2]), float(control.weight[k, :2].min()),
            # Down is the height's negative.
            -float(control.left_out_m[k, 2]), control.left_out_m[k, :2], control.left_out_sigma_m[k],
        )  # fmt: skip
    return points


def _far_findings(far: Mapping[str, float], evidence: Evidence) -> list[Finding]:
    surveyed = {one.point.name: one.point.height_m for one in evidence.sightings}
    # The poses are as they were recorded.
    sigma = max(
        (float(evidence.priors[one.run].sigma_at(_epoch(one))[0, 2]) for one in evidence.sightings), default=0.0
    )
    points = [WrongPoint(name, away, float("nan"), sigma, surveyed[name]) for name, away in sorted(far.items())]
    return far_points(far) + exchanged(points)


def _wrong(points: Sequence[ControlPoint], adjusted: Adjustment, first: int) -> list[WrongPoint]:
    """Returns points whose height or place is wrong, by name."""
    by_number, control = {one.number: one for one in points}, adjusted.control
    found: list[WrongPoint] = []
    for one in adjusted.verdict.wrong:
        point = by_number[int(control.place[one.point]) - first]
        others = tuple(sorted(by_number[int(control.place[k]) - first].name for k in one.alternatives))
        away = control.left_out_m[one.point]
        height = -float(away[2]) if one.component == HEIGHT else float("nan")
        place = _aside_m(point, away) if one.component == PLACE else float("nan")
        sigma = float(control.left_out_sigma_m[one.point, 2])
        found.append(WrongPoint(point.name, height, place, sigma, point.height_m, one.sigmas, one.limit, others))
    return sorted(found, key=lambda one: one.name)


def _aside_m(point: ControlPoint, away_m: Float64) -> float:
    """Returns the distance of a surveyed place from another (3,; north, east, down): across its line, if it has one."""
    if isinstance(point.shape, SurveyedLine):
        sine, cosine = np.sin(point.shape.azimuth_rad), np.cos(point.shape.azimuth_rad)
        return abs(float(away_m[1] * cosine - away_m[0] * sine))
    return float(np.hypot(*away_m[:2]))


def _rigid_solution(
    plan: SurveyPlan, evidence: Evidence, control: Observations, entering: Bool, found: list[Finding]
) -> Solution:
    """Returns the survey as a whole, shifted and turned onto its control."""
    config = AdjustConfig.of(plan.survey)
    fit = _rigid_fit(evidence, entering, config.control.false_alarm)
    points = _points(fit.control, 0)
    found += wrong_points(_left_out_of(evidence.sightings, points))
    # Poses and ties test the control as a whole; a rigid transformation follows the control in any case.
    following = config.model_copy(update={"control": config.control.model_copy(update={"datum_offset": "follow"})})
    adjusted, _, _, _ = _adjusted(following, evidence, control.chosen(entering), "joint")
    found += offset_findings(adjusted.verdict, adjusted.applied, len(points))
    corrections, sides_m = _rigid_corrections(plan, evidence, fit)
    prior = max((float(p.sigmas[2]) for p in evidence.priors), default=0.0)
    if sides_m > prior:
        found.append(
            HELMERT_TURN.finds(
                "adjust", f"control lies along a line, which leaves the turn about it open: σ of heights "
                f"{config.moved_arm_m:g} m to the side of the vehicle is {1e3 * sides_m:.1f} mm by the transformation "
                f"alone, more than the {1e3 * prior:.1f} mm of the poses",
            )
        )  # fmt: skip
    return Solution(
        corrections, np.zeros(evidence.ties.observations.size), points, control, tuple(found),
        tuple(line for line in (offset_line(adjusted.verdict, adjusted.applied),) if line), leave_one_out(fit.control),
    )  # fmt: skip


def _left_out_of(sightings: Sequence[Sighting], points: Mapping[tuple[int, int], PointFigures]) -> list[WrongPoint]:
    """Returns points that a rigid transformation leaves out as a whole, by name."""
    by_number = {one.point.number: one.point for one in sightings}
    wrong: list[WrongPoint] = []
    for (number, _), own in points.items():
        if own.weight_height == 0.0:
            point, away = by_number[number], float(np.hypot(*own.left_out_horizontal_m))
            wrong.append(
                WrongPoint(point.name, own.left_out_height_m, away, float(own.left_out_sigma_m[2]), point.height_m)
            )
    return sorted(wrong, key=lambda one: one.name)


def _rigid_fit(evidence: Evidence, entering: Bool, false_alarm: float) -> RigidFit:
    """Returns the one rigid transformation of the survey onto its targets."""
    sightings = _by_observation(evidence.sightings)
    own = {id(sightings[k]): sightings[k] for k in np.flatnonzero(entering)}.values()
    seen = [one for one in own if one.is_placed and np.isfinite(one.height_m) and not one.point.is_of_line]
    sigma = np.array([evidence.priors[one.run].sigma_at(_epoch(one))[0, :3] for one in seen]).reshape(-1, 3)
    return rigid_fit(seen, sigma, false_alarm)


def _epoch(one: Sighting) -> Int64:
    return np.array([one.epoch_gps_ns], np.int64)


def _rigid_corrections(
    plan: SurveyPlan, evidence: Evidence, fit: RigidFit
) -> tuple[dict[str, Corrections], float]:  # fmt: skip
    """Returns a rigid transformation as corrections of each run, and the largest σ of a height beside the vehicles."""
    corrections: dict[str, Corrections] = {}
    config, largest = AdjustConfig.of(plan.survey), 0.0
    for prior in evidence.priors:
        source = next((s for s, _ in plan.sources if s.run == prior.run and s.trajectory is not None), None)
        if source is None or source.trajectory is None or not _moves(prior):
            continue
        knots = knots_of(prior, config.solver.knot_spacing_s)
        recorded = load_recorded(
            plan.store, source.trajectory, [(int(knots[0]), int(knots[-1]))], plan.ground.max_gap_s
        )
        poses = level_poses(recorded, plan.ground.map, knots)
        if poses.epoch_gps_ns.size:
            places = level_from_map(poses.body_m - fit.origin_m, fit.convergence_rad)
            own = fit.helmert.corrections(poses.epoch_gps_ns, places, poses.level_from_body)
            sides = config.moved_arm_m * poses.level_from_body[:, :, 1]
            sigma = np.max([fit.helmert.sigma_of(places + way * sides) for way in (-1.0, 0.0, 1.0)], axis=0)
            largest = max(largest, float(sigma[:, 2].max()))
            recorded_sigma = prior.sigma_at(poses.epoch_gps_ns)
            whole = np.concatenate([np.hypot(sigma, recorded_sigma[:, :3]), recorded_sigma[:, 3:]], 1)
            corrections[prior.run] = replace(own, sigma=whole)
    return corrections, largest
