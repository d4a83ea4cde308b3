"""How far lines of cells lie below both their flanks (the response to cracks), and the skeleton of the cells that do.

1. *Lines*: the mean height at 21 places a cell apart, in 24 directions, 7.5° apart. Noise and stones average out; a
   crack does not.
2. *Response*: how far a line lies below the lower of two lines beside it, 2, 4, 8 … cells away; the deepest of all
   directions and distances. On slopes, edges of patches and rims of potholes one flank is always as low, so that
   nothing is found. Ground that rises from the line on, as beside a kerb or in a rut, is no wall: the flank counts as
   high as the line from three times as far through it meets the middle. Comparing with both sides is the idea of
   Steger (1998), "An unbiased detector of curvilinear structures" (IEEE PAMI 20, 113-125), whose derivatives of a
   Gaussian would need a scale for each width.
3. *Texture*: σ of such differences is measured nearby (0.15 m), from lines along both axes, large ones left out. So a
   rough pavement needs deeper lines than a smooth one.
4. *Cells*: those beyond `strong_sigmas`, grown on those beyond `weak_sigmas`, now and then over a cell that is none:
   a crack narrower than a cell fades where it passes from one row of cells to the next. A line that reaches beyond a
   crack's end or lies across it is shallower than one along it nearby (`nearby_share`).
5. *Bridges*: a crack that takes in less than half of a cell is in the cell's lowest reading alone. So the same lines
   are laid through heights that are lowered to the lowest readings, but by `lowered_m` at most: one wrong reading among
   25 lowers its cell by no more. Cracks go on where these are beyond `weak_sigmas`, and begin where they are
   beyond `strong_sigmas` and heights alone beyond 5/6 of that. What lowest readings alone show must lead from one
   stretch that heights show to another (:attr:`CrackResponse.bridge`), because a single profile that lies lower than
   its neighbours responds too. With `lowest_alone` cracks begin and end there as well.
6. *Skeleton*: thinned to lines (Guo & Hall 1989, "Parallel thinning with two-subiteration algorithms", CACM 32,
   algorithm A1). What is not thin after as many passes as the widest crack needs is a pit and left out.

Every step looks a stated number of cells far (:func:`halo_cells`) and adds whole numbers, so a cell has the same bits
in every window.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int32, Int64, UInt8
from roadscan.core.extras import cv2
from roadscan.distress.kernels.crack_response import add_bend, deepen, fill_holes, line_sums, thin
from roadscan.distress.settings import CrackDetection
from roadscan.surface.heights import CROWD_CELLS, HEIGHT_STEP_M, HeightWindow

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


_GROWTHS, _LEAP = 20, 7
"""Steps by which valleys grow, a cell each; every seventh step leaps over a cell."""


@dataclass(frozen=True)
class CrackResponse:
    """Figures of the deepest line through each cell of a window; all arrays (rows, columns)."""

    depth_m: Float64
    """Mean depth of the line below its lower flank (m)."""
    direction: UInt8
    """Direction of that line: n · 7.5° from the columns' axis to that of the rows."""
    flank: UInt8
    """Distance of that line's flanks (cells)."""
    skeleton: Bool
    bridge: Bool
    """Cells of the skeleton that only the lowest readings show."""


def halo_cells(config: CrackDetection, cell_m: float) -> int:
    """Returns how many cells beyond the wanted ones the skeleton depends on."""
    thinned = 3 * _thinnings(config, cell_m) + 1  # two cells a pass, and the reach of a pit
    return line_cells(config, cell_m) + bridge_cells() + thinned


def border_cells(config: CrackDetection, cell_m: float) -> int:
    """Returns how many cells beyond the last measured one the skeleton may depend on where all beyond is empty."""
    return LINE_HALF + FAR * flank_cells(config, cell_m)[-1] + MEASURED_HALF + 1


