"""The median that a surface is drawn to: wide on level ground, along the line where there is a crack or an edge.

A square median of the size that quiets noise erases a crack narrower than half its side, and with λ_M = 30 the
smoothed surface would follow it. The paper asks for "a detail-preserving median filter"; here it is one of directed
lines, as in Nieminen, Heinonen and Neuvo (1987), "A new class of detail-preserving filters for image processing"
(IEEE PAMI 9, 74–90), section II:

1. *Lines*: medians of seven cells in eight directions, 22.5° apart.
2. *Ground*: the median of seven in a row, of seven such in a column, every third cell: 19 × 19 cells, so that 20
   cells of crack do not fill it.
3. *Detail*: where a line's median differs from the ground by `detail_sigmas` of its own σ, at seven or more of the
   49 cells around (a crack as long as a line; outliers that meet by chance make fewer), then on to neighbours above
   `edge_sigmas` twice, and one cell more for the foot of its walls.
4. On detail the median along one line: the direction whose medians fit the heights of the 25 cells around best, each
   misfit cut off at `outlier_sigmas`, so that an outlier has no say. On level ground the median of seven in a row, of
   seven such in a column, side by side; of these the mean of 7 × 7, every second one (a median of medians smooths no
   more: it keeps whatever rises or falls steadily). Cells with detail are left out.

What is not measured counts nowhere, and places beyond the grid are like that. In the mean a cell counts only together
with its mirror image, so that a slope has no say at borders and holes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.kernels.line_medians import CELLS, judge_lines, keep_better, line_means, line_medians, window_sums
from roadscan.model.surface_smoothing import SurfaceSmoothing

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

_ABSENT = np.inf
_HALF = CELLS // 2
_GROUND_STEP = 3
_LEVEL_STEP = 2
_GROWTHS = 2
_STRONG_CELLS = 7
"""Of the 49 around a cell."""
_LEAST_CELLS = 5
"""Of fewer cells, two outliers move the median."""
MEDIAN_SIGMA = 1.25
"""σ of the median of n normal values, times √n (its limit for large n; 1.21 for seven)."""

REACH = _HALF * _GROUND_STEP + _HALF + _GROWTHS + 1 + _HALF * (1 + _LEVEL_STEP)
"""Cells to each side that the median of a cell depends on: ground, its count, growth, foot, level ground."""


@dataclass(frozen=True)
class DetailMedian:
    """The detail-preserving median of a grid of heights."""

    height_m: Float64
    """(rows, columns); NaN where nothing was measured."""
    detail: Bool
    """(rows, columns), True where it is one along a line."""


def directions() -> Int64:
    """(8, 7, 2) rows and columns of the cells of each line, from its middle; halves are rounded to the middle."""
    angle = np.arange(8) * np.pi / 8
    step = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    step /= np.abs(step).max(axis=-1, keepdims=True)
    away = step[:, None, :] * np.arange(-_HALF, _HALF + 1)[None, :, None]
    return np.asarray(np.sign(away) * np.ceil(np.abs(away) - 0.5 - 1e-9), dtype=np.int64)


def detail_median(height_m: Float64, config: SurfaceSmoothing) -> DetailMedian:
    """The median of a grid.

    Parameters
    ----------
    height_m : (rows, columns), NaN where nothing was measured.
    """
    measured = ~np.isnan(height_m)
    heights = np.where(measured, height_m, _ABSENT)
    found = _Lines(heights, measured, config)
    detail = found.detail()
    plain = measured & ~detail
    level = _square_median(np.where(plain, heights, _ABSENT), 1)
    level = _square_mean(np.where(plain, level, _ABSENT), _LEVEL_STEP)
    median = np.where(detail, found.median_m, level)
    return DetailMedian(np.where(measured, median, np.nan), detail)


class _Lines:
    """What the lines of all directions say about each cell."""

    def __init__(self, heights: Float64, measured: Bool, config: SurfaceSmoothing) -> None:
        self.measured, self.config = measured, config
        ground = _square_median(heights, _GROUND_STEP)
        padded = _padded(heights, _HALF)
        limit = config.outlier_sigmas * config.sigma_m
        shape = heights.shape
        self.contrast = np.zeros(shape, np.float32)
        """Greatest difference of a line's median from the ground, in σ of that median."""
        self.median_m = np.full(shape, _ABSENT)
        """The median along the line that fits best."""
        least = np.full(shape, np.inf, np.float32)
        median, count = np.empty(shape), np.empty(shape)
        misfit = np.empty(shape, np.float32)
        for line in directions():
            line_medians(padded, _HALF, line, _ABSENT, median, count)
            judge_lines(heights, ground, median, count, _LEAST_CELLS, limit, _ABSENT, self.contrast, misfit)
            keep_better(_sums(misfit, 2).ravel(), median.ravel(), least.ravel(), self.median_m.ravel())
        self.contrast /= np.float32(MEDIAN_SIGMA * config.sigma_m)

    def detail(self) -> Bool:
        """Cells on a crack, an edge or a stone, with the foot of its walls."""
        strong = self.contrast > self.config.detail_sigmas
        weak = self.contrast > min(self.config.edge_sigmas, self.config.detail_sigmas)
        found = strong & (_sums(strong.astype(np.float32), _HALF) >= _STRONG_CELLS)
        for _ in range(_GROWTHS):
            found |= weak & _beside(found)
        return np.asarray(_beside(found) & self.measured)


def _beside(cells: Bool) -> Bool:
    return np.asarray(_sums(cells.astype(np.float32), 1) > 0.5)


def _square_median(heights: Float64, step: int) -> Float64:
    """Median of seven in a row, of seven of these in a column, `step` cells apart."""
    across, down, margin = _cross(step)
    first, second, count = np.empty(heights.shape), np.empty(heights.shape), np.empty(heights.shape)
    line_medians(_padded(heights, margin), margin, across, _ABSENT, first, count)
    line_medians(_padded(first, margin), margin, down, _ABSENT, second, count)
    return second


def _square_mean(heights: Float64, step: int) -> Float64:
    """Mean of seven in a row, of seven of these in a column, `step` cells apart, each with its mirror image."""
    across, down, margin = _cross(step)
    first, second = np.empty(heights.shape), np.empty(heights.shape)
    line_means(_padded(heights, margin), margin, across, _ABSENT, first)
    line_means(_padded(first, margin), margin, down, _ABSENT, second)
    return second


def _cross(step: int) -> tuple[Int64, Int64, int]:
    """Seven cells in a row, seven in a column, and how far they reach."""
    away = np.arange(-_HALF, _HALF + 1, dtype=np.int64) * step
    return np.stack([0 * away, away], axis=-1), np.stack([away, 0 * away], axis=-1), _HALF * step


def _padded(heights: Float64, margin: int) -> Float64:
    return np.pad(heights, margin, constant_values=_ABSENT)


def _sums(values: npt.NDArray[np.float32], half: int) -> npt.NDArray[np.float32]:
    """Sums over (2 half + 1)² cells."""
    padded = np.pad(values, half)
    total = np.zeros(values.shape, np.float32)
    window_sums(padded, half, np.zeros((padded.shape[0], values.shape[1]), np.float32), total)
    return total
