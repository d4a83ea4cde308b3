"""Candidates for a target: places where a grid of intensities correlates with the shape.

Mean and contrast are those of each place's surroundings, and cells without a reading do not count (Padfield 2012,
masked normalised cross-correlation). A chequered target may be turned in any way: its picture is correlated with the
second harmonic of the direction from the middle, whose phase is twice the turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadscan.adjust.targets.shapes import Cells, Disc, Shape
from roadscan.compute.array_types import Float64

_SURROUNDINGS = 1.4
"""Radius of the area that is correlated with a disc, in radii of the disc."""
_LEAST_SEEN = 0.6
"""Share of the cells under the shape that must have readings."""
_APART = 0.4
"""Candidates nearer to a likelier one than this share of the size are dropped."""


@dataclass(frozen=True)
class Candidate:
    """A place that may be the target."""

    centre_m: Float64
    """(2,) east and north."""
    turn_rad: float
    """Of a chequered target, east to north; 0 for a disc."""
    likeness: float
    """Normalised correlation."""


def candidates(cells: Cells, cell_m: float, shape: Shape, radius_m: float, least: float, most: int) -> list[Candidate]:
    """Returns places within a radius of the origin that look like the shape, the likeliest first.

    cells : means by the cells of an even grid of `cell_m` through the origin.
    """
    half = _SURROUNDINGS * shape.half_m if isinstance(shape, Disc) else shape.half_m
    reach = int(np.ceil(radius_m / cell_m)) + int(np.ceil(half / cell_m)) + 1
    value, seen = _grid(cells, cell_m, reach)
    likeness, turn = _likeness(value, seen, shape, cell_m)
    middle = (np.arange(-reach, reach) + 0.5) * cell_m
    likeness[np.hypot(middle[None], middle[:, None]) > radius_m] = 0.0
    found: list[Candidate] = []
    while len(found) < most:
        row, column = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
        if likeness[row, column] < least:
            break
        centre = np.array([middle[column], middle[row]])
        found.append(Candidate(centre, float(turn[row, column]), float(likeness[row, column])))
        near = np.hypot(middle[None] - centre[0], middle[:, None] - centre[1]) < _APART * 2 * shape.half_m
        likeness[near] = 0.0
    return found


def _grid(cells: Cells, cell_m: float, reach: int) -> tuple[Float64, Float64]:
    """Returns intensities (2 reach, 2 reach) less their mean, and 1 where there are any; rows to the north."""
    index = np.floor(cells.place_m / cell_m).astype(np.int64) + reach
    inside = np.all((index >= 0) & (index < 2 * reach), axis=1)
    column, row = index[inside].T
    value, seen = np.zeros((2, 2 * reach, 2 * reach))
    seen[row, column] = 1.0
    level = cells.value[inside]
    value[row, column] = level - (level.mean() if level.size else 0.0)
    return value, seen


def _likeness(value: Float64, seen: Float64, shape: Shape, cell_m: float) -> tuple[Float64, Float64]:
    """Returns the correlation of each place's surroundings with the shape, and the turn."""
    from scipy import fft

    half = shape.half_m * (_SURROUNDINGS if isinstance(shape, Disc) else 1.0)
    steps = int(np.ceil(half / cell_m))
    axis = np.arange(-steps, steps + 1) * cell_m
    r = np.hypot(axis[None], axis[:, None])
    support = (r <= half).astype(np.float64)
    size = fft.next_fast_len(value.shape[0] + 2 * steps, real=True)
    spectra = [fft.rfft2(image, (size, size)) for image in (value, value * value, seen)]

    def summed(which: int, weights: Float64) -> Float64:
        product = spectra[which] * np.conj(fft.rfft2(weights, (size, size)))
        around = fft.irfft2(product, (size, size))
        places: Float64 = np.roll(around, (steps, steps), (0, 1))[: value.shape[0], : value.shape[1]]
        return places

    number = summed(2, support)
    enough = number > _LEAST_SEEN * support.sum()
    number = np.maximum(number, 1.0)
    total = summed(0, support)
    spread = np.sqrt(np.maximum(summed(1, support) - total * total / number, 1e-9))
    if isinstance(shape, Disc):
        white = np.clip((shape.half_m - r) / cell_m + 0.5, 0.0, 1.0)
        white -= np.clip((shape.centre_m / 2 - r) / cell_m + 0.5, 0.0, 1.0)
        under = summed(2, white)
        contrast = np.sqrt(np.maximum(summed(2, white * white) - under * under / number, 1e-9))
        alike = (summed(0, white) - total * under / number) / (spread * contrast)
        return np.where(enough, alike, 0.0), np.zeros_like(alike)
    twice = 2.0 * np.arctan2(axis[:, None], axis[None])
    cos = summed(0, support * np.cos(twice)) - total * summed(2, support * np.cos(twice)) / number
    sin = summed(0, support * np.sin(twice)) - total * summed(2, support * np.sin(twice)) / number
    alike = np.hypot(cos, sin) / (spread * np.sqrt(number / 2.0))
    return np.where(enough, alike, 0.0), 0.5 * np.arctan2(-cos, sin)
