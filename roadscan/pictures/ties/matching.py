"""Matches of two pictures: alike, along the epipolar line that the poses predict, and in agreement with one another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float32, Float64, Int64, UInt8
from roadscan.pictures.ties.features import FARTHEST

_RATIO: Final = 0.85
"""Distance to the best descriptor over that to the second best in the band, at most; Lowe (2004) takes 0.8 over all."""
_STEPS: Final = 12  # Rounds of re-weighting from the width of the band down to the noise of a feature.
_NOISE_PX: Final = 1.0
"""1 σ of the place of a feature across the epipolar line (px), for the last rounds."""
_WITHIN: Final = 3.0  # A match lies within so many σ of the epipolar line, in the end.
_LEAST: Final = 12
"""Matches of two pictures, at least: with fewer, chance agrees as well with five unknowns."""
_LEAST_BASE_M: Final = 1e-3
"""Two pictures that were taken nearer to each other (m) have no epipolar lines."""
_LOOSEST_RAD: Final = 0.1
"""1 σ of the direction of the base, at most (rad): beyond it the band would be the picture."""
_NEAR_EPIPOLE: Final = 0.02
"""Sine of the angle between a ray and the base below which a ray has no epipolar line."""


@dataclass(frozen=True)
class Relative:
    """The second camera as seen from the first, by the poses."""

    turn: Float64
    """(3, 3) second camera's axes from the first's."""
    base: Float64
    """(3,) centre of the second camera in the first one's axes (m)."""
    sigma_turn_rad: float
    """1 σ of the turn about each axis."""
    sigma_direction_rad: float
    """1 σ of the direction of the base about each axis."""


def matches(
    first: tuple[Float64, UInt8], second: tuple[Float64, UInt8], relative: Relative, pixel_rad: float
) -> tuple[Int64, int]:
    """Returns rows (m, 2) of the features of two pictures that show the same place, and how many other ones look alike
    but contradict the epipolar geometry: what moved, and what is alike by chance.

    Candidates are mutually the best in the band about the epipolar line that follows from the σ of the poses. The
    relative pose is then estimated from all of them, with weights that become narrower from round to round (graduated
    non-convexity, Blake & Zisserman 1987) and the poses as prior; what lies beyond 3 px of its line is left out.

    Parameters
    ----------
    first, second : rays (k, 3) in the camera's axes, unit length, and descriptors (k, 128).
    pixel_rad : angle of a pixel.
    """
    none = np.zeros((0, 2), np.int64)
    if np.linalg.norm(relative.base) < _LEAST_BASE_M or not len(first[0]) or not len(second[0]):
        return none, 0
    # A base that is known badly in relation to its length turns the epipolar lines.
    sigma = float(np.hypot(relative.sigma_turn_rad, min(relative.sigma_direction_rad, _LOOSEST_RAD)))
    band = _WITHIN * (sigma + _NOISE_PX * pixel_rad)
    pairs = _alike(first, second, relative, band)
    if len(pairs) < _LEAST:
        return none, len(pairs)
    rays = first[0][pairs[:, 0]], second[0][pairs[:, 1]]
    away = _fitted(rays, relative, band, _NOISE_PX * pixel_rad)
    kept = np.abs(away) <= _WITHIN * _NOISE_PX * pixel_rad
    found = pairs[kept] if int(kept.sum()) >= _LEAST else none
    return found, len(pairs) - len(found)


def _alike(first: tuple[Float64, UInt8], second: tuple[Float64, UInt8], relative: Relative, band: float) -> Int64:
    """Returns rows (m, 2) of features that are each other's best within a band about the epipolar lines (rad)."""
    one, other = (_unit(own[1]) for own in (first, second))
    likeness = one @ other.T
    base = relative.base / np.linalg.norm(relative.base)
    normal = np.cross(base, first[0])
    steep = np.linalg.norm(normal, axis=1)
    turned = second[0] @ relative.turn
    normal = (normal / np.maximum(steep, _NEAR_EPIPOLE)[:, None]).astype(np.float32)
    off = np.abs(normal @ turned.T.astype(np.float32))
    # At small angles to the base a line is known no better than the base's direction: the band takes them all.
    likeness[off > np.float32(band)] = -1.0
    rows = np.arange(len(one))
    best = likeness.argmax(axis=1)
    top = likeness[rows, best]
    mutual = likeness.argmax(axis=0)[best] == rows
    likeness[rows, best] = -1.0
    distance, next_best = np.sqrt(np.maximum(2.0 - 2.0 * top, 0.0)), np.sqrt(2.0 - 2.0 * likeness.max(axis=1))
    good = mutual & (distance < FARTHEST) & (distance < _RATIO * next_best) & (top > -1.0)
    return np.stack([rows[good], best[good]], axis=-1).astype(np.int64)


def _unit(descriptor: UInt8) -> Float32:
    values = descriptor.astype(np.float32)
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6), np.float32)


def _fitted(rays: tuple[Float64, Float64], relative: Relative, band: float, noise: float) -> Float64:
    """Returns the angle (m,) of each match to its epipolar line, for the relative pose that most of them agree with."""
    from scipy.spatial.transform import Rotation

    turn, base = relative.turn.copy(), relative.base / np.linalg.norm(relative.base)
    sigma_base = min(relative.sigma_direction_rad, _LOOSEST_RAD)
    prior = 1.0 / np.array([*[relative.sigma_turn_rad**2] * 3, *[sigma_base**2] * 2])
    total = np.zeros(5)
    for scale in np.geomspace(max(band, noise), noise, _STEPS):
        residual, slope, across = _epipolar(rays, turn, base)
        weight = 1.0 / (1.0 + (residual / scale) ** 2) ** 2 / scale**2
        matrix = (slope * weight[:, None]).T @ slope + np.diag(prior)
        step = np.linalg.solve(matrix, -(slope * weight[:, None]).T @ residual - prior * total)
        total = total + step
        turn = Rotation.from_rotvec(step[:3]).as_matrix() @ turn
        base = base + across @ step[3:]
        base = base / np.linalg.norm(base)
    return _epipolar(rays, turn, base)[0]


def _epipolar(rays: tuple[Float64, Float64], turn: Float64, base: Float64) -> tuple[Float64, Float64, Float64]:
    """Returns angles (m,) to the epipolar planes, derivatives (m, 5) by a turn of the second camera and a turn of the
    base, and the two directions (3, 2) in which the base turns.
    """
    one, other = rays
    turned = other @ turn
    normal = np.cross(base, one)
    steep = np.maximum(np.linalg.norm(normal, axis=1), _NEAR_EPIPOLE)
    residual = np.einsum("ni,ni->n", normal, turned) / steep
    helper = np.eye(3)[int(np.argmin(np.abs(base)))]
    first = np.cross(base, helper)
    first /= np.linalg.norm(first)
    across = np.stack([first, np.cross(base, first)], axis=-1)
    # exp(ω) turn: the ray becomes turnᵀ exp(−ω) ray, so it changes by turnᵀ (ray × ω).
    in_second = normal @ turn.T
    by_turn = np.cross(in_second, other)
    by_base = np.stack([np.einsum("ni,ni->n", np.cross(across[:, k], one), turned) for k in (0, 1)], axis=-1)
    return residual, np.concatenate([by_turn, by_base], axis=1) / steep[:, None], across
