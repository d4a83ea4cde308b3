"""Depth of a crack's bottom, from the lowest readings of its cells.

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

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.distress.kernels.quantiles_along import quantiles_along
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
