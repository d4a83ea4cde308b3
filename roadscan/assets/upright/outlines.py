"""Outlines of plates: which shape fits the returns of a plane, and how large it is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

_DIRECTIONS: Final = 36
_TRIMMED: Final = 0.0005
_BEYOND: Final = 0.35
"""The edge lies past the outermost return by this share of the mean distance from return to return: none of evenly
spread returns would make it 0, a grid of them 0.5."""
_NEAR_EDGE_M, _REACH_M, _LEAST_REACH_M = 0.15, 0.25, 0.02
"""Points so near to an edge tell where it is; it is looked for so far to both sides, at least so far in the end (m)."""
_ROUNDS, _TRIED = 5, 41
_SOFT_M: Final = 0.004
"""Scale of the logistic distribution of how far returns of a plate lie off in it (m)."""
_STRAY, _STOPPED = 1e-4, 0.05
"""Share of the points that belong to something else, and of the lines that would have hit but for something before."""
_SQUARE: Final = 0.08
"""Sides that differ by less than this share make a square."""


@dataclass(frozen=True)
class Outline:
    """The shape that fits best."""

    shape: str
    middle: tuple[float, float]
    """Of its bounding box, in the coordinates of the plane (m)."""
    width_m: float
    height_m: float
    misfit_m: float
    """Root mean square distance of the returns' hull from it."""
    sigma_m: float = math.inf
    """1 σ of width and height, the greater one, where lines that missed are known."""


def outline_of(points: Float64, misses: Float64 | None = None) -> Outline:
    """Best of rectangle, disc, octagon, diamond and triangles about points (n, 2) of a plane, second axis upwards.

    A convex shape is known by how far it reaches in each direction (its support function), which is linear in its place
    and its size; each template is fitted by least squares. Its edges lie between the points and the lines that missed.

    misses : (m, p, 2) lines past the plate, each as p places, that did not hit it.
    """
    angle = np.arange(_DIRECTIONS) * (2.0 * math.pi / _DIRECTIONS)
    ways = np.column_stack([np.cos(angle), np.sin(angle)])
    reach = np.sort(points @ ways.T, axis=0)[-1 - int(_TRIMMED * len(points))]
    best = None
    for shape, templates in _TEMPLATES.items():
        columns = np.column_stack([ways, *[t(ways) for t in templates]])
        solution, *_ = np.linalg.lstsq(columns, reach, rcond=None)
        misfit = float(np.sqrt(np.mean((columns @ solution - reach) ** 2)))
        if (solution[2:] > 0.02).all() and (best is None or misfit < best[0]):
            best = (misfit, shape, solution)
    if best is None:
        low, high = points.min(axis=0), points.max(axis=0)
        middle = (low + high) / 2
        wide, tall = map(float, high - low)
        return Outline("other", (float(middle[0]), float(middle[1])), wide, tall, math.inf)
    misfit, shape, solution = best
    width, height = float(solution[2]), float(solution[-1])
    beyond = _BEYOND * math.sqrt(width * height / len(points))
    width, height = width + 2.0 * beyond, height + 2.0 * beyond
    middle, sigma = (float(solution[0]), float(solution[1])), math.inf
    if misses is not None and len(misses):
        middle, (width, height), sigma = _between(shape, (middle, (width, height)), points, misses)
    if shape.startswith("triangle"):
        height = width * math.sqrt(3.0) / 2.0
    if shape == "rectangle" and abs(width - height) < _SQUARE * max(width, height):
        shape = "square"
    return Outline(shape.split()[0], middle, width, height, misfit, sigma)


