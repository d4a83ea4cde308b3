"""Bare earth: its cells, steep breaks of the terrain, planes through returns, and heights of empty cells."""

from __future__ import annotations

import math

import numpy as np

from roadscan.assets.kernels.low_returns import bilinear
from roadscan.compute.kernel_options import inlined, kernel

NEAR, SUM, SQUARES, CLOSE, CLOSE_SUM = range(5)
"""Sums of a cell: returns near the ground, of their heights, of the squares; returns close to it, of their heights."""


@inlined
def cell_of(x, y, origin, per_m):
    """Returns row and column of a place."""
    return math.floor((y - origin[1]) * per_m), math.floor((x - origin[0]) * per_m)


@kernel
def scatter(x, y, z, origin, coarse_per_m, ground, per_m, limits, above, sums):
    """Compute heights of returns above a first estimate of the ground, and the sums of each cell of a finer raster.

    Parameters
    ----------
    x, y, z : (n,) float64 (m).
    origin : (2,) float64, corner of both rasters (m); coarse_per_m, per_m : cells a metre of the ground and the sums.
    ground : (m, k) float32, provisional heights at the middles of its cells.
    limits : (3,) float64: near are heights from the first to the second, close those within the third (m).
    above : (n,) float32, out.
    sums : (rows, columns, 5) float64, added to.
    """
    rows, columns, _ = sums.shape
    least, most, close = limits[0], limits[1], limits[2]
    for k in range(x.size):
        u, v = (x[k] - origin[0]) * coarse_per_m - 0.5, (y[k] - origin[1]) * coarse_per_m - 0.5
        h = z[k] - bilinear(ground, u, v)
        above[k] = h
        if least <= h <= most:
            i, j = cell_of(x[k], y[k], origin, per_m)
            if 0 <= i < rows and 0 <= j < columns:
                sums[i, j, NEAR] += 1.0
                sums[i, j, SUM] += h
                sums[i, j, SQUARES] += h * h
                if abs(h) <= close:
                    sums[i, j, CLOSE] += 1.0
                    sums[i, j, CLOSE_SUM] += h


@kernel
def on_ground(x, y, above, origin, per_m, rough, tolerance, even, reach, found):
    """Find the returns on the ground: near it in cells that are not rough, or as high as an even cell beside.

    Parameters
    ----------
    x, y : (n,) float64 (m); above : (n,) float32, heights above the provisional ground (m).
    origin : (2,) float64; per_m : cells a metre.
    rough : (rows, columns) bool; tolerance : (rows, columns) float32, of heights in cells that are not (m).
    even : (rows, columns) float32, height of even cells above the provisional ground; NaN for all others.
    reach : how far a return may lie from the height of an even cell (m).
    found : (n,) bool, out.
    """
    rows, columns = rough.shape
    for k in range(x.size):
        h = above[k]
        found[k] = False
        i, j = cell_of(x[k], y[k], origin, per_m)
        if 0 <= i < rows and 0 <= j < columns:
            if not rough[i, j] and abs(h) <= tolerance[i, j]:
                found[k] = True
            elif abs(h) < 1.0:
                for a in range(max(i - 1, 0), min(i + 2, rows)):
                    for b in range(max(j - 1, 0), min(j + 2, columns)):
                        if abs(h - even[a, b]) <= reach:
                            found[k] = True


@kernel
def cell_heights(x, y, above, chosen, origin, per_m, middle, half, sums):
    """Compute number, sum and squares of the heights of chosen returns near the middle height of each cell.

    Parameters
    ----------
    x, y : (n,) float64 (m); above : (n,) float32 (m); chosen : (n,) bool.
    origin : (2,) float64; per_m : cells a metre.
    middle, half : (rows, columns) float32, what heights are taken of and how far they may lie from it (m).
    sums : (rows, columns, 3) float64, added to; sums are of heights less `middle`.
    """
    rows, columns = middle.shape
    for k in range(x.size):
        if chosen[k]:
            i, j = cell_of(x[k], y[k], origin, per_m)
            if 0 <= i < rows and 0 <= j < columns:
                h = np.float64(above[k]) - middle[i, j]
                if abs(h) <= half[i, j]:
                    sums[i, j, 0] += 1.0
                    sums[i, j, 1] += h
                    sums[i, j, 2] += h * h


