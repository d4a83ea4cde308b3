"""Residuals and normal equations of each kind of observation.

A reading's place is p = t + s + R E (B (p_sensor + o u) + l): lever arm l and rotation B of the mounting, range offset
o along the beam u, shift s and small rotation E of the traverse. A row w of a tie's weight gives, with c = Eᵀ Rᵀ w,

    ∂/∂l = c,  ∂/∂β = (B p) × c,  ∂/∂o = c · B u,  ∂/∂s = w,  ∂/∂ε = (B p + l) × c

for small rotations β that follows B and ε that follows E; Glennie (2007), "Rigorous 3D error analysis of kinematic
scanning LIDAR systems", writes the same terms.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from roadscan.calibrate.evidence import Directions, Evidence, Known, Orientation, Seen, Ties
from roadscan.calibrate.kernels.ties import tie_residuals, tie_rows
from roadscan.calibrate.orientations import OrientationObservations
from roadscan.calibrate.unknowns import BODY, MOUNTING, Geometry, Unknowns
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import NavigationError

_CHUNK: Final = 65_536
"""Ties linearised at once: 26 derivatives a row then fit the cache."""
_ABSENT: Final = -1  # Index of a missing sensor or body.


class Observations(Protocol):
    """Observations of one kind and one pair of sensors."""

    kind: str
    label: str
    """Sensors concerned, for the report."""
    fixed_weight: float | None
    """Weight of every observation, where it does not depend on the residual."""

    @property
    def count(self) -> int:
        """Number of observations."""

    @property
    def rows(self) -> int:
        """Number of residuals of one observation."""

    @property
    def unusable(self) -> int:
        """Number of observations that are not finite; they are left out."""

    def residuals(self, now: Geometry) -> Float64:
        """Return residuals (count, rows) of unit variance."""

    def metres(self, residuals: Float64) -> Float64 | None:
        """Return lengths (count,) of residuals in metres; None where they are angles."""

    def add(self, now: Geometry, weight: Float64, information: Float64, gradient: Float64) -> None:
        """Add Jᵀ diag(weight) J (P, P) and Jᵀ diag(weight) r (P,), by :class:`Geometry`'s local changes."""

    def add_seeming(self, now: Geometry, weight: Float64, information: Float64) -> None:
        """Add the part of the information (P, P) that errors of the weights' directions alone would give."""


def observations(
    evidence: Iterable[Evidence], unknowns: Unknowns, rejected: Collection[tuple[str, str]] = ()
) -> list[Observations]:
    """Prepare evidence for an adjustment; orientations of one kind are one observation, since they share errors.

    Parameters
    ----------
    rejected : kinds and sensors of orientations that count for nothing.

    Raises
    ------
    ConfigError
        where it names a sensor, traverse or object that is not among the unknowns.
    NavigationError
        where shapes do not fit.
    """
    found: list[Observations] = []
    orientations: dict[tuple[str, bool], list[Orientation]] = {}
    for one in evidence:
        if isinstance(one, Ties):
            found.append(TieObservations(one, unknowns))
        elif isinstance(one, Directions):
            found.append(DirectionObservations(one, unknowns))
        else:
            counts = (one.kind, one.sensor) not in rejected
            orientations.setdefault((one.kind, counts), []).append(one)
    for (_, counts), members in orientations.items():
        found.append(OrientationObservations(members, unknowns, counts=counts))
    return found


