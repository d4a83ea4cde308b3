"""Cracks in a window of the surface, as pieces of line that are joined over tiles (``crack_network.py``).

The skeleton comes from ``crack_response.py``. At each of its cells a cross-section is measured on heights *before*
smoothing (impulses left out): all cells up to 4.5 cells along the crack are sorted by their distance from its line into
bins of half a cell. Because a line rarely runs along the grid, the section is finer than a cell; nothing is
interpolated between cells and nothing is smoothed across the crack. Ground is the straight line between the flanks.
Where that shows no crack, or one less than half as deep, the section is that of heights lowered to the lowest readings,
as ``crack_response.py`` asks them.

- *depth*: of the bottom below the ground: from robust heights, where cells lie in the crack alone, and from the lowest
  readings of cells, where it is narrower (``crack_depths.py``). Where these are not known, robust heights show
  a crack narrower than two cells shallower than it is.
- *width*: between the places of half that depth.
- *line*: through the middles of the sections, which is good to a fraction of a cell, so that its length is that of the
  crack and not that of steps from cell to cell.

Depth of a crack's bottom, from the lowest readings of its cells.

A crack that covers less than half of a cell leaves the cell's robust height at that of the ground beside it. But the
bottom was measured: if some readings of a cell lie on it, the cell's lowest reading is one of them.

1. *Low*: at each place of the crack, how far the lowest reading of the cell in which the section's middle lies is below
   the ground. Of the lows of 10 cells to both sides a quantile is taken, because single ones mislead: one wrong
   reading decides the lowest of a cell, and of cells with few readings many missed the bottom.
2. *Level*: the level of that quantile depends on b, a cell's number of readings on a strip of 1 mm along the crack, the
   part that shows the depth of a crack of 5 mm: it is `_HALF_READINGS` / (`_HALF_READINGS` + b). In cells
   of 5 mm with 25 readings nearly all hit the bottom, but of 2 % wrong readings a fifth of them has a low that is far
   too deep: the lower third is deep enough and safe. With two readings few cells hit it and one in fifty is wrong:
   nearly the deepest is taken.
3. *Drop*: from noise and texture alone, lowest readings lie below the ground, by as much as they do beside the crack.
   Only some readings of a cell meet the bottom, so that a share of the drop, `_DROP_SHARE`, is subtracted (the lowest
   of 5 normal values lies 1.2 σ below their mean, that of 25 2.0 σ, and the quantile above is below the median).
4. *Floor*: on a level floor, the lowest reading is as far below the others as it is beside the crack. Where
   lowest readings (their median over the same cells) lie no more than `_FLOOR_BEGIN` times as far below their cell's
   robust height as beside the crack, the cells lie on the floor, and the depth is the median of their robust heights;
   from `_FLOOR_END` times on they do not.
5. *Width*: a valley wider than :data:`NARROW_CELLS`, as cells show it, gets more and more of its depth from robust
   heights, and all from :data:`WIDE_CELLS` on, where whole cells lie in it: a wide crack needs no single reading.

`_HALF_READINGS` and `_DROP_SHARE` were chosen on cracks of 3 to 10 mm in cells of 2 to 5 mm with 1 to 100 readings,
with and without wrong ones (``benchmarks/bench_cracks.py``); a quarter more or less of either changes depths by 3 %.
The bounds of a floor were chosen on slots with level floors, 5 to 15 mm wide and 3 to 10 mm deep, beside these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import way_along
from roadscan.distress import crack_response
from roadscan.distress.crack_response import DIRECTIONS, CrackResponse, bridge_cells, crack_response_of, flank_cells
from roadscan.distress.kernels.cross_sections import CELLS_ALONG, cross_sections, quantiles_along
from roadscan.distress.settings import CrackDetection
from roadscan.distress.skeleton_graph import PRUNINGS, SkeletonGraph, pruned, trimmed
from roadscan.surface.heights import HeightWindow, LowestReadings

NARROW_CELLS: Final = 2.5  # Width (cells) up to which the depth comes from lowest readings alone.
WIDE_CELLS: Final = 3.5  # Width (cells) from which it comes from robust heights alone.
_FLANK_CELLS: Final = 3
"""Cells of each flank whose lowest readings are used."""
_HALF_READINGS: Final = 2.5  # Readings on the strip for which the median of the lows is taken.
_BOTTOM_M: Final = 0.001  # Width (m) of the strip along the crack.
_DROP_SHARE: Final = 0.35  # Share of the flanks' drop that is subtracted.
_FLOOR_BEGIN: Final = 1.25  # Up to this ratio to the flanks' spread the cells lie on a level floor …
_FLOOR_END: Final = 1.75  # … and from this ratio on they do not.


@dataclass(frozen=True)
class ValleyCells:
    """Cells (n,) of valleys and the direction in which each valley runs."""

    row: Int64
    column: Int64
    north: Float64
    """Unit vector along the valley, in rows and columns."""
    east: Float64
    flank: Int64
    """Distance from the cell to the beginning of its flanks (cells)."""

    def part(self, rows: npt.NDArray[np.bool_]) -> ValleyCells:
        """Returns a subset of the cells."""
        return ValleyCells(self.row[rows], self.column[rows], self.north[rows], self.east[rows], self.flank[rows])

    def beside(self, right: Float64 | Int64) -> tuple[Int64, Int64]:
        """Returns rows and columns of the cells that lie this many cells to the right."""
        south, east = (np.rint(right * part).astype(np.int64) for part in (self.east, self.north))
        return self.row - south, self.column + east


def bottom_depths(
    window: HeightWindow, cells: ValleyCells, right: Float64, ground_m: Float64
) -> tuple[Float64, Float64]:
    """Returns the depth (n,) of the bottom (m) at each cell, NaN where no lowest reading is known, and readings (n, 2).

    The readings are those of the cell in the middle and of a cell of the flanks: fewer in the middle mean that a
    crack's walls hide its bottom from the head's camera.

    Parameters
    ----------
    right : (n,) how far the middle of a cell's section lies to the right (cells).
    ground_m : (n,) height of the ground above it; NaN where there is no valley.
    """
    if window.lowest is None:
        return np.full(cells.row.size, np.nan), np.zeros((cells.row.size, 2))
    at = cells.beside(right)
    own = window.lowest.drop_m[at].astype(np.float64)
    floor = ground_m - window.raw_m[at]
    lower, usual, readings, beside = _flanks(window.lowest, cells)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.where(usual > 0.0, own / usual, np.inf)
    number = np.full(window.raw_m.shape, -1, np.int32)
    number[cells.row, cells.column] = np.arange(cells.row.size)
    half = np.full(cells.row.size, 0.5)
    level = _HALF_READINGS / (_HALF_READINGS + readings * (_BOTTOM_M / window.cell_m))
    low, drop, floor, spread = (
        _along(number, cells, np.where(np.isnan(floor + own), np.nan, values), levels)
        for values, levels in ((floor + own, level), (lower, half), (floor, half), (spread, half))
    )
    narrow = low - _DROP_SHARE * drop
    on_floor = np.clip((_FLOOR_END - spread) / (_FLOOR_END - _FLOOR_BEGIN), 0.0, 1.0)
    return np.asarray(narrow + on_floor * (floor - narrow)), np.stack([window.lowest.count[at], beside], axis=-1)


def _along(number: npt.NDArray[np.int32], cells: ValleyCells, values: Float64, level: Float64) -> Float64:
    """Returns quantiles (n,) of the values of the cells around each cell along its valley."""
    out = np.empty(cells.row.size)
    quantiles_along(number, cells.row, cells.column, cells.north, cells.east, values, level, out)
    return out


def blended(bottom_m: Float64, depth_m: Float64, width_cells: Float64) -> Float64:
    """Returns depths (n,): that of the bottom for narrow sections, that of robust heights for wide ones."""
    share = np.clip((width_cells - NARROW_CELLS) / (WIDE_CELLS - NARROW_CELLS), 0.0, 1.0)
    return np.where(np.isnan(bottom_m), depth_m, share * depth_m + (1.0 - share) * bottom_m)


def _flanks(lowest: LowestReadings, cells: ValleyCells) -> tuple[Float64, Float64, Float64, Float64]:
    """Returns drops (n,) of the flanks (m), lower quartile and median; readings of flank cells with any, and of all.

    NaN where there is none. Wrong readings only add to a drop.
    """
    away = [side * (cells.flank + k) for side in (-1, 1) for k in range(_FLANK_CELLS)]
    places = [cells.beside(right) for right in away]
    drop = np.sort(np.stack([lowest.drop_m[at] for at in places]).astype(np.float64), axis=0)  # NaN last
    known = (~np.isnan(drop)).sum(axis=0)
    lower, usual = (np.take_along_axis(drop, (np.maximum(known - 1, 0) // part)[None], 0)[0] for part in (4, 2))
    count = np.stack([lowest.count[at] for at in places]).sum(axis=0)
    return lower, usual, count / np.maximum(known, 1), count / len(places)


_SMOOTHINGS = 3  # Passes that move each vertex of a line towards the middle of its neighbours.
_LOWER_FLANK = 0.5
"""A section is an edge if its lower flank is lower than this share of the height of the line between both flanks."""
_FARTHEST_CELLS = 1.5
"""A middle farther (cells) from its cell of the skeleton is discarded."""
_BLUR_CELLS = 0.98
"""Width at half height of a cell folded with a bin and with the spread of directions (7.5°), in cells."""
_MOST_RAISED = 1.6  # The depth is raised by this factor at most: narrower cracks leave no trace of their depth.
_LOWERED_M = 0.002
"""Heights of sections are lowered to the lowest readings by this much at most (m)."""
_SHOWN_SHARE = 0.5
"""A section of robust heights less than this share as deep as that of lowered ones is noise: heights do not show the
crack there."""


@dataclass(frozen=True)
class CrackPiece:
    """A piece of a crack from node to node. All sums can be added."""

    line_m: Float64
    """(n, 2) easting and northing (m)."""
    start: tuple[int, int]
    """Row and column on the map of the cell where it starts: an end, a junction or the border of a tile."""
    end: tuple[int, int]
    length_m: float
    measured_m: float
    """Length over which it has the cross-section of a crack, and depth and width are known (m)."""
    width_sum_m2: float
    """Integral of the width along the piece (m²): the crack's area."""
    width_max_m: float
    depth_sum_m2: float
    """Integral of the depth along the piece (m²)."""
    depth_max_m: float
    seen_sum_m: float = 0.0
    """Integral along the piece of the number of readings of a cell in its middle (m) …"""
    beside_sum_m: float = 0.0
    """… and of a cell beside it (m)."""

    @property
    def middle_m(self) -> Float64:
        """Returns the point (2,) halfway along its line (m): a simplified straight line has no vertex there."""
        along = way_along(self.line_m)
        return np.array([np.interp(0.5 * along[-1], along, axis) for axis in self.line_m.T])


