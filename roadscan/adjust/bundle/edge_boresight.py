"""The boresight that range edges show: the turn at which the scores of all pictures are best, its σ, and its rows.

σ is that of the mean of the pictures (sandwich estimator; White 1982): the scatter of the slopes of their scores at the
best turn, over the curvature of the sum. Pictures near one another see the same things, so those two apart count as
dependent (Newey & West 1987). Where another turn is as good, or the sum is flat, edges do not tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.bundle.range_edges import OTHERS, TURNS_DEG, EdgeScores
from roadscan.adjust.observations import CAMERA, COMPONENTS, FIXED, KINDS, MOUNTED, Observations
from roadscan.adjust.process import MountingPrior
from roadscan.compute.array_types import Float64
from roadscan.pictures.lens import PARAMETERS

KIND: Final = "picture_edge"
_LEAST_PICTURES: Final = 4
"""Pictures, at least: fewer have no scatter to measure."""
_LEAST_EDGES: Final = 1_000
"""Edges of all pictures, at least."""
_APART_DEG: Final = 0.5
"""A turn this far from the best one, about an axis across the optical one (degrees), is another one."""
_BETTER: Final = 3.0
"""The best turn has to be better than each other one by so many σ of the mean of the pictures."""
_LAGS: Final = 2  # Pictures up to so many apart count as dependent.
_STEP: Final = 0.5  # Step of the derivatives of scores, in steps of the turns.
_FLAT_DEG: Final = 1.0
"""σ about an axis across the optical one beyond which edges do not tell it (degrees)."""
_FIRST_PLACE: Final = 3_000_000_000
"""Number of the first pair of camera and lidar as a place: beyond all of control and of tie points."""


@dataclass(frozen=True)
class Sighted:
    """A camera and a lidar whose edges were compared."""

    camera: str
    lidar: str
    camera_seat: int
    """Number of the camera's mounting in the adjustment, −1: not estimated."""
    lidar_seat: int
    lens: int
    """Number of its lens, −1: not estimated."""
    body_from_opencv: Float64
    """(3, 3) of the camera, as stated."""
    stated_sigma_rad: Float64
    """(3,) 1 σ of the stated boresight about the axes of the body; 0 where it is not estimated."""
    is_assumed: bool = False
    """True where the rig file states no such σ."""


@dataclass(frozen=True)
class EdgeBoresight:
    """What edges say of the boresight of a camera."""

    of: Sighted
    pictures: int
    edges: int
    turn: Float64
    """(3,) by which the camera is turned from how it is stated, about the axes of the body (rad)."""
    covariance: Float64
    """(3, 3) rad²"""
    by_others: Float64
    """(3, 18) what lever arms, the lidar's mounting and the lens add to that turn when they are off: `OTHERS`."""
    why_not: str
    """Why it does not count; "" where it does."""

    @property
    def counts(self) -> bool:
        """Returns whether it is an observation of the adjustment."""
        return not self.why_not and self.of.camera_seat >= 0

    @property
    def sigma(self) -> Float64:
        """Returns 1 σ (3,) about the axes of the body (rad)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def boresight_of(of: Sighted, scores: Sequence[EdgeScores], shared_rad: float) -> EdgeBoresight:
    """Returns the boresight at which the scores of pictures, in the order of time, are best together.

    shared_rad : 1 σ of what all edges are off in common.
    """
    from scipy.ndimage import spline_filter

    used = [one for one in scores if one.edges]
    edges = sum(one.edges for one in used)
    none = np.zeros(3), np.zeros((3, 3)), np.zeros((3, OTHERS))
    if len(used) < _LEAST_PICTURES or edges < _LEAST_EDGES:
        why = f"{edges:,} range edges in {len(used):,} pictures: too few"
        return EdgeBoresight(of, len(used), edges, *none, why)
    each = np.array([one.score for one in used])
    each /= np.sqrt(np.mean(each.reshape(len(each), -1).var(axis=1)))
    total = each.sum(axis=0)
    at = np.array(np.unravel_index(int(np.argmax(total)), total.shape))
    if ((at == 0) | (at == np.array(total.shape) - 1)).any():
        return EdgeBoresight(of, len(used), edges, *none, "the best turn is the largest that was tried")
    why = _rival(each, total, at)
    splines = np.array([spline_filter(own, order=3, output=np.float64) for own in each])
    place = _best(splines.sum(axis=0), at)
    slopes = np.array([_slope(own, place) for own in splines])
    curve = -_curvature(splines.sum(axis=0), place)
    if (np.linalg.eigvalsh(curve) <= 0.0).any():
        return EdgeBoresight(of, len(used), edges, *none, why or "no turn is better than those about it")
    steps = np.radians([own[1] - own[0] for own in TURNS_DEG])
    inverse = np.linalg.inv(curve)
    own = steps[:, None] * (inverse @ _scatter(slopes) @ inverse) * steps
    if (np.sqrt(np.diag(own))[:2] > np.radians(_FLAT_DEG)).any():
        why = why or "the best turn is not determined: the edges of single pictures do not agree"
    turn = np.array([np.radians(t[0]) for t in TURNS_DEG]) + place * steps
    axes = of.body_from_opencv
    covariance = axes @ (own + shared_rad**2 * np.eye(3)) @ axes.T
    normal, others = (sum(v) for v in zip(*((one.normal, one.by_others) for one in used), strict=True))
    moved = axes @ np.linalg.solve(normal, others)
    return EdgeBoresight(of, len(used), edges, axes @ turn, covariance, moved, why)


def _rival(each: Float64, total: Float64, at: npt.NDArray[np.int64]) -> str:
    """Returns why the best turn is none, where another one is as good."""
    step = float(TURNS_DEG[0][1] - TURNS_DEG[0][0])
    rows, columns = (np.abs(np.arange(total.shape[k]) - at[k]) * step > _APART_DEG for k in (0, 1))
    other = np.where((rows[:, None] | columns)[:, :, None], total, -np.inf)
    second = np.unravel_index(int(np.argmax(other)), total.shape)
    better = each[:, at[0], at[1], at[2]] - each[:, second[0], second[1], second[2]]
    if better.mean() > _BETTER * better.std(ddof=1) / np.sqrt(better.size):
        return ""
    off = [TURNS_DEG[k][second[k]] - TURNS_DEG[k][at[k]] for k in (0, 1)]
    return f"a turn {np.hypot(*off):.1f}° away is nearly as good"


def _best(spline: Float64, at: npt.NDArray[np.int64]) -> Float64:
    """Returns where the sum is greatest (3,), in steps, by Newton's method within a step of its greatest node."""
    place = at.astype(np.float64)
    for _ in range(20):
        slope, curve = _slope(spline, place), _curvature(spline, place)
        values, vectors = np.linalg.eigh(curve)
        values = np.minimum(values, -1e-3 * max(float(np.abs(values).max()), 1e-12))
        step = np.clip(-(vectors @ ((vectors.T @ slope) / values)), -0.3, 0.3)
        place = np.clip(place + step, at - 1.0, at + 1.0)
        if np.abs(step).max() < 1e-4:
            break
    return place


