"""Test of the control: each surveyed coordinate against its prediction from poses, ties and the other control.

The adjustment first leaves the surveys aside. Its prediction of each point, with the covariance of all of them, is
all that is needed: a wrong point is found by its normalised leave-one-out residual (data snooping, Baarda
1968), an offset that all points share by its least-squares estimate over its σ. Both are tested by quantiles of the
normal distribution that right control passes with a stated chance, all tests together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from roadscan.adjust.settings import AdjustmentSettings, ControlRules
from roadscan.compute.array_types import Bool, Float64, Int64

HEIGHT, PLACE = "height", "place"
COMPONENTS: Final = {HEIGHT: (2,), PLACE: (0, 1)}
"""Axes (north, east, down) that may be wrong separately: the height of a point, or its place."""
_POWER: Final = 0.8416
"""Standard normal quantile of 80 %: an offset this many σ above the limit is found in 80 % of cases."""
APART: Final = 9.21
"""Two points of which one is wrong are distinguished if one explains this much more of the squared residuals:
a hundred times as likely (2 ln 100)."""
_MANY: Final = 8
"""With at least this many heights and places, the σ of all surveys can be distinguished from single wrong points."""
_FEW: Final = 0.25
"""Share of the heights and places that may be wrong one by one."""
_UNDERSTATED: Final = 9.0
"""Ratio of the median squared residual to its usual value that shows a stated σ that is too small: with
eight right points two surveys in 10,000 have it."""
_LARGEST_FACTOR: Final = 1e6  # Largest factor of the surveys' variances that is tried.
_BISECTIONS: Final = 12  # Bisections of the logarithm of that factor.
_LEAST_CONTRADICTED_M: Final = 0.03
"""Least offset of control (m) that poses of a vehicle, whatever σ they state, contradict: they do not know the mean
height of a drive better."""
_SLOPES: Final = 5
"""Least number of heights for a shift in the plane: it and an offset are three numbers."""
_LARGEST_SHIFT_M: Final = 3.0
"""Prior 1 σ of a shift of the control in the plane (m): antennas, epochs of a datum."""
_KNOWN: Final = 1e-9
"""Least share of its variance that a residual retains if it is to test its observation."""


@dataclass(frozen=True)
class SurveyErrors:
    """Errors of m surveyed coordinates as poses and ties alone show them."""

    point: Int64
    """(m,) row of the control point."""
    axis: Int64
    """(m,) 0 north, 1 east, 2 down."""
    away_m: Float64
    """(m,) surveyed minus predicted from poses and ties."""
    covariance_m2: Float64
    """(m, m) of that prediction, without that of the survey."""
    survey_m2: Float64
    """(m,) stated variance of the survey."""
    lean: Float64
    """(m, 2) derivatives of `away_m` by a shift of the point, north and east, from where it was surveyed:
    of heights alone the slope of the road, else 0."""

    def parts(self) -> list[tuple[int, str, Int64]]:
        """Returns point, component, and rows of each height and each place."""
        found = []
        for point in np.unique(self.point).tolist():
            for name, axes in COMPONENTS.items():
                rows = np.flatnonzero((self.point == point) & np.isin(self.axis, axes))
                if rows.size:
                    found.append((point, name, rows))
        return found


@dataclass(frozen=True)
class WrongSurvey:
    """A point whose height or place is contradicted by all other evidence."""

    point: int
    component: str
    """`height` or `place`."""
    sigmas: float
    """Length of its normalised leave-one-out residual."""
    limit: float
    """Length from which a point is wrong."""
    alternatives: tuple[int, ...] = ()
    """Points that may be wrong instead: the evidence does not distinguish them."""


@dataclass(frozen=True)
class CommonOffset:
    """An offset of all surveyed coordinates from poses and ties: surveyed minus those."""

    offset_m: Float64
    """(3,) north, east, down; 0 where it is not observed."""
    covariance_m2: Float64
    """(3, 3)"""
    observed: Bool
    """(3,) axes along which a point was observed."""

    def sigmas(self, component: str) -> float:
        """Returns the significance of the offset as that of a standard normal number; 0: not observed."""
        axes = [a for a in COMPONENTS[component] if self.observed[a]]
        if not axes:
            return 0.0
        own = self.offset_m[axes]
        return float(np.sqrt(own @ np.linalg.solve(self.covariance_m2[np.ix_(axes, axes)], own)))

    def sigma_m(self, component: str) -> float:
        """Returns 1 σ of the component, the larger one of a place; NaN: not observed."""
        axes = [a for a in COMPONENTS[component] if self.observed[a]]
        return float(np.sqrt(np.diag(self.covariance_m2)[axes].max())) if axes else float("nan")


@dataclass(frozen=True)
class PlaneShift:
    """Common horizontal shift of all points of which only heights are compared, from their surveyed places."""

    shift_m: Float64
    """(2,) surveyed minus true, north and east; 0 where nothing shows one."""
    covariance_m2: Float64
    """(2, 2)"""
    sigmas: float = 0.0
    """Significance of the shift, as that of a standard normal number."""

    def taken_from(self, errors: SurveyErrors) -> SurveyErrors:
        """Returns the errors of the surveys' heights without it."""
        more = errors.lean @ self.covariance_m2 @ errors.lean.T
        away = errors.away_m - errors.lean @ self.shift_m
        return replace(errors, away_m=away, covariance_m2=errors.covariance_m2 + more)


