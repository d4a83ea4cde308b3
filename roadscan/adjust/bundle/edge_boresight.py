"""The boresight that range edges show: the turn at which the scores of all pictures are best, its σ, and its rows.

σ is that of the mean of the pictures (sandwich estimator; White 1982): the scatter of the slopes of their scores at the
best turn, over the curvature of the sum. Pictures near one another see the same things, so those two apart count as
dependent (Newey & West 1987). Where another turn is as good, or the sum is flat, edges do not tell.

Range edges of a lidar against edges of a picture: a score for each turn of the camera.

Where one return is much nearer than its neighbour, there is an edge of the nearer thing, and most often of the picture
(Levinson & Thrun 2013, *Automatic online calibration of cameras and lasers*). Neighbours are those of a Delaunay
triangulation of the directions from the lidar, so nothing need be known of its lasers; the edge lies midway between the
two, at the range of the nearer one. A score is the sum, over edges, of the contrast of the picture across the edge,
relative to that of its surroundings. Returns of the moment of a picture are used: what moves is where the picture
shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.kernels.range_edges import continued, scores_of_turns
from roadscan.adjust.observations import CAMERA, COMPONENTS, FIXED, KINDS, MOUNTED, MountingPrior, Observations
from roadscan.compute.array_types import Float32, Float64, UInt8
from roadscan.core.extras import cv2
from roadscan.pictures.lens import PARAMETERS, Lens, derivatives

TURNS_DEG: Final = (np.linspace(-1.8, 1.8, 31), np.linspace(-1.8, 1.8, 31), np.linspace(-2.4, 2.4, 17))
"""Turns that are tried about the camera's axes right, down and ahead (degrees): ± 1.5° and some more, so that the best
one has others around it. A turn about the optical axis moves edges less than half as much."""
OTHERS: Final = 9 + len(PARAMETERS)
"""What moves edges as a turn of the camera does: its lever arm (3), lever arm and turn of the lidar (6), the lens."""
_MARGIN_DEG: Final = 2.0
"""Edges so far beside the picture (degrees) may come into it by a turn."""
_APART_DEG: Final = 1.6
"""Neighbours farther apart than this (degrees) have no edge midway: the lasers of a lidar with 32 are 1.33° apart."""
_JUMP_M, _JUMP = 0.5, 0.1
"""An edge is a leap of the range by this (m), and by this share of it; less is relief."""
_STEP, _FULL = 0.08, 0.4
"""Least share by which the inverse depth of neither side goes on to the other one, and that from which on an edge
counts fully."""
_BLUR_DEG: Final = 0.08
"""1 σ of an edge beside the distance of its returns (degrees): the width of beams, of 0.1 to 0.2°."""
_PIXEL_DEG: Final = 0.1
"""Pictures are reduced to pixels of this size (degrees): lidars resolve no more."""
_DIRECTIONS: Final = 8  # Directions across an edge that have a response each, over half a turn.
_NEAR_PX, _AROUND_PX = 12.0, 15.0
"""Extent of the surroundings whose contrast counts as one, and of those whose response counts as none (reduced px)."""
_NOISE: Final = 2.0
"""Contrast that is noise (grey values a pixel)."""
_STEEP: Final = 0.2
"""Cosine of the angle from the optical axis beyond which no edge is looked for."""


@dataclass(frozen=True)
class RangeEdges:
    """m edges in a picture."""

    point_camera_m: Float64
    """(m, 3) in the camera's axes (right, down, ahead), as its mounting is stated."""
    across: Float64
    """(m, 2) unit vectors from the nearer return to the farther one, along columns and rows."""
    weight: Float64
    """(m,)"""


@dataclass(frozen=True)
class EdgeScores:
    """What the edges of one picture say."""

    edges: int
    score: Float64
    """(31, 31, 17) for `TURNS_DEG`."""
    normal: Float64
    """(3, 3) weighted squares of the derivatives of distances across edges by turns."""
    by_others: Float64
    """(3, 18) the same of turns with `OTHERS`."""


