"""Kernels for surfaces seen in several drives: positions of readings, height images, shifts between patches."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import kernel
from roadscan.compute.kernels.arrays import catmull_rom, sampled

UNKNOWNS = 5
"""Unknowns of a patch: shift along x, y, z, and two tilts that are eliminated afterwards."""
LONGEST_CELLS = 2.0
"""Longest movement of a patch in one step."""
DONE_CELLS = 0.002
"""A step this short ends a patch's search."""
MOMENTS = 4
"""Weighted sums of a patch that give the centre of its shift: of w, w x, w y, w h; w: product of both slopes."""


class Matches(NamedTuple):
    """Matches of p patches, written by kernels."""

    shift_m: npt.NDArray[np.float64]
    """(p, 3) in/out: dx, dy, dz."""
    crossed: npt.NDArray[np.float64]
    """(p, 5, 5) normal matrix of (dx, dy, dz, tilts) from slopes of both images, for heights of unit variance."""
    mean: npt.NDArray[np.float64]
    """(p, 5, 5) the same from mean slopes."""
    spread_m2: npt.NDArray[np.float64]
    """(p,) mean squared residual."""
    used: npt.NDArray[np.int32]
    """(p,) cells used; 0 for a patch with too few in common."""
    felt: npt.NDArray[np.float64]
    """(p, 4) see `MOMENTS`; x and y in cells from the image's corner."""


@kernel
def place(point_sensor, pose, position, rotation, body_from_sensor, lever, out):
    """Compute the positions of readings.

    Parameters
    ----------
    point_sensor : (n, 3) float64, m; pose : (n,) int32, row of each reading's pose.
    position : (p, 3) float64, m; rotation : (p, 3, 3) float64, from body.
    body_from_sensor : (3, 3); lever : (3,), body, m.
    out : (n, 3) float64, out, m, in the axes of `position`.
    """
    b00, b01, b02 = body_from_sensor[0, 0], body_from_sensor[0, 1], body_from_sensor[0, 2]
    b10, b11, b12 = body_from_sensor[1, 0], body_from_sensor[1, 1], body_from_sensor[1, 2]
    b20, b21, b22 = body_from_sensor[2, 0], body_from_sensor[2, 1], body_from_sensor[2, 2]
    forward, right, down = lever[0], lever[1], lever[2]
    for i in range(pose.size):
        k = pose[i]
        x, y, z = point_sensor[i, 0], point_sensor[i, 1], point_sensor[i, 2]
        u = b00 * x + b01 * y + b02 * z + forward
        v = b10 * x + b11 * y + b12 * z + right
        w = b20 * x + b21 * y + b22 * z + down
        for a in range(3):
            out[i, a] = position[k, a] + rotation[k, a, 0] * u + rotation[k, a, 1] * v + rotation[k, a, 2] * w


@kernel
def splat(place_m, pose, corner_x, corner_y, cell, mass, height, carrier):
    """Distribute readings over the four cells around each, by proximity.

    Parameters
    ----------
    place_m : (n, 3) float64, m; pose : (n,) int32.
    corner_x, corner_y, cell : float64, m; cell (0, 0) has its centre at the corner, rows run along y.
    mass, height : (rows, columns) float64, in/out: sums of weights, and of weight · z.
    carrier : (rows, columns) int32, in/out: pose of the last reading nearest to a cell.
    """
    rows, columns = mass.shape
    for i in range(pose.size):
        u, v = (place_m[i, 0] - corner_x) / cell, (place_m[i, 1] - corner_y) / cell
        z = place_m[i, 2]
        if not (0.0 <= u < columns - 1.0 and 0.0 <= v < rows - 1.0 and math.isfinite(z)):
            continue
        c, r = int(u), int(v)
        fu, fv = u - c, v - r
        for j in range(2):
            for k in range(2):
                w = (fv if j == 1 else 1.0 - fv) * (fu if k == 1 else 1.0 - fu)
                mass[r + j, c + k] += w
                height[r + j, c + k] += w * z
        carrier[r + (1 if fv > 0.5 else 0), c + (1 if fu > 0.5 else 0)] = pose[i]