NOT_SHIFTED: Final = PlaneShift(np.zeros(2), np.zeros((2, 2)))  # No shift.


@dataclass(frozen=True)
class ControlVerdict:
    """Verdict on the control's surveys."""

    wrong: tuple[WrongSurvey, ...]
    offset: CommonOffset
    """Of the points that are not wrong."""
    doubted: tuple[str, ...]
    """Components whose common offset the poses exclude with the stated chance of error."""
    detectable_m: dict[str, float]
    """By component: a common offset of this size is found in 80 % of cases."""
    limit_point: float
    """Normalised leave-one-out residual of a height from which a point is wrong."""
    survey_factor: float
    """Of the stated variances of all surveys."""
    shift: PlaneShift = NOT_SHIFTED
    """The shift that the heights of points on slopes show."""
    squares: float = 0.0
    """Weighted squares of all surveys against poses and ties, wrong ones too, with that shift."""

    @property
    def faults(self) -> int:
        """Returns the number of wrong points and of doubted components."""
        return len(self.wrong) + len(self.doubted)

    @property
    def left_out(self) -> set[tuple[int, str]]:
        """Returns row of the point and component of all that is left out."""
        return {(p, one.component) for one in self.wrong for p in (one.point, *one.alternatives)}


@dataclass(frozen=True)
class AppliedOffset:
    """The offset that is attributed to the surveys."""

    offset_m: Float64
    """(3,) north, east, down: subtracted from all surveys."""
    covariance_m2: Float64
    """(3, 3) that it adds to the results that depend on the control."""
    estimated: tuple[str, ...]
    """Components in which the poses, and not the control, define the datum."""
    refused: tuple[str, ...]
    """Components of which no survey counts."""


def quantile(chance: float, tests: int, numbers: int = 1) -> float:
    """Length of `numbers` standard normal numbers that the largest of `tests` exceeds with a chance; inf for 0."""
    from scipy.special import chdtri

    if chance <= 0.0:
        return float("inf")
    return float(np.sqrt(chdtri(numbers, -np.expm1(np.log1p(-chance) / max(tests, 1)))))


def judged(groups: Sequence[SurveyErrors], spread: SurveyErrors, rules: AdjustmentSettings) -> ControlVerdict:
    """Returns the verdict: which points are wrong, and whether all of them share an offset.

    Parameters
    ----------
    groups : of neighbours, by which single points are tested; together all points.
    spread : points that show an offset of all; those of the only group, or some of each.

    Two explanations are compared: single wrong points, and a common offset with further wrong points. The one with
    fewer faults is accepted, or that of single points if both have as many. Right control is found wrong by chance
    `rules.false_alarm`, and doubted as a whole by chance `rules.datum_false_alarm`. Where many points are found
    wrong, the stated σ of the survey is tested as well.
    """
    groups, spread = [_in_datum(own, rules) for own in groups], _in_datum(spread, rules)
    found, shift = _with_shift(groups, spread, rules)
    groups, spread = [shift.taken_from(own) for own in groups], shift.taken_from(spread)
    found = replace(found, squares=_squares(_surveyed(spread, 1.0)))
    parts = sum(len(own.parts()) for own in groups)
    many = parts >= _MANY and len(found.left_out) > _FEW * parts
    if not many or rules.estimate_variance_components is False:
        return found
    factor = _survey_factor(groups)
    if factor <= 1.0:
        return found
    return replace(_with_factor(groups, spread, rules, factor), shift=shift, squares=found.squares)


