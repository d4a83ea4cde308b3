"""Estimates the mounting of a camera by resection on control points, in all pictures at once.

Each measurement is a ray of the camera that has to pass through a control point (collinearity equations; Kraus 2007,
Photogrammetry, section 4.2). With the poses of the body the pictures share one unknown mounting. The
estimator of all mountings gets ties without information along their ray, so that poses have their σ, directions that
the points do not determine are reported, and other evidence can be added.

Sensor axes of a camera are forward along the optical axis, right, down; OpenCV's are right, down, forward.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.calibrate.estimator import Calibrated, Calibration, Estimate, Prior, calibrate
from roadscan.calibrate.evidence import Known, Seen, Ties, Traverse
from roadscan.calibrate.rotations import exponential, logarithm
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.extras import cv2
from roadscan.core.frames import SENSOR_FROM_OPENCV
from roadscan.core.rig import Interior, Mounting
from roadscan.core.settings.calibration import CalibrationSettings

KIND: Final = "resection"

_LEAST_MEASURED: Final = 3  # Least number of usable measurements.
_LEAST_OF_A_PICTURE: Final = 4  # Least number of measurements in a picture from which a start is computed.
_START_GATE: Final = 0.02
"""A measurement supports a start if it lies within this share of the focal length."""
_START_GATE_PX: Final = 8.0  # Least such distance, and the limit for outliers in RANSAC.
_REACH: Final = 3.0
"""With the rig file's mounting measurements may lie off by this many of its σ."""
_RANSAC_ROUNDS: Final = 500  # samples: with half of the points wrong, one of 16 samples of four is right
_OUTLIER: Final = 4.0  # normalised residual from which a point is left out (σ)
_OUTLIER_ROUNDS: Final = 10  # most rounds of leaving out points
_WRONG_TURN_RAD: Final = np.radians(20.0)  # a found turn that differs more from the stated one contradicts it (rad)
_WIDE_M: Final = (1.0, 1.0, 1.0)  # σ of a lever arm that is not believed (m)
_WIDE_RAD: Final = (0.2, 0.2, 0.2)  # σ of a boresight that is not believed (rad)
_BEHIND_M: Final = 0.1  # nearest depth that a camera sees (m)
_INVERTED_PX: Final = 0.05  # largest error of inverting the distortion (pixels)
_ROUNDS: Final = 200  # most steps of that inversion
_SETTLED: Final = 1e-13  # change at which it ends


@dataclass(frozen=True)
class Exposure:
    """A picture with the pose of the body when it was taken."""

    name: str
    position_world_m: Float64
    """(3,) IMU reference point."""
    world_from_body: Float64
    """(3, 3)."""
    error: Traverse
    """Error model of the pose."""


@dataclass(frozen=True)
class Target:
    """A control point."""

    name: str
    point_world_m: Float64
    """(3,)."""
    covariance_m2: Float64
    """(3, 3), world axes."""


@dataclass(frozen=True)
class Measured:
    """A control point measured in a picture."""

    picture: str
    point: str
    u_px: float
    """From the centre of the upper left pixel, to the right."""
    v_px: float
    """Downwards."""


@dataclass(frozen=True)
class Residual:
    """Residual of a measurement."""

    measured: Measured
    du_px: float
    """Observed − computed."""
    dv_px: float
    normalised: float
    """Length of the residual in units of its σ, per coordinate."""
    used: bool
    """False where it was left out as an outlier."""


@dataclass(frozen=True)
class Resection:
    """A camera's mounting from control points."""

    sensor: str
    calibration: Calibration
    residuals: tuple[Residual, ...]
    start: str
    """Start of the search: the rig file, or a picture."""

    @property
    def found(self) -> Calibrated:
        """Mounting with covariance, and undetermined directions."""
        return self.calibration.sensors[self.sensor]

    @property
    def mounting(self) -> Mounting:
        """The mounting."""
        return self.found.mounting

    @property
    def outliers(self) -> tuple[Residual, ...]:
        """Measurements that were left out."""
        return tuple(r for r in self.residuals if not r.used)

    @property
    def rms_px(self) -> float:
        """RMS of the coordinates of the measurements used."""
        used = [(r.du_px, r.dv_px) for r in self.residuals if r.used]
        return float(np.sqrt(np.mean(np.square(used))))


