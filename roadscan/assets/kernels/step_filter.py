"""Matched filter for steps in a raster of heights, and means of the surroundings of each cell.

The filter is two one-sided straight lines that meet at a cell, and their difference there. For a direction u along the
edge, cells are first summed into strips along u, then the strips of each side give a line across the edge. Heights
along u follow a known slope, so that a grade is no step.

Rasters have a frame of `FRAME` cells without heights around them, and pieces of `CHUNK` cells of a row are worked on
together: the loops over them are short enough for the first cache and simple enough for vector registers.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inlined, inlined, kernel

MIN_STRIPS = 3  # Least number of strips on each side.
CHUNK = 64  # Cells of a row that are processed together.
FRAME = 16
"""Cells around a raster; strips and windows reach no farther."""
WORK = 20
"""Rows of `CHUNK` numbers that the kernels work in."""


@bare_inlined
def fallen(height_m, slope_x, slope_y, east_m, north_m, out):
    """Compute heights at a place less the expected rise of the ground to there."""
    for i in range(CHUNK):
        out[i] = height_m[i] - slope_x[i] * east_m - slope_y[i] * north_m


@bare_inlined
def add_weighted(weight, value, total, weighted):
    """Add weights, and values by weight."""
    for i in range(CHUNK):
        total[i] += weight[i]
        weighted[i] += weight[i] * value[i]


@bare_inlined
def add_squares(weight, value, squares):
    """Add squares of values by weight."""
    for i in range(CHUNK):
        squares[i] += weight[i] * value[i] * value[i]


@bare_inlined
def means_of(total, weighted, squares):
    """Compute a mean and a χ² from sums; 0 where nothing was added."""
    for i in range(CHUNK):
        w = total[i] if total[i] > 0.0 else 1.0
        rest = squares[i] - weighted[i] * weighted[i] / w
        squares[i] = rest if rest > 0.0 and total[i] > 0.0 else 0.0
    for i in range(CHUNK):
        w = total[i] if total[i] > 0.0 else 1.0
        weighted[i] = weighted[i] / w if total[i] > 0.0 else 0.0


@bare
def strips(weight, height_m, slope_x, slope_y, along, wanted, work, out):
    """Fill `out` (3, …): sum of weights of the strip around each cell, its mean height (m), and its χ².

    All rasters but `wanted` have a frame, where the weight is 0. weight : one over the variance of a cell's height
    (1/m²), 0: no height. slope_x, slope_y : slope of the ground at large (m/m). along : (k, 4) of each cell of a strip
    its column and row from the middle (whole numbers) and its place from the middle in x and y (m). wanted : (rows,
    chunks) bool, pieces of rows that are filled; others stay as they are. work : (WORK, CHUNK) float64.
    """
    for row in range(wanted.shape[0]):
        for chunk in range(wanted.shape[1]):
            if not wanted[row, chunk]:
                continue
            r, c = row + FRAME, chunk * CHUNK + FRAME
            total, weighted, squares = out[0, r, c : c + CHUNK], out[1, r, c : c + CHUNK], out[2, r, c : c + CHUNK]
            for i in range(CHUNK):
                total[i], weighted[i], squares[i] = 0.0, 0.0, 0.0
            for k in range(along.shape[0]):
                rr, cc = r + int(along[k, 1]), c + int(along[k, 0])
                w, z = weight[rr, cc : cc + CHUNK], work[0]
                fallen(
                    height_m[rr, cc : cc + CHUNK], slope_x[r, c : c + CHUNK], slope_y[r, c : c + CHUNK], along[k, 2],
                    along[k, 3], z,
                )  # fmt: skip
                add_weighted(w, z, total, weighted)
                add_squares(w, z, squares)
            means_of(total, weighted, squares)


@bare_inlined
def add_moments(weight, distance_m, s0, s1, s2):
    """Add moments of strips at a distance."""
    for i in range(CHUNK):
        s0[i] += weight[i]
        s1[i] += weight[i] * distance_m
        s2[i] += weight[i] * distance_m * distance_m


@bare_inlined
def add_heights(weight, value, distance_m, t0, t1):
    """Add heights of strips at a distance."""
    for i in range(CHUNK):
        t0[i] += weight[i] * value[i]
        t1[i] += weight[i] * distance_m * value[i]


@bare_inlined
def add_known(weight, rest, known, chi2):
    """Count strips, and add their χ²."""
    for i in range(CHUNK):
        known[i] += 1.0 if weight[i] > 0.0 else 0.0
        chi2[i] += rest[i]


@bare_inlined
def level_of(s0, s1, s2, t0, t1, out):
    """Compute the height of a line at the edge."""
    for i in range(CHUNK):
        out[i] = (s2[i] * t0[i] - s1[i] * t1[i]) / (s0[i] * s2[i] - s1[i] * s1[i])


@bare_inlined
def variance_of(s0, s1, s2, out):
    """Compute the variance of a line's height at the edge."""
    for i in range(CHUNK):
        out[i] = s2[i] / (s0[i] * s2[i] - s1[i] * s1[i])


