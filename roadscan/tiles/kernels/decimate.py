"""Reduces cells to one point per square, without stones on the pavement and cracks in it, in whole micrometres.

Places without a cell hold `ABSENT`, above every height, so that loops run over whole squares and need no branch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.arrays import SIGMA_OF_MAD
from roadscan.compute.kernel_options import bare_inlined, bare_inner, kernel
from roadscan.compute.kernels.arrays import copy_values
from roadscan.compute.kernels.column_statistics import LANES, OUTLIER_SIGMAS, medians_of_16
from roadscan.tiles.kernels.pyramid import run_end

ABSENT = np.int32(2**31 - 1)
"""Height of a position without a cell."""
FARTHEST_UM = 2.0**28
"""Heights are cut off here, 268 m above and below the base, so that no difference overflows."""
LIGHT_STEPS = 64.0
"""Intensities are summed in units of 1/64 of a digital number."""


class Squares(NamedTuple):
    """Columns for s squares of cells, which kernels write in order of row and column."""

    column: npt.NDArray[np.uint16]
    """(s,) column of the square in its tile, from the west edge."""
    row: npt.NDArray[np.uint16]
    """(s,) from the south edge."""
    height_m: npt.NDArray[np.float64]
    """(s,) at the square's centre."""
    intensity: npt.NDArray[np.float32]
    """(s,) mean of the cells that count."""
    cells: npt.NDArray[np.uint32]
    """(s,) cells that count."""
    points: npt.NDArray[np.uint32]
    """(s,) readings in those cells."""
    sloped: npt.NDArray[np.bool_]
    """(s,) False where the patch has too few cells for a slope."""


@bare_inlined
def count_upto(values, n, limit):
    """Return how many of the first `n` values (int32) are `limit` or less."""
    below = np.int32(0)
    for i in range(n):
        below = np.int32(below + np.int32(values[i] <= limit))
    return below


