"""Straight lines in groups of cells: fences, walls and hedges that touch parked cars, told from flanks of these."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kernels import columns
from roadscan.assets.moving import BODY, CELL_M, LEVEL_M, TALL, Columns
from roadscan.assets.quantiles import median, quantiles
from roadscan.compute.array_types import Bool, Float64
from roadscan.core.extras import cv2

LINE: Final = Judge("line", "43036f8ce76ddde9")
"""Is a straight line of cells a fence, a wall, a hedge or a front, and no flank of a vehicle or of a row of them?"""
_LEAST: Final = 0.5
"""Probability from which a line is none of vehicles."""
_LENGTH_CELLS: Final = 35
"""Least length of a line (7 m): the sides of most vehicles are shorter."""
_GAP: Final = 1
"""Empty cells that do not end a line."""
_ANGLES: Final = 72
"""Directions of lines: a line of 7 m within 1.25° of one of them keeps to a strip of two cells."""
_MOST_LINES, _MOST_CELLS = 6, 20_000
"""Most lines of one group, and cells of the largest group in which they are sought: woods are larger."""
_UPPER: Final = 0.75
"""Share of the cells of a line that do not end above the level with which the others are compared."""
_STEP_CELLS: Final = 5
"""Parts of a line, as long as the shortest line, begin so many cells apart."""


class Lines(NamedTuple):
    """Straight lines of cells, and what tells what they are."""

    row: list[npt.NDArray[np.int64]]
    column: list[npt.NDArray[np.int64]]
    """Cells of each line."""
    features: dict[str, Float64]
    """(k,) by name."""

    def mask(self, which: Bool, shape: tuple[int, ...]) -> Bool:
        """Returns the cells (rows, columns) of some of the lines; which : (k,)."""
        out = np.zeros(shape, np.bool_)
        for k in np.flatnonzero(which).tolist():
            out[self.row[k], self.column[k]] = True
        return out


def are_no_flanks(lines: Lines) -> Bool:
    """Returns which lines (k,) are no flanks of vehicles."""
    return LINE.probability(lines.features) >= _LEAST if lines.row else np.zeros(0, np.bool_)


def lines_of(groups: Iterable[tuple[Bool, int, int]], raster: Columns) -> Lines:
    """Returns the straight lines of some groups, the longest of each group first, with their features.

    groups : cells (rows, columns) of a part of the raster, and the first row and column of that part.
    """
    rows, many = [], []
    for inside, first_row, first_column in groups:
        for row, column in _runs(inside):
            rows.append(row + first_row)
            many.append(column + first_column)
    told = [_features(row, column, raster) for row, column in zip(rows, many, strict=True)]
    return Lines(rows, many, {name: np.array([one[name] for one in told]) for name in (told[0] if told else ())})


def _runs(inside: Bool) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
    """Returns rows and columns of the cells of each straight run of a group (rows, columns)."""
    out: list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]] = []
    # a line over the diagonal of its box has that many columns, or rows
    if max(inside.shape) < _LENGTH_CELLS / math.sqrt(2.0) or np.count_nonzero(inside) > _MOST_CELLS:
        return out
    row, column = np.nonzero(inside)
    free, x, y = _at_the_rim(inside)[row, column], column.astype(np.float64), row.astype(np.float64)
    for _ in range(_MOST_LINES):
        line = np.zeros(row.size, np.bool_)
        if columns.straight_run(x, y, free, _ANGLES, _GAP, line) < _LENGTH_CELLS:
            break
        free &= ~line
        out.append((row[line], column[line]))
    return out


def _at_the_rim(inside: Bool) -> Bool:
    """Returns the cells of a group with room beside them: no line runs across the roofs of cars that touch each other.

    inside : (rows, columns), and so is what is returned. A hole of one cell in a body is none.
    """
    around, rim = np.ones((3, 3), np.uint8), np.pad(inside, 2)
    body = cv2.morphologyEx(rim.view(np.uint8), cv2.MORPH_CLOSE, around)
    return np.asarray((rim & (cv2.erode(body, around) == 0))[2:-2, 2:-2])


def _features(row: npt.NDArray[np.int64], column: npt.NDArray[np.int64], raster: Columns) -> dict[str, float]:
    """Returns the features of a line of cells.

    Bonnets and cabins of a row of cars differ in height within any part of 7 m; a fence may stand on a part of a wall.
    """
    along = _along(row, column)
    levels, top = raster.levels[row, column], raster.top[row, column]
    starts = range(0, max(int(along.max()) - _LENGTH_CELLS, 0) + 1, _STEP_CELLS)
    parts = [top[(along >= start - 0.5) & (along < start + _LENGTH_CELLS - 0.5)] for start in starts]
    low, middle, upper, high = ((level + 1.0) * LEVEL_M for level in quantiles(top, [0.1, 0.5, _UPPER, 0.9]))
    return {
        "length_m": float(along.max() + 1.0) * CELL_M, "even": _even(top),
        "even_part": max(_even(part) for part in parts if part.size),
        "levels": float(median(np.bitwise_count(levels & np.uint32(BODY)).astype(np.int64))),
        "levels_seen": float(np.mean(np.bitwise_count(levels & np.uint32((1 << TALL) - 2)) / np.maximum(top, 1))),
        "low_top_m": low, "middle_top_m": middle, "upper_top_m": upper, "high_top_m": high,
    }  # fmt: skip


def _along(row: npt.NDArray[np.int64], column: npt.NDArray[np.int64]) -> Float64:
    """Returns how far along the line through them cells (n,) lie, from the first (cells).

    Sums of whole numbers are exact, so the bits are the same on each machine.
    """
    x, y, count = column, row, row.size
    xx, yy = (count * (v * v).sum() - v.sum() ** 2 for v in (x, y))
    angle = math.atan2(2.0 * (count * (x * y).sum() - x.sum() * y.sum()), xx - yy) / 2.0
    along = x * math.cos(angle) + y * math.sin(angle)
    return np.asarray(along - along.min())


def _even(top: npt.NDArray[np.int32]) -> float:
    """Returns the share of cells (n,) that end within one level of the upper quartile."""
    return float(np.mean(np.abs(top - quantiles(top, [_UPPER])[0]) <= 1.0))
