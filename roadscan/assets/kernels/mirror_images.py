"""Mirror images: returns that lie lower than the foot of something solid on the sight line to them."""

from __future__ import annotations

import math

import numpy as np

from roadscan.assets.kernels.ground import cell_of
from roadscan.compute.kernel_options import kernel


@kernel
def lowest_rows(x, y, z, left_out, origin, per_m, lowest, row):
    """Find the lowest return of each cell and its number, which are written to `lowest` and `row`.

    x, y, z : (n,) float64 (m); left_out : (n,) bool. origin, per_m : corner of the grid (m) and cells a metre.
    lowest : (rows, columns) float32, holding inf; row : (rows, columns) int64, holding −1.
    """
    for k in range(x.size):
        i, j = cell_of(x[k], y[k], origin, per_m)
        if 0 <= i < lowest.shape[0] and 0 <= j < lowest.shape[1] and z[k] < lowest[i, j] and not left_out[k]:
            lowest[i, j], row[i, j] = z[k], k


@kernel
def count_stopped(x, y, z, origin, per_m, lowest, level_m, stopped):
    """Count the returns of each cell by their height above its lowest one.

    lowest : (rows, columns) float32 (m). stopped : (rows, columns, levels) int32, added to; a level is `level_m` high.
    Other arguments as of `lowest_rows`.
    """
    rows, columns, levels = stopped.shape
    for k in range(x.size):
        i, j = cell_of(x[k], y[k], origin, per_m)
        if 0 <= i < rows and 0 <= j < columns:
            level = math.floor((z[k] - lowest[i, j]) / level_m)
            if 0 <= level < levels:
                stopped[i, j, level] += 1


@kernel
def rows_up_to(x, y, z, origin, per_m, limit, rows):
    """Find the returns up to the limit of their cell (rows, columns) (m): their numbers are written to rows (n,) int64,
    and how many there are is returned. Other arguments as of `lowest_rows`.
    """
    found = 0
    for k in range(x.size):
        i, j = cell_of(x[k], y[k], origin, per_m)
        if 0 <= i < limit.shape[0] and 0 <= j < limit.shape[1] and z[k] <= limit[i, j]:
            rows[found] = k
            found += 1
    return found


@kernel
def follow_lines(rows, end, start, origin, per_m, bottom, lowest, limits, stopped, passed, counting, foot):
    """Follow the sight lines of some returns through places where something stands.

    Parameters
    ----------
    rows : (k,) int64 numbers of the returns; end, start : x, y and height (n,) float64 of returns and of sensors (m).
    origin, per_m : corner of the grid (m) and cells a metre.
    bottom : (rows, columns) float32, height of the lowest level of a cell (m).
    lowest : (rows, columns) float32, what is the lowest in a cell (m); inf where nothing is known.
    limits : (8,) height of a level (m); steepest rise of the ground (m/m); a return is low that lies lower than the
        ground by this, and a place stands on the ground that is higher by this (m, m); a line is followed from so far
        before the return to so far before it (m, m); a place is solid that stopped so many, and so many times as many
        as passed it to low returns.
    stopped, passed : (rows, columns, levels) int32, lines that ended in a place, and that passed it to low returns.
    counting : whether lines are added to `passed`; otherwise `foot` is written.
    foot : (k,) float64, ground before the last solid place on the line to a low return (m); left as it is if none is.
    """
    level_m, steepest, below_m, stands_m, from_m, short_m, least, times = limits
    step_m = 0.5 / per_m
    for q in range(rows.size):
        k = rows[q]
        east, north, up = end[0][k] - start[0][k], end[1][k] - start[1][k], end[2][k] - start[2][k]
        length = math.hypot(east, north)
        ground, row, column = np.inf, -1, -1
        at = max(length - from_m, 0.0)
        while at <= length - short_m:
            share = at / length
            i, j = cell_of(start[0][k] + share * east, start[1][k] + share * north, origin, per_m)
            height = start[2][k] + share * up
            at += step_m
            ground += steepest * step_m
            if (i == row and j == column) or not (0 <= i < lowest.shape[0] and 0 <= j < lowest.shape[1]):
                continue
            row, column = i, j
            if not lowest[i, j] < start[2][k]:
                continue
            ground = min(ground, lowest[i, j])
            level = math.floor((height - bottom[i, j]) / level_m)
            if end[2][k] < ground - below_m and height >= ground + stands_m and 0 <= level < stopped.shape[2]:
                if counting:
                    passed[i, j, level] += 1
                elif stopped[i, j, level] >= least and stopped[i, j, level] > times * passed[i, j, level]:
                    foot[q] = ground
