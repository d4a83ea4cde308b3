"""Edges of a road in a raster of stations and offsets: steps and bends across it, and the best path along it.

The slope across shows the edge (P. Kumar et al. 2013, who fit a snake to slope, reflectance and pulse width). Here the
evidence is a difference over its σ, and dynamic programming finds the best path of all.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel


@kernel
def step_and_bend(height_m, weight, spacing_m, window, floors, step, bend):
    """Fill `step` and `bend` (stations, offsets): the step and the change of slope at a cell, each over its σ.

    height_m : (stations, offsets) heights. weight : one over their variance (1/m²), 0 where there is none. spacing_m :
    of offsets. window : (cells along, cells across) of each side's line. floors : (σ of a step (m), σ of a change of
    slope (m/m)) that no number of heights takes away. Both are NaN where a side has too few cells.
    """
    stations, offsets = height_m.shape
    for s in range(stations):
        for o in range(offsets):
            step[s, o], bend[s, o] = np.nan, np.nan
            if weight[s, o] <= 0.0:
                continue
            a, slope_a, var_a, var_slope_a, rest_a, n_a = line_beside(height_m, weight, s, o, -1, window, spacing_m)
            b, slope_b, var_b, var_slope_b, rest_b, n_b = line_beside(height_m, weight, s, o, 1, window, spacing_m)
            if n_a < 4 or n_b < 4:
                continue
            spread = max(1.0, (rest_a + rest_b) / max(n_a + n_b - 4, 1))
            step[s, o] = (b - a) / np.sqrt((var_a + var_b) * spread + floors[0] * floors[0])
            bend[s, o] = (slope_b - slope_a) / np.sqrt((var_slope_a + var_slope_b) * spread + floors[1] * floors[1])


@inlined
def line_beside(height_m, weight, s, o, side, window, spacing_m):
    """Fit a line to the cells of one side; return height and slope at the edge, their variances, χ², and count."""
    stations, offsets = height_m.shape
    sw, s1, s2, t0, t1, q, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for i in range(max(s - window[0], 0), min(s + window[0] + 1, stations)):
        for j in range(1, window[1] + 1):
            c = o + side * j
            if c < 0 or c >= offsets or weight[i, c] <= 0.0:
                continue
            # Heights along the road are taken relative to the cell of the station.
            if weight[i, o] <= 0.0:
                continue
            w, z, d = weight[i, c], height_m[i, c] - height_m[i, o], side * j * spacing_m
            n += 1
            sw += w
            s1 += w * d
            s2 += w * d * d
            t0 += w * z
            t1 += w * d * z
            q += w * z * z
    determinant = sw * s2 - s1 * s1
    if n < 4 or determinant <= 0.0:
        return 0.0, 0.0, np.inf, np.inf, 0.0, 0
    level, slope = (s2 * t0 - s1 * t1) / determinant, (sw * t1 - s1 * t0) / determinant
    return level, slope, s2 / determinant, sw / determinant, max(q - level * t0 - slope * t1, 0.0), n


@kernel
def best_path(evidence, reach, shift_cost, total, before, path):
    """Fill `path` (stations,) with the offsets (cells) whose evidence has the greatest sum.

    evidence : (stations, offsets), NaN: nothing known, which counts nothing. reach : cells that the path may move from
    station to station, each at `shift_cost`. total, before : room of the shape of `evidence`.
    """
    stations, offsets = evidence.shape
    for s in range(stations):
        for o in range(offsets):
            here = 0.0 if np.isnan(evidence[s, o]) else evidence[s, o]
            best, at = 0.0, o
            if s > 0:
                best = -np.inf
                for j in range(max(o - reach, 0), min(o + reach + 1, offsets)):
                    value = total[s - 1, j] - shift_cost * abs(j - o)
                    if value > best:
                        best, at = value, j
            total[s, o], before[s, o] = here + best, at
    if stations > 0:
        o = int(np.argmax(total[stations - 1]))
        for s in range(stations - 1, -1, -1):
            path[s] = o
            o = int(before[s, o])


@kernel
def best_places(evidence, reach, shift_cost, within, before, total, path):
    """Fill `path` (stations,) with the offset (cells) through which the best path of a finite length about each leads.

    within : stations on both sides that such a path takes in; what lies farther away does not count. before, total :
    room for two rows (2, offsets) and for one. Other arguments as those of :func:`best_path`.
    """
    stations, offsets = evidence.shape
    for s in range(stations):
        total[:] = 0.0
        for side in range(2):
            first = max(s - within, 0) if side == 0 else min(s + within, stations - 1)
            step, now = (1 if side == 0 else -1), 0
            for o in range(offsets):
                before[0, o] = evidence[first, o]
            for k in range(first + step, s + step, step):
                for o in range(offsets):
                    best = -np.inf
                    for j in range(max(o - reach, 0), min(o + reach + 1, offsets)):
                        best = max(best, before[now, j] - shift_cost * abs(j - o))
                    before[1 - now, o] = best + evidence[k, o]
                now = 1 - now
            total += before[now]
        # The station itself counts on both sides.
        path[s] = int(np.argmax(total - evidence[s]))
