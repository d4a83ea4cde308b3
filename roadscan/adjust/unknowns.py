"""The unknowns of an adjustment, and its observations as rows of them.

Unknowns are in units of their prior σ: the parts of the corrections of each run's components at its knots
(:mod:`roadscan.adjust.observations`), then the errors of the surveyed coordinates of control points (north, east,
down), which all runs that saw a point share, then those of the mountings of sensors, which all runs share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from roadscan.adjust.control_test import quantile
from roadscan.adjust.observations import (
    CAMERA,
    COMPONENTS,
    FIXED,
    KINDS,
    MOUNTED,
    CameraPrior,
    MountingPrior,
    Observations,
    RunPrior,
    knots_of,
    line_variance,
    precision_of,
    stretches,
)
from roadscan.adjust.sparse_normal import Rows
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns

_SIZE = len(COMPONENTS)
_MOUNT_SIZE = len(MOUNTED)
_TIE_POINT = KINDS.index("picture_tie")
_IN_PICTURES = (_TIE_POINT, KINDS.index("picture_control"), KINDS.index("picture_depth"))
_DOWN = 2  # Index of the component down.
_ALONG = 0.5
"""Least component of a direction along an axis for it to determine that coordinate; each has one or two such axes."""
_NOT_COMMON = 1e6
"""Weight, in units of the prior's, of the condition that the heights of all sensors have no common error."""
HEIGHT_ALONE = np.arange(_SIZE) == _DOWN
"""Components that a vertical adjustment corrects."""


@dataclass(frozen=True)
class ControlPoints:
    """c control points in the adjustment; where each run is adjusted alone, one for each run that saw it."""

    place: Int64
    """(c,) number of the point."""
    run: Int64
    """(c,) run of the point, −1: all."""
    sigma_m: Float64
    """(c, 3) of its survey, north, east, down; 0 where no observation depends on the coordinate."""
    lean: Float64
    """(c, 2) derivatives of its height, down, by a shift of the point, north and east, from where it was
    surveyed: the slope of the road, where the height alone is compared, and 0 where the place is."""
    of_observation: Int64
    """(n,) index of each observation's point, −1: none."""
    free: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    """(c,) True of tie points of pictures, which nobody surveyed: `sigma_m` is how far they may lie from where they
    were taken to be. They follow all others."""

    @classmethod
    def of(cls, observations: Observations, *, each_pass: bool) -> ControlPoints:
        """Returns the points whose survey has a σ."""
        moving = observations.run.max(axis=1, initial=FIXED)
        seen = (observations.run == FIXED).any(axis=1) & (observations.survey_sigma_m > 0.0)
        run = np.where(each_pass, moving, FIXED)
        keys = np.stack([observations.place, run], axis=1)[seen]
        points, own = np.unique(keys.reshape(-1, 2), axis=0, return_inverse=True)
        index = np.full(observations.size, -1, np.int64)
        index[seen] = own.ravel()
        sigma = np.zeros((len(points), 3))
        free = np.zeros(len(points), bool)
        free[index[observations.kind == _TIE_POINT]] = True
        # Rays of pictures run in all directions: what they say across an axis rests on the place along it.
        pictured = np.zeros(len(points), bool)
        pictured[index[np.isin(observations.kind, _IN_PICTURES) & seen]] = True
        along = (np.abs(directions_of(observations)[seen]) >= _ALONG) | pictured[index[seen]][:, None]
        for axis in range(3):
            which = along[:, axis]
            np.maximum.at(sigma[:, axis], index[seen][which], observations.survey_sigma_m[seen][which])
        upright, direction = seen.copy(), directions_of(observations)
        upright[seen] = along[:, _DOWN]
        lean, count = np.zeros((len(points), 2)), np.bincount(index[upright], minlength=len(points))
        np.add.at(lean, index[upright], direction[upright, :2] / direction[upright, _DOWN:])
        lean /= np.maximum(count, 1)[:, None]
        return cls(points[:, 0].astype(np.int64), points[:, 1].astype(np.int64), sigma, lean, index, free)


def directions_of(observations: Observations) -> Float64:
    """Direction (n, 3) of each observation, north-east-down: derivative by the position of its moving end."""
    moving = np.where(observations.run[:, 0] != FIXED, 0, 1)
    return np.asarray(observations.partials[np.arange(observations.size), moving, :3])