def edges_of(point_camera_m: Float64, lidar_camera_m: Float64) -> RangeEdges:
    """Returns the range edges of returns (n, 3) of a lidar whose place is (3,), both in the camera's axes."""
    from scipy.spatial import Delaunay

    away = point_camera_m - lidar_camera_m
    length = np.linalg.norm(away, axis=1)
    away, length = away[length > 1.0], length[length > 1.0]
    ray = away / length[:, None]
    ahead = ray[:, 2] > _STEEP
    ray, length = ray[ahead], length[ahead]
    tangent = ray[:, :2] / ray[:, 2:]
    tangent, kept = np.unique(tangent, axis=0, return_index=True)
    ray, length = ray[kept], length[kept]
    none = RangeEdges(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))
    if len(ray) < 8 or (np.ptp(tangent, axis=0) == 0.0).any():
        return none
    corner = Delaunay(tangent).simplices.astype(np.int64)
    pairs = np.unique(np.sort(corner[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1), axis=0)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    starts = np.searchsorted(both[:, 0], np.arange(len(ray) + 1)).astype(np.int64)
    near, far = np.where((length[pairs[:, 0]] > length[pairs[:, 1]])[:, None], pairs[:, ::-1], pairs).T
    apart = np.linalg.norm(ray[near] - ray[far], axis=1)
    leap = length[far] - length[near]
    wide = (apart < np.radians(_APART_DEG)) & (leap > _JUMP_M) & (leap > _JUMP * length[near])
    near, far, apart = (np.ascontiguousarray(v[wide]) for v in (near, far, apart))
    inverse, beside = 1.0 / (length * ray[:, 2]), np.ascontiguousarray(both[:, 1])
    gone = continued(starts, beside, tangent, inverse, near, far) - inverse[far]
    come = inverse[near] - continued(starts, beside, tangent, inverse, far, near)
    step = np.minimum(np.minimum(gone, come), inverse[near] - inverse[far]) / inverse[near]
    edge = step > _STEP
    near, far, apart, step = near[edge], far[edge], apart[edge], step[edge]
    middle = ray[near] + ray[far]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    across = tangent[far] - tangent[near]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    blur = np.radians(_BLUR_DEG)
    weight = np.sqrt(np.minimum(step / _FULL, 1.0)) * blur**2 / (blur**2 + apart**2 / 12.0)
    return RangeEdges(lidar_camera_m + middle * length[near][:, None], across, weight)


def responses(picture: UInt8, lens: Lens) -> tuple[Float32, float, float]:
    """Returns contrasts (8, height, width) of a grey picture across directions, less the usual one of the surroundings,
    and by how many pixels of the picture those of the responses are wide and high.
    """
    height, width = picture.shape
    focal = float(lens.parameters[:2].mean())
    step = max(1.0, np.radians(_PIXEL_DEG) * focal)
    size = (max(round(width / step), 8), max(round(height / step), 8))
    small = picture.astype(np.float32)
    small = cv2.resize(small, size, interpolation=cv2.INTER_AREA) if step > 1.0 else small
    small = cv2.GaussianBlur(small, (0, 0), 1.0)
    right, down = (cv2.Sobel(small, cv2.CV_32F, *one, ksize=3) / np.float32(8.0) for one in ((1, 0), (0, 1)))
    around = cv2.GaussianBlur(right * right + down * down, (0, 0), _NEAR_PX)
    right, down = (one / np.sqrt(around + np.float32(_NOISE**2)) for one in (right, down))
    shown = None
    if lens.hidden.size:
        hidden = cv2.resize(lens.hidden.astype(np.uint8), small.shape[::-1], interpolation=cv2.INTER_NEAREST)
        shown = cv2.dilate(hidden, np.ones((7, 7), np.uint8)) == 0
    found = []
    for angle in np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
        own = np.abs(right * np.float32(np.cos(angle)) + down * np.float32(np.sin(angle)))
        own = cv2.GaussianBlur(own / (np.float32(1.0) + own), (0, 0), 1.0)
        own -= cv2.GaussianBlur(own, (0, 0), _AROUND_PX)
        found.append(own if shown is None else np.where(shown, own, np.float32(0.0)))
    return np.array(found, np.float32), width / small.shape[1], height / small.shape[0]


def scores_of(
    point_body_m: Float64, lidar_body_m: Float64, seat: tuple[Float64, Float64], picture: UInt8, lens: Lens
) -> EdgeScores:
    """Returns how well the range edges of returns lie on the edges of a grey picture, for turns of its camera.

    Parameters
    ----------
    point_body_m : (n, 3) returns in the axes of the body at the picture's stamp. lidar_body_m : (3,) of the lidar.
    seat : lever arm (3,) of the camera, and its axes right, down, ahead (3, 3) in those of the body.
    """
    lever, axes = seat
    edges = edges_of((point_body_m - lever) @ axes, (lidar_body_m - lever) @ axes)
    pixel, by_point, by_lens = derivatives(lens, edges.point_camera_m)
    margin = np.radians(_MARGIN_DEG) * lens.parameters[:2]
    size = np.array(lens.size_px, np.float64)
    inside = np.isfinite(pixel).all(axis=1) & ((pixel > -margin) & (pixel < size + margin)).all(axis=1)
    point, across, weight = edges.point_camera_m[inside], edges.across[inside], edges.weight[inside]
    pixel, by_point, by_lens = pixel[inside], by_point[inside], by_lens[inside]
    # A turn of the camera by c moves a point of its axes by point × c.
    slope = np.stack([np.cross(by_point[:, k], point) for k in (0, 1)], axis=1)
    response, wide, high = responses(picture, lens)
    scale = np.array([wide, high])
    direction = np.rint(np.arctan2(across[:, 1], across[:, 0]) * _DIRECTIONS / np.pi).astype(np.int64) % _DIRECTIONS
    score = np.zeros([own.size for own in TURNS_DEG])
    scores_of_turns(
        np.ascontiguousarray((pixel + 0.5) / scale - 0.5), np.ascontiguousarray(slope / scale[:, None]), direction,
        weight, response, tuple(np.radians(own) for own in TURNS_DEG), score,
    )  # fmt: skip
    # Distances across edges, in radians, so that a picture of more pixels does not weigh more.
    own = across / lens.parameters[:2]
    by_place, by_turn = np.einsum("mi,mij->mj", own, by_point), np.einsum("mi,mij->mj", own, slope)
    in_body, away = by_place @ axes.T, point @ axes.T + lever - lidar_body_m
    others = np.concatenate([-in_body, in_body, np.cross(away, in_body), np.einsum("mi,mij->mj", own, by_lens)], axis=1)
    # Not by matrix products: their sums over many rows depend on how many threads the linear algebra has.
    weighted = by_turn * weight[:, None]
    normal, joint = (np.einsum("mi,mj->ij", weighted, own) for own in (by_turn, others))
    return EdgeScores(len(point), score, normal, joint)


KIND: Final = "picture_edge"
_LEAST_PICTURES: Final = 4
"""Pictures, at least: fewer have no scatter to measure."""
_LEAST_EDGES: Final = 1_000
"""Edges of all pictures, at least."""
_OTHER_TURN_DEG: Final = 0.5
"""A turn this far from the best one, about an axis across the optical one (degrees), is another one."""
_BETTER: Final = 3.0
"""The best turn has to be better than each other one by so many σ of the mean of the pictures."""
_LAGS: Final = 2  # Pictures up to so many apart count as dependent.
_DERIVATIVE_STEP: Final = 0.5  # Step of the derivatives of scores, in steps of the turns.
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
    rows, columns = (np.abs(np.arange(total.shape[k]) - at[k]) * step > _OTHER_TURN_DEG for k in (0, 1))
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
    ends = np.concatenate([place + _DERIVATIVE_STEP * np.eye(3), place - _DERIVATIVE_STEP * np.eye(3)])
    value = _value(spline, ends)
    return np.asarray((value[:3] - value[3:]) / (2.0 * _DERIVATIVE_STEP))


def _curvature(spline: Float64, place: Float64) -> Float64:
    """Returns second derivatives (3, 3)."""
    rows = [
        (_slope(spline, place + _DERIVATIVE_STEP * e) - _slope(spline, place - _DERIVATIVE_STEP * e))
        / (2.0 * _DERIVATIVE_STEP)
        for e in np.eye(3)
    ]
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
