"""The adjustment: from observations to corrections of every run's poses, with their covariance.

Corrections are piecewise linear between knots in time. Each component of each run has a first-order Gauss–Markov
process as prior, whose σ is that of each pose (:mod:`roadscan.adjust.observations`); ties and control are observations;
what solves them is one sparse least-squares problem (:mod:`roadscan.adjust.sparse_normal`), weighed anew until nothing
changes (:mod:`roadscan.adjust.estimation`). A control point's survey is a separate observation: all runs that saw the
point share its error. Surveys are first left aside, and judged by what poses and ties say of them
(:mod:`roadscan.adjust.control_test`); then those that are right count, wholly. Mountings of sensors, which all runs
share, are unknowns beside the poses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.adjust.control_test import COMPONENTS as SURVEYED
from roadscan.adjust.control_test import AppliedOffset, ControlVerdict, SurveyErrors, applied_offset, judged
from roadscan.adjust.estimation import SURVEY, Estimate, Groups, Problem, Rounds
from roadscan.adjust.observations import (
    COMPONENTS,
    FIXED,
    KINDS,
    MOUNTED,
    CameraPrior,
    MountingPrior,
    Observations,
    RunPrior,
    line_variance,
)
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.adjust.sparse_normal import Rows
from roadscan.adjust.unknowns import HEIGHT_ALONE, ControlPoints, FixedRun, Unknowns, directions_of, fixed_runs
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.pictures.lens import PARAMETERS
from roadscan.poses.trajectory import Corrections, MountingChange

_DOWN: Final = COMPONENTS.index("down_m")
_AT_ONCE: Final = 200
"""Control points that are judged with the covariance of all of them: three coordinates each give 600 rows."""
_NEIGHBOURS: Final = 50
"""With more points, at most this many neighbours are judged together."""
_LENS: Final = len(PARAMETERS)
_JOINT_NS: Final = 500_000_000
"""Knots at which errors of pictures are given jointly are so far apart (ns), about: in between, σ of places measured
in two pictures are within 15 % of those that each picture's covariances give."""
_LATER: Final = 12
"""With so many of the next such knots the errors of a pose are given: 6 s, in which a picture's reach is passed."""
_SCALED: Final = 3
"""The stated σ of single runs are enlarged at most this many times, until none is too small."""
SURVEY_FACTOR: Final = "control_survey"
"""Name of the factor of the surveys' stated variances."""

_FASTER: Final = (4.0, 16.0)
"""Factors by which correlation times are shortened in a trial: 30 s and 8 s in place of two minutes."""

__all__ = ["Adjustment", "AdjustmentSettings", "ControlErrors", "adjust"]


@dataclass(frozen=True)
class ControlErrors:
    """Errors of the control points after the adjustment; c of them, one for each run where each is adjusted alone."""

    place: Int64
    """(c,) number of the point, as in the observations."""
    run: Int64
    """(c,) run, −1: all together."""
    survey_sigma_m: Float64
    """(c, 3) stated, north, east, down; 0: the coordinate was not observed."""
    error_m: Float64
    """(c, 3) estimated error of the survey (surveyed minus adjusted); NaN where not observed."""
    weight: Float64
    """(c, 3) weight of the survey, 0 = rejected; NaN where not observed."""
    left_out_m: Float64
    """(c, 3) surveyed minus the prediction without the coordinate: leave-one-out, coordinate by coordinate."""
    left_out_sigma_m: Float64
    """(c, 3) 1 σ of that difference, with that of the survey."""

    def chosen(self, which: Bool) -> ControlErrors:
        """Returns the errors of some points (c,)."""
        return ControlErrors(**{f.name: getattr(self, f.name)[which] for f in fields(self)})