@dataclass(frozen=True)
class Unknowns:
    """Indices of all unknowns."""

    priors: tuple[RunPrior, ...]
    knots: tuple[Int64, ...]
    """Epochs of each run's knots."""
    sigmas: tuple[Float64, ...]
    """(k, 6), or (k, 12) where a run has outages: σ of the parts of each run's processes at its knots; 0: not there."""
    control: ControlPoints
    mountings: tuple[MountingPrior, ...] = ()
    cameras: tuple[CameraPrior, ...] = ()
    commons: int = 0
    """Number of errors that ties have in common."""

    @classmethod
    def of(
        cls,
        priors: Sequence[RunPrior],
        control: ControlPoints,
        spacing_s: float,
        components: npt.NDArray[np.bool_],
        shared: tuple[Sequence[MountingPrior], Sequence[CameraPrior]] = ((), ()),
    ) -> Unknowns:
        """Returns unknowns with knots at most `spacing_s` apart; only some components are estimated."""
        knots = tuple(knots_of(p, spacing_s) for p in priors)
        parts = [p.parts_at(own) for p, own in zip(priors, knots, strict=True)]
        sigmas = tuple(own * np.tile(components, own.shape[1] // _SIZE) for own in parts)
        return cls(tuple(priors), knots, sigmas, control, tuple(shared[0]), tuple(shared[1]))

    @cached_property
    def active(self) -> npt.NDArray[np.bool_]:
        """Returns a mask (runs, 6) of the components that are estimated."""
        return np.array([(own[:, :_SIZE] > 0.0).all(axis=0) for own in self.sigmas], bool).reshape(-1, _SIZE)

    @cached_property
    def first(self) -> Int64:
        """Returns the first unknown (runs + 1,) of each run; the last is that of the control points."""
        sizes = [int((own > 0.0).sum()) for own in self.sigmas]
        return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)

    @cached_property
    def fixed(self) -> npt.NDArray[np.bool_]:
        """Returns a mask (u,) of the unknowns of runs that are held."""
        found = np.zeros(self.size, np.bool_)
        for run, prior in enumerate(self.priors):
            found[self.first[run] : self.first[run + 1]] = prior.fixed
        return found

    @property
    def size(self) -> int:
        """Returns the number of unknowns."""
        return self.first_common + self.commons

    @property
    def first_common(self) -> int:
        """Returns the first unknown of the errors that ties have in common."""
        return self.first_camera + int((self.camera_sigma > 0.0).sum())

    @property
    def first_camera(self) -> int:
        """Returns the first unknown of a camera."""
        return self.first_mounting + int((self.mount_sigma > 0.0).sum())

    @property
    def first_mounting(self) -> int:
        """Returns the first unknown of a mounting."""
        return int(self.first[-1]) + int((self.control.sigma_m > 0.0).sum())

    @cached_property
    def mount_sigma(self) -> Float64:
        """Returns (s, 7) prior σ of the mountings."""
        return np.array([one.sigma for one in self.mountings]).reshape(-1, _MOUNT_SIZE)

    @cached_property
    def of_mountings(self) -> Int64:
        """Returns the unknown (s, 7) of each component of the mountings, −1: none."""
        there = self.mount_sigma > 0.0
        numbers = np.full(there.shape, -1, np.int64)
        numbers[there] = self.first_mounting + np.arange(int(there.sum()))
        return numbers

    @cached_property
    def camera_sigma(self) -> Float64:
        """Returns (k, 11) prior σ of the cameras."""
        return np.array([one.sigma for one in self.cameras]).reshape(-1, len(CAMERA))

    @cached_property
    def of_cameras(self) -> Int64:
        """Returns the unknown (k, 11) of each component of the cameras, −1: none."""
        there = self.camera_sigma > 0.0
        numbers = np.full(there.shape, -1, np.int64)
        numbers[there] = self.first_camera + np.arange(int(there.sum()))
        return numbers

    @cached_property
    def of_surveys(self) -> Int64:
        """Returns the unknown (c, 3) of each surveyed coordinate of the control points, −1: none."""
        return np.where(self.control.free[:, None], -1, self.of_control)

    @cached_property
    def of_control(self) -> Int64:
        """Returns the unknown (c, 3) of each coordinate of the control points, −1: none."""
        there = self.control.sigma_m > 0.0
        numbers = np.full(there.shape, -1, np.int64)
        numbers[there] = self.first[-1] + np.arange(int(there.sum()))
        return numbers

    def of_run(self, run: int) -> Int64:
        """Returns the unknown of each knot and part of a run, as `sigmas`; −1: none."""
        there = self.sigmas[run] > 0.0
        numbers = np.full(there.shape, -1, np.int64)
        numbers[there] = self.first[run] + np.arange(int(there.sum()))
        return numbers

    def intervals(self, run: int, epochs_gps_ns: Int64) -> tuple[Int64, Float64, Float64]:
        """Knot before each epoch (n,), share of the way to the next, 0 to 1, and the step between them (s)."""
        knots = self.knots[run]
        if knots.size == 1:
            return np.zeros(epochs_gps_ns.size, np.int64), np.zeros(epochs_gps_ns.size), np.zeros(epochs_gps_ns.size)
        before = np.clip(np.searchsorted(knots, epochs_gps_ns, side="right") - 1, 0, knots.size - 2)
        step = knots[before + 1] - knots[before]
        share = np.clip((epochs_gps_ns - knots[before]) / step, 0.0, 1.0)
        return before, share, step / NS_PER_S

    def rows(self, observations: Observations, point: Int64) -> tuple[Rows, Float64]:
        """Rows of the observations (m per unit of each unknown), and the variance (n, 6) from lines between knots.

        That variance, a share for each component, is exact for one observation; those of neighbouring ones are taken
        as independent.

        Parameters
        ----------
        point : (n,) control point of each observation, −1: none.
        """
        n, width = observations.size, max((own.shape[1] for own in self.sigmas), default=_SIZE)
        unknown = np.full((n, 4 * width + 3), -1, np.int64)
        derivative, variance = np.zeros(unknown.shape), np.zeros((n, _SIZE))
        for run in range(len(self.priors)):
            numbers, sigma = self.of_run(run), self.sigmas[run]
            parts, own = sigma.shape[1] // _SIZE, sigma.shape[1]
            taus = np.tile(self.priors[run].taus_s, parts)
            for end in (0, 1):
                here = np.flatnonzero(observations.run[:, end] == run)
                before, share, step_s = self.intervals(run, observations.epoch_gps_ns[here, end])
                partial = np.tile(observations.partials[here, end], parts)
                after = np.minimum(before + 1, len(numbers) - 1)
                for side, (knot, weight) in enumerate(((before, 1.0 - share), (after, share))):
                    at = slice((2 * end + side) * width, (2 * end + side) * width + own)
                    unknown[here, at], derivative[here, at] = numbers[knot], partial * sigma[knot] * weight[:, None]
                lines = line_variance(
                    share[:, None], step_s[:, None], taus, (sigma[before], sigma[after]), np.arange(own) >= _SIZE
                )
                variance[here] += (partial**2 * lines).reshape(-1, parts, _SIZE).sum(axis=1)
        seen = point >= 0
        unknown[seen, -3:] = self.of_control[point[seen]]
        derivative[seen, -3:] = directions_of(observations)[seen] * self.control.sigma_m[point[seen]]
        mounted, by_mounting = self._of_mounted(observations)
        filmed, by_camera = self._of_filmed(observations)
        common = np.where(observations.common >= 0, self.first_common + observations.common, -1)
        by_common = observations.common_partials
        rows = Rows.of(
            np.hstack([unknown, mounted, filmed, common]), np.hstack([derivative, by_mounting, by_camera, by_common])
        )
        return rows, variance

    def _of_filmed(self, observations: Observations) -> tuple[Int64, Float64]:
        """Returns unknowns and derivatives (n, 11) of cameras; (n, 0) where none is estimated."""
        if not self.cameras:
            return np.zeros((observations.size, 0), np.int64), np.zeros((observations.size, 0))
        here = observations.camera >= 0
        unknown = np.full((observations.size, len(CAMERA)), -1, np.int64)
        unknown[here] = self.of_cameras[observations.camera[here]]
        derivative = np.zeros(unknown.shape)
        derivative[here] = observations.camera_partials[here] * self.camera_sigma[observations.camera[here]]
        return unknown, derivative

    def _of_mounted(self, observations: Observations) -> tuple[Int64, Float64]:
        """Returns unknowns and derivatives (n, 14), of the mountings of both ends; (n, 0) where none is estimated."""
        n = observations.size
        if not self.mountings:
            return np.zeros((n, 0), np.int64), np.zeros((n, 0))
        here = observations.sensor >= 0
        unknown, derivative = np.full((n, 2, _MOUNT_SIZE), -1, np.int64), np.zeros((n, 2, _MOUNT_SIZE))
        unknown[here] = self.of_mountings[observations.sensor[here]]
        derivative[here] = observations.mount_partials[here] * self.mount_sigma[observations.sensor[here]]
        return unknown.reshape(n, 2 * _MOUNT_SIZE), derivative.reshape(n, 2 * _MOUNT_SIZE)

    def prior_entries(self) -> tuple[Int64, Int64, Float64, Int64]:
        """Returns upper entries of the prior's inverse covariance: row, column, value, component.

        Mountings, cameras, what ties have in common and tie points of pictures have the component `len(COMPONENTS)`.
        Those of control points are not among them: their survey is an observation, which may be wrong.
        """
        parts: list[tuple[Int64, Int64, Float64, Int64]] = []
        for run, prior in enumerate(self.priors):
            for part, numbers in enumerate(self.of_run(run).T):
                component = part % _SIZE
                for one in stretches(numbers >= 0):
                    drift = self.sigmas[run][one, part] if part >= _SIZE else None
                    diagonal, beside = precision_of(self.knots[run][one], prior.processes[component].tau_s, drift)
                    own = numbers[one]
                    row, column = np.concatenate([own, own[:-1]]), np.concatenate([own, own[1:]])
                    value = np.concatenate([diagonal, beside])
                    parts.append((row, column, value, np.full(row.size, component, np.int64)))
        parts.append(self._of_mounting_priors())
        commons = np.arange(self.first_common, self.size)
        points = self.of_control[self.control.free].ravel()
        free = np.concatenate([points, self.of_cameras[self.of_cameras >= 0], commons])
        parts.append((free, free, np.ones(free.size), np.full(free.size, _SIZE, np.int64)))
        rows, columns, values, components = zip(*parts, strict=True)
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values), np.concatenate(components)

    def _of_mounting_priors(self) -> tuple[Int64, Int64, Float64, Int64]:
        """Returns entries of the mountings: each has its σ, and all sensors have no common height error.

        Were all lever arms too long, all heights would be off: that is an error of the poses' heights, which are among
        the unknowns, and known less well. A sensor whose height is not estimated distinguishes the two.
        """
        mounted = self.of_mountings[self.of_mountings >= 0]
        parts = [(mounted, mounted, np.ones(mounted.size))]
        for own in self.sharing:
            heights, common = self.of_mountings[own, _DOWN], 1.0 / self.mount_sigma[own, _DOWN]
            i, j = np.triu_indices(common.size)
            parts.append((heights[i], heights[j], _NOT_COMMON * common[i] * common[j] / (common @ common)))
        row, column, value = (np.concatenate(p) for p in zip(*parts, strict=True))
        return row, column, value, np.full(row.size, _SIZE, np.int64)

    @cached_property
    def sharing(self) -> list[Int64]:
        """Sensors (k,) whose heights could have a common error: those of all runs, and each run's separate ones."""
        return sharing(tuple(one.run for one in self.mountings), self.mount_sigma)

    def wanted_pairs(self) -> tuple[Int64, Int64]:
        """Pairs of unknowns whose covariance is needed: of a knot, of neighbouring knots, of a control point, of all
        mountings; of each error that ties have in common, its variance.
        """
        mounted, filmed = self.of_mountings.reshape(1, -1), self.of_cameras
        parts = [_pairs(self.of_control, self.of_control), _pairs(mounted, mounted), _pairs(filmed, filmed)]
        common = np.arange(self.first_common, self.size)
        parts.append((common, common))
        for run in range(len(self.priors)):
            numbers = self.of_run(run)
            parts += [_pairs(numbers, numbers), _pairs(numbers[:-1], numbers[1:])]
        first, second = (np.concatenate(p) for p in zip(*parts, strict=True))
        return np.minimum(first, second), np.maximum(first, second)

    def check(self, observations: Observations) -> None:
        """Refuse observations that no run explains.

        Raises
        ------
        ConfigError
            for an end of a run that is not among the priors, or at an epoch outside of its run, what is not a number,
            and where there is nothing to correct.
        """
        if self.first[-1] == 0:
            raise ConfigError(
                "no component of any run is to be corrected",
                expected="a process with σ above 0 for one component or more",
            )
        for end in (0, 1):
            run = observations.run[:, end]
            strange = np.flatnonzero((run < FIXED) | (run >= len(self.priors)))
            if strange.size:
                raise ConfigError(
                    f"an observation of run number {run[strange[0]]}",
                    expected=f"0 to {len(self.priors) - 1}, or {FIXED} for control",
                    record=int(strange[0]),
                )
            for number, prior in enumerate(self.priors):
                here = np.flatnonzero(run == number)
                epoch = observations.epoch_gps_ns[here, end]
                outside = here[(epoch < prior.first_gps_ns) | (epoch > prior.last_gps_ns)]
                if outside.size:
                    raise ConfigError(
                        f"an observation of run '{prior.run}' at "
                        f"{iso_from_gps_ns(int(observations.epoch_gps_ns[outside[0], end]))}",
                        expected=f"{iso_from_gps_ns(prior.first_gps_ns)} to {iso_from_gps_ns(prior.last_gps_ns)}",
                        record=int(outside[0]),
                    )
        _refuse_strange_values(observations)


