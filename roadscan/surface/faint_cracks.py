"""Detection of cracks too shallow for lines of seven cells: strips of 21 cells, located to a fraction of a cell.

A crack that is 1.3 σ deep in two cells of each row stands out of seven rows by 3 to 5 σ, and so do lines of pure noise
where eight directions are tried at each cell. Over 21 rows it stands out by 8 σ, and pure noise hardly by 6. So:

1. *Candidates*: chains of three medians of seven cells, end to end, the outer two up to a cell aside, in eight
   directions; where they lie `_CHAIN_SIGMAS` below the ground, the deepest of 5 × 5. Cracks that single cells show
   need none of this: where a line of seven stands out by `_STRONGEST`, the detail's other supports are right.
2. *Axis*: lines of 21 cells, one or two wide, of 15 slopes and seven places about the candidate.
3. *Strip*: along the best of these a strip of some width is fitted to 21 × 7 cells: volume and level by least squares,
   axis in quarters of a cell, slope and width tried. A mean along the line would be 20 to 25 % too shallow: a slanting
   axis lies now in the middle of a cell, now between two, and the mean along it is that of all these places.
4. *Confirmed* are strips that gain `_GAIN_ALONE` σ, or `_GAIN_TOGETHER` if another such strip continues them 11 to 18
   cells further. In twelve million cells of noise with 2 % wrong readings three strips do; 5.5 σ alone would give 22.
   Where lines beside a strip vary more than those of independent cells, its gain is reduced by as much.
   It is drawn, as one more support that the risk decides about (``surface/detail_median.py``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Bool, Float32, Float64, Int64
from roadscan.surface.kernels.faint_cracks import (
    FIELDS,
    HALF_BREADTH,
    HALF_CUT,
    HALF_DRAWN,
    NEXT_ASIDE,
    STEEPEST,
    chain_lines,
    confirm_strips,
    draw_strips,
    fit_strips,
    line_depths,
    mark_peaks,
)
from roadscan.surface.kernels.line_medians import CELLS

_CHAIN_SIGMAS = 4.0  # Least depth of a candidate chain (σ).
_LEAST_CELLS = 3  # A median of fewer cells shows no depth.
_MARGIN = CELLS + 1  # Margin of the depth's grid (cells).
_STRONGEST = 10.0  # From this contrast of a line of seven (σ) strips are not needed.
_OUTLIER_SIGMAS = 5.0  # Heights farther from the ground (σ) are outliers and left out.
_AXIS_SIGMAS = 4.0  # Axes less low than this (σ of their mean) are not fitted.
_GAIN_ALONE, _GAIN_TOGETHER = 6.0, 5.0  # Gains (σ) of a strip that suffice alone, and with another strip.
_ALLOWED_VARIANCE = 1.5
"""Allowed variance of the mean of two lines beside a strip; for 168 independent cells it is 1.0 ± 0.3."""
_WIDTHS = np.array([1.3, 0.5, 2.2])  # Widths that are tried (cells), the first to find slope and axis.
_MEDIAN_SIGMA = 1.21 / np.sqrt(CELLS)
"""σ of a median of seven cells, relative to that of a cell."""

_FIT_REACH = HALF_CUT
_DRAWN_REACH = int(np.ceil(STEEPEST * HALF_DRAWN)) + HALF_BREADTH + 3  # Cells that a drawn strip reaches from its peak.
REACH = max(_MARGIN + 2, _FIT_REACH) + NEXT_ASIDE + _DRAWN_REACH
"""Distance (cells) from a drawn cell to those whose height and ground it depends on."""


@dataclass(frozen=True)
class Strips:
    """Confirmed strips, drawn on the grid; all (rows, columns)."""

    gain: Float32
    """Significance of the strip at a cell, 0 where there is none."""
    height_m: Float64
    """Height of the strip."""
    own: Float32
    """Share of the cell itself in that height."""


def no_strips(heights: Float64) -> Strips:
    """Returns empty strips; heights (rows, columns)."""
    nothing = np.zeros(heights.shape, np.float32)
    return Strips(nothing, heights, nothing)


class Chains:
    """The deepest chain of three lines about each cell."""

    def __init__(self, ground_m: Float64, sigma_m: float, absent: float) -> None:
        self._ground, self._absent = ground_m, absent
        self._scale = 1.0 / (sigma_m * _MEDIAN_SIGMA * np.sqrt(3.0))
        rows, columns = ground_m.shape
        self._depth = np.zeros((rows + 2 * _MARGIN, columns + 2 * _MARGIN), np.float32)
        self.depth = np.zeros(ground_m.shape, np.float32)
        """Its depth below the ground, in σ of that."""
        self.direction = np.zeros(ground_m.shape, np.uint8)

    def add(self, direction: int, line: Int64, median_m: Float64, count: Float64) -> None:
        """Chain the lines of one direction; line : (15, 2), twice as long on each side, median_m of seven."""
        line_depths(self._ground, median_m, count, _LEAST_CELLS, self._scale, self._absent, _MARGIN, self._depth)
        down, right = (int(v) for v in line[-1])
        steep = abs(down) >= abs(right)
        chain_lines(
            self._depth, _MARGIN, down, right, int(not steep), int(steep), np.uint8(direction), self.depth,
            self.direction,
        )  # fmt: skip

    def strips(self, heights: Float64, contrast: Float32, sigma_m: float) -> Strips:
        """Strips fitted about the deepest chains; heights (rows, columns), contrast of the strongest line of seven."""
        shape = heights.shape
        row, column = np.nonzero(self.depth >= _CHAIN_SIGMAS)
        peak = np.zeros(row.size, np.bool_)
        mark_peaks(row, column, np.pad(self.depth, 3), np.pad(contrast, 3), np.float32(_STRONGEST), peak)
        row, column = row[peak], column[peak]
        angle = self.direction[row, column] * (np.pi / 8)
        down, right = np.sin(angle), np.cos(angle)
        steep = np.abs(down) >= np.abs(right) - 1e-9
        slope = np.where(steep, right, down) / np.where(steep, down, right)
        with np.errstate(invalid="ignore"):
            values = ((heights - self._ground) / sigma_m).astype(np.float32)
            values[~(np.abs(values) <= _OUTLIER_SIGMAS)] = np.inf
        strips = np.zeros((row.size, FIELDS))
        padded = np.pad(values, _FIT_REACH, constant_values=np.inf)
        fit_strips(
            padded, _FIT_REACH, row, column, steep, slope, _WIDTHS, _AXIS_SIGMAS, _GAIN_TOGETHER, _ALLOWED_VARIANCE,
            np.inf, strips,
        )  # fmt: skip
        gain, level, own = (np.zeros(shape, np.float32) for _ in range(3))
        draw_strips(row, column, strips, confirmed_strips(row, column, strips, shape), gain, level, own)
        drawn = gain > 0.0
        height = np.where(drawn, self._ground + sigma_m * level.astype(np.float64), heights)
        return Strips(gain, height, own)


def confirmed_strips(row: Int64, column: Int64, strips: Float64, shape: tuple[int, int]) -> Bool:
    """Returns a mask (n,) of the strips that are drawn."""
    number = np.full((shape[0] + 2 * NEXT_ASIDE, shape[1] + 2 * NEXT_ASIDE), -1, np.int32)
    together = np.flatnonzero(strips[:, 0] >= _GAIN_TOGETHER)
    number[row[together] + NEXT_ASIDE, column[together] + NEXT_ASIDE] = together
    confirmed = np.zeros(row.size, np.bool_)
    confirm_strips(row, column, strips, number, _GAIN_ALONE, confirmed)
    return confirmed