def crack_response_of(window: HeightWindow, config: CrackDetection) -> CrackResponse:
    """Returns valleys and the skeleton of a window. A border as wide as a line and its flanks has none."""
    lines = lines_through(window.cleaned_m(), window.cell_m, config)
    shown = cells = _grown(lines.strong, lines.weak)
    lowered = _lowered_lines(window, lines.nearly, config)
    if lowered is not None:
        begin = lines.strong | (lowered.strong if config.lowest_alone else lines.nearly & lowered.strong)
        cells = _grown(begin, lines.weak | lowered.weak)
        shown = cells if config.lowest_alone else _grown(begin, lines.weak)
        both = zip(vars(lines).values(), vars(lowered).values(), strict=True)
        lines = Lines(*(np.where(lines.weak, a, b) for a, b in both))
    skeleton = _thinned(cells, _thinnings(config, window.cell_m))
    flank = np.take(np.array(flank_cells(config, window.cell_m), np.uint8), lines.which // DIRECTIONS)
    bridge = skeleton & (cv2.dilate(shown, np.ones((3, 3), np.uint8)) == 0)
    return CrackResponse(lines.depth_m, (lines.which % DIRECTIONS).astype(np.uint8), flank, skeleton, bridge)


def bridge_cells() -> int:
    """Returns how many cells a crack may continue in lowest readings from a cell that heights show."""
    return _GROWTHS + _GROWTHS // _LEAP + 2


def _lowered_lines(window: HeightWindow, begin: Bool, config: CrackDetection) -> Lines | None:
    """Returns the lines through lowered heights where cracks that start at these cells may continue, or None."""
    if window.lowest is None or config.lowered_m <= 0.0:
        return None
    if config.lowest_alone:
        return lines_through(window.lowered_m(config.lowered_m), window.cell_m, config)
    if not begin.any():
        return None
    whole = Lines(*(np.zeros(begin.shape, kind) for kind in (np.float64, np.int32, np.bool_, np.bool_, np.bool_)))
    beyond = line_cells(config, window.cell_m)
    for rows, columns in _boxes(begin, bridge_cells(), beyond):
        first = max(rows.start - beyond, 0), max(columns.start - beyond, 0)
        part = window.part((first[0], rows.stop + beyond), (first[1], columns.stop + beyond))
        lines = lines_through(part.lowered_m(config.lowered_m), window.cell_m, config)
        own = tuple(slice(s.start - a, s.stop - a) for s, a in zip((rows, columns), first, strict=True))
        for cells, found in zip(vars(whole).values(), vars(lines).values(), strict=True):
            cells[rows, columns] = found[own]
    return whole


def _boxes(cells: Bool, reach: int, beyond: int) -> list[tuple[slice, slice]]:
    """Returns slices of rectangles that cover all within `reach` of the cells.

    Several, each with a margin of `beyond`, where that is less to compute, else one.
    """
    near = cv2.dilate(cells.view(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    stats = cv2.connectedComponentsWithStats(near, connectivity=8)[2][1:].astype(np.int64)
    low, size = stats[:, [1, 0]], stats[:, [3, 2]]
    around = low.min(axis=0), (low + size).max(axis=0)
    if (size + 2 * beyond).prod(axis=1).sum() >= (around[1] - around[0] + 2 * beyond).prod():
        low, size = around[0][None], (around[1] - around[0])[None]
    return [(slice(a, a + n), slice(b, b + m)) for (a, b), (n, m) in zip(low.tolist(), size.tolist(), strict=True)]


def _thinnings(config: CrackDetection, cell_m: float) -> int:
    """Returns the number of passes that thin the widest valley."""
    return math.ceil(config.max_width_m / cell_m / 2) + 4


def _grown(strong: Bool, weak: Bool) -> UInt8:
    """Returns a mask of the weak cells that are connected to strong ones, 1 or 0."""
    found, allowed = strong.astype(np.uint8), weak.astype(np.uint8)
    if not found.any():
        return found
    square = np.ones((3, 3), np.uint8)
    leap = np.ones((5, 5), np.uint8)
    for step in range(1, _GROWTHS + 1):
        found = cv2.dilate(found, square if step % _LEAP else leap) & allowed
    return np.asarray(cv2.morphologyEx(found, cv2.MORPH_CLOSE, square), dtype=np.uint8)


def _thinned(cells: UInt8, passes: int) -> Bool:
    """Returns the cells of the skeleton."""
    cells = cells.copy()
    for side in (cells[0], cells[-1], cells[:, 0], cells[:, -1]):
        side[:] = 0
    row, column = np.nonzero(cells)
    thin(cells, row.astype(np.int64), column.astype(np.int64), _deletable(), passes)
    thick = cv2.erode(cells, np.ones((3, 3), np.uint8))
    pit = cv2.dilate(thick, np.ones((2 * passes + 1, 2 * passes + 1), np.uint8))
    return np.asarray((cells > 0) & (pit == 0))


@functools.cache
def _deletable() -> UInt8:
    """Returns (2, 256): 1 where a cell with these neighbours goes in either half of a pass (Guo & Hall 1989, A1)."""
    found = np.zeros((2, 256), np.uint8)
    for bits in range(256):
        n, ne, e, se, s, sw, w, nw = (bool(bits >> k & 1) for k in range(8))
        crossings = sum((not a and (b or c)) for a, b, c in ((n, ne, e), (e, se, s), (s, sw, w), (w, nw, n)))
        pairs = min((nw or n) + (ne or e) + (se or s) + (sw or w), (n or ne) + (e or se) + (s or sw) + (w or nw))
        if crossings == 1 and 2 <= pairs <= 3:
            found[0, bits] = not ((s or sw or not nw) and w)
            found[1, bits] = not ((n or ne or not se) and e)
    return found