@dataclass(frozen=True)
class MountingErrors:
    """Errors of the mountings of s sensors after the adjustment."""

    sensors: tuple[tuple[str, str], ...]
    """Run ("*" for all) and sensor."""
    prior_sigma: Float64
    """(s, 7) as it came in, `MOUNTED`; 0: not estimated."""
    error: Float64
    """(s, 7) correction that is added to the mounting (m, rad, share); 0 where not estimated."""
    sigma: Float64
    """(s, 7) 1 σ of the corrected mounting; that of the prior where no observation determines it."""
    covariance: Float64
    """(7 s, 7 s) of the errors of all sensors, without the height error common to all."""

    @property
    def changes(self) -> dict[tuple[str, str], MountingChange]:
        """Returns the corrections that are not 0, as changes of mountings."""
        every = zip(self.sensors, self.error, strict=True)
        return {sensor: MountingChange.of(error) for sensor, error in every if error.any()}

    def of(self, which: Bool) -> MountingErrors:
        """Returns the errors of some sensors (s,)."""
        rows = np.flatnonzero(np.repeat(which, len(MOUNTED)))
        names = tuple(one for one, kept in zip(self.sensors, which.tolist(), strict=True) if kept)
        return MountingErrors(
            names, self.prior_sigma[which], self.error[which], self.sigma[which], self.covariance[np.ix_(rows, rows)]
        )


class JointErrors(NamedTuple):
    """How the errors of a camera's pictures hang together after the adjustment: one is known by another's expense."""

    run: str
    sensor: str
    epochs_gps_ns: Int64
    """(k,) knots of the run, about half a second apart."""
    covariance: Float64
    """(k, 21, 21) of the run's pose, `COMPONENTS`, mounting (6) and lens (9); 0 of what is not estimated."""
    later: tuple[Float64, ...]
    """(k) of arrays (l, 6, 6): covariances of the pose (rows) with those of the next knots (columns), 12 at most."""


@dataclass(frozen=True)
class CameraErrors:
    """Errors of the lenses and clocks of k cameras after the adjustment."""

    sensors: tuple[str, ...]
    prior_sigma: Float64
    """(k, 11) as it came in, `CAMERA`; 0: not estimated."""
    error: Float64
    """(k, 11) correction that is added; 0 where not estimated."""
    sigma: Float64
    """(k, 11) 1 σ of the corrected value."""
    joint: tuple[JointErrors, ...] = ()
    """Of each run and camera whose mounting is estimated."""


@dataclass(frozen=True)
class CommonErrors:
    """Errors that ties have in common after the adjustment; e of them."""

    number: Int64
    """(e,) as `Observations.common` has it, rising."""
    error: Float64
    """(e,) in units of the prior σ."""
    sigma: Float64
    """(e,) 1 σ of these, in the same units."""


