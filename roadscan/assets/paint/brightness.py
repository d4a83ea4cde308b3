"""Brightness of fine cells in pictures, against that of the ground around them, summed over pictures."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from roadscan.assets.green.colours import FINE, Ground
from roadscan.compute.array_types import Bool, Float64, Int64, UInt8

_DARK: Final = 14  # Darker values (digital numbers) are too noisy.
_SURFACE: Final = 5
"""Number, from the darkest, of the fine cell that tells a cell's surface: up to four fifths of it may be painted."""
_AROUND: Final = 7
"""Edge of the square of cells whose median is the brightness around: 1.75 m. A median follows the edge of a shadow."""
_DRIVEN_M: Final = 1.5  # Ground this near to a drive (m) was driven over.
_BOUNDS: Final = (-0.5, 2.0)  # Contrasts are clipped to these.
BRIGHT: Final = 0.25
"""A fine cell of this contrast is bright in a picture."""


class Seen(NamedTuple):
    """What a picture tells of fine cells (k, 25); NaN where it does not show them."""

    contrast: Float64
    """Brightness over that of the ground around, less 1."""
    level: Float64
    """Brightness over that of the ground driven over, less 1: a lit strip between shadows has none."""


def brightness_in(colours: UInt8, shown: Bool, cells: Int64, ground: Ground) -> Seen:
    """Returns how bright fine cells of k cells are in a picture.

    Values are digital numbers, about the square root of light, of red and green: yellow paint is dark in blue. So
    exposure and light fall out, and shadows but for their edges.
    """
    from scipy import ndimage

    value = colours[:, :2].mean(axis=1, dtype=np.float64)
    value = np.where(shown & (colours.max(axis=1) >= _DARK), value, np.nan).reshape(-1, FINE * FINE)
    known = np.flatnonzero(np.isfinite(value).sum(axis=1) > _SURFACE)
    if not known.size:
        return Seen(value, value)
    surface = np.sort(value[known], axis=1)[:, _SURFACE]
    row, column = ground.row[cells], ground.column[cells]
    row, column = row - row.min(), column - column.min()
    level = np.full((int(row.max()) + 1, int(column.max()) + 1), np.nan)
    level[row[known], column[known]] = surface
    nearest = ndimage.distance_transform_edt(np.isnan(level), return_distances=False, return_indices=True)
    around = ndimage.median_filter(level[tuple(nearest)], _AROUND, mode="nearest")[row, column]
    driven = surface[ground.drive_m[cells[known]] <= _DRIVEN_M]
    usual = np.median(driven) if driven.size else np.nan
    contrast, level = (value / np.maximum(base, 1.0) - 1.0 for base in (around[:, None], usual))
    return Seen(np.clip(contrast, *_BOUNDS), np.clip(level, *_BOUNDS))


class BrightSums:
    """Sums over pictures of n cells with 25 fine ones each."""

    def __init__(self, cells: int) -> None:
        shape = (cells, FINE * FINE)
        self.weight, self.contrast, self.square, self.bright, self.level = (
            np.zeros(shape, np.float32) for _ in range(5)
        )
        self.number = np.zeros(shape, np.uint8)

    def add(self, cells: Int64, seen: Seen, pixel_m: Float64) -> None:
        """Add what a picture tells of some cells (k,), and the size of its pixels there (k,)."""
        known = np.isfinite(seen.contrast)
        weight = np.where(known, 1.0 / np.square(np.maximum(pixel_m, 0.02))[:, None], 0.0)
        value = np.nan_to_num(seen.contrast)
        self.weight[cells] += weight
        self.contrast[cells] += weight * value
        self.square[cells] += weight * value**2
        self.bright[cells] += weight * (value >= BRIGHT)
        self.number[cells] += known & (self.number[cells] < 255)
        self.level[cells] += weight * np.nan_to_num(seen.level)