@dataclass(frozen=True)
class _Side:
    """One end of n ties."""

    sensor: int
    """Index of the sensor; −1: no sensor."""
    body: Int64
    """(n,) traverse or object; −1: none."""
    point_m: Float64
    """(n, 3) sensor's, object's or world axes."""
    position_m: Float64
    """(n, 3), or (1, 3) where all share it."""
    rotation: Float64
    """(n, 3, 3), or (1, 3, 3)."""
    beam_axis: Float64
    """(3,) beam direction; zero: away from the sensor."""

    def taken(self, index: Int64 | slice) -> _Side:
        """Return some of the ends."""
        return replace(
            self,
            body=self.body[index],
            point_m=np.ascontiguousarray(self.point_m[index]),
            position_m=self.position_m if self._is_shared else np.ascontiguousarray(self.position_m[index]),
            rotation=self.rotation if self._is_shared else np.ascontiguousarray(self.rotation[index]),
        )

    @property
    def _is_shared(self) -> bool:
        return self.sensor == _ABSENT

    def arrays(self) -> tuple[Int64, Float64, Float64, Float64]:
        """The side in the form that kernels take."""
        return self.body, self.point_m, self.position_m, self.rotation

    def mounting(self, now: Geometry) -> tuple[tuple[float, ...], tuple[float, ...], float, tuple[float, ...]]:
        """Return the mounting in the form that kernels take; without a sensor, the identity."""
        if self.sensor == _ABSENT:
            return tuple(np.eye(3).ravel().tolist()), (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0)
        return (
            tuple(now.body_from_sensor[self.sensor].ravel().tolist()),
            tuple(now.lever_arm_m[self.sensor].tolist()),
            float(now.range_offset_m[self.sensor]),
            tuple(self.beam_axis.tolist()),
        )

    def finite(self) -> npt.NDArray[np.bool_]:
        """(n,) whether all numbers are finite."""
        good = (
            np.isfinite(self.point_m).all(1)
            & np.isfinite(self.position_m).all(1)
            & np.isfinite(self.rotation).all((1, 2))
        )
        return np.asarray(good)


class TieObservations:
    """Ties of one pair of sensors, sorted by their pair of traverses."""

    fixed_weight: float | None = None

    def __init__(self, ties: Ties, unknowns: Unknowns) -> None:
        self.kind = ties.kind
        self._on_object = isinstance(ties.second, Known) and ties.second.object is not None
        first, second = _seen(ties.first, unknowns), _other(ties.second, unknowns)
        self.label = _label(ties)
        _check_shapes(ties)
        good = first.finite() & second.finite() & np.isfinite(ties.weight).all((1, 2))
        order = np.lexsort((second.body, first.body))
        order = order[good[order]]
        self._first, self._second = first.taken(order), second.taken(order)
        self._weight = np.ascontiguousarray(ties.weight[order])
        self._seeming = None if ties.normal_sigma_rad is None else _slanted(self._weight, ties.normal_sigma_rad[order])
        self._unusable = int(good.size - order.size)
        self._size = unknowns.mounting_size

    @property
    def count(self) -> int:
        """Number of observations."""
        return len(self._weight)

    @property
    def rows(self) -> int:
        """Number of residuals of one observation."""
        return int(self._weight.shape[1])

    @property
    def unusable(self) -> int:
        """Number of observations that are not finite; they are left out."""
        return self._unusable

    def residuals(self, now: Geometry) -> Float64:
        """Return residuals (count, rows) of unit variance."""
        residual = np.empty((self.count, self.rows))
        tie_residuals(*self._ends(slice(None), now), self._weight, self._on_object, residual)
        return residual

    def metres(self, residuals: Float64) -> Float64 | None:
        """Return (count,) root mean square over a tie's rows, each divided by its weight."""
        scale = np.maximum(np.linalg.norm(self._weight, axis=2), 1e-300)
        length: Float64 = np.sqrt(np.mean((residuals / scale) ** 2, axis=1))
        return length

    def add(self, now: Geometry, weight: Float64, information: Float64, gradient: Float64) -> None:
        """Add Jᵀ diag(weight) J (P, P) and Jᵀ diag(weight) r (P,), by :class:`Geometry`'s local changes."""
        self._add(self._weight, now, weight, information, gradient)

    def add_seeming(self, now: Geometry, weight: Float64, information: Float64) -> None:
        """Add the part of the information (P, P) that errors of the weights' directions alone would give."""
        if self._seeming is not None:
            self._add(self._seeming, now, weight, information, np.zeros(len(information)))

    def _add(self, rows_m: Float64, now: Geometry, weight: Float64, information: Float64, gradient: Float64) -> None:
        for part in self._chunks():
            ties = rows_m[part]
            residual, jacobian = np.empty(ties.shape[:2]), np.empty((*ties.shape[:2], 2 * (MOUNTING + BODY)))
            tie_rows(*self._ends(part, now), ties, self._on_object, weight[part], residual, jacobian)
            for start, end in self._pairs(part):
                rows = jacobian[start - part.start : end - part.start].reshape(-1, jacobian.shape[2])
                where = self._places(int(self._first.body[start]), int(self._second.body[start]))
                used = where >= 0
                local = rows.T @ rows
                slope = rows.T @ residual[start - part.start : end - part.start].ravel()
                # Both ends may share a sensor or traverse, so places repeat and need add.at.
                np.add.at(information, np.ix_(where[used], where[used]), local[np.ix_(used, used)])
                np.add.at(gradient, where[used], slope[used])

    def _chunks(self) -> Iterator[slice]:
        return (slice(begin, min(begin + _CHUNK, self.count)) for begin in range(0, self.count, _CHUNK))

    def _pairs(self, part: slice) -> Iterator[tuple[int, int]]:
        """Return spans of ties in a chunk that share both traverses."""
        inside = self._changes[(self._changes > part.start) & (self._changes < part.stop)].tolist()
        return pairwise([part.start, *inside, part.stop])

    @cached_property
    def _changes(self) -> Int64:
        """Return the ties whose traverses differ from those before."""
        first, second = self._first.body, self._second.body
        return np.flatnonzero((np.diff(first) != 0) | (np.diff(second) != 0)) + 1

    def _ends(self, part: slice, now: Geometry) -> tuple[object, ...]:
        """Return both ends, and the errors of poses followed by an exact one, in the form that kernels take."""
        first, second = self._first.taken(part), self._second.taken(part)
        shift = np.concatenate([now.shift_world_m, np.zeros((1, 3))])
        turn = np.concatenate([now.turn, np.eye(3)[None]])
        return first.arrays(), first.mounting(now), second.arrays(), second.mounting(now), shift, turn

    def _places(self, first_body: int, second_body: int) -> Int64:
        """Return the columns (26,) among all unknowns; −1: none."""
        where = np.full(2 * (MOUNTING + BODY), _ABSENT, dtype=np.int64)
        for half, sensor, body in ((0, self._first.sensor, first_body), (1, self._second.sensor, second_body)):
            begin = half * (MOUNTING + BODY)
            if sensor != _ABSENT:
                where[begin : begin + MOUNTING] = MOUNTING * sensor + np.arange(MOUNTING)
            if body != _ABSENT:
                where[begin + MOUNTING : begin + MOUNTING + BODY] = self._size + BODY * body + np.arange(BODY)
        return where