@dataclass(frozen=True)
class Adjustment:
    """The result of an adjustment: corrections of each run, and residuals of the observations."""

    runs: tuple[str, ...]
    epochs_gps_ns: tuple[Int64, ...]
    """Knots (k,) of each run."""
    values: tuple[Float64, ...]
    """(k, 6) of each run, `COMPONENTS`."""
    covariance: tuple[Float64, ...]
    """(k, 6, 6) of each run's knots."""
    covariance_with_next: tuple[Float64, ...]
    """(k − 1, 6, 6) of each knot (rows) with the next one (columns)."""
    residual_m: Float64
    """(n,) observed − computed, of each observation."""
    used: Bool
    """(n,) False where the mode leaves an observation out."""
    weight: Float64
    """(n,) 1 = counts fully, 0 = rejected or not used."""
    redundancy: Float64
    """(n,) share of its error that its residual shows, 0 to 1; NaN where not used."""
    normalised_residual: Float64
    """(n,) against the prediction of all others, over its σ; NaN where not used."""
    control: ControlErrors
    mountings: MountingErrors
    cameras: CameraErrors
    common: CommonErrors
    variance_factors: Mapping[str, float]
    """Of the stated variances, by kind of observation, by component of the processes, and of the surveys of control; 1
    where not estimated."""
    rounds: int
    settled: bool
    """False where weights still changed in the last round."""
    verdict: ControlVerdict
    """Verdict on the surveys of the control points."""
    applied: AppliedOffset
    """Common offset that was attributed to the surveys."""
    priors: tuple[RunPrior, ...]
    """Priors as given, or with shorter correlation times where the evidence requires these."""
    active: Bool
    """(runs, 6) components that were estimated."""
    response: tuple[Float64, ...]
    """(k, 6, 5) of each run: derivatives of its corrections by a common offset of the control, north, east, down, and
    by a shift, north, east, of the points of which only heights are used."""
    run_factors: Float64
    """(runs, 6) factors by which the stated variances of single runs' poses were multiplied."""
    fixed: tuple[FixedRun, ...] = ()
    """Estimated errors of the runs that are fixed."""

    @property
    def sigma(self) -> tuple[Float64, ...]:
        """Returns 1 σ (k, 6) of each run's knots, including that of an offset of the control."""
        from scipy.linalg import block_diag

        common = block_diag(self.applied.covariance_m2, self.verdict.shift.covariance_m2)
        shared = [np.einsum("kia,ab,kib->ki", r, common, r) for r in self.response]
        return tuple(np.sqrt(np.einsum("kii->ki", c) + more) for c, more in zip(self.covariance, shared, strict=True))

    def corrections(self, run: str) -> Corrections:
        """Returns a run's corrections as navigation takes them."""
        index = self.runs.index(run)
        values = self.values[index]
        return Corrections(self.epochs_gps_ns[index], values[:, :3].copy(), values[:, 3:].copy())

    def sigma_of(self, run_index: int, epochs_gps_ns: Int64, partials: Float64) -> Float64:
        """Returns 1 σ (n,) of a predicted movement: from knots, their correlation, and the line between them.

        Parameters
        ----------
        run_index : place of the run in `runs`.
        epochs_gps_ns : (n,) within the run.
        partials : (n, 6) derivatives of the movement by `COMPONENTS`.
        """
        knots, own = self.epochs_gps_ns[run_index], self.covariance[run_index]
        if knots.size == 1:
            return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", partials, own[0], partials)))
        prior, before = self.priors[run_index], np.searchsorted(knots, epochs_gps_ns, side="right") - 1
        before = np.clip(before, 0, knots.size - 2)
        step = (knots[before + 1] - knots[before]).astype(np.float64)
        share = np.clip((epochs_gps_ns - knots[before]) / step, 0.0, 1.0)
        left, right = (1.0 - share)[:, None] * partials, share[:, None] * partials
        variance = np.einsum("ni,nij,nj->n", left, own[before], left)
        variance += np.einsum("ni,nij,nj->n", right, own[before + 1], right)
        variance += 2.0 * np.einsum("ni,nij,nj->n", left, self.covariance_with_next[run_index][before], right)
        factors = np.array([self.variance_factors[c] for c in COMPONENTS]) * self.active[run_index]
        parts = prior.parts_at(knots)
        count = parts.shape[1] // len(COMPONENTS)
        ends, taus = (parts[before], parts[before + 1]), np.tile(prior.taus_s, count)
        lines = line_variance(share[:, None], step[:, None] / 1e9, taus, ends, np.arange(taus.size) >= len(COMPONENTS))
        lines = lines.reshape(-1, count, len(COMPONENTS)).sum(axis=1) * factors
        return np.asarray(np.sqrt(variance + (partials**2 * lines).sum(axis=1)))


def adjust(
    observations: Observations,
    priors: Sequence[RunPrior],
    settings: AdjustmentSettings,
    mountings: Sequence[MountingPrior] = (),
    cameras: Sequence[CameraPrior] = (),
) -> Adjustment:
    """Returns the adjustment of all runs.

    Parameters
    ----------
    observations : in any order; the result does not depend on it.
    priors : of each run that `Observations.run` counts.
    mountings : of each sensor that `Observations.sensor` counts; estimated where all runs are adjusted jointly.
    cameras : of each camera that `Observations.camera` counts, likewise.

    Raises
    ------
    ConfigError
        for an observation that is not a number, of no known run, or outside of its run's time.
    """
    found, wider = _once(observations, priors, settings, (mountings, cameras)), np.ones((len(priors), len(COMPONENTS)))
    if settings.estimate_variance_components is not None or settings.mode != "joint" or len(priors) < 2:
        return found
    for _ in range(_SCALED):
        more = _by_group(found.run_factors)
        more[[prior.fixed for prior in priors]] = 1.0  # a contradiction of a fixed run is reported, and moves nothing
        if (more == 1.0).all():
            break
        own = [p.wider(f) for p, f in zip(priors, wider * more, strict=True)]
        other = _once(observations, own, settings, (mountings, cameras))
        if any((found.run_factors[:, axes] > 1.0).any() for axes in _still_doubted(found, other)):
            break
        found, wider = other, wider * more
    return replace(found, run_factors=wider**2)


def _still_doubted(before: Adjustment, after: Adjustment) -> list[tuple[int, ...]]:
    """Returns axes in which control is doubted as a whole even with larger σ of a run: these do not explain it."""
    return [SURVEYED[name] for name in before.verdict.doubted if name in after.verdict.doubted]


