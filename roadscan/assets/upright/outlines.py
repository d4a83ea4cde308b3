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


def outline_of(points: Float64) -> Outline:
    """Best of rectangle, disc, octagon, diamond and triangles about points (n, 2) of a plane, second axis upwards.

    A convex shape is known by how far it reaches in each direction (its support function), which is linear in its place
    and its size; each template is fitted by least squares.
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
    if shape.startswith("triangle"):
        height = width * math.sqrt(3.0) / 2.0
    if shape == "rectangle" and abs(width - height) < _SQUARE * max(width, height):
        shape = "square"
    return Outline(shape.split()[0], (float(solution[0]), float(solution[1])), width, height, misfit)


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
