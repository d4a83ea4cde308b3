"""The rigid movement of a survey onto its targets, and what the others say of each of them.

Poses are not corrected run by run, so their errors stay, and count as noise of what a run saw: it is σ of the poses
that tells whether a point contradicts the others. A point that does is left out as a whole, the worst first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.adjustment import ControlErrors
from roadscan.adjust.control import Sighting
from roadscan.adjust.helmert import Helmert, helmert
from roadscan.adjust.patches import level_from_map
from roadscan.model.errors import ConfigError
from roadscan.navigation.calibration.robust import length_limit

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

_SIGMAS: Final = 3.5
"""A point farther from where the others put it does not count."""
_DOWN: Final = 2


@dataclass(frozen=True)
class RigidFit:
    """A Helmert transformation of what was measured onto what was surveyed."""

    helmert: Helmert
    """Axes north, east, down from the origin."""
    origin_m: Float64
    """(3,) easting, northing, height."""
    convergence_rad: float
    control: ControlErrors
    """Of all points that were seen; left-out figures are NaN where too few points are left."""


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
        """The transformation from some sightings."""
        sigma = np.hypot(self.survey_sigma_m, self.seen_sigma_m)
        return helmert(self.measured_m[rows], self.surveyed_m[rows], sigma[rows])

    def left_out(self, point: int, counting: Bool) -> tuple[Float64, Float64]:
        """Surveyed minus what the other points that count say of a point, and its σ: (3,) each; NaN: they are too few.

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


def rigid_fit(sightings: Sequence[Sighting], sigma_pose_m: Float64) -> RigidFit:
    """The movement of a survey onto its targets.

    Parameters
    ----------
    sightings : of ground control, placed and with a height.
    sigma_pose_m : (n, 3) 1 σ of the pose of each, north, east, down.

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
        worst = np.array([_contradiction(*one) for one in left])
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


def _contradiction(away_m: Float64, sigma_m: Float64) -> float:
    """How far a point lies from where the others put it, in limits of its height or of its place; 0: not known."""
    if not np.isfinite(away_m).all():
        return 0.0
    sigmas = np.abs(away_m / sigma_m)
    return float(max(sigmas[_DOWN] / _SIGMAS, np.hypot(*sigmas[:_DOWN]) / length_limit(_SIGMAS, 2)))
