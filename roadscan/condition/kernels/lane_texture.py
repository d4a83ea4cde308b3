"""Texture of squares of a lane from their cells: the scatter of heights within small blocks.

Heights are taken from a plane through each block of 50 mm, so that wider slopes, ruts and holes do not count. The
scatter of the readings within the cells is added to that of the cells, to include waves shorter than a cell.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.compute.kernels.arrays import median, selected
from roadscan.condition.kernels.sampling import MOST_CELLS, Cells, factorise, gather, solve

BLOCK_M = 0.05
"""Edge of a block, at least that of a cell (m)."""
MOST_BLOCKS = 16
"""Most blocks along an edge of a square."""
FITTED = 9
"""Least number of cells of a block with a plane."""
BENT = 6
"""Terms of a surface of second degree."""
ENOUGH_BENT = 10
"""Least number of cells of a square that determine such a surface."""
LEAST_FREEDOM = 5.0
"""Least degrees of freedom of the readings within the cells of a block that determine their scatter."""
SOUND = 0.85
"""Share of a square's cells that lie below the level of its undamaged surface."""
SUMS = 12  # Number of sums of a block.
N, X, Y, H, XX, XY, YY, XH, YH, HH, NOISE, FREEDOM = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11  # Columns of the sums.
TEXTURE, LOSS, PEAKS, LINE, INTENSITY, SHARE, SHARED, WITHIN = 0, 1, 2, 3, 4, 5, 6, 7  # Columns of the results.
FIGURES = 8
"""Number of results of a square."""
LONGEST_CELL_M = 0.0101
"""Largest spacing of heights that show peaks (m)."""
HALF_SEGMENT_M = 0.05
"""Half of a segment of 100 mm, in each of which a peak is found (m)."""


@inlined
def plane(sums, b, slopes):
    """Return slopes along and across of the plane through the cells of block b; 0 where they do not determine it."""
    n = sums[b, N]
    xx = sums[b, XX] - sums[b, X] * sums[b, X] / n
    xy = sums[b, XY] - sums[b, X] * sums[b, Y] / n
    yy = sums[b, YY] - sums[b, Y] * sums[b, Y] / n
    xh = sums[b, XH] - sums[b, X] * sums[b, H] / n
    yh = sums[b, YH] - sums[b, Y] * sums[b, H] / n
    det = xx * yy - xy * xy
    slopes[b, 0], slopes[b, 1] = 0.0, 0.0
    if n >= FITTED and det > 1e-3 * xx * yy and det > 0.0:
        slopes[b, 0] = (yy * xh - xy * yh) / det
        slopes[b, 1] = (xx * yh - xy * xh) / det


@inner
def bent_slopes(found, count, base, half, sums, blocks, slopes):
    """Write slopes of blocks with too few cells for a plane, from a surface of second degree through the square.

    A rut bends, so a plane through the whole square has another slope than its cells. Where the cells do not determine
    the surface, the slope is that of the plane, in the last row. slopes : (blocks² + 1, 2).
    """
    last = blocks * blocks
    all_fitted = True
    for b in range(last):
        if sums[b, N] < FITTED:
            slopes[b, 0], slopes[b, 1] = slopes[last, 0], slopes[last, 1]
            all_fitted = False
    if count < ENOUGH_BENT or all_fitted:
        return
    normal, factor = np.zeros((BENT, BENT)), np.zeros((BENT, BENT))
    right, terms, surface = np.zeros(BENT), np.zeros(BENT), np.zeros(BENT)
    for k in range(count):
        x, y = found.along[k], found.across[k]
        terms[0], terms[1], terms[2], terms[3], terms[4], terms[5] = 1.0, x, y, x * x, x * y, y * y
        for i in range(BENT):
            right[i] += terms[i] * (found.height[k] - base)
            for j in range(i + 1):
                normal[i, j] += terms[i] * terms[j]
    if factorise(normal, BENT, factor) < BENT:
        return
    solve(factor, BENT, right, surface)
    for b in range(last):
        if 1.0 <= sums[b, N] < FITTED:
            x, y = sums[b, X] / sums[b, N] / half, sums[b, Y] / sums[b, N] / half
            slopes[b, 0] = (surface[1] + 2.0 * surface[3] * x + surface[4] * y) / half
            slopes[b, 1] = (surface[2] + surface[4] * x + 2.0 * surface[5] * y) / half