def project(interior: Interior, point_sensor_m: Float64) -> Float64:
    """Return pixels (n, 2: u, v) of points (n, 3) in sensor axes; NaN behind the camera."""
    opencv_axes = np.ascontiguousarray(point_sensor_m @ SENSOR_FROM_OPENCV)
    ahead = opencv_axes[:, 2] > _BEHIND_M
    pixels = np.full((len(opencv_axes), 2), np.nan)
    if ahead.any():
        found, _ = cv2.projectPoints(opencv_axes[ahead], np.zeros(3), np.zeros(3), *_opencv(interior))
        pixels[ahead] = found.reshape(-1, 2)
    return pixels


def tangents(interior: Interior, pixel: Float64) -> Float64:
    """Return tangents (n, 2: right and down per metre ahead) of pixels (n, 2); NaN where distortion has no inverse."""
    matrix, distortion = _opencv(interior)
    settled = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ROUNDS, _SETTLED)
    found = cv2.undistortPoints(pixel.reshape(-1, 1, 2), matrix, distortion, criteria=settled).reshape(-1, 2)
    back = project(interior, np.column_stack([np.ones(len(found)), found]))
    wrong = ~(np.linalg.norm(back - pixel, axis=1) < _INVERTED_PX)
    found[wrong] = np.nan
    return np.asarray(found, np.float64)


def resect(
    sensor: str,
    interior: Interior,
    prior: Prior,
    exposures: Sequence[Exposure],
    targets: Sequence[Target],
    measured: Sequence[Measured],
    sigma_px: float = 0.5,
    settings: CalibrationSettings | None = None,
) -> Resection:
    """Estimate the mounting of a camera by least squares over all pictures.

    Parameters
    ----------
    sensor : its name in the rig.
    interior : interior orientation, which stays as it is.
    prior : mounting as the rig file states it, with its σ.
    exposures : the pictures, in one world frame with the targets.
    targets : control points.
    measured : where they are in the pictures.
    sigma_px : 1 σ of a measured coordinate.
    settings : of the estimator.

    Raises
    ------
    ConfigError
        where a measurement names an unknown picture or point, lies outside the picture or stands twice, and where
        too few are left.
    """
    block = _Block(sensor, interior, tuple(exposures), tuple(targets), tuple(measured), sigma_px)
    block.check()
    start, begin = block.best_start(prior.mounting)
    apart = logarithm(begin.arrays()[0] @ prior.mounting.arrays()[0].T)
    if np.linalg.norm(apart) > _WRONG_TURN_RAD:
        prior = replace(prior, mounting=begin, lever_arm_sigma_m=_WIDE_M, boresight_sigma_rad=_WIDE_RAD)
        start += f", {np.degrees(np.linalg.norm(apart)):.0f}° from the rig file's mounting, which was not used"
    use = block.plausible(begin, block.reach_px(prior) if begin is prior.mounting else 0.0)
    calibration = block.solved(prior, use, settings)
    for _ in range(_OUTLIER_ROUNDS):
        normalised = block.normalised(calibration)
        worse = block.worst_by_picture(normalised, use)
        better = (use & ~worse) | (~use & (normalised < _OUTLIER))
        if (better == use).all():
            break
        use = better
        calibration = block.solved(prior, use, settings)
    return Resection(sensor, calibration, block.residuals(calibration, use), start)


def _opencv(interior: Interior) -> tuple[Float64, Float64]:
    (fx, fy), (cx, cy) = interior.focal_px, interior.principal_px
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.array(interior.distortion)