def _by_group(factors: Float64) -> Float64:
    """Factors (runs, 6), the largest of position and of attitude for all three: σ are usually wrong together."""
    position, attitude = factors[:, :3].max(axis=1), factors[:, 3:].max(axis=1)
    return np.repeat(np.stack([position, attitude], axis=1), 3, axis=1)


def _once(
    observations: Observations,
    priors: Sequence[RunPrior],
    settings: AdjustmentSettings,
    shared: tuple[Sequence[MountingPrior], Sequence[CameraPrior]],
) -> Adjustment:
    """Returns an adjustment with the stated σ of each run's poses."""
    order = _canonical(observations)
    numbers, common = _numbered(observations.common)
    ordered = replace(observations, common=common).chosen(order)
    which = _used(ordered, settings.mode)
    chosen = ordered.chosen(which)
    components = HEIGHT_ALONE if settings.mode == "vertical" else np.ones(len(COMPONENTS), bool)
    control = ControlPoints.of(chosen, each_pass=settings.mode == "each_pass")
    shared = shared if settings.mode == "joint" else ((), ())
    first = Unknowns.of(priors, control, settings.knot_spacing_s, components, shared)
    first = replace(first, commons=numbers.size)
    first.check(observations)
    priors, unknowns, rounds, alone = _without_surveys(first, chosen, settings)
    verdict = judged(*_survey_errors(unknowns, chosen, alone, rounds), settings)
    applied = applied_offset(verdict, settings, settings.reject_beyond)
    estimate, solution, response, joint = _with_control(unknowns, alone, rounds, verdict, applied)
    values, covariance, with_next = _of_knots(unknowns, estimate, solution)
    told, n = _of_observations(unknowns, ordered, np.flatnonzero(which), estimate), chosen.size
    back = np.empty(order.size, np.int64)
    back[order] = np.arange(order.size)
    factors = dict(
        zip((*KINDS, *COMPONENTS), [*estimate.kind_factors[:SURVEY], *estimate.process_factors], strict=True)
    ) | {SURVEY_FACTOR: verdict.survey_factor}
    factors_of_runs = _understated_runs(unknowns, rounds, verdict, estimate)
    return Adjustment(
        tuple(p.run for p in priors), unknowns.knots, values, covariance, with_next,
        told[0][back], which[back], told[1][back], told[2][back], told[3][back],
        _of_control(unknowns, estimate, n, verdict.survey_factor), _of_mountings(unknowns, estimate, solution),
        _of_cameras(unknowns, estimate, solution, joint), _of_common(unknowns, estimate, numbers),
        {k: float(v) for k, v in factors.items()},
        estimate.rounds, estimate.settled, verdict, applied, tuple(priors), unknowns.active, response,
        factors_of_runs, fixed_runs(unknowns, _of_solution(unknowns, estimate.solution)),
    )  # fmt: skip


def _without_surveys(
    unknowns: Unknowns, observations: Observations, settings: AdjustmentSettings
) -> tuple[Sequence[RunPrior], Unknowns, Rounds, Estimate]:
    """Returns all rounds without the surveys of control points, and the priors that they used.

    Where stated σ of poses turn out too small, their errors may as well vary faster than the correlation time says,
    which nobody states: the shorter time is taken where it alone explains the evidence.
    """
    rounds = Rounds(_problem(unknowns, observations), settings)
    alone = rounds.without_surveys()
    stated = unknowns.priors, unknowns, rounds, alone
    if settings.estimate_variance_components is not None:
        return stated
    wide = alone.process_factors > 1.0
    shorter = wide[:3].any(), wide[3:].any()
    for times in _FASTER if wide.any() else ():
        priors = [p.faster(times if shorter[0] else 1.0, times if shorter[1] else 1.0) for p in unknowns.priors]
        other = replace(unknowns, priors=tuple(priors))
        rounds = Rounds(_problem(other, observations), settings)
        alone, holds = rounds.as_stated()
        if holds and not rounds.contradicts_poses(alone):
            return priors, other, rounds, alone
    return stated


