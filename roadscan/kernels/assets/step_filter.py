"""Matched filter for steps: two one-sided straight lines that meet at a cell, and how far apart they are there.

For a direction u along the edge, cells are first summed into strips along u, then the strips of each side give a line
across the edge. Heights along u follow a known slope, so that a grade is no step.
"""

from __future__ import annotations

import numpy as np

from roadscan.kernels.options import inlined, kernel

MIN_STRIPS = 3


@kernel
def strips(weight, height_m, slope_x, slope_y, along, out):
    """Fill `out` (3, rows, columns): sum of weights of the strip around each cell, its mean height (m), and its χ².

    weight : (rows, columns) one over the variance of a cell's height (1/m²), 0: no height. slope_x, slope_y : slope of
    the ground at large (m/m). along : (k, 4) of each cell of a strip its column and row from the middle (whole numbers)
    and its place from the middle in x and y (m).
    """
    rows, columns = weight.shape
    for row in range(rows):
        for column in range(columns):
            sw, sz, szz = 0.0, 0.0, 0.0
            gx, gy = slope_x[row, column], slope_y[row, column]
            for k in range(along.shape[0]):
                c, r = column + int(along[k, 0]), row + int(along[k, 1])
                if 0 <= r < rows and 0 <= c < columns and weight[r, c] > 0.0:
                    w = weight[r, c]
                    z = height_m[r, c] - gx * along[k, 2] - gy * along[k, 3]
                    sw += w
                    sz += w * z
                    szz += w * z * z
            out[0, row, column] = sw
            if sw > 0.0:
                out[1, row, column] = sz / sw
                out[2, row, column] = max(szz - sz * sz / sw, 0.0)
            else:
                out[1, row, column] = 0.0
                out[2, row, column] = 0.0


@inlined
def side_line(strip, row, column, across, side, slope_precision, slope):
    """Height of a side's line at the edge (m), its variance (m²), its slope, χ² of its strips, and their number.

    slope : what is expected of it, with `slope_precision`. The variance is infinite where too few strips are
    known. Distances count from the edge, away from it.
    """
    rows, columns = strip.shape[1:]
    s0, s1, s2, t0, t1, q, chi2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    known = 0
    for j in range(across.shape[0]):
        c, r = column + side * int(across[j, 0]), row + side * int(across[j, 1])
        if 0 <= r < rows and 0 <= c < columns and strip[0, r, c] > 0.0:
            w, z, d = strip[0, r, c], strip[1, r, c], across[j, 2]
            known += 1
            s0 += w
            s1 += w * d
            s2 += w * d * d
            t0 += w * z
            t1 += w * d * z
            q += w * z * z
            chi2 += strip[2, r, c]
    if known < MIN_STRIPS:
        return 0.0, np.inf, 0.0, 0.0, known
    s2 += slope_precision
    t1 += slope_precision * slope
    determinant = s0 * s2 - s1 * s1
    level = (s2 * t0 - s1 * t1) / determinant
    found = (s0 * t1 - s1 * t0) / determinant
    q += slope_precision * slope * slope
    return level, s2 / determinant, found, chi2 + max(q - level * t0 - found * t1, 0.0), known


@kernel
def step_response(strip, freedom, active, slope, across, constants, step_m, evidence):
    """Fill (rows, columns) `step_m`, height of the right side above the left one, and `evidence`, the step over its σ.

    strip : (3, rows, columns) of :func:`strips`. freedom : (rows, columns) cells with a height near, for the degrees of
    freedom of χ². active : where to look. slope : (rows, columns) slope of the ground at large to the right (m/m), what
    is expected of each side. across : (s, 3) of each strip of the right side its column and row from the edge and its
    distance from it (m). constants : (precision of the slope of a side (m/m)⁻², floor of a step's σ (m)).
    """
    rows, columns = active.shape
    for row in range(rows):
        for column in range(columns):
            step_m[row, column] = 0.0
            evidence[row, column] = 0.0
            if not active[row, column]:
                continue
            right, var_right, _, chi_right, _ = side_line(
                strip, row, column, across, 1, constants[0], slope[row, column]
            )
            left, var_left, _, chi_left, _ = side_line(
                strip, row, column, across, -1, constants[0], -slope[row, column]
            )
            if not (np.isfinite(var_right) and np.isfinite(var_left)):
                continue
            spread = max(1.0, (chi_right + chi_left) / max(freedom[row, column] - 4.0, 1.0))
            sigma = np.sqrt((var_right + var_left) * spread + constants[1] * constants[1])
            step_m[row, column] = right - left
            evidence[row, column] = (right - left) / sigma


@kernel
def thin(step_m, evidence, direction, across_unit, limits, best):
    """Keep in `best` (5, rows, columns) the strongest step of all directions, where it is the greatest across the edge.

    `best` holds evidence, step (m), direction (number), offset across (cells, to the right) and is filled direction by
    direction. across_unit : (column, row) unit vector to the right, in cells. limits : (least evidence, least and
    greatest height of a step (m)).
    """
    rows, columns = evidence.shape
    for row in range(2, rows - 2):
        for column in range(2, columns - 2):
            e, h = abs(evidence[row, column]), abs(step_m[row, column])
            if e < limits[0] or h < limits[1] or h > limits[2] or e <= best[0, row, column]:
                continue
            sign = 1.0 if evidence[row, column] > 0.0 else -1.0
            before = sign * sample(evidence, column - across_unit[0], row - across_unit[1])
            after = sign * sample(evidence, column + across_unit[0], row + across_unit[1])
            if before > e or after > e:
                continue
            curve = before - 2.0 * e + after
            best[0, row, column] = e
            best[1, row, column] = step_m[row, column]
            best[2, row, column] = direction
            best[3, row, column] = 0.5 * (before - after) / curve if curve < 0.0 else 0.0


@inlined
def sample(field, column, row):
    """Bilinear value of a field (rows, columns) at a place inside it."""
    c, r = int(np.floor(column)), int(np.floor(row))
    u, v = column - c, row - r
    return (field[r, c] * (1.0 - u) + field[r, c + 1] * u) * (1.0 - v) + (
        field[r + 1, c] * (1.0 - u) + field[r + 1, c + 1] * u
    ) * v