@dataclass(frozen=True)
class Sections:
    """Figures of each cell (n,) of a skeleton."""

    place: Float64
    """(n, 2) column and row on the map, in cells; .5 is a cell's middle."""
    width_m: Float64
    """NaN where the section does not show it."""
    depth_m: Float64
    seen: Float64
    """(n, 2) readings of the cell in the crack's middle, and of a cell beside the crack; 0 where not counted."""


def halo_cells(config: CrackDetection, cell_m: float) -> int:
    """Returns the margin that a window needs around the cells in which cracks are wanted (cells)."""
    reach = math.ceil(math.hypot(4.5, section_cells(config, cell_m))) + 1
    walked = bridge_cells() + 2 + PRUNINGS * (_spur_cells(config, cell_m) + 2) + _SMOOTHINGS + 2
    return crack_response.halo_cells(config, cell_m) + max(CELLS_ALONG + reach, walked)


def crack_pieces(window: HeightWindow, config: CrackDetection) -> list[CrackPiece]:
    """Returns the pieces of the cracks whose edges start in the window's inner cells.

    Neighbouring windows give pieces that meet at common cells and do not overlap. None is left out for its length:
    when all are joined its length is known.
    """
    window = needed_part(window, config)
    if not window.raw_m.size:
        return []
    found = crack_response_of(window, config)
    graph = pruned(trimmed(found.skeleton, found.bridge, bridge_cells()), _spur_cells(config, window.cell_m))
    if not graph.edges.size:
        return []
    sections = _sections(window, found, graph, config)
    first = graph.edges[:, 0]
    own = window.is_inner(graph.row[first], graph.column[first])
    return [_piece(path, graph, sections, window) for path in graph.paths(own)]


