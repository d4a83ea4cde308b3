"""The rigid transformation between two frames from points known in both (Helmert without scale)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.model.errors import ConfigError

Float64 = npt.NDArray[np.float64]

_THIN: Final = 1e-3
"""Points whose second extent is below this share of their first lie on a line."""


@dataclass(frozen=True)
class RigidTransform:
    """p_to = rotation · p_from + shift_m."""

    rotation: Float64
    """(3, 3)."""
    shift_m: Float64
    """(3,)."""
    covariance: Float64
    """(6, 6) m², m rad, rad²: of the shift, then of a small rotation about the axes of `to` that follows `rotation`."""
    residual_m: Float64
    """(n, 3) observed − computed, axes of `to`."""
    sigma_m: Float64
    """(n,) 1 σ of each coordinate as stated."""

    @property
    def rms_m(self) -> float:
        """RMS of the residuals' lengths."""
        return float(np.sqrt((self.residual_m**2).sum(axis=1).mean()))

    @property
    def variance_factor(self) -> float:
        """Weighted squared residuals over their redundancy: about 1 where the stated σ is true."""
        whitened = self.residual_m / self.sigma_m[:, None]
        return float((whitened**2).sum() / max(whitened.size - 6, 1))

    def apply(self, points_m: Float64) -> Float64:
        """Points (n, 3) of `from` in the axes of `to`."""
        return np.asarray(points_m @ self.rotation.T + self.shift_m)

    def inverse(self) -> tuple[Float64, Float64]:
        """Rotation (3, 3) and shift (3,) from `to` to `from`."""
        return self.rotation.T, -self.rotation.T @ self.shift_m

    def carried_to(self, place_m: Float64) -> Float64:
        """Covariance (6, 6) of a frame whose origin (3,) and axes this transformation brings into `to`.

        Where `to` is the body and the frame a sensor's, this is what the uncertainty of the transformation adds to
        the covariance of the sensor's mounting: δl = δshift + δrotation × (l − shift).
        """
        x, y, z = np.asarray(place_m, np.float64) - self.shift_m
        carry = np.eye(6)
        carry[:3, 3:] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.asarray(carry @ self.covariance @ carry.T)


def rigid_transform(points_from_m: Float64, points_to_m: Float64, sigma_m: npt.ArrayLike) -> RigidTransform:
    """Least-squares rigid transformation between points of two frames.

    Parameters
    ----------
    points_from_m, points_to_m : (n, 3) the same n points in both frames.
    sigma_m : 1 σ of the difference of each coordinate, one value or (n,): sqrt(σ_from² + σ_to²).

    Raises
    ------
    ConfigError
        with fewer than three points, or points on one line: the rotation about it is open then.

    Notes
    -----
    Closed form by the singular value decomposition (Arun, Huang and Blostein 1987; reflections as in Umeyama 1991),
    weighted by 1/σ²; the covariance is the inverse of the normal equations at the solution.
    """
    source, target = np.asarray(points_from_m, np.float64), np.asarray(points_to_m, np.float64)
    _check(source, target)
    sigma = np.broadcast_to(np.asarray(sigma_m, np.float64), (len(source),)).copy()
    if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        raise ConfigError(f"σ of the points of {sigma.min():g} m", expected="a positive σ for each point")
    weight = 1.0 / sigma**2
    middle_from, middle_to = (np.average(p, axis=0, weights=weight) for p in (source, target))
    u, _, vt = np.linalg.svd((target - middle_to).T @ ((source - middle_from) * weight[:, None]))
    proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ proper @ vt
    shift = middle_to - rotation @ middle_from
    turned = source @ rotation.T
    return RigidTransform(rotation, shift, _covariance(turned, weight), target - turned - shift, sigma)


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
                expected="points that span a plane, such as the origin and ends of two axes",
            )


def _covariance(turned: Float64, weight: Float64) -> Float64:
    normal = np.zeros((6, 6))
    for (x, y, z), w in zip(turned, weight, strict=True):
        row = np.hstack([np.eye(3), -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])])
        normal += w * row.T @ row
    return np.asarray(np.linalg.inv(normal))
