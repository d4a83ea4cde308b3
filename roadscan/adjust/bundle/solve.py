"""The way to the solution of pictures: rays are straight, pixels are not, so rows are made anew about each solution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from roadscan.adjust.adjustment import Adjustment, MountingErrors, adjust
from roadscan.adjust.bundle.edge_boresight import KIND, EdgeBoresight
from roadscan.adjust.bundle.measurements import (
    DepthRows,
    Measurements,
    NearReturns,
    Numbers,
    Rows,
    Seen,
    State,
    Surfaces,
    depth_rows,
    met_at,
    residuals_px,
    rows_of,
    seen,
    surfaces_of,
)
from roadscan.adjust.estimation import igg_iii
from roadscan.adjust.observations import KINDS, CameraPrior, MountingPrior, Observations, RunPrior
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import length_limit

_MOST: Final = 14  # Solutions on the way, at most; eight are usual.
_ROUNDS: Final = 2
"""Rounds of weights of the other observations in a solution on the way; the last solution takes as many as it needs."""
_WIDE: Final = np.array([4.0, 2.0, 1.5])
"""Factors of the limits of judgement in the first solutions, which poses still distort."""
_FASTER: Final = 16.0
"""Factor by which correlation times are shortened on the way: measurements are judged by one another, not by how slowly
the errors of poses are thought to vary; the last solution tells how fast they do."""
_LEAST: Final = 0.02  # A weight below this is none.
_SETTLED_PX: Final = 0.05
"""Where residuals change by less than this from solution to solution (px, 95 %), rows are linear enough."""
_MEDIAN: Final = 1.1774
"""Median of the length of two standard normal numbers (Rayleigh)."""
_SIGMA_PX: Final = (0.05, 3.0)
"""Bounds of the measured σ of a tie point (px): SIFT reaches 0.1 at best, and beyond 3 px nothing was matched."""
_BEYOND: Final = 1_000_000_000
"""Number of the first tie point as a place: more control points than this are in no survey, and these come first."""
_LOOKS: Final = 5
"""Solutions up to which surfaces are looked up anew: by then mounting and lens are off by less than a pixel."""
_ELSEWHERE_M: Final = 0.5
"""A tie point farther than this from a surface that the lidar saw there (m) is of something that moves …"""
_ELSEWHERE: Final = 6.0  # … if that is so many σ as well.
_CONTRADICTS: Final = 3.0
"""Range edges, or the stated lever arm beside them, contradict tie points beyond so many σ."""
_TOLD: Final = 0.5
"""A lever arm is judged where observations take away this share of its stated σ (as variances add up) or more."""
_SOFTER: Final = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Factors of what the tie points of a picture are off in common that are tried then, until 1 σ is left."""
_LEAST_SHARED_PX: Final = 0.01
"""They multiply this at least (px)."""
_GROSS: Final = 12.0
"""At the start, a measurement farther than so many median residuals from its point is left out."""


@dataclass(frozen=True)
class PictureEvidence:
    """What pictures say, and how the adjustment numbers it."""

    measured: Measurements
    numbers: Numbers
    cameras: tuple[CameraPrior, ...]
    """By the number that `Numbers.camera` states."""
    control: Int64
    """(p,) number of the control point of each point, −1: a tie point."""
    enters: Bool
    """(m,) False of measurements of check points, which no solution uses."""
    shared_px: float
    """1 σ of what the measurements of a picture are off in common (px)."""
    notes: tuple[str, ...] = ()
    returns: tuple[NearReturns, ...] = ()
    """What lidars saw about tie points."""
    depth_sigma_m: tuple[float, float] = (0.03, 0.01)
    """1 σ of the distance of a tie point from a surface of the lidar, and of what all of a picture are off (m)."""
    edges: tuple[EdgeBoresight, ...] = ()
    """What range edges say of boresights."""

    def at_start(self) -> State:
        """Returns the state from which solutions begin: cameras turned as range edges show them."""
        told = [one for one in reversed(self.edges) if one.counts]
        return State(mountings={one.of.camera_seat: np.array([0.0, 0.0, 0.0, *one.turn, 0.0]) for one in told})


