"""Planes through returns, found by repeated random sampling (Fischler, Bolles 1981)."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel


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
