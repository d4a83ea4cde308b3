"""The rounds of an adjustment: solve, judge each observation by the others, update weights.

The surveys of control points are judged elsewhere, all of them at once (:mod:`roadscan.adjust.control_test`):
here they count as that module decides, fully or not at all. A target that only one pass saw and its survey may exclude
one another, and no weight from repeated rounds shows which of them is wrong.

Weights of observations: Huber's weights first, then IGG III of residuals that leave their group out.

Huber's function (1964) has one minimum, so the start does not matter, but a false observation keeps some pull. From
there, IGG III (Yang 1994) takes away all of it from what lies beyond a limit. Its statistic is the residual of a
prediction made without the observation over that prediction's σ, which holds as well for an observation that no
longer counts: one that was rejected because of a false neighbour comes back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.adjust.observations import COMPONENTS, KINDS
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.adjust.sparse_normal import NormalEquations, Rows, SelectedInverse
from roadscan.adjust.unknowns import Unknowns
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import length_limit

HUBER_LIMIT: Final = 1.5
"""Huber's limit (σ): at least 95 % efficiency where all is normal."""

_TURNED: Final = 0.5
"""Share that is left of a value's step when it turns."""
_ONWARD: Final = 1.2
"""Growth of that share while it goes on."""


class Pace:
    """How far each of n values moves towards what it should be: less where it went back and forth.

    Two observations that exclude one another, or a factor and the weights that follow from it, alternate for ever where
    each moves all the way. A value's share of its way is halved whenever it turns (Riedmiller & Braun 1993), and grows
    again while it goes on.
    """

    def __init__(self, size: int) -> None:
        self._share, self._before = np.ones(size), np.zeros(size)

    def step(self, way: Float64) -> Float64:
        """Returns the part (n,) of a way (n,) that is gone."""
        turned = way * self._before < 0.0
        self._share = np.where(turned, _TURNED * self._share, np.minimum(1.0, _ONWARD * self._share))
        self._before = way
        return self._share * way


@dataclass(frozen=True)
class LeftOut:
    """Prediction of each observation from the others."""

    residual: Float64
    """(n,) observed minus predicted without it."""
    variance: Float64
    """(n,) of that prediction."""
    statistic: Float64
    """(n,) residual over its σ: standard normal where all is as stated."""
    redundancy: Float64
    """(n,) share of an error of the observation that its residual shows; 1 where it does not count."""


def left_out(residual: Float64, variance: Float64, own: Float64, weight: Float64) -> LeftOut:
    """Returns residuals without the observation itself, from those with it (Cook & Weisberg 1982, 2.2).

    Parameters
    ----------
    residual : (n,) observed minus computed.
    variance : (n,) of the computed value.
    own : (n,) variance of the observation as stated.
    weight : (n,) that it counts with, 0 to 1.
    """
    redundancy = np.maximum(1.0 - weight * variance / own, 1e-12)
    without, predicted = residual / redundancy, variance / redundancy
    return LeftOut(without, predicted, without / np.sqrt(own + predicted), redundancy)


@dataclass(frozen=True)
class Groups:
    """Observations that stand or fall together."""

    of_row: Int64
    """(n,) group of each, 0 to the last."""

    def lengths(self, statistic: Float64) -> tuple[Float64, Int64]:
        """Returns the root of the summed squares of each row's group, and the group's rows."""
        count = np.bincount(self.of_row)
        total = np.bincount(self.of_row, statistic**2)
        return np.sqrt(total)[self.of_row], count[self.of_row]

    def huber(self, statistic: Float64) -> Float64:
        """Returns Huber's weights."""
        length, rows = self.lengths(statistic)
        return np.minimum(1.0, _limits(HUBER_LIMIT, rows) / np.maximum(length, 1e-300))

    def igg_iii(self, statistic: Float64, whole: float, reject: float) -> Float64:
        """Returns weights of IGG III: 1 up to `whole` σ, 0 from `reject` σ on."""
        length, rows = self.lengths(statistic)
        return igg_iii(length, _limits(whole, rows), _limits(reject, rows))


def igg_iii(length: Float64, near: Float64 | float, far: Float64 | float) -> Float64:
    """Returns weights (n,) of IGG III (Yang 1994) of residuals by their lengths: 1 up to `near`, 0 from `far` on."""
    slope = (far - np.minimum(length, far)) / (far - near)
    return np.where(length <= near, 1.0, near / np.maximum(length, near) * slope**2)