def _squares(errors: SurveyErrors) -> float:
    """Returns the weighted squares of the surveys' errors."""
    return float(errors.away_m @ np.linalg.solve(errors.covariance_m2, errors.away_m)) if errors.away_m.size else 0.0


def _with_shift(
    groups: Sequence[SurveyErrors], spread: SurveyErrors, rules: AdjustmentSettings
) -> tuple[ControlVerdict, PlaneShift]:
    """Returns the verdict with a shift of all heights' places.

    It holds where it explains what is doubted, with the chance of `rules.datum_false_alarm`, and leaves fewer faults;
    where nothing else is doubted, right control has it with the chance of `rules.false_alarm`.
    """
    plain = _with_factor(groups, spread, rules, 1.0)
    every = np.ones(spread.point.size, bool)
    for kept in (every, _kept(spread, list(plain.wrong))):
        shift = plane_shift(_surveyed(spread, 1.0), kept)
        if shift.sigmas > quantile(rules.datum_false_alarm if plain.faults else rules.false_alarm, 1, 2):
            moved = [shift.taken_from(own) for own in groups]
            other = _with_factor(moved, shift.taken_from(spread), rules, 1.0)
            if other.faults < max(plain.faults, 1):
                return replace(other, shift=shift), shift
    return plain, NOT_SHIFTED


def plane_shift(errors: SurveyErrors, kept: Bool) -> PlaneShift:
    """Returns the shift in the plane that explains heights on slopes best, beside an offset of all of them."""
    rows = kept & (errors.axis == COMPONENTS[HEIGHT][0])
    if rows.sum() < _SLOPES or not errors.lean[rows].any():
        return NOT_SHIFTED
    design = np.column_stack([errors.lean[rows], np.ones(int(rows.sum()))])
    weighed = np.linalg.solve(errors.covariance_m2[np.ix_(rows, rows)], design)
    normal = design.T @ weighed
    # Where slopes do not tell both axes, or not from an offset of the heights, the prior says that there is none.
    normal[:2, :2] += np.eye(2) / _LARGEST_SHIFT_M**2
    covariance = np.linalg.inv(normal)
    shift = (covariance @ weighed.T @ errors.away_m[rows])[:2]
    own = covariance[:2, :2]
    # Its variance with right control: that of the prior is not included.
    right = own - own @ own / _LARGEST_SHIFT_M**2
    return PlaneShift(shift, own, float(np.sqrt(max(shift @ np.linalg.solve(right, shift), 0.0))))


def _in_datum(errors: SurveyErrors, rules: ControlRules) -> SurveyErrors:
    """Returns the surveys with the uncertainty of the control's datum."""
    datum = rules.sigma_datum_m**2 * (errors.axis[:, None] == errors.axis)
    return replace(errors, covariance_m2=errors.covariance_m2 + datum)


def _surveyed(errors: SurveyErrors, factor: float) -> SurveyErrors:
    """Returns the surveys with a factor of their stated variances."""
    return replace(errors, covariance_m2=errors.covariance_m2 + factor * np.diag(errors.survey_m2))