@kernel
def least_over_disk(z, widths, line, out):
    """Compute the least height within a disk about each cell of a raster.

    Pieces of a row grow cell by cell, and each row of the disk takes the piece of its own width.
    z : (rows, columns) float32, finite. widths : (radius + 1,) int64, half the width of the disk in each of its rows,
    from the middle one on (cells). line : (columns,) float32, working space. out : (rows, columns) float32, infinite
    before.
    """
    rows, columns = z.shape
    radius = widths.size - 1
    for i in range(rows):
        for j in range(columns):
            line[j] = z[i, j]
        up = radius
        for width in range(radius + 1):
            if 0 < width < columns:
                for j in range(columns - width):
                    line[j + width] = z[i, j] if z[i, j] < line[j + width] else line[j + width]
                for j in range(columns - width):
                    line[j] = z[i, j + width] if z[i, j + width] < line[j] else line[j]
            while up >= 0 and widths[up] == width:
                if i + up < rows:
                    for j in range(columns):
                        out[i + up, j] = line[j] if line[j] < out[i + up, j] else out[i + up, j]
                if up > 0 and i >= up:
                    for j in range(columns):
                        out[i - up, j] = line[j] if line[j] < out[i - up, j] else out[i - up, j]
                up -= 1


@inlined
def _drop(z, i, j, down, right, steps, rise):
    """Greatest height of cell (i, j) above the cells on one side of it, less `rise` a cell of distance."""
    rows, columns = z.shape
    most = -1e9
    for k in range(1, steps + 1):
        a, b = i + round(k * down), j + round(k * right)
        if a < 0 or b < 0 or a >= rows or b >= columns:
            break
        most = max(most, z[i, j] - z[a, b] - rise * k)
    return most


@kernel
def drops_on_both_sides(z, directions, steps, rise, out):
    """Compute by how much each cell stands above what lies on both sides of it, along the line where that is most.

    A bridge, a wall or a roof stands above both of its sides; the upper edge of a break does above one alone.

    Parameters
    ----------
    z : (rows, columns) float32, whole (m).
    directions : (k, 2) float64, unit vectors of the lines, in rows and columns.
    steps : length of a line to each side (cells); rise : what terrain may fall a cell of distance (m).
    out : (rows, columns) float32, the lesser of both drops (m); negative where there is none.
    """
    rows, columns = z.shape
    for i in range(rows):
        for j in range(columns):
            most = -1e9
            for k in range(directions.shape[0]):
                down, right = directions[k, 0], directions[k, 1]
                one = _drop(z, i, j, down, right, steps, rise)
                if one > most:
                    most = max(most, min(one, _drop(z, i, j, -down, -right, steps, rise)))
            out[i, j] = most


@kernel
def grow(z, near, may, step, least, on_ground):
    """Add to the ground each return that may join and of whose neighbours several lie on it at about its own height.

    What joins is the same in any order.

    Parameters
    ----------
    z : (n,) float64 (m); near : (n, k) int64, neighbours of each return; may : (n,) bool, those that may join.
    step : greatest difference of height to such a neighbour (m); least : how many have to be.
    on_ground : (n,) bool, changed.
    """
    changed = True
    while changed:
        changed = False
        for i in range(z.size):
            if may[i] and not on_ground[i]:
                count = 0
                for k in range(near.shape[1]):
                    j = near[i, k]
                    if on_ground[j] and abs(z[i] - z[j]) <= step:
                        count += 1
                if count >= least:
                    on_ground[i] = True
                    changed = True