@dataclass(frozen=True)
class Approached:
    """The last rows on the way."""

    pictures: PictureEvidence
    """With the σ of tie points that was measured."""
    rows: Rows
    """Of the measurements that enter."""
    weight: Float64
    """(m,) of each measurement; 0 of one without a row, for instance where no other picture counts for its point."""
    sigma_px: float
    """1 σ of a tie point; NaN where there is none."""
    others: tuple[Observations, int]
    """All other observations, and the place that stands for control point 0."""
    surfaces: Surfaces | None
    """Surfaces of lidars at tie points; None where there are none."""
    depths: DepthRows | None
    """Their rows: those of tie points that they do not contradict as things that move."""
    depth_weight: Float64
    """(m,) weight of the depth at each measurement."""
    moving: Int64
    """Numbers of the tie points that lidars saw elsewhere, as things that move, and which do not count."""
    against_edges: float = 0.0
    """By how many σ range edges contradicted tie points, until these counted less; 0 where they agree."""


def state_of(found: Adjustment) -> State:
    """Returns what an adjustment estimated."""
    corrections = {run: found.corrections(run) for k, run in enumerate(found.runs) if found.active[k].any()}
    mountings = dict(enumerate(found.mountings.error))
    return State(corrections, mountings, dict(enumerate(found.cameras.error)))


def places(pictures: PictureEvidence, first: int) -> Int64:
    """Returns the number (p,) of each point as a place of the adjustment: control points first, then tie points.

    first : place that stands for control point 0.
    """
    return np.where(pictures.control >= 0, first + pictures.control, first + _BEYOND + np.arange(pictures.control.size))


def approached(
    pictures: PictureEvidence,
    others: tuple[Observations, int],
    priors: Sequence[RunPrior],
    settings: AdjustmentSettings,
    mountings: Sequence[MountingPrior],
) -> Approached:
    """Returns rows of the pictures about the solution that they and all other observations have.

    From solution to solution, rays are made anew, and each measurement is judged by its residual against the
    prediction of all others: weights of IGG III (Yang 1994), first with wide limits. The σ of tie points is that which
    their residuals show: nobody states how well a feature is found in a street.

    Parameters
    ----------
    others : observations, and the place that stands for control point 0.
    """
    first = places(pictures, others[1])
    quiet = settings.model_copy(update={"estimate_variance_components": False, "max_rounds": _ROUNDS})
    stated, priors = priors, [one.faster(_FASTER, _FASTER) for one in priors]
    state, weight, heavy = pictures.at_start(), _at_start(pictures), 1.0
    before, settled = np.zeros((0, 2)), False
    surfaces: Surfaces | None = None
    depths: DepthRows | None = None
    moving, depth_weight = np.zeros(0, np.int64), np.ones(pictures.measured.point.size)
    for number in range(1, _MOST + 1):
        measured = pictures.measured
        where = seen(measured, state, pictures.numbers)
        place_m = met_at(measured, where, weight)
        rows = entering(pictures, where, (place_m, first), weight, heavy)
        if number <= _LOOKS:
            surfaces = surfaces_of(measured, pictures.returns, state, pictures.numbers)
        depths = _depths(pictures, surfaces, state, (place_m, first), depth_weight)
        if len(before):
            settled = number > _WIDE.size and _change(before, rows.residual_px, weight) < _SETTLED_PX
        if settled or number == _MOST:
            break
        before = rows.residual_px
        more = Observations.none() if depths is None else depths.observations
        joined = Observations.joined([others[0], more, rows.observations])
        found = adjust(joined, priors, quiet, mountings, pictures.cameras)
        state = state_of(found)
        wide = float(_WIDE[min(number, _WIDE.size) - 1])
        lengths, root = _judged(pictures, rows, found, others[0].size + more.size)
        limits = settings.full_weight_within * wide, settings.reject_beyond * wide
        if surfaces is not None and depths is not None:
            away = _off_surfaces(depths, found, others[0].size)
            depth_weight = np.ones(depth_weight.size)
            depth_weight[surfaces.measurement[depths.surface]] = igg_iii(away[1], *limits)
            moving = _moving(pictures.measured.point[surfaces.measurement[depths.surface]], away)
        weight, factor = _weights(pictures, state, (lengths, weight), limits)
        heavy = max(heavy * root / factor, 1.0) if number > _WIDE.size else 1.0
        pictures = _with_sigma(pictures, factor)
    tied = pictures.measured.sigma_px[pictures.measured.is_tie]
    sigma = float(np.median(tied)) if tied.size else float("nan")
    if moving.size:
        weight = np.where(np.isin(pictures.measured.point, moving), 0.0, weight)
        rows = entering(pictures, where, (place_m, first), weight, heavy)
        place_m = np.where(np.isin(np.arange(len(place_m)), moving)[:, None], np.nan, place_m)
        depths = _depths(pictures, surfaces, state, (place_m, first), depth_weight)
    entered = np.isin(np.arange(weight.size), rows.measurement)
    weight = np.where(entered, weight, 0.0)
    more = Observations.none() if depths is None else depths.observations
    beside = Observations.joined([others[0], more])
    shared_px, off = _shared(pictures, (beside, rows, weight), lambda all_rows: adjust(
        all_rows, stated, quiet, mountings, pictures.cameras
    ))  # fmt: skip
    pictures = replace(pictures, shared_px=shared_px)
    rows = sharing(rows, pictures, weight)
    return Approached(pictures, rows, weight, sigma, others, surfaces, depths, depth_weight, moving, off)


