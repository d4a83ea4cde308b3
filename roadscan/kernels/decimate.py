"""Cells → one point a square, without what lies on the pavement or gapes in it. Whole micrometres throughout.

Places without a cell hold `ABSENT`, above every height, so that loops run over whole squares and need no branch.
"""

from __future__ import annotations

import numpy as np

from roadscan.kernels.cells import MAD_TO_SIGMA, OUTLIER_SIGMAS
from roadscan.kernels.options import inlined, kernel

ABSENT = np.int32(2**31 - 1)
"""Height of a place without a cell."""
FARTHEST_UM = 2.0**28
"""Heights are cut off here, 268 m above and below the base, so that no difference overflows."""
LIGHT_STEPS = 64.0
"""Intensities are summed in sixty-fourths of a digital number."""
LANES = 16
"""Scratch arrays are whole registers of as many int32."""


@inlined
def count_upto(values, n, limit):
    """How many of the first `n` values (int32) are `limit` or less."""
    below = np.int32(0)
    if n == LANES:
        for i in range(LANES):
            below = np.int32(below + np.int32(values[i] <= limit))
        return below
    for i in range(n):
        below = np.int32(below + np.int32(values[i] <= limit))
    return below


@inlined
def value_of_rank(values, n, rank):
    """Value of `rank` (from 0) among the first `n` (int32): the least that more than `rank` of them do not exceed.

    One register of values is compared with itself; for more, the interval of values is halved, so that each pass is
    a count that the processor does many at a time.
    """
    if n == LANES:
        least = ABSENT
        for i in range(LANES):
            least = min(least, values[i] if count_upto(values, LANES, values[i]) > rank else ABSENT)
        return least
    low, high = ABSENT, np.int32(-ABSENT)
    for i in range(n):
        low = min(low, values[i])
        high = max(high, values[i] if values[i] != ABSENT else np.int32(-ABSENT))
    while low < high:
        middle = np.int32(low + (np.int64(high) - np.int64(low)) // 2)
        reached = count_upto(values, n, middle) > rank
        high = middle if reached else high
        low = low if reached else np.int32(middle + 1)
    return low


@inlined
def median_step(heights, corner, edge, side, east_lag, north_lag, steps):
    """Lower median of the height differences of a patch's cells that lie so far apart, and how many there are."""
    width = side - east_lag
    k = 0
    for i in range(side - north_lag):
        a = corner + i * edge
        b = a + north_lag * edge + east_lag
        for j in range(width):
            near, far = heights[a + j], heights[b + j]
            steps[k + j] = np.int32(far - near) if (near != ABSENT) & (far != ABSENT) else ABSENT
        k += width
    pairs = count_upto(steps, k, np.int32(ABSENT - 1))
    return (value_of_rank(steps, k, (pairs - 1) // 2) if pairs else np.int32(0)), pairs


@inlined
def slopes_of(heights, corner, edge, side, steps):
    """Slopes (µm a cell) of a patch towards east and north, each the median over pairs of cells half its side apart.

    Where an eighth of the patch is not paired like that, the pairs lie a quarter of its side apart, and so on.

    Returns
    -------
    east, north, and whether both could be told.
    """
    east, north = 0.0, 0.0
    east_known, north_known = False, False
    lag = side // 2
    while lag >= 1 and not (east_known and north_known):
        if not east_known:
            step, pairs = median_step(heights, corner, edge, side, lag, 0, steps)
            if 8 * pairs >= side * side:
                east, east_known = step / lag, True
        if not north_known:
            step, pairs = median_step(heights, corner, edge, side, 0, lag, steps)
            if 8 * pairs >= side * side:
                north, north_known = step / lag, True
        lag //= 2
    return east, north, east_known and north_known


@kernel
def fill_strip(column, row, height, intensity, count, start, base, first_row, heights, lights, counts):
    """Lay the cells from `start` on out in a strip, as far as its rows reach.

    Parameters
    ----------
    column, row : (n,) uint16, sorted by row, column; height : (n,) float64, m; intensity : (n,) float32;
        count : (n,) uint32.
    base : float64, m, near most of the heights.
    first_row : int, row of the strip's south.
    heights : (rows, edge) int32, µm above `base`, `ABSENT` where no cell lies; lights : int32, sixty-fourths of a
        digital number; counts : int32. Out; lights and counts mean nothing where no cell lies.

    Returns
    -------
    The first cell north of the strip, and the strip's first and last column with a cell (first > last without any).
    """
    rows, edge = heights.shape
    flat_heights, flat_lights, flat_counts = heights.ravel(), lights.ravel(), counts.ravel()
    flat_heights[:] = ABSENT
    first, last = edge, np.int64(-1)
    i = start
    while i < row.size and row[i] < first_row + rows:
        run = 1  # cells side by side are copied together
        while i + run < row.size and row[i + run] == row[i] and column[i + run] == column[i] + run:
            run += 1
        first, last = min(first, np.int64(column[i])), max(last, np.int64(column[i]) + run - 1)
        at = (np.int64(row[i]) - first_row) * edge + column[i]
        for k in range(run):
            above = np.floor((height[i + k] - base) * 1e6 + 0.5)
            flat_heights[at + k] = np.int32(min(max(above, -FARTHEST_UM), FARTHEST_UM))
        for k in range(run):
            flat_lights[at + k] = np.int32(intensity[i + k] * LIGHT_STEPS + 0.5)
        for k in range(run):
            flat_counts[at + k] = np.int32(count[i + k])
        i += run
    return i, first, last


@kernel
def decimate_strip(
    heights_2d, lights_2d, counts_2d, first_patch, end_patch, patch, side, base, floor_um, scratch,
    out_column, out_row, out_height, out_intensity, out_cells, out_points, out_sloped,
):  # fmt: skip
    """Robust height at the centre of every square of a strip that holds a cell, in order of row and column.

    Parameters
    ----------
    heights_2d, lights_2d, counts_2d : (patch, edge), from :func:`fill_strip`.
    first_patch, end_patch : int, patches (of `patch`² cells) to look at, from the west.
    patch, side : cells along an edge of a patch, which has one slope, and of a square, which divides it.
    base : float64, m; floor_um : int, µm within which a residual always counts.
    scratch : (2, at least patch², a multiple of 16) int32, overwritten.
    out_column, out_row : (s,) uint16, of the square in the strip; out_height : (s,) float64, m; out_intensity : (s,)
        float32; out_cells : (s,) uint32 and out_points : (s,) uint32, cells that count and their points;
        out_sloped : (s,) bool, False where the patch has too few cells for a slope. Out.

    Returns
    -------
    int, how many squares were written.
    """
    edge = heights_2d.shape[1]
    heights, lights, counts = heights_2d.ravel(), lights_2d.ravel(), counts_2d.ravel()
    residual, distance = scratch[0], scratch[1]
    per_patch = patch // side
    size = -(-side * side // LANES) * LANES
    middle = 0.5 * (side - 1)
    sigmas = OUTLIER_SIGMAS * MAD_TO_SIGMA
    plain = np.int32(floor_um / sigmas)  # a MAD up to this leaves the reach at its floor
    patches = end_patch - first_patch
    slopes, sloped = np.empty((patches, 2)), np.empty(patches, np.bool_)
    for p in range(patches):
        corner = (first_patch + p) * patch
        slopes[p, 0], slopes[p, 1], sloped[p] = slopes_of(heights, corner, edge, patch, residual)
    written = 0
    for square_row in range(per_patch):
        residual[:] = ABSENT
        for square in range(first_patch * per_patch, end_patch * per_patch):
            corner = square_row * side * edge + square * side
            p = square // per_patch - first_patch
            east, north = slopes[p, 0], slopes[p, 1]
            for r in range(side):
                slant = north * (r - middle) - east * middle
                for c in range(side):
                    h = heights[corner + r * edge + c]
                    residual[r * side + c] = np.int32(h - np.int32(slant + east * c)) if h != ABSENT else ABSENT
            found = count_upto(residual, size, np.int32(ABSENT - 1))
            if found == 0:
                continue
            rank = (found - 1) // 2
            median = value_of_rank(residual, size, rank)
            for k in range(size):
                off = np.int32(abs(np.int32(residual[k] - median)))
                distance[k] = off if residual[k] != ABSENT else ABSENT
            reach = np.int32(floor_um)
            if count_upto(distance, size, plain) <= rank:
                reach = np.int32(max(sigmas * value_of_rank(distance, size, rank), floor_um))
            total, used, points, light = 0, 0, 0, 0
            for k in range(size):
                total += np.int64(np.int32(residual[k] - median) if distance[k] <= reach else np.int32(0))
                used += np.int64(distance[k] <= reach)
            for r in range(side):
                for c in range(side):
                    at, counted = corner + r * edge + c, distance[r * side + c] <= reach
                    points += np.int64(counts[at] if counted else np.int32(0))
                    light += np.int64(lights[at] if counted else np.int32(0))
            out_column[written] = square
            out_row[written] = square_row
            out_height[written] = base + 1e-6 * (median + total / used)
            out_intensity[written] = light / (LIGHT_STEPS * used)
            out_cells[written] = used
            out_points[written] = points
            out_sloped[written] = sloped[p]
            written += 1
    return written
