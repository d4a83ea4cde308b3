"""Small grey pictures of targets, with the outline where each was found."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadscan.adjust.targets.shapes import Disc, Shape
from roadscan.adjust.targets.values import TargetPicture
from roadscan.compute.array_types import Float64

_PIXELS_PER_SIZE = 48  # Pixels across half the size of a target.
_MOST_PIXELS = 192  # Largest edge of an image (pixels).
_DARKEST, _BRIGHTEST = 1.0, 99.5
"""Percentiles of the intensity that become black and white."""


def picture_of(
    place_m: Float64, value: Float64, half_width_m: float, shape: Shape, outlines: Float64, origin_m: Float64
) -> TargetPicture:
    """Returns the image of a square around a centre, with the outline of a shape dashed in white and black.

    Parameters
    ----------
    place_m : (n, 2) of readings, from the middle (m); value : (n,) intensities.
    half_width_m : half of the square's edge.
    outlines : (k, 4) east, north (m, from the middle), turn (rad), size over the stated size, of each shape found.
    origin_m : (2,) map coordinates of the middle.
    """
    from scipy.ndimage import distance_transform_edt

    pixels = int(np.clip(round(half_width_m / shape.half_m * _PIXELS_PER_SIZE), 24, _MOST_PIXELS))
    cell = 2.0 * half_width_m / pixels
    inside = np.all(np.abs(place_m) < half_width_m, axis=1)
    column = ((place_m[inside, 0] + half_width_m) / cell).astype(np.int64).clip(0, pixels - 1)
    row = ((half_width_m - place_m[inside, 1]) / cell).astype(np.int64).clip(0, pixels - 1)
    number = row * pixels + column
    count = np.bincount(number, minlength=pixels**2).reshape(pixels, pixels)
    total = np.bincount(number, value[inside], minlength=pixels**2).reshape(pixels, pixels)
    grey = np.zeros((pixels, pixels), np.uint8)
    if inside.any():
        mean = total / np.maximum(count, 1)
        nearest = distance_transform_edt(count == 0, return_distances=False, return_indices=True)
        mean = mean[tuple(nearest)]
        low, high = np.percentile(mean, [_DARKEST, _BRIGHTEST])
        grey = np.clip(np.rint((mean - low) / max(high - low, 1e-9) * 255.0), 0, 255).astype(np.uint8)
    for outline in outlines:
        _draw(grey, _outline(shape, outline), half_width_m, cell)
    west, north = float(origin_m[0]) - half_width_m, float(origin_m[1]) + half_width_m
    return TargetPicture(grey, west, north, cell)


def _outline(shape: Shape, outline: Float64) -> Float64:
    """Returns (m, 2) points along the outline and across the middle."""
    east, north, turn, scale = outline
    half = shape.half_m * scale
    along = np.linspace(-1.0, 1.0, 8 * _PIXELS_PER_SIZE)
    cross = 0.15 * half * along
    zero = np.zeros_like(along)
    if isinstance(shape, Disc):
        around = np.stack([half * np.cos(np.pi * along), half * np.sin(np.pi * along)], axis=-1)
    else:
        sides = [(along, zero + 1), (zero + 1, -along), (-along, zero - 1), (zero - 1, along)]
        around = np.concatenate([half * np.stack(side, axis=-1) for side in sides])
    points = np.concatenate([around, np.stack([cross, zero], axis=-1), np.stack([zero, cross], axis=-1)])
    cos, sin = np.cos(turn), np.sin(turn)
    turned: Float64 = points @ np.array([[cos, sin], [-sin, cos]]) + [east, north]
    return turned


def _draw(grey: npt.NDArray[np.uint8], points: Float64, half_width_m: float, cell_m: float) -> None:
    """Set the pixels along points to white and black in turns."""
    column = np.floor((points[:, 0] + half_width_m) / cell_m).astype(np.int64)
    row = np.floor((half_width_m - points[:, 1]) / cell_m).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < grey.shape[1]) & (row < grey.shape[0])
    column, row = column[inside], row[inside]
    grey[row, column] = np.where((row + column) // 3 % 2 == 0, 255, 0)