@inner
def block_scatter(sums, b, slopes, cell_m):
    """Return the variance of heights about the plane of block b (m²): between its cells plus within them.

    NaN where neither is known. slopes : (blocks² + 1, 2) of the blocks, and of the whole square in the last row.
    """
    n = sums[b, N]
    if n < 1.0:
        return np.nan, np.nan
    between, within = np.nan, np.nan
    along, across = slopes[b, 0], slopes[b, 1]
    if n >= FITTED:
        hh = sums[b, HH] - sums[b, H] * sums[b, H] / n
        explained = along * (sums[b, XH] - sums[b, X] * sums[b, H] / n)
        explained += across * (sums[b, YH] - sums[b, Y] * sums[b, H] / n)
        between = max(hh - explained, 0.0) / (n - 3.0)
    if sums[b, FREEDOM] >= LEAST_FREEDOM:
        # A slope adds to the scatter of the readings of a cell.
        within = sums[b, NOISE] / sums[b, FREEDOM] - (along * along + across * across) * cell_m * cell_m / 12.0
        within = max(within, 0.0)
    return between, within


@inner
def peaks(found, count, base, half, pitch, lattice, out):
    """Write the mean profile depth of the lines along a square (m), and the variance of their heights (m²).

    Lines are columns of a lattice as fine as the cells, cut into segments of 100 mm that lose their slope; the depth of
    one is the mean of the peaks of its halves. NaN without a segment that is four fifths measured.
    half : half of the square's edge (m); pitch : of the lattice (m); lattice : (n, n) room; out : (2,) float64, out.
    """
    n = lattice.shape[0]
    lattice[:] = np.nan
    for k in range(count):
        i = min(max(int((found.along[k] + 1.0) * half / pitch), 0), n - 1)
        j = min(max(int((found.across[k] + 1.0) * half / pitch), 0), n - 1)
        lattice[i, j] = found.height[k] - base
    own = max(round(HALF_SEGMENT_M / pitch), 2)
    depth, square, segments = 0.0, 0.0, 0
    for first in range(0, n - 2 * own + 1, 2 * own):
        for j in range(n):
            m, sx, sh, sxx, sxh, shh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(first, first + 2 * own):
                h = lattice[i, j]
                if not np.isnan(h):
                    x = float(i - first - own) + 0.5
                    m += 1.0
                    sx += x
                    sh += h
                    sxx += x * x
                    sxh += x * h
                    shh += h * h
            if m < 1.6 * own:
                continue
            det = sxx - sx * sx / m
            slope = (sxh - sx * sh / m) / det
            high_0, high_1 = -np.inf, -np.inf
            for i in range(first, first + 2 * own):
                h = lattice[i, j]
                if not np.isnan(h):
                    x = float(i - first - own) + 0.5
                    rest = h - sh / m - slope * (x - sx / m)
                    if x < 0.0:
                        high_0 = max(high_0, rest)
                    else:
                        high_1 = max(high_1, rest)
            if high_0 > -np.inf and high_1 > -np.inf:
                depth += 0.5 * (high_0 + high_1)
                square += max(shh - sh * sh / m - slope * (sxh - sx * sh / m), 0.0) / (m - 2.0)
                segments += 1
    out[0] = depth / segments if segments else np.nan
    out[1] = square / segments if segments else np.nan


@inner
def fill_blocks(found, count, base, half, blocks, sums):
    """Sum heights and positions of the cells of each block of a square; the last row is the sum of all blocks.

    blocks : along an edge; sums : (blocks² + 1, SUMS) float64, out: heights count from base (m), places from the
    square's middle (m).
    """
    sums[:] = 0.0
    all_of = blocks * blocks
    for k in range(count):
        i = min(max(int((found.along[k] + 1.0) * 0.5 * blocks), 0), blocks - 1)
        j = min(max(int((found.across[k] + 1.0) * 0.5 * blocks), 0), blocks - 1)
        x, y, h = found.along[k] * half, found.across[k] * half, found.height[k] - base
        for b in (i * blocks + j, all_of):
            sums[b, N] += 1.0
            sums[b, X] += x
            sums[b, Y] += y
            sums[b, H] += h
            sums[b, XX] += x * x
            sums[b, XY] += x * y
            sums[b, YY] += y * y
            sums[b, XH] += x * h
            sums[b, YH] += y * h
            sums[b, HH] += h * h
            if found.noise[k] >= 0.0 and found.readings[k] > 1.0:
                sums[b, NOISE] += found.noise[k]
                sums[b, FREEDOM] += found.readings[k] - 1.0