def _shared(
    pictures: PictureEvidence, parts: tuple[Observations, Rows, Float64], solved: Callable[[Observations], Adjustment]
) -> tuple[float, float]:
    """Returns 1 σ (px) of what the tie points of a picture are off in common, and by how many σ range edges, or the
    stated lever arm beside them, contradict them as it is stated, 0 where they do not.

    Edges hold whatever moves, and whatever the poses; tie points do not. So where the two contradict, tie points are
    off in common by more than is stated. Edges see a boresight and a lever arm that are off together as one: tie points
    of things that move bend both of them so that edges agree, and then the lever arm is not the stated one.

    Parameters
    ----------
    parts : all other observations, rows of the pictures, and weights of their measurements.
    """
    beside, rows, weight = parts
    edges, first = np.flatnonzero(beside.kind == KINDS.index(KIND)), 0.0
    seats = [one.of.camera_seat for one in pictures.edges if one.counts]
    for factor in _SOFTER if edges.size else ():
        softer = replace(pictures, shared_px=max(pictures.shared_px, _LEAST_SHARED_PX) * factor)
        found = solved(Observations.joined([beside, sharing(rows, softer, weight).observations]))
        off = np.append(
            np.nan_to_num(np.abs(found.normalised_residual[edges])), _off_lever(found.mountings, seats)
        ).max()
        first = first or float(off)
        if off <= (_CONTRADICTS if factor == 1.0 else 1.0):
            break
    contradicted = first > _CONTRADICTS
    return (softer.shared_px, first) if contradicted else (pictures.shared_px, 0.0)


def _off_lever(found: MountingErrors, seats: Sequence[int]) -> Float64:
    """Returns by how many σ all observations contradict the stated lever arms of some sensors, axis by axis; 0 where
    they hardly tell it.
    """
    error, sigma, stated = (own[seats, :3].ravel() for own in (found.error, found.sigma, found.prior_sigma))
    learnt = np.sqrt(np.maximum(stated**2 - sigma**2, 0.0))
    told = learnt > _TOLD * stated
    return np.where(told, np.abs(error) / np.where(told, learnt, 1.0), 0.0)


def _depths(
    pictures: PictureEvidence, surfaces: Surfaces | None, state: State, points: tuple[Float64, Int64], weight: Float64
) -> DepthRows | None:
    """Returns the rows of surfaces about a state; of a tie point that does not count there are none."""
    if surfaces is None:
        return None
    return depth_rows(pictures.measured, surfaces, state, pictures.numbers, points, pictures.depth_sigma_m, weight)