SWEEPS = 8
"""Sweeps of relaxation: with a level for each size of holes, the membrane is wrong by less than a hundredth of the fall
across a hole."""


@kernel
def halved(z, known, odd, coarse, coarse_known):
    """Compute the mean height of the known cells of each two by two.

    z : (rows, columns) float32; known : (rows, columns) bool. odd : (2,) 1 where the first row, the first column, is
    the second of its two by two, else 0. coarse, coarse_known : (⌈(rows + odd)/2⌉, ⌈(columns + odd)/2⌉), out.
    """
    rows, columns = z.shape
    for i in range(coarse.shape[0]):
        for j in range(coarse.shape[1]):
            total, count = 0.0, 0
            for a in range(max(2 * i - odd[0], 0), min(2 * i + 2 - odd[0], rows)):
                for b in range(max(2 * j - odd[1], 0), min(2 * j + 2 - odd[1], columns)):
                    if known[a, b]:
                        total += z[a, b]
                        count += 1
            coarse_known[i, j] = count > 0
            coarse[i, j] = total / count if count > 0 else 0.0


@kernel
def begin(coarse, known, odd, z):
    """Fill the unknown cells of z from the coarse level, bilinear between the middles of its cells.

    coarse : float32, whole; known : (rows, columns) bool; odd : as for :func:`halved`; z : (rows, columns) float32.
    """
    m, n = coarse.shape
    for i in range(z.shape[0]):
        a, upper = divmod(i + odd[0], 2)
        a2 = min(max(a + (1 if upper else -1), 0), m - 1)
        for j in range(z.shape[1]):
            if not known[i, j]:
                b, right = divmod(j + odd[1], 2)
                b2 = min(max(b + (1 if right else -1), 0), n - 1)
                near = 0.75 * coarse[a, b] + 0.25 * coarse[a, b2]
                far = 0.75 * coarse[a2, b] + 0.25 * coarse[a2, b2]
                z[i, j] = 0.75 * near + 0.25 * far


@kernel
def relax(z, known):
    """Replace each unknown cell by the mean of its four neighbours, row by row, eight times over (Gauss–Seidel).

    A mean waits for that of the cell to its west. So the eight sweeps go over the raster together, each two rows behind
    the one before: it finds there what that left, and the processor works on eight means at once.
    z : (rows, columns) float32, changed; known : (rows, columns) bool. The slope across the grid's edge is zero.
    """
    rows = z.shape[0]
    for front in range(rows + 2 * SWEEPS - 2):
        if 2 * SWEEPS - 2 < front < rows - 1:
            _relax_eight(z, known, front)
        else:
            for sweep in range(SWEEPS):
                _relax_row(z, known, front - 2 * sweep)


@inlined
def _relax_row(z, known, i):
    """Replace the unknown cells of a row, where the raster has it."""
    rows, columns = z.shape
    if 0 <= i < rows:
        south, north = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(columns):
            if not known[i, j]:
                west, east = max(j - 1, 0), min(j + 1, columns - 1)
                z[i, j] = 0.25 * (z[south, j] + z[north, j] + z[i, west] + z[i, east])


@inlined
def _relax_eight(z, known, front):
    """Replace the unknown cells of eight rows, each two south of the one before, none at an edge of the raster."""
    columns = z.shape[1]
    for j in range(columns):
        west, east = max(j - 1, 0), min(j + 1, columns - 1)
        for sweep in range(SWEEPS):
            i = front - 2 * sweep
            mean = np.float32(0.25) * (z[i - 1, j] + z[i + 1, j] + z[i, west] + z[i, east])
            z[i, j] = z[i, j] if known[i, j] else mean


@inlined
def mixed(counter):
    """Returns 64 random bits for a counter: the finaliser of SplitMix64 (Steele, Lea, Flood 2014)."""
    z = counter * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@inlined