@bare_inlined
def value_of_rank(values, n, rank):
    """Return the value of `rank` (from 0) among the first `n` (int32): the least that more than `rank` do not exceed.

    Halves the interval of values, so that each pass is a count that the processor does many at a time.
    """
    low, high = ABSENT, np.int32(-ABSENT)
    for i in range(n):
        low = min(low, values[i])
        high = max(high, values[i] if values[i] != ABSENT else np.int32(-ABSENT))
    high = high if rank > 0 else low
    while low < high:
        middle = np.int32(low + (np.int64(high) - np.int64(low)) // 2)
        reached = count_upto(values, n, middle) > rank
        high = middle if reached else high
        low = low if reached else np.int32(middle + 1)
    return low


@bare_inlined
def median_step(heights, corner, edge, side, east_lag, north_lag, steps):
    """Return the lower median of height differences between a patch's cells at a distance, and their number."""
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


@bare_inlined
def slopes_of(heights, corner, edge, side, steps):
    """Return a patch's slopes (µm a cell) to east and north: medians over pairs of cells half its side apart.

    Where an eighth of the patch is not paired like that, the pairs lie a quarter of its side apart, and so on.

    Returns
    -------
    east, north, and whether both are determined.
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


@bare_inlined
def micrometres(height, base):
    """Return a height (m) as whole micrometres above `base` (int32), cut off at `FARTHEST_UM`."""
    above = np.floor((height - base) * 1e6 + 0.5)
    return np.int32(min(max(above, -FARTHEST_UM), FARTHEST_UM))


@bare_inner
def _micrometres(height, base, out):
    for k in range(out.size):
        out[k] = micrometres(height[k], base)


@bare_inner
def _light_steps(intensity, out):
    for k in range(out.size):
        out[k] = np.int32(intensity[k] * LIGHT_STEPS + 0.5)


@bare_inner
def fill_strip(cells, start, base, first_row, rows, strip, listed):
    """Write the cells from `start` on into a strip, as far as its rows reach.

    Parameters
    ----------
    strip : heights, lights, counts, (rows · edge,) int32, out: µm above `base`, `ABSENT` where no cell lies;
        sixty-fourths of a digital number; counts. Lights and counts mean nothing where no cell lies. And the edge.
    listed : (edge // rows,) int32, out: the patches, as wide as the strip is high, that hold a cell, from the west.
    Others as in :func:`decimate_cells`.

    Returns
    -------
    The first cell north of the strip, and how many patches hold a cell.
    """
    column, row, height, intensity, count = cells
    heights, lights, counts, edge = strip
    heights[:] = ABSENT
    listed[:] = 0
    i = start
    while i < row.size and row[i] < first_row + rows:
        end = run_end(column, row, i, row.size)
        west, at = np.int64(column[i]), (np.int64(row[i]) - first_row) * edge + np.int64(column[i])
        to = at + end - i
        if end == i + 1:
            heights[at] = micrometres(height[i], base)
            lights[at] = np.int32(intensity[i] * LIGHT_STEPS + 0.5)
            counts[at] = count[i]
        else:
            _micrometres(height[i:end], base, heights[at:to])
            _light_steps(intensity[i:end], lights[at:to])
            copy_values(count[i:end], counts[at:to])
        for patch in range(west // rows, (west + end - i - 1) // rows + 1):
            listed[patch] = 1
        i = end
    found = 0
    for patch in range(listed.size):
        here = listed[patch]
        listed[found] = patch
        found += here
    return i, found


@bare_inlined
def reach_of(mad, floor_um):
    """Return the distance (µm) from the median within which a cell counts."""
    return np.int32(max(OUTLIER_SIGMAS * SIGMA_OF_MAD * mad, floor_um))


@bare_inlined
def large_squares(strip, patches, south, per_patch, side, slopes, base, floor_um, scratch, out, written):
    """Write the squares of one row of some patches, one by one; return how many are written so far."""
    heights, lights, counts, edge = strip
    residual, distance = scratch[0], scratch[1]
    out_column, _, out_height, out_intensity, out_cells, out_points, out_sloped = out
    size = -(-side * side // LANES) * LANES
    middle = 0.5 * (side - 1)
    plain = np.int32(floor_um / (OUTLIER_SIGMAS * SIGMA_OF_MAD))  # up to this MAD the reach is the floor
    residual[:] = ABSENT
    for own in range(patches.size * per_patch):
        p = own // per_patch
        square = patches[p] * per_patch + own % per_patch
        corner = south * edge + square * side
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
            reach = reach_of(value_of_rank(distance, size, rank), floor_um)
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
        out_height[written] = base + 1e-6 * (median + total / used)
        out_intensity[written] = light / (LIGHT_STEPS * used)
        out_cells[written], out_points[written], out_sloped[written] = used, points, slopes[p, 2] > 0
        written += 1
    return written


@bare_inlined
def small_squares(strip, patches, south, per_patch, side, slopes, base, floor_um, table, out, written):
    """Do the same as `large_squares` for squares of up to 16 cells, sixteen squares at once."""
    heights, lights, counts, edge = strip
    residual, place, found, median, mad, square_of = table
    out_column, _, out_height, out_intensity, out_cells, out_points, out_sloped = out
    middle = 0.5 * (side - 1)
    for first in range(0, patches.size * per_patch, LANES):
        lanes = min(LANES, patches.size * per_patch - first)
        found[:] = 0
        for lane in range(lanes):
            p = (first + lane) // per_patch
            square_of[lane] = patches[p] * per_patch + (first + lane) % per_patch
            corner = south * edge + square_of[lane] * side
            east, north = slopes[p, 0], slopes[p, 1]
            cells = 0
            for r in range(side):
                slant = north * (r - middle) - east * middle
                for c in range(side):
                    at = corner + r * edge + c
                    h = heights[at]
                    if h != ABSENT:
                        residual[cells, lane] = np.int32(h - np.int32(slant + east * c))
                        place[lane, cells] = at
                        cells += 1
            found[lane] = cells
        medians_of_16(residual, found, median, mad)
        for lane in range(lanes):
            if found[lane] == 0:
                continue
            reach = reach_of(mad[lane], floor_um)
            total, used, points, light = 0, 0, 0, 0
            for k in range(found[lane]):
                off = np.int64(residual[k, lane]) - median[lane]
                counted = np.int64(abs(off) <= reach)
                total += off * counted
                used += counted
                points += counts[place[lane, k]] * counted
                light += lights[place[lane, k]] * counted
            out_column[written] = square_of[lane]
            out_height[written] = base + 1e-6 * (median[lane] + total / used)
            out_intensity[written] = light / (LIGHT_STEPS * used)
            out_cells[written], out_points[written] = used, points
            out_sloped[written] = slopes[(first + lane) // per_patch, 2] > 0
            written += 1
    return written


@bare_inner
def decimate_strip(strip, patches, patch, side, base, floor_um, scratch, table, slopes, out, first_row, written):
    """Write the squares of the patches of a strip with a cell; return how many are written so far.

    strip : as from :func:`fill_strip`; patches : (p,) int32; slopes : (p, 3)
    float64, scratch; first_row : int, row of the strip's first squares. Others as in :func:`decimate_cells`.
    """
    edge, per_patch = strip[3], patch // side
    for p in range(patches.size):
        east, north, known = slopes_of(strip[0], patches[p] * patch, edge, patch, scratch[0])
        slopes[p, 0], slopes[p, 1], slopes[p, 2] = east, north, np.float64(known)
    for row in range(per_patch):
        start = written
        if side * side <= LANES:
            written = small_squares(
                strip, patches, row * side, per_patch, side, slopes, base, floor_um, table, out, written
            )
        else:
            written = large_squares(
                strip, patches, row * side, per_patch, side, slopes, base, floor_um, scratch, out, written
            )
        out.row[start:written] = first_row + row
    return written


@kernel
def decimate_cells(cells, base, edge, patch, side, floor_um, out):
    """Write the robust height at the centre of every square of a tile with a cell, in order of row and column.

    Parameters
    ----------
    cells : Cells; out : Squares.
    base : float64, m, near most of the heights; floor_um : int, µm within which a residual always counts.
    edge : int, cells along an edge of the tile.
    patch, side : cells along an edge of a patch, which has one slope and divides the tile, and of a square, which
        divides the patch.

    Returns
    -------
    int, how many squares were written.
    """
    listed, slopes = np.empty(edge // patch, np.int32), np.empty((edge // patch, 3))
    table = (
        np.empty((LANES, LANES), np.int32), np.empty((LANES, LANES), np.int64),
        np.empty(LANES, np.int32), np.empty(LANES, np.int32), np.empty(LANES, np.int32), np.empty(LANES, np.int64),
    )  # fmt: skip
    room = patch * edge
    strip = (np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room, np.int32), edge)
    scratch = np.empty((2, -(-patch * patch // LANES) * LANES), np.int32)
    row = cells.row
    start, written = 0, 0
    while start < row.size:
        number = np.int64(row[start]) // patch
        start, found = fill_strip(cells, start, base, number * patch, patch, strip, listed)
        written = decimate_strip(
            strip, listed[:found], patch, side, base, floor_um, scratch, table, slopes, out,
            number * (patch // side), written,
        )  # fmt: skip
    return written
