"""Images of a patch that are shifted against each other: its relief and its paint, without slow variation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.adjust.kernels.patch_cells import Splat, splat
from roadscan.adjust.patches import Patch
from roadscan.compute.array_types import Float64

BLUR_CELLS: Final = 1.2
"""σ (cells) of the Gaussian that smooths images: else interpolation between cells would damp their noise and draw
shifts to half cells."""
_FILLED: Final = 0.3
"""A cell is seen if it has this share of the usual weight."""
_DEEPEST_M: Final = 0.05
"""Readings farther than this from the height of their cell (m) are not road."""
_EDGE_CELLS: Final = 3  # Edge of the square of cells around one that must all be seen.
_LEAST_CELLS: Final = 64  # An image with fewer cells is empty.
_FEW: Final = 2000
"""Readings on either side of the middle from which the spacing of readings is measured."""


@dataclass(frozen=True)
class Picture:
    """Relief (m) or intensity (standard deviations of the picture) of a patch."""

    value: Float64
    """(k, k; along, across) NaN where nothing was seen."""
    sampling_m2: Float64
    """(2, 2; along, across) variance of the position of an edge that runs along the grid of the readings."""


def pictures_of(patch: Patch, cell_m: float) -> tuple[Picture, Picture]:
    """Returns relief and intensity of a patch in cells of `cell_m`."""
    edge = max(round(2.0 * patch.place.radius_m / cell_m), 8)
    half, inside = 0.5 * edge * cell_m, patch.inside
    sums = Splat._make(np.zeros((edge, edge)) for _ in range(3))
    level = float(np.nanmedian(patch.height_m)) if patch.seen.any() else 0.0
    splat(
        inside.along_m + half, inside.across_m + half, inside.height_m, inside.intensity, inside.number,
        patch.height_m.ravel(), _DEEPEST_M, level, cell_m, sums,
    )  # fmt: skip
    relief, paint = _without_slow(sums.mass, (sums.height, sums.intensity))
    if np.isfinite(paint).any():
        paint = paint / max(float(np.nanstd(paint)), 1e-9)
    sampling = _sampling(patch)
    return Picture(relief, sampling), Picture(paint, sampling)


def _sampling(patch: Patch) -> Float64:
    """Returns the variance (2, 2) of an edge's position between readings: spacing² / 12, along a profile and beside it.

    An edge that runs along the grid is displaced by the same part of a step over its whole length, which no
    residual shows.
    """
    inside = patch.inside
    each = float(patch.seen.sum()) * patch.cell_m**2 / max(inside.pose.size, 1)
    few = slice(max(inside.pose.size // 2 - _FEW, 0), inside.pose.size // 2 + _FEW)
    along, across, pose = inside.along_m[few], inside.across_m[few], inside.pose[few]
    pair = np.diff(pose) == 0
    step = np.stack([np.diff(along)[pair], np.diff(across)[pair]], axis=-1)
    length = np.hypot(step[:, 0], step[:, 1])
    usual = float(np.median(length)) if length.size else math.sqrt(each)
    # Neighbours in a profile are closer than random neighbours.
    on_line = (length > 0.5 * usual) & (length < 2.0 * usual)
    if 2 * int(pair.sum()) < pair.size or usual <= 0.0 or not on_line.any() or usual**2 > 4.0 * each:
        return np.eye(2) * each / 12.0
    unit = np.linalg.eigh(step[on_line].T @ step[on_line])[1][:, 1]
    line = np.outer(unit, unit)
    return np.asarray((usual**2 * line + (each / usual) ** 2 * (np.eye(2) - line)) / 12.0)


def _without_slow(mass: Float64, totals: Sequence[Float64]) -> list[Float64]:
    """Returns smoothed values of cells minus a surface of the second degree; NaN where nothing was seen.

    A running mean would be one-sided at the rims, and its error would be the same in all images, as if nothing had
    moved.
    """
    from scipy.ndimage import gaussian_filter, minimum_filter

    pictures = [np.full(mass.shape, np.nan) for _ in totals]
    if not mass.any():
        return pictures
    fine_mass = gaussian_filter(mass, BLUR_CELLS, mode="constant", truncate=3.0)
    seen = minimum_filter(fine_mass > _FILLED * np.median(mass[mass > 0]), _EDGE_CELLS, mode="constant")
    row, column = np.nonzero(seen)
    if row.size < _LEAST_CELLS:
        return pictures
    x, y = row / (0.5 * len(mass)) - 1.0, column / (0.5 * len(mass)) - 1.0
    design = np.stack([np.ones(row.size), x, y, x * x, x * y, y * y])
    normal = design @ design.T
    for picture, total in zip(pictures, totals, strict=True):
        value = gaussian_filter(total, BLUR_CELLS, mode="constant", truncate=3.0)[seen] / fine_mass[seen]
        picture[seen] = value - np.linalg.lstsq(normal, design @ value, rcond=1e-12)[0] @ design
    return pictures