def _cross(a: Float64, b: Float64) -> Float64:
    """Return cross products (n, k, 3) of vectors a (n, 3) and b (n, k, 3)."""
    x, y, z = (a[:, None, i] for i in range(3))
    return np.stack(
        [y * b[..., 2] - z * b[..., 1], z * b[..., 0] - x * b[..., 2], x * b[..., 1] - y * b[..., 0]], axis=-1
    )


def _seen(seen: Seen, unknowns: Unknowns) -> _Side:
    return _Side(
        unknowns.find_sensor(seen.sensor),
        unknowns.find_traverses(seen.traverse),
        seen.point_sensor_m,
        seen.position_world_m,
        seen.world_from_body,
        np.array(unknowns.priors[seen.sensor].beam_axis_sensor or (0.0, 0.0, 0.0)),
    )


def _other(second: Seen | Known, unknowns: Unknowns) -> _Side:
    if isinstance(second, Seen):
        return _seen(second, unknowns)
    count = len(second.point_m)
    if second.object is None:
        nowhere = np.full(count, _ABSENT, dtype=np.int64)
        return _Side(_ABSENT, nowhere, second.point_m, np.zeros((1, 3)), np.eye(3)[None], np.zeros(3))
    body = np.full(count, unknowns.find_object(second.object), dtype=np.int64)
    pose = unknowns.objects[second.object]
    return _Side(_ABSENT, body, second.point_m, pose.position_world_m[None], pose.world_from_object[None], np.zeros(3))


