"""A window of a gridded surface, the input of the detection of cracks and potholes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64
from roadscan.core.errors import RoadscanError
from roadscan.core.extras import cv2

CROWD_CELLS: Final = 5
"""The readings of a cell are compared with those of the cells within this distance (cells)."""
_CROWD_TIMES: Final = 3
"""A cell with more than this many times the mean number of readings around is crowded, as where a vehicle stood."""


@dataclass(frozen=True)
class LowestReadings:
    """Lowest readings of a window; arrays (rows, columns)."""

    drop_m: npt.NDArray[np.float32]
    """Depth of a cell's lowest reading below its robust height (m), NaN where that is not known."""
    count: npt.NDArray[np.uint16]
    """Number of readings in the cell; 65,535 stands for all above."""

    def part(self, rows: slice, columns: slice) -> LowestReadings:
        """Returns some of the rows and columns, as views."""
        return LowestReadings(self.drop_m[rows, columns], self.count[rows, columns])

    def crowded(self) -> npt.NDArray[np.bool_]:
        """Returns a mask of the cells with many times the readings of non-empty cells around, in whole numbers."""
        side = (2 * CROWD_CELLS + 1,) * 2
        around = cv2.boxFilter(self.count, cv2.CV_64F, side, None, (-1, -1), False, cv2.BORDER_CONSTANT)
        cells = cv2.boxFilter(
            (self.count > 0).view(np.uint8), cv2.CV_32S, side, None, (-1, -1), False, cv2.BORDER_CONSTANT
        )
        return np.asarray(self.count * cells.astype(np.float64) > _CROWD_TIMES * around)


HEIGHT_STEP_M = 1e-5
"""Heights are whole multiples of this (m), so that sums do not depend on their order."""
_OUTLIER_SIGMAS = 6.0  # Raw heights farther than this from smoothed ones (σ) are impulses.
_SURE_READINGS = 5
"""With this many readings a cell's median is hardly wrong."""


@dataclass(frozen=True)
class HeightWindow:
    """Heights of a rectangle of square cells, its northernmost row last.

    Cells are counted from the map's origin: cell (row, column) covers northing [row, row + 1) · `cell_m`.
    """

    raw_m: Float64
    """(rows, columns) heights before smoothing (m), NaN where there is none."""
    height_m: Float64
    """The same after smoothing."""
    cell_m: float
    sigma_m: float
    """1 σ of the noise of one cell's raw height (m)."""
    first_row: int = 0
    """Row on the map of the window's first row."""
    first_column: int = 0
    halo: int = 0
    """Cells along each border that belong to the neighbours: they are read, and nothing is reported in them."""
    cut_off: tuple[tuple[int, int], tuple[int, int]] = ((0, 0), (0, 0))
    """Numbers of cells cut off at the south and north, and at the west and east, the halo first."""
    lowest: LowestReadings | None = None
    """Lowest readings of the same cells; None where they are not known."""

    def __post_init__(self) -> None:
        if self.raw_m.ndim != 2 or self.raw_m.shape != self.height_m.shape:
            raise RoadscanError(
                f"heights of shapes {self.raw_m.shape} and {self.height_m.shape}",
                expected="two grids of the same rows and columns",
            )
        whole = [n + sum(gone) for n, gone in zip(self.raw_m.shape, self.cut_off, strict=True)]
        if 2 * self.halo >= min(whole):
            raise RoadscanError(
                f"a window of {whole[0]} × {whole[1]} cells with a halo of {self.halo}",
                expected="cells that are not halo",
            )

    def inner(self) -> tuple[slice, slice]:
        """Returns row and column slices of the cells that are not halo."""
        rows, columns = (
            slice(min(max(self.halo - low, 0), n), max(n - max(self.halo - high, 0), 0))
            for n, (low, high) in zip(self.raw_m.shape, self.cut_off, strict=True)
        )
        return rows, columns

    def part(self, rows: tuple[int, int], columns: tuple[int, int]) -> HeightWindow:
        """Returns the cells from one row and column up to others, clipped to the window."""
        spans, cut_off = [], []
        for n, span, gone in zip(self.raw_m.shape, (rows, columns), self.cut_off, strict=True):
            low = min(max(span[0], 0), n)
            high = max(min(span[1], n), low)
            spans.append(slice(low, high))
            cut_off.append((gone[0] + low, gone[1] + n - high))
        own = (spans[0], spans[1])
        return replace(
            self,
            raw_m=self.raw_m[own],
            height_m=self.height_m[own],
            lowest=None if self.lowest is None else self.lowest.part(*own),
            first_row=self.first_row + spans[0].start,
            first_column=self.first_column + spans[1].start,
            cut_off=(cut_off[0], cut_off[1]),
        )

    def is_inner(self, row: npt.NDArray[np.int64], column: npt.NDArray[np.int64]) -> Bool:
        """Returns a mask of the cells (n,), counted within the window, that are not halo."""
        rows, columns = self.inner()
        return np.asarray((row >= rows.start) & (row < rows.stop) & (column >= columns.start) & (column < columns.stop))

    def cleaned_m(self) -> Float64:
        """Returns raw heights without those that the smoothing left out as impulses.

        A low robust height of several readings is no impulse: it is a crack's, which fills little of the cells
        around. One above may be that of what lies on the road.
        """
        off = self.raw_m - self.height_m
        with np.errstate(invalid="ignore"):
            kept = np.abs(off) <= _OUTLIER_SIGMAS * self.sigma_m
            if self.lowest is not None:
                kept |= (off < 0.0) & (self.lowest.count >= _SURE_READINGS)
        return np.where(kept, self.raw_m, np.nan)

    def lowered_m(self, most_m: float) -> Float64:
        """Returns the same, lowered to the lowest reading of a cell where it is known, but by at most `most_m` (m).

        A crack that takes in less than half of a cell is not in its height, but in its lowest reading. A single wrong
        reading decides that: it must not outweigh the cells around. Nor must cells with many times the readings of
        those around them (``surface/heights.py``): the lowest of 300 readings lies lower than that of 10.
        """
        heights = self.cleaned_m()
        if self.lowest is None or most_m <= 0.0:
            return heights
        drop = np.minimum(self.lowest.drop_m, np.float32(most_m))
        return np.asarray(heights - np.where(np.isnan(drop) | self.lowest.crowded(), np.float32(0.0), drop))

    def map_m(self, row: npt.ArrayLike, column: npt.ArrayLike) -> Float64:
        """Returns easting and northing (n, 2) of positions in cells of the window; .5 is a cell's middle."""
        east = (np.asarray(column, np.float64) + self.first_column) * self.cell_m
        north = (np.asarray(row, np.float64) + self.first_row) * self.cell_m
        return np.stack([east, north], axis=-1)
