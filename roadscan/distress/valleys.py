"""Narrow valleys of a gridded surface: lines of cells that lie below both flanks.

1. *Lines* (``valley_lines.py``) of 21 cells in 24 directions say how far a cell lies below both its flanks.
2. *Cells*: valleys beyond `strong_sigmas`, grown on those beyond `weak_sigmas`, now and then over a cell that is none:
   a crack narrower than a cell fades where it passes from one row of cells to the next. A line that reaches beyond a
   crack's end or lies across it is shallower than one along it nearby (`nearby_share`).
3. *Bridges*: a crack that takes in less than half of a cell is in the cell's lowest reading alone. So the same lines
   are laid through heights that are lowered to the lowest readings, but by `lowered_m` at most: one wrong reading among
   25 lowers its cell by no more. Cracks go on where these are valleys beyond `weak_sigmas`, and begin where they are
   beyond `strong_sigmas` and heights alone beyond 5/6 of that. What lowest readings alone show must lead from one
   stretch that heights show to another (:attr:`Valleys.bridge`), because a single profile that lies lower than its
   neighbours is such a valley too. With `lowest_alone` cracks begin and end there as well.
4. *Skeleton*: thinned to lines (Guo & Hall 1989, "Parallel thinning with two-subiteration algorithms", CACM 32,
   algorithm A1). What is not thin after as many passes as the widest crack needs is a pit and left out.

Every step looks a stated number of cells far (:func:`halo_cells`) and adds whole numbers, so a cell has the same bits
in every window.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Bool, Float64, UInt8
from roadscan.core.extras import cv2
from roadscan.distress.kernels.crack_response import thin
from roadscan.distress.settings import CrackDetection
from roadscan.distress.valley_lines import (
    DIRECTIONS,
    FAR,
    LINE_HALF,
    MEASURED_HALF,
    Lines,
    flank_cells,
    line_cells,
    lines_through,
)
from roadscan.surface.heights import HeightWindow

_GROWTHS, _LEAP = 20, 7
"""Steps by which valleys grow, a cell each; every seventh step leaps over a cell."""


@dataclass(frozen=True)
class Valleys:
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


def find_valleys(window: HeightWindow, config: CrackDetection) -> Valleys:
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
    return Valleys(lines.depth_m, (lines.which % DIRECTIONS).astype(np.uint8), flank, skeleton, bridge)


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