@inner
def loss(found, count, base, half, blocks, sums, slopes, away):
    """Return the mean depth of a square's cells below its undamaged surface (m), each from the plane of its block.

    NaN with fewer than four cells a block. away : (count,) room.
    """
    used, total = 0, 0.0
    for k in range(count):
        i = min(max(int((found.along[k] + 1.0) * 0.5 * blocks), 0), blocks - 1)
        j = min(max(int((found.across[k] + 1.0) * 0.5 * blocks), 0), blocks - 1)
        b = i * blocks + j
        n = sums[b, N]
        if n < FITTED:
            continue
        x, y = found.along[k] * half, found.across[k] * half
        level = sums[b, H] / n + slopes[b, 0] * (x - sums[b, X] / n) + slopes[b, 1] * (y - sums[b, Y] / n)
        away[used] = found.height[k] - base - level
        total += away[used]
        used += 1
    if used < 4 * blocks * blocks:
        return np.nan
    return selected(away[:used], int(SOUND * used)) - total / used


@kernel
def texture_of_squares(table, places, edge_m, out):
    """Compute the texture of squares of a lane.

    Parameters
    ----------
    table : CellTable.
    places : (n, 4) float64, easting, northing of the squares' middles (m), and the unit vector along the road.
    edge_m : float64, edge of a square (m).
    out : (n, 8) float64, out: root mean square texture (m), the square root of the median variance of the blocks; mean
        depth below the level of the sound surface (m); mean profile depth of the cells' heights (m) and the variance of
        these (m²); mean intensity; share of the square that holds cells; share of these that several drives measured;
        and variance within the cells that their heights do not show (m²). NaN where too little is there.
    """
    room = np.empty((6, MOST_CELLS))
    found = Cells(room[0], room[1], room[2], room[3], room[4], room[5], np.empty(MOST_CELLS, np.int64))
    away, of_lines = np.empty(MOST_CELLS), np.empty(2)
    cell = max(table.cell[0], table.cell[1])
    half = 0.5 * edge_m
    window = edge_m * edge_m / (table.cell[0] * table.cell[1])
    stride = max(math.ceil(math.sqrt(window / (0.9 * MOST_CELLS))), 1)
    blocks = min(max(round(edge_m / max(BLOCK_M, cell)), 1), MOST_BLOCKS)
    sums, slopes = np.empty((blocks * blocks + 1, SUMS)), np.empty((blocks * blocks + 1, 2))
    variance = np.empty(blocks * blocks)
    pitch = stride * cell
    lines = max(round(edge_m / pitch), 1)
    lattice = np.empty((lines, lines))
    for i in range(len(places)):
        out[i] = np.nan
        count = gather(table, places[i], half, half, stride, found)
        out[i, SHARE] = min(count * stride * stride / window, 1.0)
        out[i, SHARED] = 0.0
        if count < 3:
            continue
        base = found.height[0]
        grey, lit, shared, single = 0.0, 0.0, 0.0, 0.0
        for k in range(count):
            value = table.intensity[found.at[k]]
            if not np.isnan(value):
                grey += value
                lit += 1.0
            shared += table.passes[found.at[k]] > 1.0
            single += 1.0 / max(found.readings[k], 1.0)
        out[i, SHARED] = shared / count
        if lit > 0.0:
            out[i, INTENSITY] = grey / lit
        # The mean of n readings keeps 1 / n of the variance within a cell.
        hidden = 1.0 - single / count
        fill_blocks(found, count, base, half, blocks, sums)
        for b in range(blocks * blocks + 1):
            plane(sums, b, slopes)
        bent_slopes(found, count, base, half, sums, blocks, slopes)
        known = 0
        for b in range(blocks * blocks):
            between, within = block_scatter(sums, b, slopes, cell)
            if np.isnan(between) and np.isnan(within):
                continue
            own = 0.0 if np.isnan(between) else between
            if not np.isnan(within):
                own += within if np.isnan(between) else within * hidden
            variance[known] = own
            known += 1
        if 2 * known < blocks * blocks:
            continue
        out[i, TEXTURE] = math.sqrt(median(variance[:known]))
        out[i, LOSS] = loss(found, count, base, half, blocks, sums, slopes, away)
        _, within = block_scatter(sums, blocks * blocks, slopes, cell)
        out[i, WITHIN] = 0.0 if np.isnan(within) else within * hidden
        if pitch <= LONGEST_CELL_M:
            peaks(found, count, base, half, pitch, lattice, of_lines)
            out[i, PEAKS] = of_lines[0]
            out[i, LINE] = of_lines[1]
