"""The rigid transformation of a survey onto its control (Helmert), and a leave-one-out test of each target.

Poses are not corrected run by run, so their errors stay, and count as noise of what a run saw: it is σ of the poses
that tells whether a point contradicts the others. A point that does is left out as a whole, the worst first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import scipy

from roadscan.adjust.adjustment import ControlErrors
from roadscan.adjust.control import Sighting
from roadscan.adjust.control_test import quantile
from roadscan.adjust.places import level_from_map
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.errors import ConfigError
from roadscan.poses.trajectory import Corrections

_THIN: Final = 1e-3
"""Points whose second extent is below this share of their first are collinear."""
_DOWN: Final = 2  # Index of the component down.


@dataclass(frozen=True)
class Helmert:
    """p_to = centre_to + scale · rotation · (p_from − centre_from)."""

    rotation: Float64
    """(3, 3)."""
    scale: float
    """1 unless it was asked for."""
    centre_from_m: Float64
    """(3,) weighted mean of the points, axes of `from`."""
    centre_to_m: Float64
    """(3,) weighted mean of the points, axes of `to`."""
    covariance: Float64
    """(6, 6), or (7, 7) with scale: of `centre_to_m`, then of a small rotation about the axes of `to` that follows
    `rotation`, then of the scale's logarithm (m, rad, 1)."""
    residual_m: Float64
    """(n, 3) observed − computed, axes of `to`."""
    sigma_m: Float64
    """(n, 3) 1 σ of each coordinate as stated."""

    @property
    def variance_factor(self) -> float:
        """Returns weighted squared residuals over their redundancy: about 1 where the stated σ is true."""
        whitened = self.residual_m / self.sigma_m
        return float((whitened**2).sum() / max(whitened.size - len(self.covariance), 1))

    def apply(self, points_m: Float64) -> Float64:
        """Returns points (n, 3) of `from` in the axes of `to`."""
        return np.asarray(self._turned(points_m) + self.centre_to_m)

    def sigma_of(self, points_m: Float64) -> Float64:
        """Returns 1 σ (n, 3) that the transformation adds to points (n, 3) of `from`, axes of `to`."""
        rows = _derivatives(self._turned(points_m), with_scale=len(self.covariance) == 7)
        return np.asarray(np.sqrt(np.einsum("nai,ij,naj->na", rows, self.covariance, rows)))

    def corrections(self, epochs_gps_ns: Int64, position_m: Float64, level_from_body: Float64) -> Corrections:
        """Returns corrections of a run that are equivalent to this transformation.

        Parameters
        ----------
        epochs_gps_ns : (k,) knots. Between them corrections are linear: a turn of the vehicle wants several.
        position_m : (k, 3) recorded positions, axes of `from`, which have to be north, east, down.
        level_from_body : (k, 3, 3) recorded attitudes.

        Notes
        -----
        A turn ω about level axes is Rᵀ ω about those of the body, exactly: R exp(Rᵀ ω) = exp(ω) R. The level of the
        site is taken as that of each pose; a kilometre apart they differ by 0.16 mrad, which turns a correction of a
        metre by 0.16 mm.
        """
        shift = self.apply(position_m) - position_m
        turn = scipy.spatial.transform.Rotation.from_matrix(self.rotation).as_rotvec()
        return Corrections(epochs_gps_ns, shift, np.einsum("kij,i->kj", level_from_body, turn))

    def _turned(self, points_m: Float64) -> Float64:
        return np.asarray(self.scale * (points_m - self.centre_from_m) @ self.rotation.T)


