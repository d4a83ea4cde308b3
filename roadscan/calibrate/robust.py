"""Weights of observations: Huber weights, rejection, variance factor by kind.

This requires many observations of a kind, most of them right; orientations are treated separately
(:mod:`roadscan.calibrate.orientations`).

The variance factor of a kind is that of an M-estimator (Huber 1981, eq. 7.6.5): mean square of the clipped residuals
over the squared share of those that are not clipped. It is applied where it is significantly above 1, never below:
residuals that are smaller than stated may share errors that they do not show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np

from roadscan.calibrate.observations import Observations
from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import length_limit
from roadscan.core.settings.calibration import CalibrationSettings

_ENOUGH: Final = 30
"""Least number of observations from whose median their spread is estimated."""
_SIGNIFICANT: Final = 0.95  # A variance factor is applied if its χ² exceeds this quantile.


@dataclass(frozen=True)
class Scales:
    """Spread of the residuals of each kind, and weight of the kind."""

    spread: Mapping[str, float]
    """Spread in units of the stated σ, at least 1; limits are multiples of it."""
    variance_factor: Mapping[str, float]
    share: Mapping[str, float]
    """Number of independent observations over number of observations."""
    robust_limit: float
    reject_limit: float

    def gain(self, kind: str) -> float:
        """Return the factor on the normal equations of a kind."""
        return self.share[kind] / self.variance_factor[kind]

    def limits(self, kind: str, rows: int) -> tuple[float, float]:
        """Return robust and reject limit for the length of `rows` residuals, as rarely exceeded as those for one."""
        spread = self.spread[kind]
        return spread * length_limit(self.robust_limit, rows), spread * length_limit(self.reject_limit, rows)

    def with_factors(self, factors: Mapping[str, float], share: Mapping[str, float]) -> Scales:
        """Return the same limits with other weights of the kinds."""
        return replace(self, variance_factor=dict(factors), share=dict(share))


@dataclass(frozen=True)
class Weighed:
    """Observations with their residuals at one point, and their weights."""

    observations: Observations
    residuals: Float64
    """(n, k)"""
    length: Float64
    """(n,)"""
    weight: Float64
    """(n,) in [0, 1]; 0: rejected."""

    @property
    def kind(self) -> str:
        """Kind of evidence."""
        return self.observations.kind


def scales_of(found: Sequence[Observations], residuals: Sequence[Float64], settings: CalibrationSettings) -> Scales:
    """Return the spread of each kind from the median of its residuals, robust against half of them."""
    normed: dict[str, list[Float64]] = {}
    for one, residual in zip(found, residuals, strict=True):
        normed.setdefault(one.kind, []).append(np.sum(residual**2, axis=1) / _median(one.rows))
    spread = {}
    for kind, parts in normed.items():
        values = np.concatenate(parts)
        spread[kind] = max(1.0, float(np.sqrt(np.median(values)))) if values.size >= _ENOUGH else 1.0
    squares = {kind: value**2 for kind, value in spread.items()}
    share = dict.fromkeys(spread, 1.0)
    return Scales(spread, squares, share, settings.robust_limit, settings.reject_limit)


def weigh(one: Observations, residuals: Float64, scales: Scales, *, reject: bool) -> Weighed:
    """Compute Huber's weights; with `reject`, observations beyond the reject limit get 0."""
    robust, limit = scales.limits(one.kind, one.rows)
    length = np.linalg.norm(residuals, axis=1)
    if one.fixed_weight is not None:
        return Weighed(one, residuals, length, np.full(len(length), one.fixed_weight))
    weight = np.minimum(1.0, robust / np.maximum(length, 1e-300))
    if reject:
        weight[length > limit] = 0.0
    return Weighed(one, residuals, length, weight)


def loss(one: Weighed, scales: Scales, *, reject: bool) -> float:
    """Return the sum of Huber's function, constant beyond the reject limit with `reject`."""
    if one.observations.fixed_weight is not None:
        return float((one.weight * one.length**2).sum())
    robust, limit = scales.limits(one.kind, one.observations.rows)
    length = np.minimum(one.length, limit) if reject else one.length
    return float(np.where(length <= robust, length**2, 2 * robust * length - robust**2).sum())


def independent_share(weighed: Sequence[Weighed], most: float) -> dict[str, float]:
    """Return for each kind the factor that limits its sum of weights to `most` independent observations."""
    counted: dict[str, float] = {}
    for one in weighed:
        counted[one.kind] = counted.get(one.kind, 0.0) + float(one.weight.sum())
    return {kind: min(1.0, most / max(count, 1.0)) for kind, count in counted.items()}


def variance_factor(weighed: Sequence[Weighed], scales: Scales, parameters: float) -> float:
    """Return the factor on one kind's variances.

    Parameters
    ----------
    weighed : all observations of the kind.
    parameters : how many unknowns they determine, as the trace of their share of the solution.
    """
    from scipy.special import gammaincinv

    squares = rows = whole = used = total_weight = 0.0
    for one in weighed:
        if one.observations.fixed_weight is not None:
            # No spread can be estimated from a few residuals that the solution mostly follows.
            continue
        k = one.observations.rows
        kept = one.weight > 0
        robust, _ = scales.limits(one.kind, k)
        squares += float((np.minimum(one.length[kept], robust) ** 2).sum())
        rows += k * int(kept.sum())
        used += int(kept.sum())
        whole += int((one.length[kept] <= robust).sum())
        total_weight += float(one.weight.sum())
    redundancy = rows - parameters
    if redundancy < 1.0 or whole == 0:
        return 1.0
    if squares <= 2.0 * gammaincinv(redundancy / 2.0, _SIGNIFICANT):
        return 1.0
    # Normal equations contain the mean weight, Huber's formula the squared share of unclipped residuals.
    clipped = (total_weight / used) / (whole / used) ** 2
    return max(1.0, squares / redundancy * clipped)


@cache
def _median(rows: int) -> float:
    """Return the median of the squared length of `rows` standard normal numbers."""
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(rows / 2.0, 0.5))