def _limits(limit: float, rows: Int64) -> Float64:
    """For each row the limit of its group's length that is as rare as `limit` for one standard normal number."""
    by_rows = np.array([length_limit(limit, max(int(n), 1)) for n in range(int(rows.max(initial=0)) + 1)])
    return by_rows[rows]


SURVEY: Final = len(KINDS)
"""Kind of the rows that observe a control point at its surveyed place."""
_HUBER_ROUNDS: Final = 10  # Rounds with Huber's weights before IGG III.
_SETTLED: Final = 0.01
"""Weights, and logarithms of factors, that change by less are final."""
_CALM: Final = 15
"""Rounds in which weights move all the way; from then on, one that turns takes smaller steps."""
_ROUGH: Final = 0.1
"""Changes that are small enough for a decision on which σ hold; the result itself is settled."""
_LEAST: Final = 1e-6
"""Weight of a rejected survey: the point is then free, but its coordinates stay determined."""
_ENOUGH: Final = 30.0
"""Least redundancy for which a factor of variances is estimated."""
_FACTORS: Final = (1e-3, 1e3)  # Bounds of a factor of variances.
_STEP: Final = 4.0
"""Greatest change of a factor in one round."""
_UNDERSTATED: Final = 3.0
"""Variances this many times those stated are estimated even where that was not asked for: with σ that are 1.7
times too small, right observations are rejected and published σ are wrong."""
_FREE: Final = 100.0
"""Factor of the poses' variances in the test whether they were too small."""
_SOME: Final = 1.0
"""Least redundancy for which the σ of poses that turned out too small is estimated, however roughly."""
_SURE: Final = 0.99
"""Share of right solutions whose corrections are no larger."""
_RIGID: Final = 1e14
"""Weight, in units of the prior's, of an unknown that is fixed at 0: others move it by less than a double shows in a
millimetre."""
_MEDIAN: Final = 0.6745
"""Median of the absolute value of a standard normal number."""


@dataclass(frozen=True)
class Problem:
    """All rows, those of surveys last."""

    unknowns: Unknowns
    rows: Rows
    observed: Float64
    """(n,)"""
    variance: Float64
    """(n,) as stated."""
    line_variance: Float64
    """(n, 6) added by the straight lines between knots."""
    kind: Int64
    """(n,) index into `KINDS`, or `SURVEY`."""
    groups: Groups


@dataclass(frozen=True)
class Estimate:
    """The result of the rounds."""

    solution: Float64
    """(u,)"""
    inverse: SelectedInverse
    residual: Float64
    """(n,) observed minus computed."""
    weight: Float64
    """(n,) 0 to 1."""
    without: LeftOut
    kind_factors: Float64
    """Of the stated variances of each kind, and 1 for surveys."""
    process_factors: Float64
    """(6,) of the stated variances of the processes."""
    rounds: int
    moved: float
    """Largest change of a weight, or of the logarithm of a factor, that its result asks for."""

    @property
    def settled(self) -> bool:
        """Whether the result equals its input."""
        return self.moved < _SETTLED