def _between(
    shape: str, start: tuple[tuple[float, float], tuple[float, float]], points: Float64, misses: Float64
) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Middle, width and height of a shape between the points on it and the lines past it, and σ of its size.

    Each parameter in turn becomes the mean of its distribution, given the others. Few points may lie outside, and some
    lines may have been stopped before they came to the plate.
    """
    (x, y), (width, height) = start
    is_box = shape == "rectangle"
    at = np.array([x - width / 2, x + width / 2, y - height / 2, y + height / 2] if is_box else [x, y, width])
    apart = math.sqrt(width * height / len(points))
    outwards = np.array([-1.0, 1.0, -1.0, 1.0] if is_box else [0.0, 0.0, 0.5]) / apart
    points = points[_outside(shape, at[None], points)[0] > -_NEAR_EDGE_M]
    spread = np.full(at.size, _NEAR_EDGE_M)
    for _ in range(_ROUNDS):
        for k in range(at.size):
            tried = np.repeat(at[None], _TRIED, axis=0)
            tried[:, k] += np.linspace(-1.0, 1.0, _TRIED) * min(max(4.0 * float(spread[k]), _LEAST_REACH_M), _REACH_M)
            odds = -tried @ outwards
            odds += np.log(_STRAY + (1.0 - _STRAY) * _share(-_outside(shape, tried, points))).sum(axis=1)
            missed = _outside(shape, tried, misses.reshape(-1, 2)).reshape(_TRIED, *misses.shape[:2]).min(axis=2)
            odds += np.log(_STOPPED + (1.0 - _STOPPED) * _share(missed)).sum(axis=1)
            weight = np.exp(odds - odds.max())
            weight /= weight.sum()
            at[k] = float(weight @ tried[:, k])
            spread[k] = math.sqrt(float(weight @ (tried[:, k] - at[k]) ** 2))
    if is_box:
        sigma = max(math.hypot(spread[0], spread[1]), math.hypot(spread[2], spread[3]))
        middle = float(at[0] + at[1]) / 2, float(at[2] + at[3]) / 2
        return middle, (float(at[1] - at[0]), float(at[3] - at[2])), sigma
    return (float(at[0]), float(at[1])), (float(at[2]), float(at[2])), float(spread[2])


def _share(past_m: Float64) -> Float64:
    """Probability that something lies on the right side of an edge, by how far it does."""
    share: Float64 = 1.0 / (1.0 + np.exp(np.clip(-past_m / _SOFT_M, -50.0, 50.0)))
    return share


def _outside(shape: str, tried: Float64, points: Float64) -> Float64:
    """How far (g, n) points (n, 2) lie outside of shapes of g places and sizes; negative inside."""
    x, y = points.T
    if shape == "rectangle":
        left, right, low, high = tried.T[:, :, None]
        box: Float64 = np.maximum(np.maximum(left - x, x - right), np.maximum(low - y, y - high))
        return box
    x, y, size = x - tried[:, :1], y - tried[:, 1:2], tried[:, 2:]
    out: Float64 = np.hypot(x, y) - size / 2 if shape == "round" else np.full(x.shape, -math.inf)
    for degrees in _SIDES.get(shape, ()):
        way = np.array([[math.cos(math.radians(degrees)), math.sin(math.radians(degrees))]])
        reach = float(_TEMPLATES[shape][0](way)[0])
        np.maximum(out, x * way[0, 0] + y * way[0, 1] - size * reach, out=out)
    return out


def _disc(ways: Float64) -> Float64:
    return np.full(len(ways), 0.5)


def _octagon(ways: Float64) -> Float64:
    corners = np.deg2rad(22.5 + 45.0 * np.arange(8))
    radius = 0.5 / math.cos(math.pi / 8)
    out: Float64 = radius * np.max(ways @ np.array([np.cos(corners), np.sin(corners)]), axis=1)
    return out


def _diamond(ways: Float64) -> Float64:
    out: Float64 = 0.5 * np.abs(ways).max(axis=1)
    return out


def _triangle(ways: Float64) -> Float64:
    """Equal sides, one of them below; its bounding box has the width 1."""
    half = math.sqrt(3.0) / 4.0
    out: Float64 = np.max(ways @ np.array([[-0.5, 0.5, 0.0], [-half, -half, half]]), axis=1)
    return out


def _triangle_down(ways: Float64) -> Float64:
    return _triangle(ways * np.array([1.0, -1.0]))


_TEMPLATES: Final = {
    "rectangle": (lambda w: 0.5 * np.abs(w[:, 0]), lambda w: 0.5 * np.abs(w[:, 1])),
    "round": (_disc,),
    "octagon": (_octagon,),
    "diamond": (_diamond,),
    "triangle": (_triangle,),
    "triangle down": (_triangle_down,),
}
"""Support functions for a width, or a width and a height, of 1."""
_SIDES: Final = {
    "octagon": range(0, 360, 45),
    "diamond": range(45, 360, 90),
    "triangle": (30, 150, 270),
    "triangle down": (90, 210, 330),
}
"""Directions of the sides' normals (degrees)."""
