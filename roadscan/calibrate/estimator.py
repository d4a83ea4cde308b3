"""Estimates mountings by least squares over all evidence at once.

Weighted, robust Gauss–Newton over mountings, errors of poses and poses of calibration objects, each with its prior
(Triggs, McLauchlan, Hartley and Fitzgibbon 2000, "Bundle adjustment – a modern synthesis", sections 3 and 4). Poses and
objects are eliminated; the remaining information shows which directions of the mountings the evidence determines
(:mod:`roadscan.calibrate.observability`). The other directions keep their prior value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.calibrate.evidence import Evidence, Traverse
from roadscan.calibrate.observability import Observability, observe
from roadscan.calibrate.observations import Observations, observations
from roadscan.calibrate.orientations import Contradiction, OrientationObservations
from roadscan.calibrate.robust import Scales, Weighed, independent_share, loss, scales_of, variance_factor, weigh
from roadscan.calibrate.unknowns import (
    MOUNTING,
    Correction,
    Estimate,
    Geometry,
    ObjectPose,
    Prior,
    Unknowns,
    priors_of,
)
from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import length_limit
from roadscan.core.errors import ConfigError
from roadscan.core.rig import Mounting
from roadscan.core.settings.calibration import CalibrationSettings

__all__ = [
    "Calibrated",
    "Calibration",
    "Correction",
    "Estimate",
    "Figures",
    "KindFigures",
    "ObjectPose",
    "Prior",
    "calibrate",
    "priors_of",
]


Finder = Callable[[Estimate], Sequence[Evidence]]
"""Searches for evidence with improved mountings, by which correspondences change."""

_CONVERGED: Final = 0.01
"""A step below this share of every mounting's σ ends the iteration."""
_STAYED: Final = 0.2
"""Mountings count as settled if evidence found again moves them by less than this share of their σ."""
_HALVINGS: Final = 6  # A Gauss–Newton step that increases the cost is halved at most this many times.
_SEEMING: Final = 2.0
"""Factor on the apparent information from errors of normals that is subtracted, since their σ is an estimate too."""