def _value(spline: Float64, places: Float64) -> Float64:
    from scipy.ndimage import map_coordinates

    return np.asarray(map_coordinates(spline, places.T, order=3, mode="nearest", prefilter=False))


def _slope(spline: Float64, place: Float64) -> Float64:
    """Returns derivatives (3,) a step."""
    ends = np.concatenate([place + _STEP * np.eye(3), place - _STEP * np.eye(3)])
    value = _value(spline, ends)
    return np.asarray((value[:3] - value[3:]) / (2.0 * _STEP))


def _curvature(spline: Float64, place: Float64) -> Float64:
    """Returns second derivatives (3, 3)."""
    rows = [(_slope(spline, place + _STEP * e) - _slope(spline, place - _STEP * e)) / (2.0 * _STEP) for e in np.eye(3)]
    whole = np.array(rows)
    return np.asarray(0.5 * (whole + whole.T))


def _scatter(slopes: Float64) -> Float64:
    """Returns the covariance (3, 3) of the sum of slopes (k, 3), whose neighbours are dependent."""
    count = len(slopes)
    away = slopes - slopes.mean(axis=0)
    alone = away.T @ away
    found = alone.copy()
    for lag in range(1, min(_LAGS, count - 1) + 1):
        with_next = away[:-lag].T @ away[lag:]
        found += (1.0 - lag / (_LAGS + 1.0)) * (with_next + with_next.T)
    # Neighbours that happen to differ make no sum better known than independent ones do.
    values, vectors = np.linalg.eigh(found - alone)
    found = alone + (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(found * count / max(count - 3, 1))


def edge_observations(found: Sequence[EdgeBoresight]) -> Observations:
    """Returns three observations of each boresight that counts: turns about the axes of its covariance (rad)."""
    parts = []
    for number, one in enumerate(found):
        if not one.counts:
            continue
        values, vectors = np.linalg.eigh(one.covariance)
        seats = np.zeros((3, 2, len(MOUNTED)))
        moved = vectors.T @ one.by_others
        seats[:, 0, :3], seats[:, 0, 3:6] = moved[:, :3], vectors.T
        seats[:, 1, :6] = moved[:, 3:9]
        filmed = np.zeros((3, len(CAMERA)))
        filmed[:, : len(PARAMETERS)] = moved[:, 9:]
        sensors = np.array([one.of.camera_seat, one.of.lidar_seat], np.int32)
        parts.append(
            Observations(
                np.full(3, KINDS.index(KIND), np.uint8), np.full((3, 2), FIXED, np.int32), np.zeros((3, 2), np.int64),
                np.zeros((3, 2, len(COMPONENTS))), vectors.T @ one.turn, np.sqrt(values), np.zeros(3, np.int64),
                np.full(3, _FIRST_PLACE + number), np.zeros(3), np.tile(sensors, (3, 1)), seats,
                np.full(3, one.of.lens, np.int32), filmed,
            )
        )  # fmt: skip
    return Observations.joined(parts)


def widened(priors: Sequence[MountingPrior], found: Sequence[EdgeBoresight]) -> tuple[MountingPrior, ...]:
    """Returns priors of mountings whose σ of a boresight, where the rig file states none, is at least the turn that
    edges show: an assumption would hold it back.
    """
    wider = list(priors)
    for one in found:
        if one.counts and one.of.is_assumed:
            own = wider[one.of.camera_seat]
            sigma = own.sigma.copy()
            sigma[3:6] = np.where(sigma[3:6] > 0.0, np.maximum(sigma[3:6], np.abs(one.turn)), 0.0)
            wider[one.of.camera_seat] = replace(own, sigma=sigma)
    return tuple(wider)
