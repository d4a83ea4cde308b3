"""Detail-preserving median of a surface: wide on level ground, along the line on a crack or an edge.

A square median of the size that quiets noise erases a crack narrower than half its side, and with λ_M = 30 the
smoothed surface would follow it. The paper asks for "a detail-preserving median filter"; here it is one of directed
lines, as in Nieminen, Heinonen and Neuvo (1987), "A new class of detail-preserving filters for image processing"
(IEEE PAMI 9, 74–90), section II:

1. *Lines*: medians of seven cells in eight directions, 22.5° apart.
2. *Ground*: the median of seven in a row, of seven such in a column, every third cell: 19 × 19 cells, so that 20
   cells of crack do not fill it. At borders the missing side is the other mirrored, else a slope would stand out.
3. *Detail*: where a line's median differs from the ground by `detail_sigmas` of its own σ, at seven or more of the
   49 cells around (a crack as long as a line; outliers that meet by chance make fewer), then on to neighbours above
   `edge_sigmas` twice, and one cell more for the foot of its walls.
4. *Direction*: the one whose medians have the least risk at the 49 cells around. Risk is Stein's (1981) unbiased
   estimate of the squared error: misfit² + 2 σ² for each cell that is its own median. Without the second term lines
   across a wall would win: their median is the cell in the middle, noise and all. A misfit is cut off at
   `outlier_sigmas`, so that outliers have little weight.
5. *Support*: a crack 20 cells wide could be smoothed more than by a line of seven, one cell wide at a bend less. So
   on detail there are means of 3 and of 13 cells along the line and paraboloids over 7 × 7 and 9 × 9 besides
   (outliers replaced by the line's median), and of all that of least risk (``surface/kernels/line_medians.py``).
6. *Strips*: a crack too shallow for lines of seven may show over 21 cells (``faint_cracks.py``). Its cells
   are detail as well, and the strip is a sixth support.
7. *Level ground*: the median of seven in a row, of seven such in a column, side by side; of these the mean of 7 × 7,
   every second one (a median of medians smooths no more: it keeps whatever rises or falls steadily). Cells with
   detail are left out.

Cells without a measurement or beyond the grid count nowhere. In means and fits a cell counts only
together with its mirror image, so that a slope has no effect at borders and holes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.surface.faint_cracks import REACH as STRIP_REACH
from roadscan.surface.faint_cracks import Chains, no_strips
from roadscan.surface.kernels.line_medians import (
    CELLS,
    SUPPORTS,
    CrackCells,
    Shapes,
    heights_by_support,
    judge_lines,
    keep_better,
    least_risk,
    line_means,
    line_medians,
    mirrored_line_medians,
    window_sums,
)
from roadscan.surface.settings import SurfaceSmoothing

_ABSENT = np.inf
_HALF = CELLS // 2  # Cells of a line to either side of its middle.
_GROUND_STEP = 3  # Spacing (cells) of the medians that make the ground.
_LEVEL_STEP = 2  # Spacing (cells) of the mean over level ground.
_GROWTHS = 2  # Times that detail grows to neighbours above `edge_sigmas`.
_STRONG_CELLS = 7
"""Least number of the 49 cells around a cell on detail that exceed `detail_sigmas`."""
_LEAST_CELLS = 5
"""With fewer cells, two outliers move the median."""
MEDIAN_SIGMA = 1.25
"""σ of the median of n normal values, times √n (its limit for large n; 1.21 for seven)."""

_ACROSS_ROWS = 4
"""Index of the direction that runs along a column."""
_FIT_REACH = 6  # The fits on detail reach this many cells to each side.
_CHOICE = 0.12
"""Added share of a cell in supports along its line, because eight directions were tried on its height (of pure
noise: covariance 0.23 with the median along the line of least risk, 0.12 of it the median's own)."""

_FAVOUR = 0.5
"""A significant strip is replaced by another support only where that is better by this much a cell (σ²): if risks
alone decided, a third of what strips show would be smoothed away again."""

_GROUND_REACH = _HALF * _GROUND_STEP + _HALF
"""Cells that the ground reaches: every third cell, and the columns about which borders are mirrored."""
_DETAIL_REACH = _GROUND_REACH + max(_HALF + _GROWTHS + 1, STRIP_REACH)
"""Cells that detail reaches: ground, then count, growth and foot, or the strips."""
REACH = _DETAIL_REACH + _HALF * (1 + _LEVEL_STEP)
"""Cells to each side on which the median of a cell depends: detail, and level ground. A height on detail reaches no
farther: its risk, detail there or the fit and the outliers in it."""


@dataclass(frozen=True)
class DetailMedian:
    """The detail-preserving median of a grid of heights."""

    height_m: Float64
    """(rows, columns); NaN where nothing was measured."""
    detail: Bool
    """(rows, columns), True on a crack, an edge or a stone."""
    drawn: Bool
    """(rows, columns), True on a crack that is seen only in a long strip."""


def directions() -> Int64:
    """Returns (8, 7, 2) rows and columns of the cells of each line from its middle; halves round to the middle."""
    return _lines(_HALF)


def _lines(half: int) -> Int64:
    angle = np.arange(8) * np.pi / 8
    step = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    step /= np.abs(step).max(axis=-1, keepdims=True)
    away = step[:, None, :] * np.arange(-half, half + 1)[None, :, None]
    return np.asarray(np.sign(away) * np.ceil(np.abs(away) - 0.5 - 1e-9), dtype=np.int64)


def lines_onward() -> Int64:
    """Returns (8, 6, 2) the continuation of one half of the same lines."""
    return np.ascontiguousarray(_lines(_FIT_REACH)[:, _FIT_REACH + 1 :])


def detail_pairs() -> Int64:
    """Returns (40, 2) one cell of each pair about the middle of 9 × 9, those of smaller squares first."""
    away = [(i, j) for i in range(5) for j in range(-4, 5) if i > 0 or j > 0]
    return np.array(sorted(away, key=lambda cell: (max(cell[0], abs(cell[1])), cell)), dtype=np.int64)


def detail_median(height_m: Float64, config: SurfaceSmoothing) -> DetailMedian:
    """Returns the detail-preserving median of a grid.

    Parameters
    ----------
    height_m : (rows, columns), NaN where nothing was measured.
    """
    measured = ~np.isnan(height_m)
    heights = np.where(measured, height_m, _ABSENT)
    lines = _Lines(heights, measured, config)
    detail = lines.detail()
    plain = measured & ~detail
    level = _square_median(np.where(plain, heights, _ABSENT))
    level = _square_mean(np.where(plain, level, _ABSENT), _LEVEL_STEP)
    level[detail] = lines.supported(heights, detail)
    return DetailMedian(np.where(measured, level, np.nan), detail, detail & (lines.strips.gain > 0.0))


class _Lines:
    """Medians along lines of all directions, and their risk, at each cell."""

    def __init__(self, heights: Float64, measured: Bool, config: SurfaceSmoothing) -> None:
        self.measured, self.config = measured, config
        shape = heights.shape
        padded = _padded(heights, _HALF)
        median, count = np.empty(shape), np.empty(shape)
        own, risk = np.empty(shape, np.float32), np.empty(shape, np.float32)
        line_medians(padded, _HALF, directions()[_ACROSS_ROWS], _ABSENT, median, count, own)
        ground = _ground(heights, median)
        self.contrast = np.zeros(shape, np.float32)
        """Greatest difference of a line's median from the ground, in σ of that median."""
        self.median_m = np.full(shape, _ABSENT)
        """The median along the line of least risk."""
        self.own, self.direction = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
        """Share of the cell itself in that median, and which line it is."""
        least = np.full(shape, np.inf, np.float32)
        best = (least.ravel(), self.median_m.ravel(), self.own.ravel(), self.direction.ravel())
        sigma_m, limit = config.sigma_m, config.outlier_sigmas
        chains = Chains(ground, sigma_m, _ABSENT) if config.independent else None
        onward = _lines(CELLS)
        for direction, line in enumerate(directions()):
            line_medians(padded, _HALF, line, _ABSENT, median, count, own)
            judge_lines(heights, ground, median, count, own, _LEAST_CELLS, sigma_m, limit, _ABSENT, self.contrast, risk)
            if chains is not None:
                chains.add(direction, onward[direction], median, count)
            keep_better(_sums(risk, _HALF).ravel(), median.ravel(), own.ravel(), np.uint8(direction), *best)
        self.contrast /= np.float32(MEDIAN_SIGMA * sigma_m)
        self.strips = no_strips(heights) if chains is None else chains.strips(heights, self.contrast, sigma_m)

    def supported(self, heights: Float64, detail: Bool) -> Float64:
        """Returns heights (n,) of the cells on detail, each over the support of least risk."""
        row, column = map(np.ascontiguousarray, np.nonzero(detail))
        middle, sigma_m = self.median_m[detail], self.config.sigma_m
        with np.errstate(invalid="ignore"):
            outlier = np.abs(heights - self.median_m) > self.config.outlier_sigmas * sigma_m
        clean = _padded(np.where(outlier & self.measured, self.median_m, heights), _FIT_REACH)
        off, own = np.empty((row.size, SUPPORTS), np.float32), np.empty((row.size, SUPPORTS), np.float32)
        cells = CrackCells(row, column, middle, self.own[detail], self.direction[detail])
        shapes = Shapes(lines_onward(), detail_pairs())
        heights_by_support(clean, _FIT_REACH, cells, _CHOICE, shapes, _ABSENT, off, own)
        drawn = self.strips.gain[detail] > 0.0
        off[:, -1] = np.where(drawn, self.strips.height_m[detail] - middle, 0.0)
        own[:, -1] = np.where(drawn, self.strips.own[detail] - _FAVOUR, own[:, 0])
        number = np.full(detail.shape, -1, np.int32)
        number[detail] = np.arange(row.size, dtype=np.int32)
        number = np.pad(number, _HALF, constant_values=-1)
        chosen = np.empty(row.size, np.float32)
        height = heights[detail] - middle
        least_risk(row, column, number, height, off, own, sigma_m, self.config.outlier_sigmas, chosen)
        return np.asarray(middle + chosen)

    def detail(self) -> Bool:
        """Returns a mask of cells on a crack, an edge or a stone, with the foot of its walls."""
        strong = self.contrast > self.config.detail_sigmas
        weak = self.contrast > min(self.config.edge_sigmas, self.config.detail_sigmas)
        found = strong & (_sums(strong.astype(np.float32), _HALF) >= _STRONG_CELLS)
        for _ in range(_GROWTHS):
            found |= weak & _beside(found)
        return np.asarray((_beside(found) | (self.strips.gain > 0.0)) & self.measured)


def _beside(cells: Bool) -> Bool:
    return np.asarray(_sums(cells.astype(np.float32), 1) > 0.5)


def _square_median(heights: Float64) -> Float64:
    """Returns the median of seven in a row, of seven of these in a column, side by side."""
    across, down, margin = _cross(1)
    first, second, count = np.empty(heights.shape), np.empty(heights.shape), np.empty(heights.shape)
    own = np.empty(heights.shape, np.float32)
    line_medians(_padded(heights, margin), margin, across, _ABSENT, first, count, own)
    line_medians(_padded(first, margin), margin, down, _ABSENT, second, count, own)
    return second


def _ground(heights: Float64, column_median: Float64) -> Float64:
    """Returns the median of seven in a row, of seven of these in a column, every third; missing ones are mirrored.

    A row is mirrored about the median of seven in the column, which has no slope across.
    """
    across, down, margin = _cross(_GROUND_STEP)
    first, second = np.empty(heights.shape), np.empty(heights.shape)
    mirrored_line_medians(_padded(heights, margin), margin, across, column_median, _ABSENT, first)
    mirrored_line_medians(_padded(first, margin), margin, down, first, _ABSENT, second)
    return second


def _square_mean(heights: Float64, step: int) -> Float64:
    """Returns the mean of seven in a row, of seven of these in a column, `step` cells apart, in mirrored pairs."""
    across, down, margin = _cross(step)
    first, second = np.empty(heights.shape), np.empty(heights.shape)
    line_means(_padded(heights, margin), margin, across, _ABSENT, first)
    line_means(_padded(first, margin), margin, down, _ABSENT, second)
    return second


def _cross(step: int) -> tuple[Int64, Int64, int]:
    """Returns seven cells in a row, seven in a column, and their reach."""
    away = np.arange(-_HALF, _HALF + 1, dtype=np.int64) * step
    return np.stack([0 * away, away], axis=-1), np.stack([away, 0 * away], axis=-1), _HALF * step


def _padded(heights: Float64, margin: int) -> Float64:
    return np.pad(heights, margin, constant_values=_ABSENT)


def _sums(values: npt.NDArray[np.float32], half: int) -> npt.NDArray[np.float32]:
    """Returns sums over (2 half + 1)² cells."""
    padded = np.pad(values, half)
    total = np.zeros(values.shape, np.float32)
    window_sums(padded, half, np.zeros((padded.shape[0], values.shape[1]), np.float32), total)
    return total
