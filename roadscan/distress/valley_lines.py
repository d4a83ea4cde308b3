"""Depth of lines of cells below both flanks, and its ratio to the texture around.

1. *Lines*: the mean height at 21 places a cell apart, in 24 directions, 7.5° apart. Noise and stones average out; a
   crack does not.
2. *Valley*: how far a line lies below the lower of two lines beside it, 2, 4, 8 … cells away; the deepest of all
   directions and distances. On slopes, edges of patches and rims of potholes one flank is always as low, so that
   nothing is found. Ground that rises from the line on, as beside a kerb or in a rut, is no wall: the flank counts as
   high as the line from three times as far through it meets the middle. Comparing with both sides is the idea of
   Steger (1998), "An unbiased detector of curvilinear structures" (IEEE PAMI 20, 113-125), whose derivatives of a
   Gaussian would need a scale for each width.
3. *Texture*: σ of such differences is measured nearby (0.15 m), from lines along both axes, large ones left out. So a
   rough pavement needs deeper valleys than a smooth one.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int32, Int64
from roadscan.core.extras import cv2
from roadscan.distress.kernels.crack_response import add_bend, deepen, fill_holes, line_sums
from roadscan.distress.settings import CrackDetection
from roadscan.surface.heights import CROWD_CELLS, HEIGHT_STEP_M

DIRECTIONS = 24  # Directions of lines, 7.5° apart.
LINE_HALF = 10  # Cells of a line to either side of its middle.
LINE_CELLS = 2 * LINE_HALF + 1  # Cells of a line.
_TEXTURE_M = 0.15
"""Half the edge (m) of the square in which texture is measured."""
_TEXTURE_FLANK = 4  # Distance of the flanks from which texture is measured (cells).
FAR = 3
"""Flanks are compared with lines this many times as far from the middle."""
_STEEPEST = 0.25
"""Steeper rises (m/m) are not ground but another thing, such as a kerb."""
_UNKNOWN = -90_000_000
"""Value for unknown heights, below all others: it neither lowers a flank (no rise) nor makes one."""
_NEARLY = 5 / 6
"""Share of `strong_sigmas` that is enough where lowered heights reach all of it."""
MEASURED_HALF = 3  # Half the edge (cells) of the square of which half must be measured.
_MEAN_TO_SIGMA = 1.2533
"""Ratio of σ to the mean absolute value of normal values."""
_CUT = 2.5
"""Differences beyond this many means are not texture; for normal values that leaves a mean of 0.88."""
_CUT_MEAN = 0.88  # The mean of normal values that is left after that cut, as a share.


@dataclass(frozen=True)
class Lines:
    """Deepest lines through the cells of a grid; all arrays (rows, columns)."""

    depth_m: Float64
    """Mean depth of the deepest line through the cell below its lower flank (m)."""
    which: Int32
    """24 · number of the flank + direction."""
    weak: Bool
    """Cells that continue a crack: deeper than the lowest of three hysteresis thresholds …"""
    nearly: Bool
    """… cells that start a crack if the lowest readings agree …"""
    strong: Bool
    """… and cells that start a crack."""


def flank_cells(config: CrackDetection, cell_m: float) -> list[int]:
    """Returns the distances of flanks (cells): doubled until the widest crack lies between them."""
    found = [2]
    while 2 * found[-1] * cell_m < 1.5 * config.max_width_m and found[-1] < 64:
        found.append(2 * found[-1])
    return found


def line_cells(config: CrackDetection, cell_m: float) -> int:
    """Returns how many cells around a cell its lines depend on, lowered heights included."""
    lines = LINE_HALF + FAR * flank_cells(config, cell_m)[-1] + _fill_cells(config, cell_m) + CROWD_CELLS
    return lines + 2 * _texture_half(cell_m) + LINE_HALF


def lines_through(heights: Float64, cell_m: float, config: CrackDetection) -> Lines:
    """Returns the lines through heights (rows, columns) in m, NaN where there is none; holes are filled.

    A border as wide as a line and its flanks has no lines.
    """
    measured = ~np.isnan(heights)
    whole = _whole_numbers(_filled(heights, _fill_cells(config, cell_m)))
    depth, which, bend = _deepest(whole, flank_cells(config, cell_m), cell_m)
    unit = HEIGHT_STEP_M / LINE_CELLS
    depth_m = np.asarray(depth * unit, dtype=np.float64)
    sigma_m = _texture_sigma(bend, measured, _texture_half(cell_m)) * unit
    seen = 2 * _count(measured, MEASURED_HALF) >= (2 * MEASURED_HALF + 1) ** 2
    looked_at = np.where(seen, depth_m, 0.0)
    nearby = cv2.dilate(looked_at, np.ones((LINE_CELLS, LINE_CELLS), np.uint8))
    least = np.maximum(config.weak_sigmas * sigma_m, config.min_valley_m)
    weak = (looked_at >= least) & (looked_at >= config.nearby_share * nearby)
    begin = (weak & (looked_at >= share * config.strong_sigmas * sigma_m) for share in (_NEARLY, 1.0))
    return Lines(depth_m, which, weak, *begin)


@functools.cache
def _lines() -> tuple[Int64, Int64]:
    """Returns the cells (24, 21, 2) of each direction in rows and columns, and unit vectors (24, 2) to their right."""
    angle = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    step = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    cells = np.rint(step[:, None, :] * np.arange(-LINE_HALF, LINE_HALF + 1)[None, :, None])
    right = np.stack([-step[:, 1], step[:, 0]], axis=-1)
    return np.ascontiguousarray(cells, dtype=np.int64), right


def _fill_cells(config: CrackDetection, cell_m: float) -> int:
    return LINE_HALF + flank_cells(config, cell_m)[-1] + 1


def _texture_half(cell_m: float) -> int:
    return max(20, min(100, round(_TEXTURE_M / cell_m)))


def _filled(heights: Float64, reach: int) -> Float64:
    """Returns heights with holes filled up to `reach` cells from measured ones, so that lines may cross them."""
    known = ~np.isnan(heights)
    near = _count(known, reach) > 0
    inside = np.zeros_like(known)
    inside[1:-1, 1:-1] = True
    row, column = np.nonzero(near & ~known & inside)
    fill_holes(heights, row.astype(np.int64), column.astype(np.int64), reach)
    return heights


def _whole_numbers(heights: Float64) -> Int32:
    """Returns heights in units of HEIGHT_STEP_M, less a whole number of them."""
    known = ~np.isnan(heights)
    if not known.any():
        return np.full(heights.shape, _UNKNOWN, np.int32)
    steps = np.rint(np.where(known, heights, 0.0) / HEIGHT_STEP_M)
    return np.where(known, (steps - steps[known].min()).clip(0, -_UNKNOWN / LINE_CELLS), _UNKNOWN).astype(np.int32)


def _deepest(whole: Int32, flanks: list[int], cell_m: float) -> tuple[Int32, Int32, Int32]:
    """Returns the greatest depth (of sums), 24 · number of the flank + direction, and the bends along both axes."""
    margin = LINE_HALF + FAR * flanks[-1]
    rows, columns = whole.shape
    shape = (max(rows - 2 * margin, 0), max(columns - 2 * margin, 0))
    depth, which, bend = (np.zeros(shape, np.int32) for _ in range(3))
    if not depth.size:
        return tuple(np.zeros(whole.shape, np.int32) for _ in range(3))  # type: ignore[return-value]
    sums = np.empty((rows - 2 * LINE_HALF, columns - 2 * LINE_HALF), np.int32)
    cells, right = _lines()
    for direction in range(DIRECTIONS):
        line_sums(whole, cells[direction], sums)
        for number, flank in enumerate(flanks):
            away = np.rint(right[direction] * flank * np.array([[1], [FAR]])).astype(np.int64)
            most = np.int32(_STEEPEST * flank * cell_m / HEIGHT_STEP_M * LINE_CELLS)
            deepen(sums, away, most, np.int32(DIRECTIONS * number + direction), depth, which)
        if direction % (DIRECTIONS // 2) == 0:  # along both axes
            add_bend(sums, np.rint(right[direction] * _TEXTURE_FLANK).astype(np.int64), bend)
    return tuple(np.pad(a, margin) for a in (depth, which, bend))  # type: ignore[return-value]


def _texture_sigma(bend: Int32, measured: Bool, half: int) -> Float64:
    """Returns σ of a line's depth below its flanks, from the cells around; infinite where nothing was measured."""
    level = _mean(bend, measured & (bend > 0), half)
    level = _mean(bend, measured & (bend > 0) & (bend < _CUT * level), half)
    # The bends of two directions were added, each twice the depth: |a| + |b| has twice the mean of |a|.
    return np.where(level > 0, level, np.inf) * (_MEAN_TO_SIGMA / _CUT_MEAN / 4.0)


def _mean(values: Int32, where: Bool, half: int) -> Float64:
    total, count = _sum(np.where(where, values, 0), half), _count(where, half)
    return total / np.maximum(count, 1)


def _count(cells: Bool, half: int) -> Int32:
    """Returns the number of set cells in the square around each cell."""
    side = 2 * half + 1
    return np.asarray(cv2.boxFilter(cells.view(np.uint8), cv2.CV_32S, (side, side), None, (-1, -1), False, 0))


def _sum(values: Int32, half: int) -> Float64:
    """Returns the sum over the square around each cell: of whole numbers, which float64 adds exactly."""
    side = 2 * half + 1
    return np.asarray(cv2.boxFilter(values, cv2.CV_64F, (side, side), None, (-1, -1), False, 0))