def _with_factor(
    groups: Sequence[SurveyErrors], spread: SurveyErrors, rules: ControlRules, factor: float
) -> ControlVerdict:
    """Returns the verdict with a factor of the surveys' stated variances."""
    groups, spread = [_surveyed(own, factor) for own in groups], _surveyed(spread, factor)
    tests = max(sum(len(own.parts()) for own in groups), 1)
    lengths = {len(axes): quantile(rules.false_alarm, tests, len(axes)) for axes in COMPONENTS.values()}
    fixed = [one for own in groups for one in _snooped(own, lengths, free=False)]
    at_once = common_offset(spread, _kept(spread, fixed))
    free = [one for own in groups for one in _snooped(own, lengths, free=True)]
    freely = common_offset(spread, _kept(spread, free))
    limits = {name: quantile(rules.datum_false_alarm, len(COMPONENTS), len(axes)) for name, axes in COMPONENTS.items()}
    doubted = {name: [one.sigmas(name) > limits[name] for one in (at_once, freely)] for name in COMPONENTS}
    offsets = sum(late for _, late in doubted.values())
    simpler = offsets > 0 and (len(free) + offsets < len(fixed) or any(early for early, _ in doubted.values()))
    wrong, offset = (free, freely) if simpler else (fixed, at_once)
    return ControlVerdict(
        tuple(wrong), offset, tuple(name for name in COMPONENTS if offset.sigmas(name) > limits[name]),
        {name: (limits[name] + _POWER) * offset.sigma_m(name) for name in COMPONENTS}, lengths[1], factor,
    )  # fmt: skip


def _survey_factor(groups: Sequence[SurveyErrors]) -> float:
    """Returns a factor of the stated variances of all surveys: 1, or more where most points contradict one another.

    Wrong points are few. Where the median of all normalised leave-one-out residuals is far too large, it is the σ of
    the survey that is wrong.
    """
    from scipy.special import chdtri

    def spread(factor: float) -> float:
        ratios = []
        for own in groups:
            parts = own.parts()
            squares = _explained(_surveyed(own, factor), parts, np.ones(own.point.size, bool), free=True)
            ratios.append(squares / np.array([chdtri(rows.size, 0.5) for _, _, rows in parts]))
        return float(np.median(np.concatenate(ratios)))

    if spread(1.0) <= _UNDERSTATED:
        return 1.0
    low, high = 0.0, np.log(_LARGEST_FACTOR)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if spread(float(np.exp(middle))) > 1.0 else (low, middle)
    return float(np.exp(high))


def common_offset(errors: SurveyErrors, kept: Bool) -> CommonOffset:
    """Returns the offset that surveys have in common, from some of the coordinates."""
    axes = np.unique(errors.axis[kept])
    offset, covariance, observed = np.zeros(3), np.zeros((3, 3)), np.zeros(3, bool)
    if axes.size:
        shared = (errors.axis[kept][:, None] == axes).astype(np.float64)
        weighed = np.linalg.solve(errors.covariance_m2[np.ix_(kept, kept)], shared)
        own = np.linalg.inv(shared.T @ weighed)
        offset[axes] = own @ weighed.T @ errors.away_m[kept]
        covariance[np.ix_(axes, axes)], observed[axes] = own, True
    return CommonOffset(offset, covariance, observed)


def _kept(errors: SurveyErrors, wrong: list[WrongSurvey]) -> Bool:
    kept = np.ones(errors.point.size, bool)
    for one in wrong:
        own = np.isin(errors.point, (one.point, *one.alternatives))
        kept[own & np.isin(errors.axis, COMPONENTS[one.component])] = False
    return kept


def _snooped(errors: SurveyErrors, lengths: Mapping[int, float], *, free: bool) -> list[WrongSurvey]:
    """Returns wrong points, the worst first: each is left out before the others are judged.

    Parameters
    ----------
    lengths : from which on a normalised residual of one, or of two numbers, is that of a wrong point.
    free : all points may have an offset in common.
    """
    parts, wrong = errors.parts(), list[WrongSurvey]()
    if not parts:
        return wrong
    while True:
        kept = _kept(errors, wrong)
        squares = _explained(errors, parts, kept, free=free)
        limit = np.array([lengths[rows.size] for _, _, rows in parts])
        excess = np.sqrt(squares) / limit
        if excess.max() <= 1.0:
            break
        worst = int(excess.argmax())
        alike = [k for k in np.flatnonzero(excess > 1.0) if k != worst and parts[k][1] == parts[worst][1]]
        others = tuple(parts[k][0] for k in alike if squares[worst] - squares[k] < APART)
        point, component, _ = parts[worst]
        wrong.append(WrongSurvey(point, component, float(np.sqrt(squares[worst])), float(limit[worst]), others))
    return _without_the_right(errors, parts, wrong, lengths, free=free)


