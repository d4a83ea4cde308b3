"""Reduces squares of two by two cells, each its own patch, to one point; bit-identical to `decimate_cells`.

A square has four places, so its slopes and medians are written out. Squares that hold a cell are gathered and go
through registers side by side, whatever lies between them.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inlined, bare_inner, kernel
from roadscan.tiles.kernels.decimate import ABSENT, LIGHT_STEPS, micrometres, reach_of

AT_ONCE = 512
"""Number of squares that are collected before they are computed."""
_BEYOND = np.uint16(65_535)  # Column beyond that of any cell.
SCRATCH_ROWS, SUMS = 20, 4
"""Rows of scratch: heights, lights, counts of the four places, slopes, median, reach, distances; sums."""


@bare_inlined
def _gather(cells, i, end, square, base, found, south, at):
    """Collect the cells of a square in one of its rows; return the first cell after them."""
    column, _, height, intensity, count = cells
    while i < end and column[i] >> 1 == square:
        place = south + np.uint64(column[i] & 1)
        found[place, at] = micrometres(height[i], base)
        found[place + np.uint64(4), at] = np.int32(intensity[i] * LIGHT_STEPS + 0.5)
        found[place + np.uint64(8), at] = np.int32(count[i])
        i += 1
    return i


@bare
def _steps(near, far, other_near, other_far, out):
    """Compute the lower median of two differences of each square in one direction, `ABSENT` where there is none."""
    for k in range(out.size):
        first = np.int32(far[k] - near[k]) if (near[k] != ABSENT) & (far[k] != ABSENT) else ABSENT
        other = np.int32(other_far[k] - other_near[k])
        second = other if (other_near[k] != ABSENT) & (other_far[k] != ABSENT) else ABSENT
        out[k] = min(first, second)


@bare
def _known(east, north, out):
    """Write whether both slopes are determined, and set the others to 0."""
    for k in range(out.size):
        out[k] = (east[k] != ABSENT) & (north[k] != ABSENT)
    for k in range(out.size):
        east[k] = east[k] if east[k] != ABSENT else np.int32(0)
    for k in range(out.size):
        north[k] = north[k] if north[k] != ABSENT else np.int32(0)


@bare_inner
def _flatten(heights, east, north, up, right):
    """Subtract the slopes from the cells at one position; `up` and `right` are its row and column, 0.0 or 1.0."""
    for k in range(heights.size):
        slope = np.float64(east[k])
        slant = np.float64(north[k]) * (up - 0.5) - slope * 0.5
        flat = np.int32(heights[k] - np.int32(slant + slope * right))
        heights[k] = flat if heights[k] != ABSENT else ABSENT


@bare
def _medians(a, b, c, d, out):
    """Compute the lower median of those of four values that exist."""
    for k in range(out.size):
        low, high = min(a[k], b[k]), max(a[k], b[k])
        less, more = min(c[k], d[k]), max(c[k], d[k])
        inner, other = max(low, less), min(high, more)
        out[k] = min(low, less) if max(inner, other) == ABSENT else min(inner, other)


@bare_inner
def _distances(heights, median, out):
    for k in range(out.size):
        out[k] = np.int32(abs(np.int32(heights[k] - median[k]))) if heights[k] != ABSENT else ABSENT


@bare_inner
def _reaches(mad, floor_um):
    for k in range(mad.size):
        mad[k] = reach_of(mad[k], floor_um)


@bare
def _add(heights, lights, counts, median, reach, total, used, points, light):
    """Add the cells at one position that count."""
    for k in range(total.size):
        off = np.int64(heights[k]) - np.int64(median[k])
        counted = np.int64(abs(off) <= np.int64(reach[k]))
        total[k] += off * counted
        used[k] += counted
    for k in range(total.size):
        off = np.int64(heights[k]) - np.int64(median[k])
        counted = np.int64(abs(off) <= np.int64(reach[k]))
        points[k] += np.int64(counts[k]) * counted
        light[k] += np.int64(lights[k]) * counted


@bare
def _write(sums, median, base, out_height, out_intensity, out_cells, out_points):
    total, used, points, light = sums
    for k in range(total.size):
        out_height[k] = base + 1e-6 * (median[k] + total[k] / used[k])
    for k in range(total.size):
        out_intensity[k] = light[k] / (LIGHT_STEPS * used[k])
    for k in range(total.size):
        out_cells[k], out_points[k] = used[k], points[k]


@bare
def _compute(found, sums, base, floor_um, own, out):
    """Compute the points of the collected squares, into the rows `own` of the output."""
    n = out.height_m[own].size
    a, b, c, d = found[0, :n], found[1, :n], found[2, :n], found[3, :n]
    east, north, median, reach = found[12, :n], found[13, :n], found[14, :n], found[15, :n]
    total, used, points, light = sums[0, :n], sums[1, :n], sums[2, :n], sums[3, :n]
    _steps(a, b, c, d, east)
    _steps(a, c, b, d, north)
    _known(east, north, out.sloped[own])
    for place in range(4):
        _flatten(found[place, :n], east, north, np.float64(place >> 1), np.float64(place & 1))
    _medians(a, b, c, d, median)
    for place in range(4):
        _distances(found[place, :n], median, found[16 + place, :n])
    _medians(found[16, :n], found[17, :n], found[18, :n], found[19, :n], reach)
    _reaches(reach, floor_um)
    for k in range(4):
        _clear(sums[k, :n])
    for place in range(4):
        lights, counts = found[4 + place, :n], found[8 + place, :n]
        _add(found[place, :n], lights, counts, median, reach, total, used, points, light)
    values = out.height_m[own], out.intensity[own], out.cells[own], out.points[own]
    _write((total, used, points, light), median, base, *values)


@bare
def _clear(values):
    for k in range(values.size):
        values[k] = 0


@kernel
def decimate_2x2(cells, starts, base, floor_um, out):
    """Write the robust height at the centre of every square of two by two cells with a cell.

    Parameters
    ----------
    starts : (rows + 1,) int64, first cell of each row of the tile, and the number of cells.
    Others, and what is returned, as in :func:`decimate_cells`.
    """
    found, sums = np.empty((SCRATCH_ROWS, AT_ONCE), np.int32), np.empty((SUMS, AT_ONCE), np.int64)
    column = cells.column
    begun = written = 0
    for row in range(starts.size // 2):
        i, south_end, end = starts[2 * row], starts[2 * row + 1], starts[2 * row + 2]
        j = south_end
        while i < south_end or j < end:
            square = min(column[i] if i < south_end else _BEYOND, column[j] if j < end else _BEYOND) >> 1
            at = np.uint64(written - begun)
            for place in range(4):
                found[place, at] = ABSENT
            i = _gather(cells, i, south_end, square, base, found, np.uint64(0), at)
            j = _gather(cells, j, end, square, base, found, np.uint64(2), at)
            out.column[written], out.row[written] = square, row
            written += 1
            if written - begun == AT_ONCE:
                _compute(found, sums, base, floor_um, slice(begun, written), out)
                begun = written
    _compute(found, sums, base, floor_um, slice(begun, written), out)
    return written
