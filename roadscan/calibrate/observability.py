"""Finds which directions of the mountings the evidence determines, and which it does not.

Poses and objects are eliminated from the information of the evidence (Schur complement, with their priors); the
remaining matrix M is in units of the prior's information. Along an eigenvector with eigenvalue λ, the σ of the evidence
alone is 1/√λ times that of the prior. Where that is no small share of the prior's σ, the direction is not determined,
and keeps its prior value instead of noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.calibrate.unknowns import MOUNTING, Unknowns
from roadscan.compute.array_types import Float64

AXES: Final = (
    "forward lever arm",
    "right lever arm",
    "vertical lever arm",
    "roll",
    "pitch",
    "heading",
    "range offset",
)
"""Names of a sensor's unknowns, in their order."""
_NAMED_SHARE: Final = 0.15
"""Parts of a direction smaller than this share of the largest, in units of prior σ, are not reported."""

_NOTHING: Final = 0.01
"""Parts of a fixed direction smaller than this share of the largest are set to 0."""


@dataclass(frozen=True)
class Part:
    """One component of a direction."""

    sensor: str
    axis: int
    """Index into :data:`AXES`."""
    share: float
    """In units of prior σ; the direction has length 1."""
    amount: float
    """In metres or radians."""

    @property
    def is_angle(self) -> bool:
        """Whether `amount` is in radians."""
        return 3 <= self.axis < 6


@dataclass(frozen=True)
class Direction:
    """One direction among the mountings: a change of several unknowns at once."""

    determined: bool
    sigma_ratio: float
    """σ from the evidence alone over prior σ; infinite where the evidence has no information. For a determined one
    the other determined ones are unknown, for others all else is known."""
    parts: tuple[Part, ...]
    """Largest first."""

    @property
    def words(self) -> str:
        """Words such as "heading of 'left' together with the forward lever arm of 'left' (17.1 mm a degree)"."""
        return _words(self.parts)


