"""The rigid transformation that brings a survey onto its control (Helmert), and the corrections that amount to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import scipy

from roadscan.model.errors import ConfigError
from roadscan.navigation.trajectory import Corrections

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

_THIN: Final = 1e-3
"""Points whose second extent is below this share of their first lie on a line."""


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
        """Weighted squared residuals over their redundancy: about 1 where the stated σ is true."""
        whitened = self.residual_m / self.sigma_m
        return float((whitened**2).sum() / max(whitened.size - len(self.covariance), 1))

    def apply(self, points_m: Float64) -> Float64:
        """Points (n, 3) of `from` in the axes of `to`."""
        return np.asarray(self._turned(points_m) + self.centre_to_m)

    def sigma_of(self, points_m: Float64) -> Float64:
        """1 σ (n, 3) that the transformation adds to points (n, 3) of `from`, axes of `to`."""
        rows = _derivatives(self._turned(points_m), with_scale=len(self.covariance) == 7)
        return np.asarray(np.sqrt(np.einsum("nai,ij,naj->na", rows, self.covariance, rows)))

    def corrections(self, epochs_gps_ns: Int64, position_m: Float64, level_from_body: Float64) -> Corrections:
        """Corrections of a run that amount to this transformation.

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
    """Least-squares transformation of points of one frame into another.

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
    """Of turned points (n, 3) by shift, small rotation, and the scale's logarithm: (n, 3, 6 or 7)."""
    rows = np.zeros((len(turned), 3, 7))
    x, y, z = turned.T
    rows[:, [0, 1, 2], [0, 1, 2]] = 1.0
    rows[:, 0, 4], rows[:, 0, 5] = z, -y
    rows[:, 1, 3], rows[:, 1, 5] = -z, x
    rows[:, 2, 3], rows[:, 2, 4] = y, -x
    rows[:, :, 6] = turned
    return rows if with_scale else rows[:, :, :6]