def helmert(
    points_from_m: Float64, points_to_m: Float64, sigma_m: npt.ArrayLike, *, with_scale: bool = False
) -> Helmert:
    """Returns the least-squares transformation of points of one frame into another.

    Parameters
    ----------
    points_from_m, points_to_m : (n, 3) the same n points in both frames, for corrections north, east, down.
    sigma_m : 1 σ of the difference of each coordinate: one value, (n, 1) or (n, 3), sqrt(σ_from² + σ_to²).
    with_scale : estimate a scale as well.

    Raises
    ------
    ConfigError
        with fewer than three points, or points on one line: the rotation about it is open then.

    Notes
    -----
    Begins with the closed form of one weight a point (Arun, Huang & Blostein 1987; reflections as in Umeyama 1991)
    and goes on by Gauss and Newton with the σ of each coordinate; the covariance is the inverse of the normal
    equations at the solution.
    """
    source, target = np.asarray(points_from_m, np.float64), np.asarray(points_to_m, np.float64)
    _check(source, target)
    sigma = np.broadcast_to(np.asarray(sigma_m, np.float64), source.shape).copy()
    if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        raise ConfigError(f"σ of the points of {sigma.min():g} m", expected="a positive σ for each point")
    weight = (1.0 / sigma**2).sum(axis=1)
    centre_from, centre_to = (np.average(p, axis=0, weights=weight) for p in (source, target))
    away = source - centre_from
    u, _, vt = np.linalg.svd((target - centre_to).T @ (away * weight[:, None]))
    rotation, scale = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt, 1.0
    for _ in range(20):
        turned = scale * away @ rotation.T
        rows = _derivatives(turned, with_scale=with_scale) / sigma[:, :, None]
        flat = rows.reshape(-1, rows.shape[-1])
        covariance = np.asarray(np.linalg.inv(flat.T @ flat), np.float64)
        step = covariance @ (flat.T @ ((target - turned - centre_to) / sigma).ravel())
        centre_to = centre_to + step[:3]
        rotation = scipy.spatial.transform.Rotation.from_rotvec(step[3:6]).as_matrix() @ rotation
        scale *= float(np.exp(step[6])) if with_scale else 1.0
        if np.abs(step / np.sqrt(np.diag(covariance))).max() < 1e-6:
            break
    residual = target - scale * away @ rotation.T - centre_to
    return Helmert(rotation, scale, centre_from, centre_to, covariance, residual, sigma)


def _check(source: Float64, target: Float64) -> None:
    if source.shape != target.shape or source.ndim != 2 or source.shape[1:] != (3,):
        raise ConfigError(
            f"points of shapes {source.shape} and {target.shape}", expected="the same points in both frames, (n, 3)"
        )
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        bad = int(np.flatnonzero(~(np.isfinite(source) & np.isfinite(target)).all(axis=1))[0])
        raise ConfigError("a coordinate is not a finite number", expected="metres", record=bad)
    if len(source) < 3:
        raise ConfigError(f"{len(source)} points in both frames", expected="at least three, not on one line")
    for points in (source, target):
        extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if extent[1] < _THIN * max(extent[0], 1e-9):
            raise ConfigError(
                "the points lie on one line (or are one): the rotation about it is not determined",
                expected="points that span a plane",
            )


def _derivatives(turned: Float64, *, with_scale: bool) -> Float64:
    """Derivatives of turned points (n, 3) by shift, small rotation, and the scale's logarithm: (n, 3, 6 or 7)."""
    rows = np.zeros((len(turned), 3, 7))
    x, y, z = turned.T
    rows[:, [0, 1, 2], [0, 1, 2]] = 1.0
    rows[:, 0, 4], rows[:, 0, 5] = z, -y
    rows[:, 1, 3], rows[:, 1, 5] = -z, x
    rows[:, 2, 3], rows[:, 2, 4] = y, -x
    rows[:, :, 6] = turned
    return rows if with_scale else rows[:, :, :6]


@dataclass(frozen=True)
class RigidFit:
    """A Helmert transformation of measured onto surveyed points."""

    helmert: Helmert
    """Axes north, east, down from the origin."""
    origin_m: Float64
    """(3,) easting, northing, height."""
    convergence_rad: float
    control: ControlErrors
    """Errors of all points that were seen; leave-one-out figures are NaN where too few points remain."""