@dataclass(frozen=True)
class Calibrated:
    """The calibrated mounting of one sensor."""

    before: Mounting
    mounting: Mounting
    covariance: Float64
    """(6, 6) lever arm forward, right, down (m), then a small rotation about body x, y, z (rad) that follows the
    boresight."""
    prior_sigma: Float64
    """(6,) m and rad."""
    range_offset_m: float
    range_offset_sigma_m: float
    not_determined: tuple[str, ...]
    """Directions in words that kept their prior value. Empty where the evidence determines all."""

    @property
    def sigma(self) -> Float64:
        """(6,) m and rad."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class Figures:
    """Residuals of one kind between one pair of sensors."""

    kind: str
    sensors: str
    count: int
    rejected: int
    """Number beyond the reject limit with the final mountings; they have no weight."""
    unusable: int
    """Number of residuals that are not finite."""
    rms_before: float
    """RMS with the mountings of the rig file: 1 where residuals are as large as their σ states."""
    rms_after: float
    rms_before_m: float | None
    """None for angles."""
    rms_after_m: float | None


@dataclass(frozen=True)
class KindFigures:
    """Statistics of all observations of one kind, against their stated σ."""

    kind: str
    count: int
    rejected: int
    down_weighted: int
    """Number beyond the robust limit and within the reject limit."""
    variance_factor: float
    """Factor by which the variances of this kind were multiplied; 1 where residuals agree with their σ."""
    counted_as: float
    """Number of independent observations that they count as."""


@dataclass(frozen=True)
class Calibration:
    """Mountings, their covariance, and statistics of the evidence."""

    sensors: dict[str, Calibrated]
    covariance: Float64
    """(6 S, 6 S) of all sensors in their order, as in :class:`Calibrated`."""
    observability: Observability
    kinds: tuple[KindFigures, ...]
    figures: tuple[Figures, ...]
    corrections: dict[int, Correction]
    """Errors of the poses, by traverse."""
    objects: dict[str, ObjectPose]
    rounds: int
    """Number of times that the evidence was searched for."""
    iterations: int
    """Total number of linearisations."""
    converged: bool

    @property
    def mountings(self) -> dict[str, Mounting]:
        """Mountings by sensor."""
        return {name: one.mounting for name, one in self.sensors.items()}


def calibrate(
    sensors: Mapping[str, Prior],
    evidence: Sequence[Evidence] | Finder,
    traverses: Mapping[int, Traverse],
    settings: CalibrationSettings | None = None,
    objects: Mapping[str, ObjectPose] | None = None,
) -> Calibration:
    """Estimate mountings.

    Parameters
    ----------
    sensors : those that are calibrated, with what is known of their mountings.
    evidence : observations, or a function that finds them with the mountings of an estimate; it is called until the
        mountings stay where they are.
    traverses : errors of poses by the numbers that the evidence names; some hundreds, since the equations of all are
        solved as a whole.
    settings : limits; their defaults where left out.
    objects : about where the calibration objects lie that the evidence names.

    Raises
    ------
    ConfigError
        where there is no sensor, or evidence names a sensor, traverse or object that is not given.
    NavigationError
        where the shapes of evidence do not fit.
    """
    if not sensors:
        raise ConfigError("a calibration without sensors", expected="at least one sensor whose mounting is estimated")
    unknowns = Unknowns(dict(sensors), dict(traverses), dict(objects or {}))
    return _Adjustment(unknowns, evidence, settings or CalibrationSettings()).run()


@dataclass
class _Adjustment:
    """The state of one calibration."""

    unknowns: Unknowns
    evidence: Sequence[Evidence] | Finder
    settings: CalibrationSettings
    rounds: int = 0
    iterations: int = 0
    found: list[Observations] = field(default_factory=list)
    rejected: set[tuple[str, str]] = field(default_factory=set)
    """Kind and sensor of orientations that contradict all other evidence."""

    def run(self) -> Calibration:
        """Run all stages: with all directions free, then with those fixed that the evidence does not determine."""
        z, converged = self._free(np.zeros(self.unknowns.size))
        system = self._linearised(z, reject=True)
        seen = observe(system.told(), self.unknowns, self.settings.determined_below)
        z, settled = self._held(z, seen.free)
        return self._result(z, seen, converged=converged and settled)

    def _free(self, z: Float64) -> tuple[Float64, bool]:
        """Solve with all orientations, then without those that contradict all other evidence, the worst first."""
        z, settled = self._stay(z)
        while (worst := self._contradicting(z)) is not None:
            self.rejected.add((worst.kind, worst.sensor))
            z, settled = self._stay(z)
        return z, settled

    def _contradicting(self, z: Float64) -> Contradiction | None:
        """Return the orientation that exceeds the limit by most."""
        system = self._linearised(z, reject=True)
        derivative = system.now.derivative
        covariance = derivative @ system.covariance @ derivative.T
        tested = [
            one
            for observed in self.found
            if isinstance(observed, OrientationObservations)
            for one in observed.contradictions(system.now, covariance)
            if one.rows and one.length > length_limit(self.settings.reject_limit, one.rows)
        ]
        return max(tested, key=lambda one: one.length, default=None)

    def _stay(self, z: Float64) -> tuple[Float64, bool]:
        """Find the evidence and solve, until the mountings settle."""
        self._find(z)
        # What is far off at first may come near, so nothing is rejected yet.
        z, _ = self._solve(z, None, reject=False)
        z, settled = self._solve(z, None, reject=True)
        if not callable(self.evidence):
            return z, settled
        for _ in range(self.settings.rounds_max - 1):
            z, settled, stayed = self._again(z, None)
            if settled and stayed:
                return z, True
        return z, False

    def _held(self, z: Float64, free: Float64) -> tuple[Float64, bool]:
        """Solve with the mountings in the space of `free`; find the evidence once more where that changes it."""
        before = z
        z, settled = self._solve(z, free, reject=True)
        if not callable(self.evidence) or self._small(z - before, self._linearised(z, reject=True), share=_STAYED):
            return z, settled
        z, settled, _ = self._again(z, free)
        return z, settled

    def _again(self, z: Float64, free: Float64 | None) -> tuple[Float64, bool, bool]:
        """Solve with evidence at improved mountings; return z, whether it converged, and whether it changed little."""
        self._find(z)
        found, settled = self._solve(z, free, reject=True)
        return found, settled, self._small(found - z, self._linearised(found, reject=True), share=_STAYED)

    def _find(self, z: Float64) -> None:
        found = self.evidence(self.unknowns.estimate(z)) if callable(self.evidence) else self.evidence
        self.found = observations(found, self.unknowns, self.rejected)
        self.rounds += 1

    def _solve(self, z: Float64, free: Float64 | None, *, reject: bool) -> tuple[Float64, bool]:
        """Run Gauss–Newton with the present evidence; a step that increases the cost is halved."""
        if free is not None:
            # Setting fixed directions to zero may increase the cost, which no descent step does.
            z = np.concatenate([free @ (free.T @ z[: len(free)]), z[len(free) :]])
        system = self._linearised(z, reject=reject)
        for _ in range(self.settings.iterations_max):
            step = system.solution(free) - z
            system, z, accepted = self._stepped(system, z, step, reject=reject)
            if self._small(step, system) or not accepted:
                return z, accepted or self._small(step, system, share=1.0)
        return z, False

    def _stepped(self, system: _System, z: Float64, step: Float64, *, reject: bool) -> tuple[_System, Float64, bool]:
        for _ in range(_HALVINGS):
            tried = self._linearised(z + step, reject=reject)
            if tried.cost(system.scales) <= system.cost(system.scales) * (1 + 1e-9):
                return tried, z + step, True
            if self._small(step, tried):
                return tried, z + step, True
            step = 0.5 * step
        return system, z, False

    def _small(self, step: Float64, system: _System, share: float = _CONVERGED) -> bool:
        size = self.unknowns.mounting_size
        return bool((np.abs(step[:size]) <= share * np.sqrt(np.diag(system.covariance)[:size])).all())

    def _linearised(self, z: Float64, *, reject: bool) -> _System:
        self.iterations += 1
        return _System.at(z, self.unknowns, self.found, self.settings, reject=reject)

    def _result(self, z: Float64, seen: Observability, *, converged: bool) -> Calibration:
        system = self._linearised(z, reject=True)
        # The split into directions stays that of the solution; σ are computed for the final mountings.
        seen = seen.updated(system.told(), self.unknowns)
        estimate = self.unknowns.estimate(z)
        before = self.unknowns.geometry(np.zeros_like(z))
        # Rotations that follow the boresight, not changes of the rotation vector.
        size = self.unknowns.mounting_size
        change = system.now.derivative[:size, :size]
        covariance = change @ seen.covariance @ change.T
        keep = np.concatenate([MOUNTING * i + np.arange(6) for i in range(len(self.unknowns.priors))])
        return Calibration(
            sensors={name: self._calibrated(name, estimate, covariance, seen) for name in self.unknowns.priors},
            covariance=covariance[np.ix_(keep, keep)],
            observability=seen,
            kinds=system.kind_figures(),
            figures=_figures(system.weighed, before),
            corrections=estimate.corrections,
            objects=estimate.objects,
            rounds=self.rounds,
            iterations=self.iterations,
            converged=converged,
        )

    def _calibrated(self, name: str, estimate: Estimate, covariance: Float64, seen: Observability) -> Calibrated:
        prior = self.unknowns.priors[name]
        place = self.unknowns.mounting_slice(name)
        own = covariance[place, place]
        return Calibrated(
            before=prior.mounting,
            mounting=estimate.mountings[name],
            covariance=own[:6, :6],
            prior_sigma=np.array([*prior.lever_arm_sigma_m, *prior.boresight_sigma_rad]),
            range_offset_m=estimate.range_offsets_m[name],
            range_offset_sigma_m=float(np.sqrt(own[6, 6])),
            not_determined=seen.not_determined(name),
        )


def _figures(weighed: Sequence[Weighed], before: Geometry) -> tuple[Figures, ...]:
    """Return statistics of the residuals of each kind and pair of sensors."""
    pairs: dict[tuple[str, str], list[Weighed]] = {}
    for one in weighed:
        pairs.setdefault((one.kind, one.observations.label), []).append(one)
    return tuple(_pair_figures(kind, label, members, before) for (kind, label), members in pairs.items())


def _pair_figures(kind: str, label: str, members: Sequence[Weighed], before: Geometry) -> Figures:
    at_start = [one.observations.residuals(before) for one in members]
    at_end = [one.residuals for one in members]
    used = [one.weight > 0 for one in members]
    lengths_before, lengths_after = (
        [one.observations.metres(r) for one, r in zip(members, residuals, strict=True)]
        for residuals in (at_start, at_end)
    )
    return Figures(
        kind=kind,
        sensors=label,
        count=sum(one.observations.count for one in members),
        rejected=sum(int((~u).sum()) for u in used),
        unusable=sum(one.observations.unusable for one in members),
        rms_before=_rms(at_start, used) or 0.0,
        rms_after=_rms(at_end, used) or 0.0,
        rms_before_m=_rms(lengths_before, used),
        rms_after_m=_rms(lengths_after, used),
    )


def _rms(values: Sequence[Float64 | None], used: Sequence[npt.NDArray[np.bool_]]) -> float | None:
    """Return the root mean square of the used values; None where there is none."""
    known = [v[u].ravel() for v, u in zip(values, used, strict=True) if v is not None]
    if not known:
        return None
    whole = np.concatenate(known)
    return float(np.sqrt(np.mean(whole**2))) if whole.size else 0.0


@dataclass(frozen=True)
class _System:
    """Normal equations at one point, whitened by the prior."""

    z: Float64
    now: Geometry
    weighed: tuple[Weighed, ...]
    scales: Scales
    information: Float64
    """(P, P) of the evidence alone, in units of the prior's."""
    slope: Float64
    """(P,)"""
    reject: bool

    @classmethod
    def at(
        cls,
        z: Float64,
        unknowns: Unknowns,
        found: Sequence[Observations],
        settings: CalibrationSettings,
        *,
        reject: bool,
    ) -> _System:
        """Linearise at z."""
        now = unknowns.geometry(z)
        residuals = [one.residuals(now) for one in found]
        scales = scales_of(found, residuals, settings)
        weighed = tuple(
            weigh(one, residual, scales, reject=reject) for one, residual in zip(found, residuals, strict=True)
        )
        by_kind = _normal_equations(weighed, now)
        scales = _settled(scales, weighed, by_kind, settings)
        information, slope = np.zeros((unknowns.size, unknowns.size)), np.zeros(unknowns.size)
        for kind, (own_information, own_slope) in by_kind.items():
            information += scales.gain(kind) * own_information
            slope += scales.gain(kind) * own_slope
        return cls(z, now, weighed, scales, information, slope, reject)

    @cached_property
    def covariance(self) -> Float64:
        """(P, P) in units of prior σ, with all directions free."""
        return _inverse(self.information + np.eye(self.z.size))

    def told(self) -> Float64:
        """Information (P, P) without what errors of normals alone would give."""
        seeming = np.zeros_like(self.information)
        for kind, members in _by_kind(self.weighed).items():
            own = np.zeros_like(seeming)
            for one in members:
                one.observations.add_seeming(self.now, one.weight, own)
            seeming += _SEEMING * self.scales.gain(kind) * own
        if not seeming.any():
            return self.information
        values, vectors = np.linalg.eigh(self.information - self.now.derivative.T @ seeming @ self.now.derivative)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)

    def cost(self, scales: Scales) -> float:
        """Return the cost at this point for the scales of weights that another point gave."""
        of_evidence = sum(scales.gain(one.kind) * loss(one, scales, reject=self.reject) for one in self.weighed)
        return float(of_evidence + self.z @ self.z)

    def solution(self, free: Float64 | None) -> Float64:
        """Return the solution z (P,) of the normal equations, with the mountings in the space of `free` (M, d)."""
        from scipy.linalg import block_diag, cho_factor, cho_solve

        right = self.information @ self.z - self.slope
        if free is None:
            return self.covariance @ right
        rest = self.z.size - len(free)
        basis = block_diag(free, np.eye(rest))
        inner = cho_factor(basis.T @ self.information @ basis + np.eye(basis.shape[1]))
        return np.asarray(basis @ cho_solve(inner, basis.T @ right))

    def kind_figures(self) -> tuple[KindFigures, ...]:
        """Return statistics of each kind against its stated σ."""
        return tuple(
            KindFigures(
                kind=kind,
                count=sum(one.observations.count for one in members),
                rejected=sum(int((one.weight == 0).sum()) for one in members),
                down_weighted=sum(int(((one.weight > 0) & (one.weight < 1)).sum()) for one in members),
                variance_factor=self.scales.variance_factor[kind],
                counted_as=self.scales.share[kind] * sum(float(one.weight.sum()) for one in members),
            )
            for kind, members in _by_kind(self.weighed).items()
        )