@dataclass(frozen=True)
class Observability:
    """The split of the mountings' unknowns into determined and undetermined directions."""

    directions: tuple[Direction, ...]
    """All directions, the undetermined ones first."""
    free: Float64
    """(M, d) basis of the determined directions, in units of prior σ."""
    held: Float64
    """(M, u) basis of the undetermined directions."""
    covariance: Float64
    """(M, M) in units of prior σ: of the evidence with the prior where determined, of the prior elsewhere."""

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Directions that kept their prior value, in words."""
        return tuple(d.words for d in self.directions if not d.determined)

    def not_determined(self, sensor: str) -> tuple[str, ...]:
        """Return those of them in which a sensor has a part."""
        return tuple(d.words for d in self.directions if not d.determined and any(p.sensor == sensor for p in d.parts))

    def updated(self, information: Float64, unknowns: Unknowns) -> Observability:
        """Return the same split with the covariance from information at another point.

        Directions that are kept fixed err by their prior σ; the effect on the others is part of their covariance
        (Schmidt's consider covariance).
        """
        reduced = eliminated(information, unknowns.mounting_size)
        inner = _inverse(np.eye(self.free.shape[1]) + self.free.T @ reduced @ self.free)
        spill = inner @ self.free.T @ reduced @ self.held
        mixed = self.held - self.free @ spill
        covariance = self.free @ inner @ self.free.T + mixed @ mixed.T
        return replace(self, covariance=0.5 * (covariance + covariance.T))


def eliminated(information: Float64, size: int) -> Float64:
    """Information (size, size) of the first unknowns, with the others and their prior (1 each) eliminated."""
    mixed = information[size:, :size]
    reduced = information[:size, :size] - mixed.T @ _inverse(information[size:, size:] + np.eye(len(mixed))) @ mixed
    return np.asarray(0.5 * (reduced + reduced.T))


def observe(information: Float64, unknowns: Unknowns, determined_below: float) -> Observability:
    """Split the mountings' unknowns into determined and undetermined directions.

    Parameters
    ----------
    information : (P, P) of the evidence alone, in units of the prior's.
    determined_below : σ of the evidence alone as a share of prior σ, below which a direction is determined.
    """
    size = unknowns.mounting_size
    active = np.flatnonzero(np.diag(unknowns.root)[:size] > 0.0)
    reduced = eliminated(information, size)
    values, vectors = np.linalg.eigh(reduced[np.ix_(active, active)])
    determined = values > 1.0 / determined_below**2
    of_held = _cleared(_plain_basis(vectors[:, ~determined] @ vectors[:, ~determined].T, int((~determined).sum())))
    of_free = _plain_basis(np.eye(active.size) - of_held @ of_held.T, int(determined.sum()))
    free, held = (_embedded(basis, active, size) for basis in (of_free, of_held))
    held_values = np.einsum("iu,ij,ju->u", held, reduced, held)
    variances = np.diag(_inverse(free.T @ reduced @ free))
    directions = [
        _direction(v, float(1.0 / np.sqrt(value)) if value > 1e-12 else float("inf"), unknowns, determined=False)
        for v, value in zip(held.T, held_values, strict=True)
    ]
    directions += [
        _direction(v, float(np.sqrt(variance)), unknowns, determined=True)
        for v, variance in zip(free.T, variances, strict=True)
    ]
    split = Observability(tuple(directions), free, held, np.eye(size))
    return split.updated(information, unknowns)


def _plain_basis(projector: Float64, count: int) -> Float64:
    """Return an orthonormal basis (n, count) of the space that (n, n) projects on, with few components a vector.

    Its vectors are columns of the projector, the largest first (Cholesky's factors with pivots).
    """
    basis = np.zeros((len(projector), count))
    for index in range(count):
        pivot = int(np.argmax(np.diag(projector)))
        column = projector[:, pivot] / np.linalg.norm(projector[:, pivot])
        basis[:, index] = column
        projector = projector - np.outer(column, column @ projector)
        projector = projector - np.outer(projector @ column, column)
    return basis


def _cleared(basis: Float64) -> Float64:
    """Return the same directions (n, u) without negligible components, so that the remaining ones are fixed exactly.

    Fixing a slightly different direction adds a part in ten thousand to the others' errors, within the covariance.
    """
    if not basis.size:
        return basis
    plain = np.where(np.abs(basis) < _NOTHING * np.abs(basis).max(axis=0), 0.0, basis)
    orthogonal, triangle = np.linalg.qr(plain)
    return np.asarray(orthogonal * np.sign(np.diag(triangle)))


def _embedded(basis: Float64, active: npt.NDArray[np.int64], size: int) -> Float64:
    whole = np.zeros((size, basis.shape[1]))
    whole[active] = basis
    return whole


def _inverse(matrix: Float64) -> Float64:
    from scipy.linalg import cho_factor, cho_solve

    return np.asarray(cho_solve(cho_factor(matrix), np.eye(len(matrix)))) if matrix.size else matrix


def _direction(vector: Float64, ratio: float, unknowns: Unknowns, *, determined: bool) -> Direction:
    names = list(unknowns.priors)
    amount = np.diag(unknowns.root)[: vector.size] * vector
    large = np.flatnonzero(np.abs(vector) >= _NAMED_SHARE * np.abs(vector).max())
    order = large[np.argsort(-np.abs(vector[large]), kind="stable")]
    parts = tuple(
        Part(names[i // MOUNTING], int(i % MOUNTING), float(vector[i]), float(amount[i])) for i in order.tolist()
    )
    return Direction(determined, ratio, parts)


def _words(parts: Sequence[Part]) -> str:
    first = parts[0]
    if len(parts) == 1:
        return _name(first)
    if all(p.axis == first.axis and abs(p.amount - first.amount) <= 0.1 * abs(first.amount) for p in parts):
        sensors = ", ".join(f"'{p.sensor}'" for p in sorted(parts, key=lambda p: p.sensor))
        return f"{AXES[first.axis]} of {sensors} together"
    others = ", ".join(f"the {_name(p)} ({_rate(p, first)})" for p in parts[1:])
    return f"{_name(first)} together with {others}"


def _name(part: Part) -> str:
    return f"{AXES[part.axis]} of '{part.sensor}'"


def _rate(part: Part, first: Part) -> str:
    """Return how much of a part corresponds to one degree or ten millimetres of the first."""
    per = np.radians(1.0) if first.is_angle else 0.01
    value = part.amount / first.amount * per
    unit = "a degree" if first.is_angle else "for 10 mm"
    return f"{np.degrees(value):+.3f}° {unit}" if part.is_angle else f"{value * 1e3:+.1f} mm {unit}"