@bare_inlined
def slope_of(s0, s1, s2, t0, t1, out):
    """Compute the slope of a line."""
    for i in range(CHUNK):
        out[i] = (s0[i] * t1[i] - s1[i] * t0[i]) / (s0[i] * s2[i] - s1[i] * s1[i])


@bare_inlined
def expect_slope(slope, side, precision, s2, t1):
    """Add the expected slope of a side to its sums."""
    for i in range(CHUNK):
        s2[i] += precision
        t1[i] += precision * (side * slope[i])


@bare_inlined
def expect_squares(slope, precision, q):
    """Add the expected slope of a side to its squares."""
    for i in range(CHUNK):
        q[i] += precision * slope[i] * slope[i]


@bare_inlined
def add_rest(q, level, t0, found, t1, chi2):
    """Add the deviations of strips from their line to the χ² within them."""
    for i in range(CHUNK):
        rest = q[i] - level[i] * t0[i] - found[i] * t1[i]
        chi2[i] += rest if rest > 0.0 else 0.0


@bare_inlined
def side_lines(strip, r, c, across, side, slope, precision, work, first):
    """Lines through the strips of one side of a piece of a row: fills five rows of `work` from `first` on.

    They are the height at the edge (m), its variance (m²), χ², the number of strips, and the slope. slope : what is
    expected of it to the right, with `precision`. Distances count from the edge, away from it. side : 1 right, −1 left.
    """
    level, variance, chi2 = work[first], work[first + 1], work[first + 2]
    known, found = work[first + 3], work[first + 4]
    s0, s1, s2, t0, t1, q = work[0], work[1], work[2], work[3], work[4], work[5]
    for i in range(CHUNK):
        s0[i], s1[i], s2[i] = 0.0, 0.0, 0.0
        t0[i], t1[i], q[i] = 0.0, 0.0, 0.0
        chi2[i], known[i] = 0.0, 0.0
    for j in range(across.shape[0]):
        rr, cc = r + side * int(across[j, 1]), c + side * int(across[j, 0])
        w, z, d = strip[0, rr, cc : cc + CHUNK], strip[1, rr, cc : cc + CHUNK], across[j, 2]
        add_moments(w, d, s0, s1, s2)
        add_heights(w, z, d, t0, t1)
        add_squares(w, z, q)
        add_known(w, strip[2, rr, cc : cc + CHUNK], known, chi2)
    expect_slope(slope, float(side), precision, s2, t1)
    expect_squares(slope, precision, q)
    level_of(s0, s1, s2, t0, t1, level)
    variance_of(s0, s1, s2, variance)
    slope_of(s0, s1, s2, t0, t1, found)
    add_rest(q, level, t0, found, t1, chi2)


@bare_inlined
def spread_of(right, left, freedom, out):
    """Compute by how much more than expected both sides scatter, by their χ²."""
    for i in range(CHUNK):
        free = freedom[i] - 4.0
        spread = (right[i] + left[i]) / (free if free > 1.0 else 1.0)
        out[i] = spread if spread > 1.0 else 1.0


@bare_inlined
def sigma_of(right, left, spread, floor_m, out):
    """Compute the standard deviation of a step."""
    for i in range(CHUNK):
        out[i] = np.sqrt((right[i] + left[i]) * spread[i] + floor_m * floor_m)


@bare_inlined
def steps_of(right, left, sigma, told, step_m, evidence):
    """Compute steps, and steps over their σ; 0 where they are not measurable."""
    for i in range(CHUNK):
        step = right[i] - left[i]
        step_m[i] = step if told[i] > 0.0 else 0.0
    for i in range(CHUNK):
        step = right[i] - left[i]
        evidence[i] = step / sigma[i] if told[i] > 0.0 else 0.0


