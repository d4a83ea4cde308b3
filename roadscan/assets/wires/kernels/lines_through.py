"""Straight level lines through cubes of returns."""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import kernel


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