def _by_kind(weighed: Sequence[Weighed]) -> dict[str, list[Weighed]]:
    found: dict[str, list[Weighed]] = {}
    for one in weighed:
        found.setdefault(one.kind, []).append(one)
    return found


def _normal_equations(weighed: Sequence[Weighed], now: Geometry) -> dict[str, tuple[Float64, Float64]]:
    """Return information and slope of each kind, in units of prior σ."""
    size = len(now.derivative)
    found = {}
    for kind, members in _by_kind(weighed).items():
        information, slope = np.zeros((size, size)), np.zeros(size)
        for one in members:
            one.observations.add(now, one.weight, information, slope)
        found[kind] = (now.derivative.T @ information @ now.derivative, now.derivative.T @ slope)
    return found


def _settled(
    scales: Scales,
    weighed: Sequence[Weighed],
    by_kind: Mapping[str, tuple[Float64, Float64]],
    settings: CalibrationSettings,
) -> Scales:
    """Set the weights of the kinds: variance factors, number of unknowns that each determines, and limits."""
    if not by_kind:
        return scales
    share = independent_share(weighed, settings.independent_ties)
    scales = scales.with_factors(scales.variance_factor, share)
    gained = {kind: scales.gain(kind) * information for kind, (information, _) in by_kind.items()}
    total = sum(gained.values(), np.zeros_like(next(iter(gained.values()))))
    covariance = _inverse(total + np.eye(len(total)))
    factors = {
        kind: variance_factor(members, scales, float((gained[kind] * covariance).sum()))
        for kind, members in _by_kind(weighed).items()
    }
    return scales.with_factors(factors, share)


def _inverse(matrix: Float64) -> Float64:
    """Return the inverse of a positive definite matrix."""
    from scipy.linalg import cho_factor, cho_solve

    return np.asarray(cho_solve(cho_factor(0.5 * (matrix + matrix.T)), np.eye(len(matrix))))