def needed_part(window: HeightWindow, config: CrackDetection) -> HeightWindow:
    """Returns the part of a window on which its pieces depend: near its inner cells, and near measured ones."""
    halo = halo_cells(config, window.cell_m)
    own = window.inner()
    part = window.part(*((max(s.start - halo, 0), s.stop + halo) for s in own))
    known = ~np.isnan(part.raw_m)
    border = crack_response.border_cells(config, window.cell_m)
    spans = [np.flatnonzero(known.any(axis=axis)) for axis in (1, 0)]
    return part.part(*((int(at[0]) - border, int(at[-1]) + 1 + border) if at.size else (0, 0) for at in spans))


def sharpened(width_cells: Float64, depth_m: Float64) -> tuple[Float64, Float64]:
    """Returns width and depth of sections (n,), corrected for the blur of cells and bins.

    A section is the crack's, folded with a cell and with a bin. That adds the squares of widths and keeps the area:
    exact for bells, and good to some per cent for other forms. Depth is raised 1.6 times at most, where the crack is
    as wide as 0.8 cells at half its depth: what is narrower leaves no trace of how deep it is.
    """
    width = np.maximum(np.sqrt(np.maximum(width_cells**2 - _BLUR_CELLS**2, 0.0)), width_cells / _MOST_RAISED)
    return width, depth_m * (width_cells / width)