class Rounds:
    """The state of an adjustment during its rounds."""

    def __init__(self, problem: Problem, settings: AdjustmentSettings) -> None:
        self.problem, self.settings = problem, settings
        self._estimating = bool(settings.estimate_variance_components)
        self._surveyed = problem.kind == SURVEY
        self._tied = np.isin(problem.kind, [KINDS.index("picture_tie"), KINDS.index("picture_edge")])
        self._survey_weight = np.zeros(int(self._surveyed.sum()))
        self._observed = problem.observed.copy()
        self._row, self._column, self._value, self._component = problem.unknowns.prior_entries()
        prior, wanted = (self._row, self._column, self._value), problem.unknowns.wanted_pairs()
        self._equations = NormalEquations(problem.rows, prior, wanted, problem.unknowns.size)
        self._weight = np.where(self._surveyed, 0.0, 1.0)
        self._kinds, self._processes = np.ones(len(KINDS) + 1), np.ones(len(COMPONENTS))
        self._enough, self._fixed = _ENOUGH, np.zeros(len(COMPONENTS), bool)

    def as_stated(self) -> tuple[Estimate, bool]:
        """Returns the rounds without the surveys of control points, with all σ as stated, and whether these hold."""
        done = 0
        while done < min(_HUBER_ROUNDS, self.settings.max_rounds - 1):
            done += 1
            residual = self._solved()[1]
            if self._moved_to(self.problem.groups.huber(residual / np.sqrt(self._own()))) < 10 * _SETTLED:
                break
        given = self.settings.estimate_variance_components is not None
        estimate = self._rounds(done, _SETTLED if given else _ROUGH)
        if given or self._is_understated(estimate):
            return estimate, given
        return self._rounds(estimate.rounds), True

    def without_surveys(self) -> Estimate:
        """Returns all rounds without the surveys of control points."""
        estimate, holds = self.as_stated()
        if holds:
            return estimate
        # Ties that contradict poses of too small a σ look wrong themselves: poses are tested first.
        self._processes *= _FREE
        freed = self._rounds(estimate.rounds, _ROUGH)
        if self._wide_kinds(freed).any():
            self._processes /= _FREE
            self._kinds = np.maximum(self._kinds, self._wide_kinds(estimate))
            self._estimating = True
            return self._rounds(freed.rounds)
        self._keep_stated(self._process_ratios(freed.solution, freed.inverse)[1] < _SOME)
        self._enough, self._estimating = _SOME, True
        estimate = self._rounds(freed.rounds, _ROUGH)
        self._keep_stated(self._processes < _UNDERSTATED)
        self._keep_followers()
        return self._rounds(estimate.rounds)

    def _keep_stated(self, components: Bool) -> None:
        """Fix the σ of some components of the poses at the stated one."""
        self._fixed = self._fixed | components
        self._processes[self._fixed] = 1.0

    def _keep_followers(self) -> None:
        """Fix the components whose corrections the stated σ explains, by the quantile of χ², when all others have their
        factors: they only followed those.
        """
        from scipy.special import chdtri

        for component in np.argsort(self._processes, kind="stable").tolist():
            if self._fixed[component]:
                continue
            factor, self._processes[component] = self._processes[component], 1.0
            ratio, told = self._process_ratios(self._solved()[0], self._equations.inverse())
            redundancy = max(float(told[component]), _SOME)
            if ratio[component] * redundancy > chdtri(redundancy, 1.0 - _SURE):
                self._processes[component] = factor
            else:
                self._fixed[component] = True

    def with_surveys(self, weight: Float64, observed: Float64, factor: float, done: int) -> Estimate:
        """Returns rounds from there on, with surveys that count by a weight of 1 or 0 each.

        Parameters
        ----------
        observed : error that each survey states for itself, in its σ: 0, or a common offset of all.
        factor : of the surveys' stated variances.
        done : number of rounds so far.
        """
        self._survey_weight, self._kinds[SURVEY] = weight, factor
        self._observed[self._surveyed] = observed
        self._weight[self._surveyed] = weight
        return self._rounds(done)

    def _rounds(self, done: int, until: float = _SETTLED) -> Estimate:
        """Run rounds of IGG III after those that are done, until weights and factors change by less."""
        pace, factor_pace = Pace(self._weight.size), Pace(self._kinds.size + self._processes.size)
        for number in range(self.settings.max_rounds):
            estimate = self._judged(done + number + 1, pace if number >= _CALM else None, factor_pace)
            if estimate.moved < until:
                break
        return estimate

    def covariances(self, groups: Sequence[Int64]) -> list[Float64]:
        """Returns covariances (m, m) of the unknowns of each group, in their σ, from the last solution."""
        return self._equations.covariances(groups)

    def holding(self, fixed: Bool) -> Float64:
        """Last solution (u,) with some unknowns (u,) fixed at 0, and the weights of the rounds without that."""
        value = self._value / np.append(self._processes, 1.0)[self._component]
        own = fixed[self._row] & (self._row == self._column)
        rows, scaled = self.problem.rows, self._counted() / self._own()
        self._equations.factor(scaled, np.where(own, _RIGID * value, value))
        right = rows.transposed_times(scaled * self._observed, self.problem.unknowns.size)
        return np.where(fixed, 0.0, self._equations.solve(right))

    def response(self, shift: Float64) -> Float64:
        """Returns the derivative of the last solution (u,) by an error `shift` of the surveys, in their σ."""
        whole = np.zeros(self._observed.size)
        whole[self._surveyed] = shift
        scaled = self._counted() / self._own()
        return self._equations.solve(self.problem.rows.transposed_times(scaled * whole, self.problem.unknowns.size))

    def _own(self) -> Float64:
        """Returns the variance of each row apart from that of the corrections at the knots."""
        lines = self.problem.line_variance @ self._processes
        return np.asarray(self.problem.variance * self._kinds[self.problem.kind] + lines)

    def _counted(self) -> Float64:
        """Returns the weights in the sum of the equations."""
        return np.where(self.problem.kind == SURVEY, np.maximum(self._weight, _LEAST), self._weight)

    def _solved(self) -> tuple[Float64, Float64]:
        """Returns solution and residuals with the current weights."""
        rows, scaled = self.problem.rows, self._counted() / self._own()
        self._equations.factor(scaled, self._value / np.append(self._processes, 1.0)[self._component])
        right = rows.transposed_times(scaled * self._observed, self.problem.unknowns.size)
        solution = self._equations.solve(right)
        return solution, self._observed - rows.times(solution)

    def _judged(self, rounds: int, pace: Pace | None, factor_pace: Pace) -> Estimate:
        """Run one round of IGG III; weights move all the way without a pace."""
        solution, residual = self._solved()
        inverse = self._equations.inverse()
        own, weight = self._own(), self._weight.copy()
        kinds, processes = self._kinds.copy(), self._processes.copy()
        without = left_out(residual, inverse.variances(), own, self._counted())
        near, far = self.settings.full_weight_within, self.settings.reject_beyond
        wanted = self.problem.groups.igg_iii(without.statistic, near, far)
        moved = self._moved_to(wanted if pace is None else weight + pace.step(wanted - weight))
        if self._estimating:
            way = np.log(self._new_factors(solution, inverse, residual, without, own, weight) / self._factors())
            moved = max(moved, float(np.abs(way).max()))
            self._set_factors(self._factors() * np.exp(factor_pace.step(way)))
        return Estimate(solution, inverse, residual, weight, without, kinds, processes, rounds, moved)

    def _moved_to(self, weight: Float64) -> float:
        """Returns weights of the next round; one close to 0 becomes 0, so that 0 marks a row that does not count."""
        weight = np.where(weight < _SETTLED, 0.0, weight)
        weight[self._surveyed] = self._survey_weight
        # Tie points of pictures were judged on the way to their rows: what came here counts, as its σ says.
        weight = np.where(self._tied, 1.0, weight)
        moved = float(np.abs(weight - self._weight).max(initial=0.0))
        self._weight = weight
        return moved

    def _is_understated(self, estimate: Estimate) -> bool:
        """Returns whether the stated σ of a kind of observation, or of a component of the poses, is much too small."""
        if self._wide_kinds(estimate).any():
            return True
        factors = self._new_factors(
            estimate.solution, estimate.inverse, estimate.residual, estimate.without, self._own(), estimate.weight
        )
        return bool((factors[self._kinds.size :] > _UNDERSTATED).any())

    def contradicts_poses(self, estimate: Estimate) -> bool:
        """Returns whether corrections of some component are larger than its process allows, by the quantile of χ²."""
        from scipy.special import chdtri

        ratio, redundancy = self._process_ratios(estimate.solution, estimate.inverse)
        known = redundancy >= _SOME
        return bool((ratio * redundancy > chdtri(np.maximum(redundancy, _SOME), 1.0 - _SURE))[known].any())

    def understated(self, estimate: Estimate) -> Float64:
        """Returns factors (runs, 6) by which the stated σ of components of single runs are too small; 1 where none is.

        Corrections are then larger than the process allows, by the quantile of χ² over all runs and components, and σ
        too small by what :data:`_UNDERSTATED` says, beside the factor that all runs have.
        """
        from scipy.special import chdtri

        own = self._component < len(COMPONENTS)
        row, column, component = self._row[own], self._column[own], self._component[own]
        run = np.searchsorted(self.problem.unknowns.first, row, side="right") - 1
        twice = np.where(row == column, 1.0, 2.0) * self._value[own] / self._processes[component]
        shape = len(self.problem.unknowns.priors), len(COMPONENTS)
        cell = run * shape[1] + component
        squares, lost, unknowns = (
            np.bincount(cell, values, shape[0] * shape[1]).reshape(shape)
            for values in (
                twice * estimate.solution[row] * estimate.solution[column],
                twice * estimate.inverse.at(row, column),
                (row == column).astype(np.float64),
            )
        )
        told = unknowns - lost
        known = told >= _SOME
        chance = -np.expm1(np.log(_SURE) / max(int(known.sum()), 1))
        limit = np.maximum(chdtri(np.maximum(told, _SOME), chance), _UNDERSTATED * told)
        return np.where(known & (squares > limit), np.sqrt(squares / np.maximum(told, _SOME)), 1.0)

    def _process_ratios(self, solution: Float64, inverse: SelectedInverse) -> tuple[Float64, Float64]:
        """Squares over redundancy (6,) of each component's process with the current factor, and the redundancy."""
        twice = np.where(self._row == self._column, 1.0, 2.0) * self._value
        moved = twice * solution[self._row] * solution[self._column]
        shrunk = twice * inverse.at(self._row, self._column)
        unknowns = np.bincount(self._component[self._row == self._column], minlength=len(COMPONENTS))[: len(COMPONENTS)]
        squares, lost = (
            np.array([v[self._component == c].sum() for c in range(len(COMPONENTS))]) / self._processes
            for v in (moved, shrunk)
        )
        told = unknowns - lost
        return squares / np.maximum(told, 1e-300), told

    def _wide_kinds(self, estimate: Estimate) -> Float64:
        """Returns factors of the stated variances of kinds of observations that are much too small; 0 of the others.

        The median is used, because observations that contradict a σ that is too small were rejected.
        """
        statistic, found = np.abs(estimate.without.statistic), np.zeros(len(KINDS) + 1)
        for kind in range(len(KINDS)):
            here = statistic[self.problem.kind == kind]
            if here.size >= _ENOUGH:
                ratio = (float(np.median(here)) / _MEDIAN) ** 2
                found[kind] = ratio if ratio > _UNDERSTATED else 0.0
        return found

    def _new_factors(
        self,
        solution: Float64,
        inverse: SelectedInverse,
        residual: Float64,
        without: LeftOut,
        own: Float64,
        weight: Float64,
    ) -> Float64:
        """Returns all factors (kinds, processes) as they follow from the others (Förstner 1979)."""
        kinds, processes = self._kinds.copy(), self._processes.copy()
        # Only the observation's share of its variance counts; the rest is that of lines between knots.
        share = self.problem.variance * kinds[self.problem.kind] / own
        squares, redundancy = weight * residual**2 / own, np.where(weight > 0.0, without.redundancy, 0.0)
        for kind in range(len(KINDS)):
            here = self.problem.kind == kind
            told, own_part = redundancy[here].sum(), (share * redundancy)[here].sum()
            ratio = (share * squares)[here].sum() / max(own_part, 1e-300)
            kinds[kind] = _stepped(kinds[kind], ratio, told, own_part / max(told, 1e-300))
        for component, (ratio, told) in enumerate(zip(*self._process_ratios(solution, inverse), strict=True)):
            if not self._fixed[component]:
                processes[component] = _stepped(processes[component], float(ratio), float(told), enough=self._enough)
        return np.concatenate([kinds, processes])

    def _factors(self) -> Float64:
        """Returns the factors of all kinds, then of all processes."""
        return np.concatenate([self._kinds, self._processes])

    def _set_factors(self, factors: Float64) -> None:
        self._kinds, self._processes = factors[: self._kinds.size].copy(), factors[self._kinds.size :].copy()


def _stepped(
    factor: float, ratio: float, redundancy: float, share: float = 1.0, enough: float = _ENOUGH
) -> float:  # fmt: skip
    """Returns the factor that makes squares as large as their redundancy; unchanged where redundancy is too small.

    Parameters
    ----------
    ratio : squares over redundancy, with the factor of now.
    share : of the variance that the factor multiplies, in that of what is squared.
    """
    if redundancy < enough:
        return factor
    step = np.clip(1.0 + (ratio - 1.0) / share, 1.0 / _STEP, _STEP)
    return float(np.clip(factor * step, *_FACTORS))
