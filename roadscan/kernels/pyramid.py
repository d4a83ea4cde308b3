"""Cells → pixels of overviews. Sums are of whole units, hence exact: a pixel does not depend on the way to it."""

from __future__ import annotations

import numpy as np

from roadscan.kernels.options import kernel

TO_HEIGHT_UNIT = 1.5 * 2.0**20
"""Added and taken away again, it rounds a number below 2¹⁹ to a multiple of 2⁻³² (heights, m: 0.23 nm)."""

TO_WHOLE = 1.5 * 2.0**52
"""Added and taken away again, it rounds a number below 2⁵¹ to a whole one (intensities)."""


@kernel
def reduce_cells(
    column, row, count, height, intensity, base, factors, edges, starts, pixel_of, sums,
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
    pixel_of : (edge,) uint16, a cell's column or row divided by the first factor.
    sums : (levels, pixels along an edge of the first, 4) float64, zeros; zeros again at the end.
        Cells, points, height above `base`, intensity of a strip's pixels.
    out_column, out_row : (…,) uint16, out; out_count, out_cells : uint32; out_height : float64, m;
        out_intensity : float32.
    written : (levels,) int64, out: pixels of each level.
    """
    n = row.size
    levels = factors.size
    written[:] = 0
    first = sums[0]
    i = 0
    while i < n:
        strip = pixel_of[row[i]]
        while i < n and pixel_of[row[i]] == strip:
            pixel = np.int64(pixel_of[column[i]])
            points = np.float64(count[i])
            first[pixel, 0] += 1.0
            first[pixel, 1] += points
            first[pixel, 2] += ((height[i] - base) + TO_HEIGHT_UNIT) - TO_HEIGHT_UNIT
            first[pixel, 3] += (np.float64(intensity[i]) * points + TO_WHOLE) - TO_WHOLE
            i += 1
        line = np.int64(strip)
        following = np.int64(pixel_of[row[i]]) if i < n else np.int64(-1)
        for level in range(levels):
            ratio = factors[level + 1] // factors[level] if level + 1 < levels else 1
            here = sums[level]
            at = starts[level] + written[level]
            for pixel in range(edges[level]):
                cells = here[pixel, 0]
                if cells == 0.0:
                    continue
                points = here[pixel, 1]
                out_column[at] = pixel
                out_row[at] = line
                out_count[at] = np.uint32(points)
                out_cells[at] = np.uint32(cells)
                out_height[at] = base + here[pixel, 2] / cells
                out_intensity[at] = here[pixel, 3] / points
                at += 1
                if level + 1 < levels:
                    parent = pixel // ratio
                    for k in range(4):
                        sums[level + 1, parent, k] += here[pixel, k]
                for k in range(4):
                    here[pixel, k] = 0.0
            written[level] = at - starts[level]
            if following >= 0 and following // ratio == line // ratio:
                break
            line //= ratio
            following = following // ratio if following >= 0 else following