def _canonical(observations: Observations) -> Int64:
    """Returns an order that depends on the observations alone, not on how they arrived."""
    o = observations
    keys = [o.kind, o.place, *o.run.T, *o.sensor.T, *o.epoch_gps_ns.T, o.observed_m, o.sigma_m, o.survey_sigma_m]
    keys += list(o.partials.reshape(o.size, 2 * len(COMPONENTS)).T)
    keys += [o.camera, *o.camera_partials.T] if (o.camera >= 0).any() else []
    return np.lexsort(keys[::-1])


def _used(observations: Observations, mode: str) -> Bool:
    """Returns observations that a mode uses: only control for each run alone, only upright ones for heights."""
    if mode == "each_pass":
        return np.asarray((observations.run == FIXED).any(axis=1))
    if mode == "vertical":
        return np.asarray(np.abs(directions_of(observations)[:, 2]) > np.sqrt(0.5))
    return np.ones(observations.size, bool)


def _problem(unknowns: Unknowns, observations: Observations) -> Problem:
    """Returns the rows of the observations, then of the surveys of control points."""
    rows, lines = unknowns.rows(observations, unknowns.control.of_observation)
    numbers = unknowns.of_surveys
    surveyed = numbers[numbers >= 0]
    m = surveyed.size
    _, first, own = np.unique(observations.group, return_index=True, return_inverse=True)
    rank = np.empty(first.size, np.int64)
    rank[np.argsort(first)] = np.arange(first.size)
    # Height and horizontal place of a point's survey are separate: one may be wrong while the other is right.
    part = (2 * np.arange(len(numbers))[:, None] + np.array([0, 0, 1]))[numbers >= 0]
    return Problem(
        unknowns,
        Rows(
            np.concatenate([rows.first, rows.first[-1] + 1 + np.arange(m)]),
            np.concatenate([rows.unknown, surveyed]),
            np.concatenate([rows.derivative, np.ones(m)]),
        ),
        np.concatenate([observations.observed_m, np.zeros(m)]),
        np.concatenate([observations.sigma_m**2, np.ones(m)]),
        np.concatenate([lines, np.zeros((m, len(COMPONENTS)))]),
        np.concatenate([observations.kind.astype(np.int64), np.full(m, SURVEY)]),
        Groups(np.concatenate([rank[own.ravel()], first.size + part])),
    )


def _surveyed(unknowns: Unknowns) -> tuple[Int64, Int64, Float64]:
    """Returns control point, axis and σ (m,) of each surveyed coordinate, in the order of their unknowns."""
    point, axis = np.nonzero(unknowns.of_surveys >= 0)
    return point.astype(np.int64), axis.astype(np.int64), unknowns.control.sigma_m[point, axis]