@dataclass(frozen=True)
class _Seen:
    """n sightings, north, east, down from the origin."""

    point: Int64
    """(n,) number of the control point."""
    measured_m: Float64
    """(n, 3)"""
    surveyed_m: Float64
    survey_sigma_m: Float64
    seen_sigma_m: Float64
    """(n, 3) of the measurement and of the poses together."""

    def fit(self, rows: Bool) -> Helmert:
        """Returns the transformation from some sightings."""
        sigma = np.hypot(self.survey_sigma_m, self.seen_sigma_m)
        return helmert(self.measured_m[rows], self.surveyed_m[rows], sigma[rows])

    def left_out(self, point: int, counting: Bool) -> tuple[Float64, Float64]:
        """Returns surveyed minus the prediction from the other points that count, and its σ: (3,) each; NaN: too few.

        counting : (n,) sightings of points that count.
        """
        own = self.point == point
        try:
            others = self.fit(counting & ~own)
        except ConfigError:
            return np.full(3, np.nan), np.full(3, np.nan)
        weight = self.seen_sigma_m[own] ** -2.0
        away = self.surveyed_m[own] - others.apply(self.measured_m[own])
        predicted = others.sigma_of(self.measured_m[own].mean(axis=0, keepdims=True))[0]
        sigma = np.sqrt(self.survey_sigma_m[own][0] ** 2 + 1.0 / weight.sum(axis=0) + predicted**2)
        return (away * weight).sum(axis=0) / weight.sum(axis=0), sigma


def rigid_fit(sightings: Sequence[Sighting], sigma_pose_m: Float64, false_alarm: float = 0.01) -> RigidFit:
    """Returns the rigid transformation of a survey onto its targets.

    Parameters
    ----------
    sightings : of ground control, placed and with a height.
    sigma_pose_m : (n, 3) 1 σ of the pose of each, north, east, down.
    false_alarm : chance that one of all points is left out although all are right.

    Raises
    ------
    ConfigError
        for fewer than three points, or points on one line.
    """
    measured = np.array([[s.easting_m, s.northing_m, s.height_m] for s in sightings]).reshape(-1, 3)
    surveyed = np.array([[s.point.easting_m, s.point.northing_m, s.point.height_m] for s in sightings]).reshape(-1, 3)
    origin = measured.mean(axis=0) if len(measured) else np.zeros(3)
    turned = float(np.mean([s.convergence_rad for s in sightings])) if sightings else 0.0
    own = [[np.sqrt(np.trace(s.covariance_m2) / 2)] * 2 + [s.sigma_height_m] for s in sightings]
    survey = [[s.point.sigma_horizontal_m] * 2 + [s.point.sigma_height_m] for s in sightings]
    seen = _Seen(
        np.array([s.point.number for s in sightings], np.int64), level_from_map(measured - origin, turned),
        level_from_map(surveyed - origin, turned), np.array(survey).reshape(-1, 3),
        np.hypot(np.array(own).reshape(-1, 3), sigma_pose_m),
    )  # fmt: skip
    counting = np.ones(len(sightings), bool)
    points = np.unique(seen.point)
    while True:
        left = [seen.left_out(int(point), counting) for point in points]
        worst = np.array([_contradiction(*one, false_alarm, 2 * points.size) for one in left])
        worst[~np.isin(points, seen.point[counting])] = 0.0
        if not worst.size or worst.max() <= 1.0:
            break
        counting &= seen.point != points[worst.argmax()]
    found = seen.fit(counting)
    kept = np.isin(points, seen.point[counting]).astype(np.float64)
    control = ControlErrors(
        points, np.full(points.size, -1, np.int64),
        np.array([seen.survey_sigma_m[seen.point == p][0] for p in points]),
        np.array([(seen.surveyed_m - found.apply(seen.measured_m))[seen.point == p].mean(axis=0) for p in points]),
        np.repeat(kept[:, None], 3, axis=1), *(np.array(column) for column in zip(*left, strict=True)),
    )  # fmt: skip
    return RigidFit(found, origin, turned, control)


def _contradiction(away_m: Float64, sigma_m: Float64, false_alarm: float, tests: int) -> float:
    """Distance of a point from its prediction, relative to the limit of its height or place; 0: not known."""
    if not np.isfinite(away_m).all():
        return 0.0
    sigmas = np.abs(away_m / sigma_m)
    limits = [quantile(false_alarm, tests, numbers) for numbers in (1, 2)]
    return float(max(sigmas[_DOWN] / limits[0], np.hypot(*sigmas[:_DOWN]) / limits[1]))
