"""Orientations of sensors as observations, with their covariances and the errors that several share.

An orientation is the solution of a separate adjustment. It is not one of many similar observations, most of them right:
with a σ far below that of the other evidence it seems an outlier until the others have converged. So it has full weight
while the mountings are estimated, and is tested afterwards against the other evidence: its residual has the
covariance Q_r = Q − A C Aᵀ, and T = rᵀ Q_r⁻¹ r is χ² (Baarda 1968, "A testing procedure for use in geodetic networks").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.calibrate.evidence import AttitudeInfluence, Orientation
from roadscan.calibrate.rotations import left_jacobian, logarithm
from roadscan.calibrate.unknowns import MOUNTING, Geometry, Unknowns
from roadscan.compute.array_types import Float64
from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S

_TESTED: Final = 1e-4
"""Directions in which the other evidence has less than this share of the orientation's information cannot contradict
it: the iteration ends at 1 % of σ, which moves √T by 1 there."""


@dataclass(frozen=True)
class Contradiction:
    """An orientation that contradicts the other evidence, and its test statistic."""

    kind: str
    sensor: str
    length: float
    """Test statistic √T, distributed as the length of `rows` standard normal numbers."""
    rows: int


class OrientationObservations:
    """Rotations of some sensors, with their joint covariance."""

    def __init__(self, members: Sequence[Orientation], unknowns: Unknowns, *, counts: bool = True) -> None:
        self.kind = members[0].kind
        self._names = [one.sensor for one in members]
        self.label = " and ".join(sorted(self._names))
        self.fixed_weight: float | None = 1.0 if counts else 0.0
        self._sensors = [unknowns.find_sensor(name) for name in self._names]
        self._observed = [one.body_from_sensor for one in members]
        for one in members:
            _factor(one.covariance_rad2, f"orientation of '{one.sensor}' ({one.kind})")
        covariance = joint_covariance(members)
        label = f"orientations of {self.label} ({self.kind}), with the errors they share"
        self._whitening = np.linalg.inv(_factor(covariance, label))

    @property
    def count(self) -> int:
        """Number of observations."""
        return len(self._sensors)

    @property
    def rows(self) -> int:
        """Number of residuals of one observation."""
        return 3

    @property
    def unusable(self) -> int:
        """Number of observations that are not finite; they are left out."""
        return 0

    def residuals(self, now: Geometry) -> Float64:
        """Return residuals (count, rows) of unit variance, decorrelated from those before."""
        return np.asarray((self._whitening @ self._away(now).ravel()).reshape(-1, 3))

    def metres(self, residuals: Float64) -> Float64 | None:
        """Return None, since angles have no length."""
        return None

    def add(self, now: Geometry, weight: Float64, information: Float64, gradient: Float64) -> None:
        """Add Jᵀ diag(weight) J (P, P) and Jᵀ diag(weight) r (P,), by :class:`Geometry`'s local changes."""
        jacobian = self._jacobian(now, len(information))
        rows = jacobian * np.repeat(weight, 3)[:, None]
        information += rows.T @ jacobian
        gradient += rows.T @ self.residuals(now).ravel()

    def add_seeming(self, now: Geometry, weight: Float64, information: Float64) -> None:
        """Add nothing: these have no normals."""

    def contradictions(self, now: Geometry, covariance: Float64) -> list[Contradiction]:
        """Test each orientation that has weight against the other evidence.

        Parameters
        ----------
        covariance : (P, P) of all unknowns from all evidence, these included, by :class:`Geometry`'s local changes.
        """
        from scipy.linalg import eigh

        if not self.fixed_weight:
            return []
        jacobian = self._jacobian(now, len(covariance))
        spread = np.eye(len(jacobian)) - jacobian @ covariance @ jacobian.T
        residual = self.residuals(now).ravel()
        found = []
        for index, name in enumerate(self._names):
            # A shift of one orientation alone, seen in all whitened residuals.
            own = self._whitening[:, 3 * index : 3 * index + 3]
            share, direction = eigh(own.T @ spread @ own, own.T @ own)
            known = share > _TESTED
            along = direction[:, known].T @ (own.T @ residual)
            length = float(np.sqrt(np.sum(along**2 / share[known])))
            found.append(Contradiction(self.kind, name, length, int(known.sum())))
        return found

    def _away(self, now: Geometry) -> Float64:
        """Return the small rotations (count, 3) from what was observed."""
        pairs = zip(self._sensors, self._observed, strict=True)
        return np.array([logarithm(now.body_from_sensor[s] @ observed.T) for s, observed in pairs])

    def _jacobian(self, now: Geometry, size: int) -> Float64:
        """Return the Jacobian (3 count, size) of the residuals."""
        derivative = np.zeros((3 * self.count, size))
        for index, (sensor, away) in enumerate(zip(self._sensors, self._away(now), strict=True)):
            begin = MOUNTING * sensor + 3
            derivative[3 * index : 3 * index + 3, begin : begin + 3] = np.linalg.inv(left_jacobian(away))
        return np.asarray(self._whitening @ derivative)


def joint_covariance(members: Sequence[Orientation]) -> Float64:
    """Return the (3 n, 3 n) covariance (rad²) of orientations that share errors of the trajectory's attitude."""
    size = 3 * len(members)
    covariance = np.zeros((size, size))
    for i, first in enumerate(members):
        place = slice(3 * i, 3 * i + 3)
        covariance[place, place] = first.covariance_rad2
        for j, second in enumerate(members[:i]):
            other = slice(3 * j, 3 * j + 3)
            shared = sum((_shared(a, b) for a in first.attitude for b in second.attitude), np.zeros((3, 3)))
            covariance[place, other], covariance[other, place] = shared, shared.T
    return covariance


def _shared(first: AttitudeInfluence, second: AttitudeInfluence) -> Float64:
    """Return the (3, 3) covariance of two orientations from the same piece of a trajectory; 0 for others."""
    a, b = first.epoch_gps_ns, second.epoch_gps_ns
    if a[0] > b[-1] or b[0] > a[-1]:
        return np.zeros((3, 3))
    apart = np.abs(a[:, None] - b) / NS_PER_S
    alike = np.exp(-apart / max(first.time_constant_s, second.time_constant_s))
    power = np.multiply(first.sigma_roll_pitch_heading_rad, second.sigma_roll_pitch_heading_rad)
    return np.asarray(np.einsum("ika,kl,a,jla->ij", first.influence, alike, power, second.influence, optimize=True))


def _factor(covariance: Float64, label: str) -> Float64:
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise NavigationError(
            f"{label}: its covariance is not positive definite", expected="a 3 × 3 covariance in rad²"
        ) from error