def sharing(runs: Sequence[str], mount_sigma: Float64) -> list[Int64]:
    """Returns sensors (k,) of mountings of one run, or of all, where the heights of all of them are estimated."""
    groups = [np.flatnonzero([run == one for run in runs]) for one in dict.fromkeys(runs)]
    return [own for own in groups if (mount_sigma[own, _DOWN] > 0.0).all()]


def _refuse_strange_values(observations: Observations) -> None:
    """Refuse a σ that is not positive, and what is not a number."""
    sound = np.isfinite(observations.observed_m) & np.isfinite(observations.partials).all(axis=(1, 2))
    sound &= np.isfinite(observations.sigma_m) & (observations.sigma_m > 0.0)
    sound &= np.isfinite(observations.survey_sigma_m) & (observations.survey_sigma_m >= 0.0)
    bad = np.flatnonzero(~sound)
    if bad.size:
        raise ConfigError(
            f"an observation of {observations.observed_m[bad[0]]:g} m with σ {observations.sigma_m[bad[0]]:g} m",
            expected="finite numbers, σ above 0",
            record=int(bad[0]),
        )


def _pairs(first: Int64, second: Int64) -> tuple[Int64, Int64]:
    """Returns all pairs of unknowns of the same row of two tables (k, a), without those that are −1."""
    i = np.broadcast_to(first[:, :, None], (*first.shape, second.shape[1]))
    j = np.broadcast_to(second[:, None, :], i.shape)
    there = (i >= 0) & (j >= 0)
    return i[there], j[there]


