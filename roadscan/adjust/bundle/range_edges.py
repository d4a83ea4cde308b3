"""Range edges of a lidar against edges of a picture: a score for each turn of the camera.

Where one return is much nearer than its neighbour, there is an edge of the nearer thing, and most often of the picture
(Levinson & Thrun 2013, *Automatic online calibration of cameras and lasers*). Neighbours are those of a Delaunay
triangulation of the directions from the lidar, so nothing need be known of its lasers; the edge lies midway between the
two, at the range of the nearer one. A score is the sum, over edges, of the contrast of the picture across the edge,
relative to that of its surroundings. Returns of the moment of a picture are used: what moves is where the picture
shows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.adjust.kernels.range_edges import continued, scores_of_turns
from roadscan.compute.array_types import Float32, Float64, UInt8
from roadscan.core.extras import cv2
from roadscan.pictures.lens import PARAMETERS, derivatives
from roadscan.pictures.views import Lens

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
