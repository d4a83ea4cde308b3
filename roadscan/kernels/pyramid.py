"""Cells → pixels of overviews. Sums are of whole units, hence exact: a pixel does not depend on the way to it."""

from __future__ import annotations

import numpy as np

from roadscan.kernels.cell_runs import run_end
from roadscan.kernels.options import kernel

TO_HEIGHT_UNIT = 1.5 * 2.0**20
"""Added and taken away again, it rounds a number below 2¹⁹ to a multiple of 2⁻³² (heights, m: 0.23 nm)."""

TO_WHOLE = 1.5 * 2.0**52
"""Added and taken away again, it rounds a number below 2⁵¹ to a whole one (intensities)."""


@kernel
def _add_run(count, height, intensity, base, cells, points, above, light):
    """Add cells side by side to the sums of their columns."""
    for i in range(count.size):
        cells[i] += 1.0
    for i in range(count.size):
        points[i] += np.float64(count[i])
    for i in range(count.size):
        above[i] += ((height[i] - base) + TO_HEIGHT_UNIT) - TO_HEIGHT_UNIT
    for i in range(count.size):
        light[i] += (np.float64(intensity[i]) * np.float64(count[i]) + TO_WHOLE) - TO_WHOLE


@kernel
def _fold(line, factor, pixels):
    """Add `factor` columns to each pixel, and leave zeros. Usual factors are spelled out for the compiler."""
    if factor == 2:
        for p in range(pixels.size):
            pixels[p] += line[2 * p] + line[2 * p + 1]
    elif factor == 4:
        for p in range(pixels.size):
            pixels[p] += (line[4 * p] + line[4 * p + 1]) + (line[4 * p + 2] + line[4 * p + 3])
    else:
        for p in range(pixels.size):
            for j in range(factor):
                pixels[p] += line[factor * p + j]
    line[:] = 0.0


@kernel
def _means(cells, points, above, light, base, out_count, out_cells, out_height, out_intensity):
    """Write pixels side by side that all hold a cell."""
    for p in range(cells.size):
        out_cells[p] = np.uint32(cells[p])
    for p in range(cells.size):
        out_count[p] = np.uint32(points[p])
    for p in range(cells.size):
        out_height[p] = base + above[p] / cells[p]
    for p in range(cells.size):
        out_intensity[p] = light[p] / points[p]


@kernel
def reduce_cells(
    column, row, count, height, intensity, base, factors, edges, starts, sums,
    out_column, out_row, out_count, out_cells, out_height, out_intensity, written,
):  # fmt: skip
    """Pixels of all levels in one pass over the cells, strip by strip; the sums of a strip feed the next level.

    Parameters
    ----------
    column, row : (n,) uint16, sorted by row, column; count : (n,) uint32.
    height : (n,) float64, m; intensity : (n,) float32, mean of the cell's points.
    base : float64, whole metres near the heights: sums are of heights above it.
    factors : (levels,) int64, ascending, each a multiple of the one before.
    edges, starts : (levels,) int64, pixels along an edge; first place of each level in the outputs.
    sums : (levels + 1, 4, edge) float64, zeros; zeros again at the end. Cells, points, height above `base`, intensity:
        first of the columns of a strip, then of the pixels of each level.
    out_column, out_row : (…,) uint16, out; out_count, out_cells : uint32; out_height : float64, m;
        out_intensity : float32.
    written : (levels,) int64, out: pixels of each level.
    """
    n = row.size
    levels = factors.size
    written[:] = 0
    i = 0
    while i < n:
        strip = row[i] // factors[0]
        while i < n and row[i] // factors[0] == strip:
            end = run_end(column, row, i, n)
            own = slice(np.int64(column[i]), np.int64(column[i]) + end - i)
            _add_run(
                count[i:end], height[i:end], intensity[i:end], base,
                sums[0, 0, own], sums[0, 1, own], sums[0, 2, own], sums[0, 3, own],
            )  # fmt: skip
            i = end
        line, following = np.int64(row[i - 1]), np.int64(row[i]) if i < n else np.int64(-1)
        for level in range(levels):
            ratio = factors[level] // factors[level - 1] if level > 0 else factors[0]
            for k in range(4):
                _fold(sums[level, k, : ratio * edges[level]], ratio, sums[level + 1, k, : edges[level]])
            line //= ratio
            following //= ratio
            if following == line:
                break  # more of this line of pixels is to come
            at = starts[level] + written[level]
            here, end = sums[level + 1], 0
            while end < edges[level]:
                pixel = end
                while pixel < edges[level] and here[0, pixel] == 0.0:
                    pixel += 1
                end = pixel
                while end < edges[level] and here[0, end] > 0.0:
                    out_column[at + end - pixel] = end
                    end += 1
                to = at + end - pixel
                out_row[at:to] = line
                _means(
                    here[0, pixel:end], here[1, pixel:end], here[2, pixel:end], here[3, pixel:end],
                    base, out_count[at:to], out_cells[at:to], out_height[at:to], out_intensity[at:to],
                )  # fmt: skip
                at = to
            written[level] = at - starts[level]
            if level + 1 == levels:
                sums[levels, :, : edges[level]] = 0.0
