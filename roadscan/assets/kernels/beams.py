"""Incidence of beams on the ground, and gains of their intensities from a table."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel


@kernel
def ground_heights(x, y, grid, height_m, out):
    """Compute the height of the ground at each place: out (n,), bilinear between middles of cells, NaN if unknown.

    x, y : (n,) places (m). grid : (x_min_m, y_min_m, cell_m). height_m : (rows, columns) float32.
    """
    rows, columns = height_m.shape
    for k in range(x.size):
        u = min(max((x[k] - grid[0]) / grid[2] - 0.5, 0.0), columns - 1.0)
        v = min(max((y[k] - grid[1]) / grid[2] - 0.5, 0.0), rows - 1.0)
        if math.isnan(x[k]) or math.isnan(y[k]):
            out[k] = np.nan
            continue
        j, i = max(min(int(u), columns - 2), 0), max(min(int(v), rows - 2), 0)
        east, north = min(j + 1, columns - 1), min(i + 1, rows - 1)
        fu, fv = u - j, v - i
        south = np.float64(height_m[i, j]) * (1 - fu) + np.float64(height_m[i, east]) * fu
        beyond = np.float64(height_m[north, j]) * (1 - fu) + np.float64(height_m[north, east]) * fu
        out[k] = south * (1 - fv) + beyond * fv


@kernel
def meet_ground(place, sensor, grid, slope_x, slope_y, wanted, range_m, cosine):
    """Fill `range_m` (n,) of each return, and `cosine` of the angle between beam and the ground's normal below it.

    place, sensor : three (n,) float64 arrays, x, y and height of the return and of the sensor (m). grid : (x_min_m,
    y_min_m, cell_m) of the slopes (rows, columns) to the east and to the north (m/m). wanted : (n,) bool, returns whose
    cosine is computed; it is 1 for all others.
    """
    rows, columns = slope_x.shape
    for k in range(wanted.size):
        dx, dy = sensor[0][k] - place[0][k], sensor[1][k] - place[1][k]
        dz = sensor[2][k] - place[2][k]
        range_m[k] = math.sqrt(dx * dx + dy * dy + dz * dz)
        cosine[k] = 1.0
        if wanted[k]:
            i = min(max(int((place[1][k] - grid[1]) / grid[2]), 0), rows - 1)
            j = min(max(int((place[0][k] - grid[0]) / grid[2]), 0), columns - 1)
            sx, sy = slope_x[i, j], slope_y[i, j]
            along = (dz - sx * dx - sy * dy) / math.sqrt(1.0 + sx * sx + sy * sy)
            cosine[k] = along / max(range_m[k], 1e-9)
            if cosine[k] < 0.0:
                cosine[k] = 0.0
            elif cosine[k] > 1.0:
                cosine[k] = 1.0


@inlined
def _between(value, nodes, levels):
    """Returns the level at a value, linear between nodes; the levels of the ends beyond them."""
    last = nodes.size - 1
    if not value < nodes[last]:
        return levels[last] if value >= nodes[last] else np.nan
    if value <= nodes[0]:
        return levels[0]
    j = 0
    while nodes[j + 1] <= value:
        j += 1
    slope = (levels[j + 1] - levels[j]) / (nodes[j + 1] - nodes[j])
    return slope * (value - nodes[j]) + levels[j]


@kernel
def log_gains(mine, laser, range_m, incidence, on_ground, by_laser, range_gains, incidence_gains, out):
    """Compute the logarithm of the gain of a sensor's returns: out (n,), other sensors' are unchanged.

    mine : (n,) bool. laser : (n,) uint16. range_m, incidence : (n,) (m, degrees). on_ground : (n,) bool; the gain of
    incidence of all others is 1. by_laser : (65536,) logarithms. range_gains, incidence_gains : nodes (k,), ascending,
    and logarithms (k,) there.
    """
    for k in range(mine.size):
        if mine[k]:
            out[k] = by_laser[laser[k]] + _between(range_m[k], range_gains[0], range_gains[1])
            if on_ground[k]:
                out[k] += _between(incidence[k], incidence_gains[0], incidence_gains[1])