def section_cells(config: CrackDetection, cell_m: float) -> int:
    """Returns the half width of a cross-section (cells)."""
    flank = flank_cells(config, cell_m)[-1]
    return flank + max(flank // 2, 2) + 1


def _spur_cells(config: CrackDetection, cell_m: float) -> int:
    return round(config.spur_m / cell_m)


def _sections(window: HeightWindow, found: CrackResponse, graph: SkeletonGraph, config: CrackDetection) -> Sections:
    cells = _valley_cells(found)
    row, column = cells.row, cells.column
    out = _valley_sections(window.cleaned_m(), cells, window, config)
    hidden = np.zeros(row.size, bool)
    if window.lowest is not None:  # where robust heights show no crack, lowest readings may
        lowered = _valley_sections(window.lowered_m(_LOWERED_M), cells, window, config)
        hidden = np.isnan(out[:, 0]) | (out[:, 0] < _SHOWN_SHARE * lowered[:, 0])
        out[hidden, :4] = lowered[hidden, :4]
    right = np.where(np.abs(out[:, 2]) <= _FARTHEST_CELLS, out[:, 2], 0.0)
    width, depth = sharpened(out[:, 1], out[:, 0])
    bottom, seen = bottom_depths(window, cells, right, np.where(np.isnan(depth), np.nan, out[:, 4]))
    depth = blended(bottom, depth, np.where(hidden, 0.0, out[:, 1]))
    columns = found.skeleton.shape[1]
    own = np.searchsorted(row * columns + column, graph.row * columns + graph.column)
    east = column + window.first_column + 0.5 + right * cells.north
    north = row + window.first_row + 0.5 - right * cells.east
    place = np.stack([east, north], axis=-1)[own]
    for _ in range(_SMOOTHINGS):
        place = graph.smoothed(place)
    return Sections(place, width[own] * window.cell_m, depth[own], seen[own])


def _valley_sections(heights: Float64, cells: ValleyCells, window: HeightWindow, config: CrackDetection) -> Float64:
    """Returns (n, 5) as :func:`cross_sections` does; all but the ground's height is NaN where there is no crack."""
    out = np.empty((cells.row.size, 5))
    reach = section_cells(config, window.cell_m)
    cross_sections(heights, cells.row, cells.column, cells.north, cells.east, cells.flank, reach, out)
    with np.errstate(invalid="ignore"):
        is_valley = (out[:, 1] * window.cell_m <= config.max_width_m) & (out[:, 3] >= _LOWER_FLANK * out[:, 0])
    out[~is_valley, :4] = np.nan
    return out


def _valley_cells(found: CrackResponse) -> ValleyCells:
    """Returns all cells of the skeleton, also those pruned later: what is pruned depends on cells far away."""
    row, column = map(np.ascontiguousarray, np.nonzero(found.skeleton))
    angle = found.direction[row, column] * (np.pi / DIRECTIONS)
    flank = np.maximum(found.flank[row, column], 2).astype(np.int64)
    return ValleyCells(row, column, np.sin(angle), np.cos(angle), flank)


def _piece(path: Sequence[int], graph: SkeletonGraph, sections: Sections, window: HeightWindow) -> CrackPiece:
    cells = np.asarray(path)
    line_m = sections.place[cells] * window.cell_m
    step = np.hypot(*np.diff(line_m, axis=0).T)
    width, depth = sections.width_m[cells], sections.depth_m[cells]
    known = ~np.isnan(width[:-1] + width[1:])
    seen, beside = sections.seen[cells].T
    width_step, depth_step, seen, beside = (
        (0.5 * (a[:-1] + a[1:]) * step)[known] for a in (width, depth, seen, beside)
    )
    start, end = (
        (int(graph.row[k]) + window.first_row, int(graph.column[k]) + window.first_column) for k in cells[[0, -1]]
    )
    return CrackPiece(
        line_m,
        start,
        end,
        float(step.sum()),
        float(step[known].sum()),
        float(width_step.sum()),
        float(np.nanmax(width, initial=0.0)),
        float(depth_step.sum()),
        float(np.nanmax(depth, initial=0.0)),
        float(seen.sum()),
        float(beside.sum()),
    )