def plane_through(x, y, z, a, b, c):
    """Slopes east and north of the plane z = e x + n y + h through three points, h, and whether there is one."""
    x1, y1, z1 = x[b] - x[a], y[b] - y[a], z[b] - z[a]
    x2, y2, z2 = x[c] - x[a], y[c] - y[a], z[c] - z[a]
    area = x1 * y2 - x2 * y1
    if abs(area) < 1e-3:
        return 0.0, 0.0, 0.0, False
    east, north = (z1 * y2 - z2 * y1) / area, (x1 * z2 - x2 * z1) / area
    return east, north, z[a] - east * x[a] - north * y[a], True


@inlined
def supporters(x, y, z, left, many, step, plane, reach):
    """How many of the returns `left[:many]`, every `step`-th of them, lie within `reach` of a plane, vertically (m)."""
    east, north, height = plane
    found = 0
    for k in range(0, many, step):
        at = left[k]
        if abs(z[at] - east * x[at] - north * y[at] - height) <= reach:
            found += 1
    return found


@inlined
def fitted(x, y, z, left, many, plane, reach):
    """Returns the plane of least squares through the returns within `reach` of another one."""
    east, north, height = plane
    n, sx, sy, sz, sxx, sxy, syy, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(many):
        at = left[k]
        r = z[at] - east * x[at] - north * y[at] - height
        if abs(r) <= reach:
            n += 1.0
            sx += x[at]
            sy += y[at]
            sz += r
            sxx += x[at] * x[at]
            sxy += x[at] * y[at]
            syy += y[at] * y[at]
            sxz += x[at] * r
            syz += y[at] * r
    if n < 3.0:
        return plane
    cxx, cxy, cyy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
    cxz, cyz = sxz - sx * sz / n, syz - sy * sz / n
    area = cxx * cyy - cxy * cxy
    if area <= 1e-9 * (cxx + cyy) ** 2:
        return plane
    de, dn = (cxz * cyy - cyz * cxy) / area, (cyz * cxx - cxz * cxy) / area
    return east + de, north + dn, height + (sz - de * sx - dn * sy) / n


@kernel
def planes(x, y, z, begin, key, reach, steepest, counts, found):
    """Find the returns on a large plane of their block: each plane is sought among the returns that others left.

    Parameters
    ----------
    x, y, z : (n,) float64, block after block, x and y from a corner near them (m).
    begin : (blocks + 1,) int64, where each block's returns begin.
    key : (blocks,) uint64, counters that draws begin at: numbers of the block's place.
    reach : upright distance of returns on a plane (m); steepest : slope of one (m/m).
    counts : (4,) int64, the most planes of a block, draws of a plane, returns that judge a draw, and returns that make
        a plane at the least.
    found : (n,) bool, out.
    """
    left = np.empty(x.size, np.int64)
    for block in range(key.size):
        many = 0
        for k in range(begin[block], begin[block + 1]):
            found[k] = False
            left[many] = k
            many += 1
        counter = key[block]
        for _ in range(counts[0]):
            if many < counts[3]:
                break
            step = many // counts[2] + 1
            best, most = (0.0, 0.0, 0.0), 0
            for _ in range(counts[1]):
                a = left[int(mixed(counter) % np.uint64(many))]
                b = left[int(mixed(counter + np.uint64(1)) % np.uint64(many))]
                c = left[int(mixed(counter + np.uint64(2)) % np.uint64(many))]
                counter += np.uint64(3)
                east, north, height, good = plane_through(x, y, z, a, b, c)
                if good and math.hypot(east, north) <= steepest:
                    support = supporters(x, y, z, left, many, step, (east, north, height), reach)
                    if support > most:
                        best, most = (east, north, height), support
            if most * step < counts[3]:
                break
            east, north, height = fitted(x, y, z, left, many, best, reach)
            kept = 0
            for k in range(many):
                at = left[k]
                if abs(z[at] - east * x[at] - north * y[at] - height) <= reach:
                    found[at] = True
                else:
                    left[kept] = at
                    kept += 1
            many = kept