def _label(ties: Ties) -> str:
    if isinstance(ties.second, Seen):
        names = sorted({ties.first.sensor, ties.second.sensor})
        return " and ".join(names)
    return f"{ties.first.sensor} and {ties.second.object or 'the world'}"


def _check_shapes(ties: Ties) -> None:
    count = len(ties.first.point_sensor_m)
    expected = f"{count} of each"
    sizes = {"first.traverse": len(ties.first.traverse), "weight": len(ties.weight)}
    if ties.normal_sigma_rad is not None:
        sizes["normal_sigma_rad"] = len(ties.normal_sigma_rad)
    if isinstance(ties.second, Seen):
        sizes |= {
            "second.point_sensor_m": len(ties.second.point_sensor_m),
            "second.traverse": len(ties.second.traverse),
        }
    else:
        sizes["second.point_m"] = len(ties.second.point_m)
    for name, size in sizes.items():
        if size != count:
            raise NavigationError(f"ties of kind '{ties.kind}': {size} of {name}", expected=expected)
    if ties.weight.ndim != 3 or ties.weight.shape[2] != 3:
        raise NavigationError(f"ties of kind '{ties.kind}': weights of shape {ties.weight.shape}", expected="(n, k, 3)")


class DirectionObservations:
    """Observations of directions: two angles each, across the direction in the body."""

    fixed_weight: float | None = None

    def __init__(self, one: Directions, unknowns: Unknowns) -> None:
        self.kind, self.label = one.kind, one.sensor
        self._sensor = unknowns.find_sensor(one.sensor)
        good = (
            np.isfinite(one.direction_sensor).all(1)
            & np.isfinite(one.direction_body).all(1)
            & np.isfinite(one.sigma_rad)
            & (one.sigma_rad > 0)
        )
        self._unusable = int((~good).sum())
        self._sensor_axes = one.direction_sensor[good]
        self._across = _across(one.direction_body[good]) / one.sigma_rad[good][:, None, None]

    @property
    def count(self) -> int:
        """Number of observations."""
        return len(self._across)

    @property
    def rows(self) -> int:
        """Number of residuals of one observation."""
        return 2

    @property
    def unusable(self) -> int:
        """Number of observations that are not finite; they are left out."""
        return self._unusable

    def residuals(self, now: Geometry) -> Float64:
        """Return residuals (count, rows) of unit variance."""
        return np.asarray(np.einsum("nki,ni->nk", self._across, self._turned(now)))

    def metres(self, residuals: Float64) -> Float64 | None:
        """Return None, since angles have no length."""
        return None

    def add(self, now: Geometry, weight: Float64, information: Float64, gradient: Float64) -> None:
        """Add Jᵀ diag(weight) J (P, P) and Jᵀ diag(weight) r (P,), by :class:`Geometry`'s local changes."""
        jacobian = _cross(self._turned(now), self._across)
        rows = jacobian * weight[:, None, None]
        begin = MOUNTING * self._sensor + 3
        place = slice(begin, begin + 3)
        information[place, place] += np.einsum("nki,nkj->ij", rows, jacobian)
        gradient[place] += np.einsum("nki,nk->i", rows, self.residuals(now))

    def add_seeming(self, now: Geometry, weight: Float64, information: Float64) -> None:
        """Add nothing: these have no normals."""

    def _turned(self, now: Geometry) -> Float64:
        return np.asarray(self._sensor_axes @ now.body_from_sensor[self._sensor].T)


def _slanted(weight: Float64, normal_sigma_rad: Float64) -> Float64:
    """Return the parts (n, 2 k, 3) that rows (n, k, 3) gain when their directions err by their σ (n,)."""
    length = np.linalg.norm(weight, axis=2)
    unit = weight / np.maximum(length, 1e-300)[..., None]
    across = _across(unit.reshape(-1, 3)) * (length * normal_sigma_rad[:, None]).reshape(-1, 1, 1)
    return np.ascontiguousarray(across.reshape(len(weight), -1, 3))


def _across(direction: Float64) -> Float64:
    """Return (n, 2, 3) unit vectors perpendicular to unit vectors (n, 3) and to each other."""
    least = np.argmin(np.abs(direction), axis=1)
    first = np.cross(direction, np.eye(3)[least])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=1)