@bare_inlined
def tell(active, right, left, out):
    """Write 1 where both sides have enough strips and a step is sought, else 0."""
    for i in range(CHUNK):
        enough = right[i] >= MIN_STRIPS and left[i] >= MIN_STRIPS and active[i]
        out[i] = 1.0 if enough else 0.0


@bare_inlined
def slope_towards(slope_x, slope_y, unit, out):
    """Compute the slope in a direction."""
    for i in range(CHUNK):
        out[i] = slope_x[i] * unit[0] + slope_y[i] * unit[1]


@bare
def step_response(strip, freedom, active, slopes, across, constants, work, step_m, evidence):
    """Fill (rows, columns) `step_m`, height of the right side above the left one, and `evidence`, the step over its σ.

    strip : (3, …) of :func:`strips`, with a frame; the other rasters have none, and whole chunks of columns. freedom :
    cells with a height near, for the degrees of freedom of χ². active : where to look. slopes : those of the ground at
    large in x and in y (m/m), expected of each side, and the unit vector to the right. across : (s, 3) of each strip of
    the right side its column and row from the edge and its distance from it (m). constants : (precision of the slope of
    a side (m/m)⁻², floor of a step's σ (m)). work : (WORK, CHUNK) float64.
    """
    for row in range(active.shape[0]):
        for c in range(0, active.shape[1], CHUNK):
            here, step, told = active[row, c : c + CHUNK], step_m[row, c : c + CHUNK], evidence[row, c : c + CHUNK]
            some = False
            for i in range(CHUNK):
                step[i], told[i] = 0.0, 0.0
                some |= here[i]
            if not some:
                continue
            expected = work[19]
            slope_towards(slopes[0][row, c : c + CHUNK], slopes[1][row, c : c + CHUNK], slopes[2], expected)
            side_lines(strip, row + FRAME, c + FRAME, across, 1, expected, constants[0], work, 6)
            side_lines(strip, row + FRAME, c + FRAME, across, -1, expected, constants[0], work, 11)
            tell(here, work[9], work[14], work[16])
            spread_of(work[8], work[13], freedom[row, c : c + CHUNK], work[17])
            sigma_of(work[7], work[12], work[17], constants[1], work[18])
            steps_of(work[6], work[11], work[18], work[16], step, told)


@bare
def sizes_of(evidence, still, bounds, counted, size):
    """Fill (rows, columns) `counted`, 1 for cells that tell how steps scatter, and `size`, by how much.

    evidence : steps over their σ. still : cells without a step of any kind near. bounds : (size that counts for a still
    cell, greatest that counts).
    """
    for row in range(evidence.shape[0]):
        for column in range(evidence.shape[1]):
            e, calm = abs(evidence[row, column]), still[row, column]
            counted[row, column] = 1.0 if calm or e != 0.0 else 0.0
            size[row, column] = bounds[0] if calm else min(e, bounds[1])


@bare
def take_excess(evidence, counted, size, prior, usual):
    """Divide `evidence` (rows, columns) by the excess scatter of steps around each cell over the usual; 1 at least.

    counted, size : means around each cell of what :func:`sizes_of` fills. prior : (mean share and mean size that are
    added). usual : size by chance.
    """
    for row in range(evidence.shape[0]):
        for column in range(evidence.shape[1]):
            if evidence[row, column] != 0.0:
                mean = (size[row, column] + prior[1]) / (counted[row, column] + prior[0])
                evidence[row, column] /= max(mean / usual, 1.0)


@kernel
def thin(step_m, evidence, direction, across_unit, limits, first, best):
    """Keep in `best` (4, rows, columns) the strongest step of all directions, where it is the greatest across the edge.

    `best` holds evidence, step (m), direction (number), offset across (cells, to the right) and is filled direction by
    direction. `step_m` and `evidence` may have more columns, which are left out. across_unit : (column, row) unit
    vector to the right, in cells. limits : (least evidence, least and greatest height of a step (m)). first : row and
    column that cells count from.
    """
    rows, columns = best.shape[1:]
    for row in range(2, rows - 2):
        for column in range(2, columns - 2):
            e, h = abs(evidence[row, column]), abs(step_m[row, column])
            if e < limits[0] or h < limits[1] or h > limits[2] or e <= best[0, row, column]:
                continue
            sign = 1.0 if evidence[row, column] > 0.0 else -1.0
            x, y = column + first[1], row + first[0]
            before = sign * sample(evidence, x - across_unit[0], y - across_unit[1], first)
            after = sign * sample(evidence, x + across_unit[0], y + across_unit[1], first)
            if before > e or after > e:
                continue
            curve = before - 2.0 * e + after
            best[0, row, column] = e
            best[1, row, column] = step_m[row, column]
            best[2, row, column] = direction
            best[3, row, column] = 0.5 * (before - after) / curve if curve < 0.0 else 0.0