@dataclass(frozen=True)
class FixedRun:
    """A run that is fixed, and the corrections that it would have if it were not."""

    run: str
    error: Float64
    """(k, 6) at its knots, `COMPONENTS`."""
    sigma: Float64
    """(k, 6) 1 σ of its poses, as stated."""
    spans: Float64
    """(6,) number of correlation times in its drive, at least 1: the number of independent values."""

    def contradicted(self, false_alarm: float) -> list[tuple[str, float, float]]:
        """Component, largest error and its size in σ, of each error that right poses would exceed with that chance.

        An estimated error scatters by no more than the stated σ.
        """
        found = []
        for k, name in enumerate(COMPONENTS):
            there = self.sigma[:, k] > 0.0
            if not there.any():
                continue
            ratio = np.abs(self.error[there, k]) / self.sigma[there, k]
            worst = int(ratio.argmax())
            if ratio[worst] > quantile(false_alarm, int(np.ceil(len(COMPONENTS) * self.spans[k]))):
                found.append((name, float(self.error[there, k][worst]), float(ratio[worst])))
        return found


def fixed_runs(unknowns: Unknowns, error: Sequence[Float64]) -> tuple[FixedRun, ...]:
    """Returns the fixed runs of the adjustment; error : (k, 6) of each run, where no run is held."""
    found = []
    for number, (prior, knots) in enumerate(zip(unknowns.priors, unknowns.knots, strict=True)):
        if prior.fixed:
            spans = np.maximum((prior.last_gps_ns - prior.first_gps_ns) / NS_PER_S / prior.taus_s, 1.0)
            sigma = np.where(unknowns.active[number], prior.sigma_at(knots), 0.0)
            found.append(FixedRun(prior.run, error[number], sigma, spans))
    return tuple(found)