@dataclass(frozen=True)
class _Poses:
    """Poses of the body, one for each measurement."""

    position_m: Float64
    """(n, 3) world."""
    world_from_body: Float64
    """(n, 3, 3)."""


@dataclass(frozen=True)
class _Block:
    """All measurements of one camera."""

    sensor: str
    interior: Interior
    exposures: tuple[Exposure, ...]
    targets: tuple[Target, ...]
    measured: tuple[Measured, ...]
    sigma_px: float

    @cached_property
    def pixel(self) -> Float64:
        """(n, 2) measured pixels."""
        return np.array([(m.u_px, m.v_px) for m in self.measured], dtype=np.float64)

    @cached_property
    def picture(self) -> Int64:
        """(n,) index of the exposure."""
        index = {e.name: k for k, e in enumerate(self.exposures)}
        return np.array([index[m.picture] for m in self.measured], dtype=np.int64)

    @cached_property
    def target(self) -> Int64:
        """(n,) index of the control point."""
        index = {t.name: k for k, t in enumerate(self.targets)}
        return np.array([index[m.point] for m in self.measured], dtype=np.int64)

    @cached_property
    def point_m(self) -> Float64:
        """(n, 3) world."""
        return np.array([t.point_world_m for t in self.targets])[self.target]

    @cached_property
    def stated(self) -> _Poses:
        """Poses of the body as stated in the trajectory."""
        return _Poses(
            np.array([e.position_world_m for e in self.exposures])[self.picture],
            np.array([e.world_from_body for e in self.exposures])[self.picture],
        )

    def corrected(self, calibration: Calibration) -> _Poses:
        """Return the poses corrected by the errors that the estimator found."""
        position, attitude = self.stated.position_m.copy(), self.stated.world_from_body.copy()
        for k, correction in calibration.corrections.items():
            rows = self.picture == k
            position[rows] += self.exposures[k].error.world_from_ned @ correction.shift_north_east_down_m
            attitude[rows] = attitude[rows] @ exponential(correction.turn_roll_pitch_heading_rad)
        return _Poses(position, attitude)

    @cached_property
    def tangent(self) -> Float64:
        """(n, 2) tangents of the pixels."""
        return tangents(self.interior, self.pixel)

    def check(self) -> None:
        """Reject measurements that cannot be used."""
        pictures, points = {e.name for e in self.exposures}, {t.name for t in self.targets}
        for m in self.measured:
            if m.picture not in pictures:
                raise ConfigError(
                    f"point {m.point} is measured in '{m.picture}', which is no picture of the survey with a pose"
                    + nearest(m.picture, pictures)
                )
            if m.point not in points:
                raise ConfigError(
                    f"'{m.point}', measured in {m.picture}, is no control point of the survey"
                    + nearest(m.point, points)
                )
            inside = -0.5 <= m.u_px <= self.interior.width_px - 0.5 and -0.5 <= m.v_px <= self.interior.height_px - 0.5
            if not inside:
                raise ConfigError(
                    f"{m.point} is measured at ({m.u_px:g}, {m.v_px:g}) in {m.picture}",
                    expected=f"a place in the picture of {self.interior.width_px} × {self.interior.height_px} pixels",
                )
        twice = [key for key, n in Counter((m.picture, m.point) for m in self.measured).items() if n > 1]
        if twice:
            raise ConfigError(f"{twice[0][1]} is measured twice in {twice[0][0]}", expected="one measurement of each")
        if len(self.measured) < _LEAST_MEASURED:
            raise ConfigError(f"{len(self.measured)} measurements", expected=f"at least {_LEAST_MEASURED}, better 12")
        folded = np.flatnonzero(np.isnan(self.tangent).any(axis=1))
        if folded.size:
            m = self.measured[int(folded[0])]
            raise ConfigError(
                f"no ray belongs to ({m.u_px:g}, {m.v_px:g}) in {m.picture}: the distortion folds the picture over",
                change="calibrate the interior orientation with corners up to the picture's edges",
            )

    def in_sensor(self, mounting: Mounting, poses: _Poses) -> Float64:
        """Return the control points (n, 3) in sensor axes."""
        rotation, lever = mounting.arrays()
        body = np.einsum("nji,nj->ni", poses.world_from_body, self.point_m - poses.position_m)
        return np.asarray((body - lever) @ rotation)

    def best_start(self, nominal: Mounting) -> tuple[str, Mounting]:
        """Return the mounting that most measurements support: computed from one picture, or the rig file's."""
        starts = [("the rig file", nominal)]
        for k, exposure in enumerate(self.exposures):
            rows = np.flatnonzero(self.picture == k)
            mounting = self._alone(rows) if rows.size >= _LEAST_OF_A_PICTURE else None
            if mounting is not None:
                starts.append((f"picture {exposure.name} by itself", mounting))
        return max(starts, key=lambda start: int(self.plausible(start[1]).sum()))

    def reach_px(self, prior: Prior) -> Float64:
        """Return how far (n,) measurements may lie from their positions with the rig file's mounting."""
        depth = np.maximum(self.in_sensor(prior.mounting, self.stated)[:, 0], 1.0)
        lever, boresight = np.linalg.norm(prior.lever_arm_sigma_m), np.linalg.norm(prior.boresight_sigma_rad)
        return np.asarray(_REACH * float(np.mean(self.interior.focal_px)) * (lever / depth + boresight))

    def plausible(self, mounting: Mounting, reach_px: npt.ArrayLike = 0.0) -> Bool:
        """Return the measurements (n,) that are close to their positions with this mounting."""
        near = max(_START_GATE * float(np.mean(self.interior.focal_px)), _START_GATE_PX)
        gate = np.maximum(near, reach_px)
        away = np.linalg.norm(project(self.interior, self.in_sensor(mounting, self.stated)) - self.pixel, axis=1)
        return np.asarray(away < gate)

    def _alone(self, picked: Int64) -> Mounting | None:
        """Compute the mounting from the measurements of one picture, robust against wrong ones."""
        origin = self.stated.position_m[picked[0]]
        cv2.setRNGSeed(0)
        found, turn, shift, _ = cv2.solvePnPRansac(
            np.ascontiguousarray(self.point_m[picked] - origin),
            np.ascontiguousarray(self.pixel[picked]),
            *_opencv(self.interior),
            iterationsCount=_RANSAC_ROUNDS,
            reprojectionError=_START_GATE_PX,
            flags=cv2.SOLVEPNP_SQPNP,
        )
        if not found:
            return None
        opencv_from_world, _ = cv2.Rodrigues(turn)
        world_from_sensor = opencv_from_world.T @ SENSOR_FROM_OPENCV.T
        camera_m = -opencv_from_world.T @ np.asarray(shift, np.float64).ravel()
        attitude = self.stated.world_from_body[picked[0]]
        rotation, lever = attitude.T @ world_from_sensor, attitude.T @ camera_m
        if not (np.isfinite(rotation).all() and np.isfinite(lever).all()):
            return None
        rows = tuple((float(r[0]), float(r[1]), float(r[2])) for r in rotation)
        return Mounting((float(lever[0]), float(lever[1]), float(lever[2])), rows)

    def solved(self, prior: Prior, use: Bool, settings: CalibrationSettings | None) -> Calibration:
        """Return the estimator's mounting from the measurements in use."""
        if use.sum() < _LEAST_MEASURED:
            raise ConfigError(
                f"{int(use.sum())} of {use.size} measurements agree with one mounting",
                expected=f"at least {_LEAST_MEASURED}",
                change="check the points' names, the pictures' stamps and the interior orientation",
            )
        chosen = np.flatnonzero(use)
        traverses = {int(k): self.exposures[k].error for k in np.unique(self.picture[chosen])}

        def ties(estimate: Estimate) -> list[Ties]:
            return [self._ties(estimate.mountings[self.sensor], chosen)]

        return calibrate({self.sensor: prior}, ties, traverses, settings)

    def _ties(self, mounting: Mounting, chosen: Int64) -> Ties:
        """Return ties with each ray at the depth of its point; their rows have no component along the ray."""
        depth, rows, covariance = self._rows(mounting, self.stated, chosen)
        ray = np.column_stack([np.ones(chosen.size), self.tangent[chosen]]) * depth[:, None]
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        position, attitude = self.stated.position_m[chosen], self.stated.world_from_body[chosen]
        seen = Seen(self.sensor, ray, position, attitude, self.picture[chosen])
        return Ties(KIND, seen, Known(self.point_m[chosen]), whiten @ rows)

    def _rows(self, mounting: Mounting, poses: _Poses, chosen: Int64) -> tuple[Float64, Float64, Float64]:
        """Return depths (k,), derivatives (k, 2, 3) of the tangents by the points, and their covariance (k, 2, 2)."""
        depth = np.maximum(self.in_sensor(mounting, poses)[chosen, 0], _BEHIND_M)
        projection = np.zeros((chosen.size, 2, 3))
        projection[:, 0, 1] = projection[:, 1, 2] = 1.0
        projection[:, :, 0] = -self.tangent[chosen]
        world_from_sensor = poses.world_from_body[chosen] @ mounting.arrays()[0]
        rows = projection @ world_from_sensor.transpose(0, 2, 1) / depth[:, None, None]
        # k pictures of a point share its error: k times the variance for each gives their mean the point's variance.
        sharing = np.bincount(self.target[chosen], minlength=len(self.targets))[self.target[chosen]]
        point = np.array([t.covariance_m2 for t in self.targets])[self.target[chosen]] * sharing[:, None, None]
        of_pixel = np.diag((self.sigma_px / np.array(self.interior.focal_px)) ** 2)
        return depth, rows, rows @ point @ rows.transpose(0, 2, 1) + of_pixel

    def _away(self, calibration: Calibration) -> tuple[Float64, Float64]:
        """Return observed − computed (n, 2: px) with corrected poses, and their length by their σ, per coordinate."""
        mounting = calibration.sensors[self.sensor].mounting
        poses = self.corrected(calibration)
        away = self.pixel - project(self.interior, self.in_sensor(mounting, poses))
        _, _, covariance = self._rows(mounting, poses, np.arange(len(self.measured)))
        in_tangents = away / np.array(self.interior.focal_px)
        squared = np.einsum("ni,nij,nj->n", in_tangents, np.linalg.inv(covariance), in_tangents) / 2.0
        return away, np.sqrt(np.where(np.isfinite(squared), squared, np.inf))

    def normalised(self, calibration: Calibration) -> Float64:
        """Return (n,) residuals by their σ, which grows with that of the measurements in use."""
        (kind,) = calibration.kinds
        return self._away(calibration)[1] / float(np.sqrt(max(kind.variance_factor, 1.0)))

    def worst_by_picture(self, normalised: Float64, use: Bool) -> Bool:
        """Return the worst outlier (n,) of each picture: it may have made others outliers."""
        worst = np.zeros(use.size, dtype=bool)
        for k in np.unique(self.picture):
            outliers = np.flatnonzero(use & (self.picture == k) & (normalised > _OUTLIER))
            if outliers.size:
                worst[outliers[np.argmax(normalised[outliers])]] = True
        return worst

    def residuals(self, calibration: Calibration, use: Bool) -> tuple[Residual, ...]:
        """Return the residuals of all measurements."""
        away, _ = self._away(calibration)
        normalised = self.normalised(calibration)
        return tuple(
            Residual(m, float(d[0]), float(d[1]), float(n), bool(u))
            for m, d, n, u in zip(self.measured, away, normalised, use, strict=True)
        )