def _explained(errors: SurveyErrors, parts: list[tuple[int, str, Int64]], kept: Bool, *, free: bool) -> Float64:
    """Returns how much the weighted squared residuals fall where a part is left out: the square of its normalised
    leave-one-out residual; 0 of those that are left out, or that the others say nothing of.
    """
    squares = np.zeros(len(parts))
    if not kept.any():
        return squares
    weight = np.zeros_like(errors.covariance_m2)
    weight[np.ix_(kept, kept)] = np.linalg.inv(errors.covariance_m2[np.ix_(kept, kept)])
    if free:
        axes = np.unique(errors.axis[kept])
        shared = ((errors.axis[:, None] == axes) & kept[:, None]).astype(np.float64)
        weighed = weight @ shared
        weight_after = weight - weighed @ np.linalg.solve(shared.T @ weighed, weighed.T)
    else:
        weight_after = weight
    score = weight_after @ errors.away_m
    for k, (_, _, rows) in enumerate(parts):
        own = weight_after[np.ix_(rows, rows)]
        if kept[rows].all() and (np.diag(own) > _KNOWN * np.diag(weight)[rows]).all():
            squares[k] = max(float(score[rows] @ np.linalg.solve(own, score[rows])), 0.0)
    return squares


def _without_the_right(
    errors: SurveyErrors,
    parts: list[tuple[int, str, Int64]],
    wrong: list[WrongSurvey],
    lengths: Mapping[int, float],
    *,
    free: bool,
) -> list[WrongSurvey]:
    """Wrong points without those that fit once the worse ones are left out: a wrong neighbour had spoiled their
    prediction. Each gets its normalised residual against all that counts.
    """
    found = list(wrong)
    for one in sorted(wrong, key=lambda w: w.sigmas):
        rest = [w for w in found if w is not one]
        number = next(k for k, (p, c, _) in enumerate(parts) if (p, c) == (one.point, one.component))
        kept = _kept(errors, rest)
        kept[parts[number][2]] = True
        squares = _explained(errors, parts, kept, free=free)
        fits = np.sqrt(squares[number]) <= lengths[parts[number][2].size]
        if fits and len(rest) < len(found) and not one.alternatives:
            found = rest
        else:
            found[found.index(one)] = replace(one, sigmas=float(np.sqrt(squares[number])))
    return found


def applied_offset(verdict: ControlVerdict, rules: ControlRules, contradicted_from: float) -> AppliedOffset:
    """Returns how an offset of the control as a whole is treated.

    contradicted_from : σ from which on poses contradict control, and do not merely cast doubt on it.
    """
    found, prior = verdict.offset, rules.sigma_datum_m**2
    offset, covariance = np.zeros(3), np.zeros((3, 3))
    estimated, refused = list[str](), list[str]()
    for name, every in COMPONENTS.items():
        axes = [a for a in every if found.observed[a]]
        if not axes:
            continue
        block, away = np.ix_(axes, axes), found.offset_m[axes]
        stated = found.covariance_m2[block]
        off = found.sigmas(name) > contradicted_from and float(np.linalg.norm(away)) > _LEAST_CONTRADICTED_M
        doubted = name in verdict.doubted
        if rules.datum_offset == "leave_out" and doubted:
            refused.append(name)
        elif rules.datum_offset == "estimate" or (rules.datum_offset == "judge" and off and doubted):
            estimated.append(name)
            offset[axes], covariance[block] = away, stated - prior * np.eye(len(axes))
        else:
            gain = prior * np.linalg.inv(stated)
            offset[axes], covariance[block] = gain @ away, prior * (np.eye(len(axes)) - gain)
            covariance[axes, axes] += np.where(doubted, (away - offset[axes]) ** 2, 0.0)
    return AppliedOffset(offset, covariance, tuple(estimated), tuple(refused))