def _off_surfaces(depths: DepthRows, found: Adjustment, others: int) -> tuple[Float64, Float64]:
    """Returns distances (r,) of tie points from their surfaces by the prediction of all other rows (m), and the same in
    the σ that they have alone, whatever their weight.
    """
    own = slice(others, others + depths.surface.size)
    left_out = np.abs(found.residual_m[own] / found.redundancy[own])
    predicted = (left_out / found.normalised_residual[own]) ** 2 - depths.observations.sigma_m**2
    return left_out, left_out / np.sqrt(np.maximum(predicted, 0.0) + depths.alone_sigma_m[depths.surface] ** 2)


def _moving(point: Int64, off: tuple[Float64, Float64]) -> Int64:
    """Returns numbers of the tie points that most of their surfaces contradict by far: what moves along the epipolar
    lines, as a car ahead does, has its rays meet at a wrong distance.

    Parameters
    ----------
    point : (r,) of each row.
    off : distances (m) and the same in σ.
    """
    far = (off[0] > _ELSEWHERE_M) & (off[1] > _ELSEWHERE)
    size = int(point.max(initial=-1)) + 1
    return np.flatnonzero(2 * np.bincount(point[far], minlength=size) > np.bincount(point, minlength=size))


def sharing(rows: Rows, pictures: PictureEvidence, weight: Float64) -> Rows:
    """Returns rows with larger σ: the mean of a picture's tie points is off at least by what they share.

    Of n measurements with σ each, the mean then has the variance σ² / n + shared². One error more for each picture and
    axis would say the same, but it would be as many unknowns as a free pose a picture. A control point stands alone.
    """
    measured = pictures.measured
    tied = np.where(measured.is_tie, weight, 0.0)
    number = np.bincount(measured.picture, tied, minlength=len(measured.exposures))[measured.picture]
    number = np.where(measured.is_tie, number, 1.0)[rows.measurement]
    shared_m = np.sqrt(number) * pictures.shared_px / rows.px_per_m
    observations = replace(rows.observations, sigma_m=np.hypot(rows.alone_sigma_m, shared_m))
    return replace(rows, observations=observations)


def _judged(pictures: PictureEvidence, rows: Rows, found: Adjustment, others: int) -> tuple[Float64, float]:
    """Returns the length (m,) of each measurement's residual against the prediction of all others, in σ, NaN where it
    did not enter; and the root of the squares of tie points over their redundancy, in the σ of their rows.
    """
    own = slice(others, None)
    left_out = found.residual_m[own] / found.redundancy[own]
    whole = (left_out / found.normalised_residual[own]) ** 2
    stated = rows.observations.sigma_m**2
    # A weight below 1 is a larger σ: without it the measurement is judged by the σ that all have.
    plain = (pictures.measured.sigma_px[rows.measurement] / rows.px_per_m) ** 2
    statistic = left_out / np.sqrt(np.maximum(whole - stated, 0.0) + plain)
    squares = np.bincount(rows.measurement, np.nan_to_num(statistic) ** 2, minlength=pictures.measured.point.size)
    lengths = np.full(squares.size, np.nan)
    lengths[rows.measurement] = np.sqrt(squares[rows.measurement])
    tie = pictures.measured.is_tie[rows.measurement]
    left = (found.residual_m[own] / rows.observations.sigma_m)[tie]
    freedom = float(found.redundancy[own][tie].sum())
    return lengths, float(np.sqrt((left**2).sum() / freedom)) if freedom > 1.0 else 1.0