@inlined
def sample(field, column, row, first):
    """Bilinear value of a field (rows, columns) at a place in it; first : row and column of its beginning."""
    c, r = int(np.floor(column)), int(np.floor(row))
    u, v = column - c, row - r
    c, r = c - first[1], r - first[0]
    return (field[r, c] * (1.0 - u) + field[r, c + 1] * u) * (1.0 - v) + (
        field[r + 1, c] * (1.0 - u) + field[r + 1, c + 1] * u
    ) * v


@bare_inlined
def scaled(value, factor, out):
    """Numbers times a factor."""
    for i in range(out.size):
        out[i] = value[i] * factor


@bare_inlined
def add_pairs(before, after, weight, out):
    """Add sums of two rows by a weight."""
    for i in range(out.size):
        out[i] += (before[i] + after[i]) * weight


@bare_inlined
def mirrored(at, size):
    """Returns the index of a row beyond the ends, which are mirrored."""
    at %= 2 * size
    return at if at < size else 2 * size - 1 - at


@bare
def convolve(value, weights, line, between, out):
    """Fill `out` (rows, columns) with sums of the surroundings by weight; the raster is mirrored at its edges.

    weights : (k + 1,) of the cell itself and of those up to k cells away, the same on both sides, and along rows and
    columns. line : (columns + 2 k,) and between : (rows, columns) are working space. Sums begin with the middle and go
    on from the farthest cells inwards.
    """
    rows, columns = value.shape
    most = weights.size - 1
    for row in range(rows):
        scaled(value[row], weights[0], between[row])
        for k in range(most, 0, -1):
            add_pairs(value[mirrored(row - k, rows)], value[mirrored(row + k, rows)], weights[k], between[row])
    for row in range(rows):
        for i in range(columns):
            line[most + i] = between[row, i]
        for i in range(most):
            line[i] = between[row, mirrored(i - most, columns)]
            line[most + columns + i] = between[row, mirrored(columns + i, columns)]
        scaled(line[most : most + columns], weights[0], out[row])
        for k in range(most, 0, -1):
            add_pairs(line[most - k : most - k + columns], line[most + k : most + k + columns], weights[k], out[row])


@bare_inlined
def add_row(value, total):
    """Add a row of numbers to another one."""
    for i in range(total.size):
        total[i] += value[i]


@bare_inlined
def moved(entering, leaving, total):
    """Advance sums of rows by one row."""
    for i in range(total.size):
        total[i] += entering[i] - leaving[i]


@bare_inlined
def divided(total, size, out):
    """Divide sums to means."""
    for i in range(out.size):
        out[i] = total[i] / size


@bare
def window_means(value, size, wanted, between, line, out):
    """Fill `out` (rows, columns) with the means of squares of `size` by `size` cells, zeros beyond the raster.

    wanted : (first, end) rows that are filled. The square reaches from size // 2 cells before a cell. between : (rows +
    2, columns), its last row zeros, and line : (columns + size,), zeros, are working space. Sums run along columns,
    then along rows.
    """
    rows, columns = value.shape
    before = size // 2
    after = size - before - 1
    total, nothing = between[rows], between[rows + 1]
    for i in range(columns):
        total[i] = 0.0
    for row in range(min(after + 1, rows)):
        add_row(value[row], total)
    if wanted[0] == 0:
        divided(total, float(size), between[0])
    for row in range(1, wanted[1]):
        entering = value[row + after] if row + after < rows else nothing
        leaving = value[row - before - 1] if row - before - 1 >= 0 else nothing
        moved(entering, leaving, total)
        if row >= wanted[0]:
            divided(total, float(size), between[row])
    for row in range(wanted[0], wanted[1]):
        for i in range(columns):
            line[before + i] = between[row, i]
        here = 0.0
        for i in range(size):
            here += line[i]
        out[row, 0] = here / float(size)
        for i in range(1, columns):
            here += line[i + size - 1] - line[i - 1]
            out[row, i] = here / float(size)
