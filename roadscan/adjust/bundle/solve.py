"""The way to the solution of pictures: rays are straight, pixels are not, so rows are made anew about each solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.adjustment import Adjustment, adjust
from roadscan.adjust.bundle.measurements import Measurements, Numbers, Rows, State, met_at, rows_of, seen
from roadscan.adjust.observations import Observations
from roadscan.adjust.process import CameraPrior, MountingPrior, RunPrior
from roadscan.adjust.solver_settings import AdjustmentSettings

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

_MOST: Final = 8  # Solutions on the way, at most; four are usual.
_ROUNDS: Final = 6  # Rounds of weights of a solution on the way; the last solution takes as many as it needs.
_SETTLED_PX: Final = 0.02
"""Where residuals change by less than this from solution to solution (px, 95 %), rows are linear enough."""
_MEDIAN: Final = 0.6745
"""Median of the absolute value of a standard normal number."""
_SIGMA_PX: Final = (0.05, 3.0)
"""Bounds of the measured σ of a tie point (px): SIFT reaches 0.1 at best, and beyond 3 px nothing was matched."""
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
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Approached:
    """The last rows on the way."""

    pictures: PictureEvidence
    """With the σ of tie points that was measured."""
    rows: Rows
    """Of the measurements that enter."""
    place_m: Float64
    """(p, 3) of the points."""
    sigma_px: float
    """1 σ of a tie point; NaN where there is none."""
    solutions: int
    settled: bool


def state_of(found: Adjustment) -> State:
    """Returns what an adjustment estimated."""
    corrections = {run: found.corrections(run) for k, run in enumerate(found.runs) if found.active[k].any()}
    mountings = dict(enumerate(found.mountings.error))
    return State(corrections, mountings, dict(enumerate(found.cameras.error)))


def places(pictures: PictureEvidence, first: int) -> Int64:
    """Returns the number (p,) of each point as a place of the adjustment: control points first, then tie points.

    first : place that stands for control point 0.
    """
    beyond = first + 1 + int(max(pictures.control.max(initial=-1), 0)) + 1_000_000_000
    return np.where(pictures.control >= 0, first + pictures.control, beyond + np.arange(pictures.control.size))


def approached(
    pictures: PictureEvidence,
    others: tuple[Observations, int],
    priors: Sequence[RunPrior],
    settings: AdjustmentSettings,
    mountings: Sequence[MountingPrior],
) -> Approached:
    """Returns rows of the pictures about the solution that they and all other observations have.

    The σ of tie points is that which their residuals show: nobody states how well a feature is found in a street.

    Parameters
    ----------
    others : observations, and the place that stands for control point 0.
    """
    first = places(pictures, others[1])
    quiet = settings.model_copy(update={"estimate_variance_components": False, "max_rounds": _ROUNDS})
    state, weight = State(), _at_start(pictures)
    before, settled = np.zeros((0, 2)), False
    for number in range(1, _MOST + 1):
        measured = pictures.measured
        place = met_at(measured, seen(measured, state, pictures.numbers), weight)
        rows = _entering(pictures, state, place, first, weight)
        residual = rows.residual_px
        if len(before):
            settled = _change(before, residual) < _SETTLED_PX
        if settled or number == _MOST:
            break
        before = residual
        found = adjust(Observations.joined([others[0], rows.observations]), priors, quiet, mountings, pictures.cameras)
        state = state_of(found)
        own = slice(others[0].size, None)
        tie = measured.is_tie[rows.measurement]
        factor = _factor(found.normalised_residual[own][tie])
        pictures = _with_sigma(pictures, factor)
        judged = np.zeros(weight.size)
        judged[rows.measurement] = found.weight[own]
        weight = np.where(pictures.enters, judged, 0.0)
        weight[~measured.is_tie & pictures.enters] = 1.0
        weight = _once_more(pictures, state, weight)
    tied = pictures.measured.sigma_px[pictures.measured.is_tie]
    sigma = float(np.median(tied)) if tied.size else float("nan")
    return Approached(pictures, rows, place, sigma, number, settled)


def _at_start(pictures: PictureEvidence) -> Float64:
    """Returns weights (m,): 0 of measurements that pass their point by far more than the others do."""
    measured = pictures.measured
    weight = pictures.enters.astype(np.float64)
    for _ in range(2):
        place = met_at(measured, seen(measured, State(), pictures.numbers), weight)
        away = _lengths(pictures, State(), place)
        usual = (
            float(
                np.median(
                    away[(weight > 0.0) & measured.is_tie & np.isfinite(away)],
                )
            )
            if weight.any()
            else 0.0
        )
        far = measured.is_tie & ~(away <= _GROSS * max(usual, 0.5))
        weight = np.where(far, 0.0, pictures.enters)
    return weight


def _once_more(pictures: PictureEvidence, state: State, weight: Float64) -> Float64:
    """Returns weights (m,) with those measurements back whose points lie where the others' rays meet now."""
    measured = pictures.measured
    place = met_at(measured, seen(measured, state, pictures.numbers), weight)
    away = _lengths(pictures, state, place) / measured.sigma_px
    back = measured.is_tie & pictures.enters & (weight == 0.0) & (away < 3.0)
    return np.where(back, 1.0, weight)


def _lengths(pictures: PictureEvidence, state: State, place_m: Float64) -> Float64:
    """Returns residuals (m,) as lengths (px); infinite of points that do not lie before the camera."""
    rows = rows_of(pictures.measured, state, pictures.numbers, place_m, np.zeros(len(place_m), np.int64))
    away = np.hypot(*rows.residual_px.T)
    return np.where(np.isfinite(away), away, np.inf)


def _entering(pictures: PictureEvidence, state: State, place_m: Float64, first_place: Int64, weight: Float64) -> Rows:
    """Returns the rows of measurements that enter; of a tie point that fewer than two pictures see there are none."""
    measured = pictures.measured
    counted = np.bincount(measured.point[weight > 0.0], minlength=len(place_m))
    known = np.isfinite(place_m).all(axis=1) & (counted >= 2)
    enter = pictures.enters & ((measured.is_tie & known[measured.point]) | ~measured.is_tie)
    whole = rows_of(measured, state, pictures.numbers, place_m, first_place)
    kept = enter[whole.measurement]
    return replace(
        whole, observations=whole.observations.chosen(kept), measurement=whole.measurement[kept],
        px_per_m=whole.px_per_m[kept],
    )  # fmt: skip


def _change(before: Float64, after: Float64) -> float:
    """Returns by how much residuals (m, 2) changed (px): 95 % by less."""
    away = np.hypot(*(after - before).T)
    away = away[np.isfinite(away)]
    return float(np.quantile(away, 0.95)) if away.size else 0.0


def _factor(normalised: Float64) -> float:
    """Returns by how much residuals are larger than their σ, in the median."""
    known = np.abs(normalised[np.isfinite(normalised)])
    return float(np.median(known)) / _MEDIAN if known.size else 1.0


def _with_sigma(pictures: PictureEvidence, factor: float) -> PictureEvidence:
    """Returns the same with another σ of tie points."""
    measured = pictures.measured
    sigma = np.where(measured.is_tie, np.clip(factor * measured.sigma_px, *_SIGMA_PX), measured.sigma_px)
    return replace(pictures, measured=replace(measured, sigma_px=sigma))