def _weights(
    pictures: PictureEvidence, state: State, before: tuple[Float64, Float64], limits: tuple[float, float]
) -> tuple[Float64, float]:
    """Returns new weights (m,) of IGG III, and by how much tie points are off more than their σ says, in the median.

    What did not enter comes back where its point lies on its ray by now. It belongs to the median as well: of those
    alone that were found good, σ would shrink from solution to solution.

    Parameters
    ----------
    before : lengths of the residuals in σ, and weights.
    limits : σ of one number up to which a measurement counts wholly, and from which on it does not.
    """
    measured, (lengths, weight) = pictures.measured, before
    where = seen(measured, state, pictures.numbers)
    away = _lengths_px(measured, where, weight) / measured.sigma_px
    away = np.where(np.isnan(lengths), away, lengths)
    every = measured.is_tie & pictures.enters & np.isfinite(away)
    factor = float(np.median(away[every])) / _MEDIAN if every.any() else 1.0
    near, far = (factor * length_limit(limit, 2) for limit in limits)
    judged = igg_iii(away, near, far)
    judged = np.where(judged < _LEAST, 0.0, judged)
    return np.where(measured.is_tie, np.where(pictures.enters, judged, 0.0), pictures.enters), factor


def _at_start(pictures: PictureEvidence) -> Float64:
    """Returns weights (m,): 0 of measurements that pass their point by far more than the others do."""
    measured = pictures.measured
    weight, where = pictures.enters.astype(np.float64), seen(measured, pictures.at_start(), pictures.numbers)
    for _ in range(2):
        away = _lengths_px(measured, where, weight)
        known = (weight > 0.0) & measured.is_tie & np.isfinite(away)
        usual = float(np.median(away[known])) if known.any() else 0.0
        far = measured.is_tie & ~(away <= _GROSS * max(usual, 0.5))
        weight = np.where(far, 0.0, pictures.enters)
    return weight


def _lengths_px(measured: Measurements, where: Seen, weight: Float64) -> Float64:
    """Returns residuals (m,) as lengths (px) from where the rays meet that count; infinite of points that do not lie
    before the camera.
    """
    away = np.hypot(*residuals_px(measured, where, met_at(measured, where, weight)).T)
    return np.where(np.isfinite(away), away, np.inf)


def entering(
    pictures: PictureEvidence, where: Seen, points: tuple[Float64, Int64], weight: Float64, heavy: float
) -> Rows:
    """Returns the rows of measurements that count; a weight below 1 is a larger σ of a tie point.

    Of a tie point that fewer than two pictures see there are none.

    Parameters
    ----------
    points : places (p, 3) and their numbers (p,).
    heavy : by which the σ of tie points that count is larger than the one they are judged by: their errors have heavier
        tails than a normal distribution.
    """
    measured, (place_m, first_place) = pictures.measured, points
    counted = np.bincount(measured.point[weight > 0.0], minlength=len(place_m))
    known = np.isfinite(place_m).all(axis=1) & (counted >= 2)
    enter = (weight > 0.0) & (known[measured.point] | ~measured.is_tie)
    larger = np.where(measured.is_tie, heavy, 1.0) / np.sqrt(np.where(enter, weight, 1.0))
    scaled = replace(measured, sigma_px=measured.sigma_px * larger)
    whole = rows_of(scaled, where, pictures.numbers, place_m, first_place)
    kept = enter[whole.measurement]
    return replace(
        whole, observations=whole.observations.chosen(kept), measurement=whole.measurement[kept],
        px_per_m=whole.px_per_m[kept], alone_sigma_m=whole.alone_sigma_m[kept],
    )  # fmt: skip


def _change(before: Float64, after: Float64, weight: Float64) -> float:
    """Returns by how much residuals (m, 2) of what counts changed (px): 95 % by less."""
    away = np.hypot(*(after - before)[weight > 0.0].T)
    away = away[np.isfinite(away)]
    return float(np.quantile(away, 0.95)) if away.size else 0.0


def _with_sigma(pictures: PictureEvidence, factor: float) -> PictureEvidence:
    """Returns the same with another σ of tie points."""
    measured = pictures.measured
    sigma = np.where(measured.is_tie, np.clip(factor * measured.sigma_px, *_SIGMA_PX), measured.sigma_px)
    return replace(pictures, measured=replace(measured, sigma_px=sigma))