@kernel
def _equations(first, second, cell, row, column, size, step, move, crossed, mean, right, felt):
    """Fill the normal equations of one patch at (dx, dy, dz, tilts); return sum of squared residuals and cells used."""
    rows, columns = first.shape
    half = 0.5 * (size - 1)
    du, dv = move[0] / cell, move[1] / cell
    ku, kv = math.floor(du), math.floor(dv)
    s, t = catmull_rom(du - ku), catmull_rom(dv - kv)
    low_r, high_r = max(1, 1 - kv), min(rows - 1, rows - 2 - kv)
    low_c, high_c = max(1, 1 - ku), min(columns - 1, columns - 2 - ku)
    jacobian = np.empty(UNKNOWNS)
    total, used = 0.0, 0
    for j in range(0, size, step):
        r = row + j
        for i in range(0, size, step):
            c = column + i
            if not (low_r <= r < high_r and low_c <= c < high_c):
                continue
            here = first[r, c]
            ax = 0.5 * (first[r, c + 1] - first[r, c - 1]) / cell
            ay = 0.5 * (first[r + 1, c] - first[r - 1, c]) / cell
            there, bx, by = sampled(second, r + kv, c + ku, s, t)
            bx, by = bx / cell, by / cell
            x, y = (i - half) / half, (j - half) / half
            left = here + move[2] + move[3] * x + move[4] * y - there
            if not math.isfinite(left + ax + ay + bx + by):
                continue
            jacobian[0], jacobian[1], jacobian[2] = -0.5 * (ax + bx), -0.5 * (ay + by), 1.0
            jacobian[3], jacobian[4] = x, y
            for a in range(UNKNOWNS):
                right[a] -= jacobian[a] * left
                for d in range(a + 1):
                    mean[a, d] += jacobian[a] * jacobian[d]
            crossed[0, 0] += ax * bx
            crossed[1, 1] += ay * by
            crossed[1, 0] += 0.5 * (ax * by + bx * ay)
            weight = max(ax * bx + ay * by, 0.0)
            felt[0] += weight
            felt[1] += weight * c
            felt[2] += weight * r
            felt[3] += weight * here
            total += left * left
            used += 1
    for a in range(UNKNOWNS):
        for d in range(a + 1):
            mean[d, a] = mean[a, d]
            if a > 1:
                crossed[a, d] = mean[a, d]
            crossed[d, a] = crossed[a, d]
    return total, used


@kernel
def match_patches(first, second, cell, corner, size, step, iterations, least, found):
    """Find the shifts between patches of two height images, by Gauss–Newton on the heights (Lucas and Kanade 1981).

    A place (x, y, h) of the first image lies at (x + dx, y + dy, h + dz) in the second; tilts of the patch against
    the second image are unknowns too. A second normal matrix is made of products of one image's slopes with the
    other's, to which noise in the slopes adds nothing.

    Parameters
    ----------
    first, second : (rows, columns) float64, m; NaN where nothing was seen. cell : float64, m.
    corner : (p, 2) int32, row and column of each patch's corner; size : int, cells along its edge; every `step`-th
        cell of a row and of a column is used.
    iterations : int, most; least : int, a patch with fewer cells in common gets `count` 0.
    found : Matches.
    """
    shift, crossed, mean, spread, count, felt = found
    move = np.empty(UNKNOWNS)
    right = np.empty(UNKNOWNS)
    for p in range(corner.shape[0]):
        for k in range(UNKNOWNS):
            move[k] = shift[p, k] if k < 3 else 0.0
        done = False
        for turn in range(iterations):
            crossed[p], mean[p], felt[p], right[:] = 0.0, 0.0, 0.0, 0.0
            total, used = _equations(
                first, second, cell, corner[p, 0], corner[p, 1], size, step, move, crossed[p], mean[p], right, felt[p]
            )
            count[p] = used if used >= least else 0
            spread[p] = total / max(used, 1)
            if used < least or done or turn == iterations - 1:
                break
            change = np.linalg.solve(mean[p] + 1e-9 * used * np.eye(UNKNOWNS), right)
            reach = math.hypot(change[0], change[1]) / cell
            move += min(1.0, LONGEST_CELLS / max(reach, 1e-300)) * change
            done = reach < DONE_CELLS
        for k in range(3):
            shift[p, k] = move[k]
