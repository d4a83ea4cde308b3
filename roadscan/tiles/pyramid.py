"""Overviews of a tile: its cells in ever larger pixels, for small map scales."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import read_only
from roadscan.core.errors import ConfigError
from roadscan.tiles.cells import TileCells
from roadscan.tiles.kernels.pyramid import Levels, Pixels, reduce_cells

WANTED_FACTORS: Final = (2, 8, 32)
"""Cells along an edge of a pixel: cells of 5 mm become pixels of 10, 40 and 160 mm."""

LARGEST_FACTOR: Final = 256
"""Largest factor: sums stay exact while a pixel's cells, times their height above the first cell, are below 2²¹ m."""


@dataclass(frozen=True)
class Level:
    """Pixels of one overview with at least one point, in order of row and column; all arrays are (n,)."""

    factor: int
    """Cells of the tile along an edge of a pixel."""
    column: npt.NDArray[np.uint16]
    """Column of the pixel in its tile, from the west edge."""
    row: npt.NDArray[np.uint16]
    """Row of the pixel in its tile, from the south edge."""
    count: npt.NDArray[np.uint32]
    """Number of points in the pixel."""
    cells: npt.NDArray[np.uint32]
    """Number of cells of the pixel with a point."""
    height_m: npt.NDArray[np.float64]
    """Mean of the robust heights of those cells, each counted once, rounded to 2⁻³² m before summation."""
    intensity: npt.NDArray[np.float32]
    """Mean intensity of the pixel's points."""

    def __len__(self) -> int:
        return int(self.column.size)


@functools.cache
def overview_factors(cells_per_edge: int, wanted: tuple[int, ...] = WANTED_FACTORS) -> tuple[int, ...]:
    """Return the factors of a tile's overviews: for each wanted one the nearest that fits, ascending.

    A factor fits if it divides the tile's edge, so that no pixel straddles two tiles, and is a multiple of the
    factor before it. Nearest is by ratio, the smaller of two equally near. 10 m tiles with cells of 5 mm get
    2, 8 and 40 (10, 40 and 200 mm; 160 mm does not divide 10 m); tiles of 8 or 16 m get 2, 8 and 32. A wanted
    factor is left out where none within twice or half of it fits.
    """
    found: list[int] = []
    for near in wanted:
        last = found[-1] if found else 1
        fits = [
            f
            for f in range(2 * last, min(2 * near, cells_per_edge, LARGEST_FACTOR) + 1, last)
            if cells_per_edge % f == 0 and 2 * f >= near
        ]
        if fits:
            found.append(min(fits, key=lambda f: (max(f / near, near / f), f)))
    return tuple(found)


def pyramid_of(cells: TileCells, factors: Sequence[int]) -> list[Level]:
    """Compute overviews of a tile by `factors`, in that order; the result does not depend on the other factors.

    Sums are of whole units: heights of 2⁻³² m, intensities of digital numbers (a cell's mean times its count,
    rounded: exact up to 128 readings of 65,535 a cell). Raises :class:`ConfigError` for factors that do not
    divide the tile's edge or are not ascending multiples of one another.
    """
    from roadscan.tiles.kernels.decimate import Cells

    edge = cells.cells_per_edge
    _check(edge, factors)
    if not factors:
        return []
    steps = np.array(factors, np.int64)
    edges = edge // steps
    rooms = np.minimum(edges * edges, len(cells))
    ends = np.cumsum(rooms)
    starts, total = ends - rooms, int(ends[-1])
    column, row = np.empty(total, np.uint16), np.empty(total, np.uint16)
    count, covered = np.empty(total, np.uint32), np.empty(total, np.uint32)
    height, intensity = np.empty(total, np.float64), np.empty(total, np.float32)
    written = np.zeros(len(factors), np.int64)
    base = float(np.rint(cells.height_robust_m[0])) if len(cells) else 0.0
    held = Cells(
        cells.column, cells.row, read_only(cells.height_robust_m), cells.intensity_mean, cells.count
    )  # fmt: skip
    pixels = Pixels(column, row, count, covered, height, intensity)
    reduce_cells(held, base, Levels(steps, edges, starts, written), np.zeros((len(factors), 4, edges[0])), pixels)
    levels: list[Level] = []
    for factor, start, size in zip(factors, starts.tolist(), written.tolist(), strict=True):
        own = slice(start, start + size)
        levels.append(Level(factor, column[own], row[own], count[own], covered[own], height[own], intensity[own]))
    return levels


def _check(edge: int, factors: Sequence[int]) -> None:
    for before, factor in itertools.pairwise((1, *factors)):
        if not before < factor <= LARGEST_FACTOR or factor % before or math.gcd(edge, factor) != factor:
            raise ConfigError(
                f"overviews by {', '.join(map(str, factors))} of a tile of {edge} cells",
                expected=f"ascending factors up to {LARGEST_FACTOR} that divide the tile and one another",
                change="use overview_factors(cells_per_edge)",
            )