def _survey_errors(
    unknowns: Unknowns, observations: Observations, alone: Estimate, rounds: Rounds
) -> tuple[list[SurveyErrors], SurveyErrors]:
    """Returns the surveys' errors from poses and ties: for groups of neighbours, and for points that stand for all.

    Many points are too many for one covariance. A wrong point is found by its neighbours; an offset of all is
    found by points that are spread over all.
    """
    point, axis, sigma = _surveyed(unknowns)
    in_time = _in_time(unknowns.control, observations)
    few = in_time.size <= _AT_ONCE
    groups = [in_time] if few else np.array_split(in_time, -(-in_time.size // _NEIGHBOURS))
    spread = in_time[np.linspace(0, in_time.size - 1, min(in_time.size, _AT_ONCE)).round().astype(np.int64)]
    rows = [np.flatnonzero(np.isin(point, own)) for own in (*groups, *([] if few else [spread]))]
    numbers = unknowns.of_control[point, axis]
    found = []
    for own, unit in zip(rows, rounds.covariances([numbers[own] for own in rows]), strict=True):
        away = alone.solution[numbers[own]] * sigma[own]
        covariance = sigma[own][:, None] * 0.5 * (unit + unit.T) * sigma[own]
        lean = np.where((axis[own] == _DOWN)[:, None], unknowns.control.lean[point[own]], 0.0)
        found.append(SurveyErrors(point[own], axis[own], away, covariance, sigma[own] ** 2, lean))
    return (found, found[0]) if few else (found[:-1], found[-1])


def _in_time(control: ControlPoints, observations: Observations) -> Int64:
    """Returns control points in the order in which a run first passed them."""
    first = np.full(control.place.size, np.iinfo(np.int64).max)
    seen = control.of_observation >= 0
    np.minimum.at(first, control.of_observation[seen], observations.epoch_gps_ns[seen].max(axis=1))
    order = np.argsort(first, kind="stable").astype(np.int64)
    return order[~control.free[order]]


def _counting(unknowns: Unknowns, verdict: ControlVerdict, refused: Sequence[str]) -> Float64:
    """Returns 1 for each surveyed coordinate (m,) that is right, and 0 for wrong or refused ones."""
    point, axis, _ = _surveyed(unknowns)
    component = {a: name for name, axes in SURVEYED.items() for a in axes}
    names = [component[a] for a in axis.tolist()]
    pairs = zip(point.tolist(), names, strict=True)
    return np.array([n not in refused and (p, n) not in verdict.left_out for p, n in pairs], np.float64)


def _with_control(
    unknowns: Unknowns, alone: Estimate, rounds: Rounds, verdict: ControlVerdict, applied: AppliedOffset
) -> tuple[Estimate, Float64, tuple[Float64, ...], tuple[JointErrors, ...]]:
    """Returns the solution with right surveys, the same with fixed runs held, derivatives of each knot by an offset of
    all surveys, and how the errors of pictures hang together.

    Fixed runs are estimated like all others as long as observations are judged: what contradicts their poses within
    the σ of these is not wrong.
    """
    point, axis, sigma = _surveyed(unknowns)
    weight = _counting(unknowns, verdict, applied.refused)
    lean = np.where((axis == _DOWN)[:, None], unknowns.control.lean[point], 0.0)
    estimate = alone
    if weight.any():
        stated = (applied.offset_m[axis] + lean @ verdict.shift.shift_m) / sigma
        estimate = rounds.with_surveys(weight, stated, verdict.survey_factor, alone.rounds)
    joint = tuple(_joint(unknowns, estimate, rounds))
    fixed = unknowns.fixed
    solution = rounds.holding(fixed) if fixed.any() else estimate.solution
    if not weight.any():
        return estimate, solution, tuple(np.zeros((k.size, len(COMPONENTS), 5)) for k in unknowns.knots), joint
    moving = [*(axis == a for a in range(3)), *lean.T]
    moved = [_of_solution(unknowns, rounds.response(own / sigma)) for own in moving]
    return estimate, solution, tuple(np.stack(own, axis=-1) for own in zip(*moved, strict=True)), joint


def _understated_runs(unknowns: Unknowns, rounds: Rounds, verdict: ControlVerdict, estimate: Estimate) -> Float64:
    """Returns factors (runs, 6) by which the stated σ of single runs' poses are too small.

    Control that the poses contradict as a whole is followed first: where all runs are off by it, they are right and it
    is not, and where one of them is, it is the other way round.
    """
    found = rounds.understated(estimate)
    if (found > 1.0).any() or not verdict.doubted:
        return found
    counts = _counting(unknowns, verdict, ())
    found = rounds.understated(rounds.with_surveys(counts, np.zeros(counts.size), 1.0, estimate.rounds))
    every = (found > 1.0).all(axis=0, where=unknowns.active) & unknowns.active.any(axis=0)
    return np.where(every, 1.0, found)


def _of_solution(unknowns: Unknowns, solution: Float64) -> list[Float64]:
    """Returns corrections (k, 6) of each run's knots."""
    numbers = [unknowns.of_run(run) for run in range(len(unknowns.priors))]
    parts = [np.where(n >= 0, solution[n], 0.0) * s for n, s in zip(numbers, unknowns.sigmas, strict=True)]
    return [own.reshape(len(own), -1, len(COMPONENTS)).sum(axis=1) for own in parts]


def _of_knots(
    unknowns: Unknowns, estimate: Estimate, solution: Float64
) -> tuple[tuple[Float64, ...], tuple[Float64, ...], tuple[Float64, ...]]:
    """Returns values, covariances, and those with the next knot, of each run.

    Where a run is fixed, the others differ from the most likely solution; their covariance is the mean square
    error of what is published: that of the most likely solution, and the square of the way from there.
    """
    covariance, with_next, values = [], [], _of_solution(unknowns, solution)
    for run, (sigma, away) in enumerate(zip(unknowns.sigmas, _of_solution(unknowns, estimate.solution), strict=True)):
        numbers, more = unknowns.of_run(run), values[run] - away
        own = _blocks(estimate, (numbers, sigma), (numbers, sigma))
        beside = _blocks(estimate, (numbers[:-1], sigma[:-1]), (numbers[1:], sigma[1:]))
        covariance.append(own + more[:, :, None] * more[:, None, :])
        with_next.append(beside + more[:-1, :, None] * more[1:, None, :])
    return tuple(values), tuple(covariance), tuple(with_next)


def _blocks(estimate: Estimate, first: tuple[Int64, Float64], second: tuple[Int64, Float64]) -> Float64:
    """Returns covariances (k, 6, 6) of the sum of two tables of unknowns, each with its scale."""
    blocks = _entries(estimate, first[0][:, :, None], second[0][:, None, :])
    blocks *= first[1][:, :, None] * second[1][:, None, :]
    rows, columns, size = first[0].shape[1], second[0].shape[1], len(COMPONENTS)
    folded = blocks.reshape(-1, rows // size, size, columns // size, size)
    return np.asarray(folded.sum(axis=(1, 3)))


def _of_observations(
    unknowns: Unknowns, observations: Observations, used: Int64, estimate: Estimate
) -> tuple[Float64, Float64, Float64, Float64]:
    """Returns residual, weight, redundancy and normalised residual of each observation, also of unused ones."""
    size, n = observations.size, used.size
    rows, _ = unknowns.rows(observations, np.full(size, -1, np.int64))
    residual = observations.observed_m - rows.times(estimate.solution)
    weight, redundancy, normalised = np.zeros(size), np.full(size, np.nan), np.full(size, np.nan)
    residual[used], weight[used] = estimate.residual[:n], estimate.weight[:n]
    redundancy[used], normalised[used] = estimate.without.redundancy[:n], estimate.without.statistic[:n]
    return residual, weight, redundancy, normalised


def _of_mountings(unknowns: Unknowns, estimate: Estimate, solution: Float64) -> MountingErrors:
    prior, numbers = unknowns.mount_sigma, unknowns.of_mountings
    there = numbers >= 0
    covariance = _entries(estimate, numbers.reshape(-1, 1), numbers.reshape(1, -1)) * np.outer(prior, prior)
    error = np.zeros(prior.shape)
    error[there] = solution[numbers[there]] * prior[there]
    variance = np.zeros(prior.shape)
    variance[there] = estimate.inverse.at(numbers[there], numbers[there]) * prior[there] ** 2
    # What all heights have in common is not estimated: it is known as well as it was.
    for own in unknowns.sharing:
        variance[own, _DOWN] += 1.0 / (1.0 / prior[own, _DOWN] ** 2).sum()
    return MountingErrors(tuple(one.key for one in unknowns.mountings), prior, error, np.sqrt(variance), covariance)


def _of_cameras(
    unknowns: Unknowns, estimate: Estimate, solution: Float64, joint: tuple[JointErrors, ...]
) -> CameraErrors:
    prior, numbers = unknowns.camera_sigma, unknowns.of_cameras
    there = numbers >= 0
    error, variance = np.zeros(prior.shape), np.zeros(prior.shape)
    error[there] = solution[numbers[there]] * prior[there]
    variance[there] = estimate.inverse.at(numbers[there], numbers[there]) * prior[there] ** 2
    return CameraErrors(tuple(one.sensor for one in unknowns.cameras), prior, error, np.sqrt(variance), joint)


def _numbered(common: npt.NDArray[np.int32]) -> tuple[Int64, npt.NDArray[np.int32]]:
    """Returns the numbers (e,) of errors that ties have in common, rising, and those (n, 3) without gaps; −1: none."""
    numbers = np.unique(common[common >= 0])
    dense = np.searchsorted(numbers, common).astype(np.int32)
    return numbers.astype(np.int64), np.where(common >= 0, dense, np.int32(-1))


def _of_common(unknowns: Unknowns, estimate: Estimate, numbers: Int64) -> CommonErrors:
    own = unknowns.first_common + np.arange(numbers.size)
    return CommonErrors(numbers, estimate.solution[own], np.sqrt(estimate.inverse.at(own, own)))


def _joint(unknowns: Unknowns, estimate: Estimate, rounds: Rounds) -> Iterator[JointErrors]:
    """Yield covariances of poses, mountings and lenses at knots of poses at which a picture was measured."""
    keys = [one.key for one in unknowns.mountings]
    for camera, prior in enumerate(unknowns.cameras):
        for run, name in enumerate(one.run for one in unknowns.priors):
            seat = next((keys.index(key) for key in ((name, prior.sensor), ("*", prior.sensor)) if key in keys), None)
            if seat is None:
                continue
            own = np.concatenate([unknowns.of_mountings[seat, :6], unknowns.of_cameras[camera, :_LENS]])
            own_sigma = np.concatenate([unknowns.mount_sigma[seat, :6], unknowns.camera_sigma[camera, :_LENS]])
            posed, knots = unknowns.of_run(run), unknowns.knots[run]
            # The factor of the equations has covariances of a pose and a mounting that share a measurement.
            told = np.isfinite(_entries(estimate, posed[:, :, None], own[None, None, :6])).all(axis=(1, 2))
            at = np.flatnonzero(told)
            if not at.size:
                continue
            first = np.unique((knots[at] - knots[at[0]]) // _JOINT_NS, return_index=True)[1]
            at = at[np.union1d(first, [at.size - 1])]
            covariance, later = [], []
            for start in range(0, at.size, _LATER):
                near = at[start : start + 2 * _LATER]
                numbers, sigma = posed[near].ravel(), unknowns.sigmas[run][near].ravel()
                whole = _whole(rounds, np.concatenate([numbers, own]), np.concatenate([sigma, own_sigma]))
                blocks = _folded(whole, near.size, own.size)
                for k in range(min(_LATER, near.size)):
                    rows = np.r_[6 * k : 6 * k + 6, 6 * near.size : len(blocks)]
                    covariance.append(blocks[np.ix_(rows, rows)])
                    after = blocks[6 * k : 6 * k + 6, 6 * (k + 1) : 6 * min(k + 1 + _LATER, near.size)]
                    later.append(after.reshape(6, -1, 6).transpose(1, 0, 2))
            yield JointErrors(name, prior.sensor, knots[at], np.array(covariance), tuple(later))


def _whole(rounds: Rounds, numbers: Int64, sigma: Float64) -> Float64:
    """Returns the covariance (n, n) of unknowns (n,) with their scales; 0 where one is none."""
    there, found = np.flatnonzero(numbers >= 0), np.zeros((numbers.size, numbers.size))
    found[np.ix_(there, there)] = rounds.covariances([numbers[there]])[0]
    return found * np.outer(sigma, sigma)


def _folded(whole: Float64, knots: int, own: int) -> Float64:
    """Returns covariances whose poses have the 6 components alone: the parts of their errors are added up."""
    parts = (len(whole) - own) // (knots * len(COMPONENTS))
    fold = np.kron(np.eye(knots), np.tile(np.eye(len(COMPONENTS)), parts))
    poses = fold @ whole[:-own, :-own] @ fold.T
    beside = fold @ whole[:-own, -own:]
    return np.block([[poses, beside], [beside.T, whole[-own:, -own:]]])


def _entries(estimate: Estimate, first: Int64, second: Int64) -> Float64:
    """Returns covariances of pairs of unknowns, in their σ; 0 where one is none, NaN where the factor lacks them."""
    i, j = np.broadcast_arrays(first, second)
    there, found = (i >= 0) & (j >= 0), np.zeros(i.shape)
    found[there] = estimate.inverse.at(i[there], j[there])
    return found


def _of_control(unknowns: Unknowns, estimate: Estimate, n: int, factor: float) -> ControlErrors:
    """Returns the errors of surveyed control: rows after the first n are those of surveys."""
    surveyed = ~unknowns.control.free
    control, numbers = unknowns.control, unknowns.of_control[surveyed]
    there = numbers >= 0

    def table(values: Float64) -> Float64:
        found = np.full(numbers.shape, np.nan)
        found[there] = values
        return found

    without, sigma = estimate.without, control.sigma_m[surveyed]
    error = table(estimate.solution[numbers[there]]) * sigma
    # The survey states zero for its error; the others predict it.
    left_out = table(-without.residual[n:]) * sigma
    left_out_sigma = table(np.sqrt(factor + without.variance[n:])) * sigma
    place, run = control.place[surveyed], control.run[surveyed]
    return ControlErrors(place, run, sigma, error, table(estimate.weight[n:]), left_out, left_out_sigma)
