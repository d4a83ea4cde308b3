"""Computes pixels of overviews from cells. Sums are of whole units, hence exact, whatever the order."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare, bare_inner, kernel


@bare
def run_end(column, row, start, end):
    """Return the end of the run that begins at `start`: cells of one row, each beside the one before.

    Parameters
    ----------
    column, row : (n,) uint16, sorted by row, column, no cell twice.
    start, end : int, the run ends at `end` at the latest.
    """
    step = 1
    while start + step < end and row[start + step] == row[start] and column[start + step] - column[start] == step:
        step *= 2
    low, high = start + (step >> 1), min(start + step, end)
    while high - low > 1:
        middle = (low + high) >> 1
        if row[middle] == row[start] and column[middle] - column[start] == middle - start:
            low = middle
        else:
            high = middle
    return low + 1


TO_HEIGHT_UNIT = 1.5 * 2.0**20
"""Adding and subtracting it rounds a number below 2¹⁹ to a multiple of 2⁻³² (heights, m: 0.23 nm)."""

_SAMPLE = 4096  # About this many cells are sampled for runs.

TO_WHOLE = 1.5 * 2.0**52
"""Adding and subtracting it rounds a number below 2⁵¹ to an integer (intensities)."""


class Levels(NamedTuple):
    """Overviews of a tile: the factor of each, and the place of its pixels."""

    factors: npt.NDArray[np.int64]
    """(levels,) cells along an edge of a pixel, ascending, each a multiple of the one before."""
    edges: npt.NDArray[np.int64]
    """(levels,) pixels along an edge of the tile."""
    starts: npt.NDArray[np.int64]
    """(levels,) first place of each level in the pixels."""
    written: npt.NDArray[np.int64]
    """(levels,) out: pixels of each level."""


class Pixels(NamedTuple):
    """Pixels of all levels with at least one cell, in order of row and column; written by kernels."""

    column: npt.NDArray[np.uint16]
    """(n,) from the tile's west edge."""
    row: npt.NDArray[np.uint16]
    """(n,) from its south edge."""
    readings: npt.NDArray[np.uint32]
    """(n,)"""
    cells: npt.NDArray[np.uint32]
    """(n,) number of cells with a reading."""
    height_m: npt.NDArray[np.float64]
    """(n,) mean of the cells' heights."""
    intensity: npt.NDArray[np.float32]
    """(n,) mean of the readings' intensities."""


@bare_inner
def _add_pairs(count, height, intensity, base, cells, points, above, light):
    """Add two adjacent cells to each pixel."""
    for p in range(cells.size):
        cells[p] += 2.0
    for p in range(cells.size):
        points[p] += np.float64(count[2 * p]) + np.float64(count[2 * p + 1])
    for p in range(cells.size):
        west, east = height[2 * p] - base, height[2 * p + 1] - base
        above[p] += ((west + TO_HEIGHT_UNIT) - TO_HEIGHT_UNIT) + ((east + TO_HEIGHT_UNIT) - TO_HEIGHT_UNIT)
    for p in range(cells.size):
        west = np.float64(intensity[2 * p]) * np.float64(count[2 * p])
        east = np.float64(intensity[2 * p + 1]) * np.float64(count[2 * p + 1])
        light[p] += ((west + TO_WHOLE) - TO_WHOLE) + ((east + TO_WHOLE) - TO_WHOLE)


@bare_inner
def _add_run(first, factor, count, height, intensity, base, sums):
    """Add adjacent cells from column `first` on to the sums (4, …) of their pixels."""
    end, pairs = count.size, 0
    if factor == 2:
        start = first & 1
        pairs = (end - start) >> 1
        own = slice((first + start) >> 1, ((first + start) >> 1) + pairs)
        _add_pairs(
            count[start:],
            height[start:],
            intensity[start:],
            base,
            sums[0, own],
            sums[1, own],
            sums[2, own],
            sums[3, own],
        )
    i = 0
    while i < end:
        if pairs > 0 and i == first & 1:
            i += 2 * pairs
            continue
        pixel, points = (first + i) // factor, np.float64(count[i])
        sums[0, pixel] += 1.0
        sums[1, pixel] += points
        sums[2, pixel] += ((height[i] - base) + TO_HEIGHT_UNIT) - TO_HEIGHT_UNIT
        sums[3, pixel] += (np.float64(intensity[i]) * points + TO_WHOLE) - TO_WHOLE
        i += 1


@bare
def _fold(line, factor, pixels):
    """Add `factor` pixels to each of the next level, and reset them to 0. The usual four are written out."""
    if factor == 4:
        for p in range(pixels.size):
            pixels[p] += (line[4 * p] + line[4 * p + 1]) + (line[4 * p + 2] + line[4 * p + 3])
    else:
        for p in range(pixels.size):
            for j in range(factor):
                pixels[p] += line[factor * p + j]
    line[:] = 0.0


@bare
def _means(cells, points, above, light, base, out_count, out_cells, out_height, out_intensity):
    """Write adjacent pixels, each with a cell."""
    for p in range(cells.size):
        out_cells[p] = np.uint32(cells[p])
    for p in range(cells.size):
        out_count[p] = np.uint32(points[p])
    for p in range(cells.size):
        out_height[p] = base + above[p] / cells[p]
    for p in range(cells.size):
        out_intensity[p] = light[p] / points[p]


