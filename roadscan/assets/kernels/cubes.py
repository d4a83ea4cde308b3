"""Returns in cubes over the ground: their scatter, classes of stationary ones, and level lines through cubes."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel

NUMBER, LINEARITY, PLANARITY, SCATTERING, NORMAL_UP, ALONG_UP, THICKNESS = range(7)
"""Columns of the features of a cube."""
MOMENTS = 10
"""Number, three sums, six sums of products."""


@kernel
def numbered(x, y, above, chosen, origin, per_m, index, number, place):
    """Number the cubes of chosen returns in the order of their first ones.

    Parameters
    ----------
    x, y : (n,) float64 (m); above : (n,) float32, heights above ground (m); chosen : (n,) bool.
    origin : (2,) float64, corner (m); per_m : cubes a metre.
    index : (rows, columns, layers) int32, holding -1; the number of each cube.
    number : (n,) int32, out: the number of each return's cube, -1 for none.
    place : (most, 3) int32, out: row, column and layer of each cube; more cubes than `most` are left out.

    Returns
    -------
    How many there are.
    """
    rows, columns, layers = index.shape
    found = 0
    for k in range(x.size):
        number[k] = -1
        if not chosen[k]:
            continue
        i, j = math.floor((y[k] - origin[1]) * per_m), math.floor((x[k] - origin[0]) * per_m)
        m = int(above[k] * per_m)
        if above[k] < 0.0 or i < 0 or j < 0 or i >= rows or j >= columns or m >= layers:
            continue
        at = index[i, j, m]
        if at < 0:
            if found >= place.shape[0]:
                continue
            at = found
            index[i, j, m] = at
            place[at, 0], place[at, 1], place[at, 2] = i, j, m
            found += 1
        number[k] = at
    return found


@kernel
def moments(x, y, above, number, origin, per_m, place, out):
    """Sum the returns of each cube, in cubes from its corner.

    out : (cubes, 10) float64, added to: number; x, y, z; xx, xy, xz, yy, yz, zz. Other arguments as of `numbered`.
    """
    for k in range(x.size):
        at = number[k]
        if at >= 0:
            u = (x[k] - origin[0]) * per_m - place[at, 1]
            v = (y[k] - origin[1]) * per_m - place[at, 0]
            w = above[k] * per_m - place[at, 2]
            out[at, 0] += 1.0
            out[at, 1] += u
            out[at, 2] += v
            out[at, 3] += w
            out[at, 4] += u * u
            out[at, 5] += u * v
            out[at, 6] += u * w
            out[at, 7] += v * v
            out[at, 8] += v * w
            out[at, 9] += w * w


@inlined
def eigenvalues(a, b, c, d, e, f):
    """Returns eigenvalues, largest first, of the matrix of rows (a, b, c), (b, d, e), (c, e, f) (Smith 1961)."""
    q = (a + d + f) / 3.0
    p = (a - q) ** 2 + (d - q) ** 2 + (f - q) ** 2 + 2.0 * (b * b + c * c + e * e)
    if p < 1e-24:
        return q, q, q
    p = math.sqrt(p / 6.0)
    a1, d1, f1, b1, c1, e1 = (a - q) / p, (d - q) / p, (f - q) / p, b / p, c / p, e / p
    r = 0.5 * (a1 * (d1 * f1 - e1 * e1) - b1 * (b1 * f1 - e1 * c1) + c1 * (b1 * e1 - d1 * c1))
    angle = math.acos(min(max(r, -1.0), 1.0)) / 3.0
    first = q + 2.0 * p * math.cos(angle)
    last = q + 2.0 * p * math.cos(angle + 2.0 * math.pi / 3.0)
    return first, 3.0 * q - first - last, last


@inlined
def upward(a, b, c, d, e, f, value):
    """Returns how far the eigenvector of an eigenvalue of that matrix points upwards: 0 level, 1 upright."""
    a, d, f = a - value, d - value, f - value
    x1, y1, z1 = b * e - c * d, c * b - a * e, a * d - b * b
    x2, y2, z2 = b * f - c * e, c * c - a * f, a * e - b * c
    x3, y3, z3 = d * f - e * e, e * c - b * f, b * e - d * c
    n1, n2, n3 = x1 * x1 + y1 * y1 + z1 * z1, x2 * x2 + y2 * y2 + z2 * z2, x3 * x3 + y3 * y3 + z3 * z3
    z, n = z1, n1
    if n2 > n:
        z, n = z2, n2
    if n3 > n:
        z, n = z3, n3
    return abs(z) / math.sqrt(n) if n > 0.0 else 0.0


@kernel
def features(index, place, sums, out):
    """Compute the scatter of each cube's returns and the 26 about it (Demantké, Mallet, David, Vallet 2011, eq. 2).

    Parameters
    ----------
    index : (rows, columns, layers) int32; place : (cubes, 3) int32; sums : (cubes, 10) float64.
    out : (cubes, 7) float32: number of returns; linearity, planarity, scattering (they sum to 1); how far the normal
        and the longest direction point upwards; standard deviation along the normal (cubes).
    """
    rows, columns, layers = index.shape
    s = np.empty(MOMENTS)
    for k in range(place.shape[0]):
        i, j, m = place[k, 0], place[k, 1], place[k, 2]
        s[:] = 0.0
        for a in range(max(i - 1, 0), min(i + 2, rows)):
            for b in range(max(j - 1, 0), min(j + 2, columns)):
                for c in range(max(m - 1, 0), min(m + 2, layers)):
                    at = index[a, b, c]
                    if at >= 0:
                        u, v, w, n = float(b - j), float(a - i), float(c - m), sums[at, 0]
                        su, sv, sw = sums[at, 1], sums[at, 2], sums[at, 3]
                        s[0] += n
                        s[1] += su + n * u
                        s[2] += sv + n * v
                        s[3] += sw + n * w
                        s[4] += sums[at, 4] + 2.0 * u * su + n * u * u
                        s[5] += sums[at, 5] + u * sv + v * su + n * u * v
                        s[6] += sums[at, 6] + u * sw + w * su + n * u * w
                        s[7] += sums[at, 7] + 2.0 * v * sv + n * v * v
                        s[8] += sums[at, 8] + v * sw + w * sv + n * v * w
                        s[9] += sums[at, 9] + 2.0 * w * sw + n * w * w
        n = s[0]
        x, y, z = s[1] / n, s[2] / n, s[3] / n
        xx, xy, xz = s[4] / n - x * x, s[5] / n - x * y, s[6] / n - x * z
        yy, yz, zz = s[7] / n - y * y, s[8] / n - y * z, s[9] / n - z * z
        first, second, third = eigenvalues(xx, xy, xz, yy, yz, zz)
        l1, l2, l3 = math.sqrt(max(first, 0.0)), math.sqrt(max(second, 0.0)), math.sqrt(max(third, 0.0))
        out[k, NUMBER] = n
        if l1 > 1e-6:
            out[k, LINEARITY] = (l1 - l2) / l1
            out[k, PLANARITY] = (l2 - l3) / l1
            out[k, SCATTERING] = l3 / l1
        else:
            out[k, LINEARITY], out[k, PLANARITY], out[k, SCATTERING] = 0.0, 0.0, 0.0
        out[k, NORMAL_UP] = upward(xx, xy, xz, yy, yz, zz, third)
        out[k, ALONG_UP] = upward(xx, xy, xz, yy, yz, zz, first)
        out[k, THICKNESS] = l3


LEAFY, WALL, WIRE, ALONE = 1, 2, 4, 8
"""Bits of a cube."""


@kernel
def standing_classes(above, number, cubes, place, sensor, limits, codes, out):
    """Give returns without a class the class of what stands there.

    above : (n,) float32, heights above the ground (m). number : (n,) int32 cube of each return, −1 of none. cubes :
    (k,) uint8 bits of each cube. place, sensor : three (n,) arrays, x, y and height (m). limits : (height of what lies
    on the ground, heights from which vegetation is medium and high, how near a lone return is noise (m)). codes :
    classes: none, low, medium and high vegetation, building, wire, noise. out : (n,) uint8, changed where it holds
    none.
    """
    for k in range(out.size):
        if out[k] != codes[0]:
            continue
        h = above[k]
        if number[k] < 0:
            if abs(h) < limits[0]:
                out[k] = codes[1]
            continue
        bits = cubes[number[k]]
        if bits & LEAFY:
            out[k] = codes[1] if h < limits[1] else codes[2] if h < limits[2] else codes[3]
        if bits & WALL:
            out[k] = codes[4]
        if bits & WIRE:
            out[k] = codes[5]
        if bits & ALONE:
            dx, dy, dz = place[0][k] - sensor[0][k], place[1][k] - sensor[1][k], place[2][k] - sensor[2][k]
            if math.sqrt(dx * dx + dy * dy + dz * dz) < limits[3]:
                out[k] = codes[6]


@kernel
def lines_through(middle, chosen, starts, near, limits, filled, beside, way):
    """Find the straight line through each chosen cube and a cube near it that most cubes around lie on.

    Parameters
    ----------
    middle : (cubes, 3) float64, mean place of the returns of each cube (m).
    chosen : (n,) int64, cubes; starts : (n + 1,) int64 and near : (m,) int64, cubes around each.
    limits : (6,) float64: bin along the line, least distance of the second cube, greatest slope of the line, radius of
        the line, inner and outer radius of the tube about it (m; the slope has no unit).
    filled : (n,) int64, out: bins along the best line with a cube on it, at most 62; 0 where there is no level line.
    beside : (n,) int64, out: cubes in the tube about it.
    way : (n, 3) float64, out: its direction (unit vector; the first part that is not 0 is positive).

    Of lines with equally many filled bins, that wins whose cubes lie closer to it.
    """
    size, least, slope, radius, inner, outer = limits
    for k in range(chosen.size):
        own = chosen[k]
        best_off = math.inf
        filled[k] = beside[k] = 0
        for a in range(starts[k], starts[k + 1]):
            x, y = middle[near[a], 0] - middle[own, 0], middle[near[a], 1] - middle[own, 1]
            z = middle[near[a], 2] - middle[own, 2]
            length = math.sqrt(x * x + y * y + z * z)
            if length < least or abs(z) > slope * length:
                continue
            x, y, z = x / length, y / length, z / length
            bins, number, around, off = 0, 0, 0, 0.0
            for b in range(starts[k], starts[k + 1]):
                u, v = middle[near[b], 0] - middle[own, 0], middle[near[b], 1] - middle[own, 1]
                w = middle[near[b], 2] - middle[own, 2]
                along = u * x + v * y + w * z
                across = u * u + v * v + w * w - along * along
                if across <= radius * radius:
                    bit = 1 << (31 + math.floor(along / size))
                    if not bins & bit:
                        number += 1
                        bins |= bit
                    off += across
                elif inner * inner <= across <= outer * outer:
                    around += 1
            off /= max(number, 1)
            if number > filled[k] or (number == filled[k] and off < best_off):
                sign = -1.0 if x < 0.0 or (x == 0.0 and y < 0.0) else 1.0
                filled[k], beside[k], best_off = number, around, off
                way[k, 0], way[k, 1], way[k, 2] = sign * x, sign * y, sign * z