@bare_inner
def _is_scattered(column, row):
    """Return True where fewer than half of the sampled cells have a neighbour, so that searching runs does not pay."""
    beside, looked = 0, 0
    for k in range(1, row.size, 1 + row.size // _SAMPLE):
        looked += 1
        beside += np.int64((row[k] == row[k - 1]) & (column[k] == column[k - 1] + 1))
    return 2 * beside < looked


@bare_inner
def _add_cells(column, factor, count, height, intensity, base, cells, above, points, light):
    """Add cells one by one to the sums of their pixels; return the first pixel and the one after the last."""
    west, east = cells.size, 0
    for i in range(column.size):
        pixel = np.int64(column[i] >> 1) if factor == 2 else np.int64(column[i]) // factor
        number = np.float64(count[i])
        cells[pixel] += 1.0
        points[pixel] += number
        above[pixel] += ((height[i] - base) + TO_HEIGHT_UNIT) - TO_HEIGHT_UNIT
        light[pixel] += (np.float64(intensity[i]) * number + TO_WHOLE) - TO_WHOLE
        west, east = min(west, pixel), max(east, pixel + 1)
    return west, east


@bare_inner
def _write_pixels(sums, west, east, base, line, at, out):
    """Write pixels one by one; return where the next one goes."""
    for pixel in range(west, east):
        cells = sums[0, pixel]
        if cells > 0.0:
            out.column[at], out.row[at] = pixel, line
            out.cells[at], out.readings[at] = np.uint32(cells), np.uint32(sums[1, pixel])
            out.height_m[at] = base + sums[2, pixel] / cells
            out.intensity[at] = sums[3, pixel] / sums[1, pixel]
            at += 1
    return at


@bare_inner
def _reduce(cells, base, levels, sums, pixels, west, east):
    """Compute :func:`reduce_cells`; west, east: (levels,) int64, edges[0] and 0, pixels of a strip that have sums."""
    column, row, height, intensity, count = cells
    factors, edges, starts, written = levels
    n = row.size
    scattered = _is_scattered(column, row)
    most = factors.size
    written[:] = 0
    i = 0
    while i < n:
        strip = row[i] // factors[0]
        beyond = (np.int64(strip) + 1) * factors[0]
        if scattered:
            end = i + 1
            while end < n and row[end] < beyond:
                end += 1
            west[0], east[0] = _add_cells(
                column[i:end], factors[0], count[i:end], height[i:end], intensity[i:end], base,
                sums[0, 0], sums[0, 2], sums[0, 1], sums[0, 3],
            )  # fmt: skip
            i = end
        while i < n and row[i] < beyond:
            end, first = run_end(column, row, i, n), np.int64(column[i])
            _add_run(first, factors[0], count[i:end], height[i:end], intensity[i:end], base, sums[0])
            west[0] = min(west[0], first // factors[0])
            east[0] = max(east[0], (first + end - i - 1) // factors[0] + 1)
            i = end
        line, following = np.int64(strip), row[i] // factors[0] if i < n else np.int64(-1)
        for level in range(most):
            at = starts[level] + written[level]
            here, end = sums[level], west[level]
            if scattered:
                at = _write_pixels(here, west[level], east[level], base, line, at, pixels)
                end = east[level]
            while end < east[level]:
                pixel = end
                while pixel < east[level] and here[0, pixel] == 0.0:
                    pixel += 1
                end = pixel
                while end < east[level] and here[0, end] > 0.0:
                    pixels.column[at + end - pixel] = end
                    end += 1
                to = at + end - pixel
                pixels.row[at:to] = line
                _means(
                    here[0, pixel:end], here[1, pixel:end], here[2, pixel:end], here[3, pixel:end],
                    base, pixels.readings[at:to], pixels.cells[at:to], pixels.height_m[at:to], pixels.intensity[at:to],
                )  # fmt: skip
                at = to
            written[level] = at - starts[level]
            if level + 1 == most:
                here[:, west[level] : east[level]] = 0.0
                west[level], east[level] = edges[0], 0
                break
            ratio = factors[level + 1] // factors[level]
            low, high = west[level] // ratio, -(-east[level] // ratio)
            for k in range(4):
                _fold(here[k, ratio * low : ratio * high], ratio, sums[level + 1, k, low:high])
            west[level + 1], east[level + 1] = min(west[level + 1], low), max(east[level + 1], high)
            west[level], east[level] = edges[0], 0
            line //= ratio
            following //= ratio
            if following == line:
                break  # more cells of this line of pixels follow


@kernel
def reduce_cells(cells, base, levels, sums, pixels):
    """Compute the pixels of all levels in one pass over the cells; the sums of a strip feed the next level.

    Parameters
    ----------
    cells : Cells; levels : Levels; pixels : Pixels.
    base : float64, whole metres near the heights: sums are of heights above it.
    sums : (levels, 4, pixels along an edge of the first) float64, zeros; zeros again at the end. Cells, points, height
        above `base`, intensity of a strip's pixels.
    """
    most = levels.factors.size
    _reduce(cells, base, levels, sums, pixels, np.full(most, levels.edges[0]), np.zeros(most, np.int64))


class Cells(NamedTuple):
    """Cells of a tile with a reading, sorted by row and column."""

    column: npt.NDArray[np.uint16]
    """(n,) from the tile's west edge."""
    row: npt.NDArray[np.uint16]
    """(n,) from its south edge."""
    height_m: npt.NDArray[np.float64]
    """(n,)"""
    intensity: npt.NDArray[np.float32]
    """(n,) mean of the cell's readings."""
    readings: npt.NDArray[np.uint32]
    """(n,)"""
