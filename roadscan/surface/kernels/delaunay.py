"""Exact decisions for the Delaunay triangulation.

Positions are int64 on the lattice of ``surfaces.sites`` (2⁻³⁶ m), so differences are exact and every decision is the
same whatever else is triangulated. Triangles are (n, 3) int64 indices, counter-clockwise; column k of `across` is the
triangle over the edge opposite corner k, -1 where there is none.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel

ERROR_BOUND = 2.0**-49
"""Bound of the determinant's rounding error, relative to the sum of its terms' sizes (Shewchuk 1997: 1.1e-15)."""
LOW = np.uint64(0xFFFFFFFF)  # Mask of the low 32 bits.
HALF = np.uint64(32)  # Bits of half a word.


@inlined
def product_128(a, b):
    """Returns the product modulo 2¹²⁸ of numbers (high, low) of two uint64."""
    a0, a1, b0, b1 = a[1] & LOW, a[1] >> HALF, b[1] & LOW, b[1] >> HALF
    low, m1, m2 = a0 * b0, a1 * b0, a0 * b1
    middle = (low >> HALF) + (m1 & LOW) + (m2 & LOW)
    high = a1 * b1 + (m1 >> HALF) + (m2 >> HALF) + (middle >> HALF)
    return high + a[0] * b[1] + a[1] * b[0], (low & LOW) | (middle << HALF)


@inlined
def sum_128(a, b):
    """Returns the sum modulo 2¹²⁸."""
    low = a[1] + b[1]
    return a[0] + b[0] + (np.uint64(1) if low < a[1] else np.uint64(0)), low


@inlined
def negative_128(a):
    """Returns the two's complement."""
    low = ~a[1] + np.uint64(1)
    return ~a[0] + (np.uint64(1) if low == np.uint64(0) else np.uint64(0)), low


@inlined
def wide(value):
    """Returns an int64 as a number of 128 bits."""
    return (~np.uint64(0) if value < 0 else np.uint64(0)), np.uint64(value)


@inlined
def lift(x, y):
    """Returns x² + y²."""
    return sum_128(product_128(wide(x), wide(x)), product_128(wide(y), wide(y)))


@inlined
def cross(ax, ay, bx, by):
    """Returns ax·by - ay·bx."""
    return sum_128(product_128(wide(ax), wide(by)), negative_128(product_128(wide(ay), wide(bx))))


@inner
def in_circle_exactly(ax, ay, bx, by, cx, cy):
    """Returns the sign of the determinant where floating point cannot decide.

    It is then smaller than 2¹²⁷ for differences below 2⁴³ lattice steps (128 m), so arithmetic modulo 2¹²⁸ holds it.
    """
    total = wide(0)
    for _ in range(3):
        total = sum_128(total, product_128(lift(ax, ay), cross(bx, by, cx, cy)))
        ax, ay, bx, by, cx, cy = bx, by, cx, cy, ax, ay
    if total[0] == np.uint64(0) and total[1] == np.uint64(0):
        return 0
    return -1 if total[0] >> np.uint64(63) else 1


@kernel
def in_circle(x, y, a, b, c, d):
    """Returns 1 where point `d` lies inside the circle of the counter-clockwise triangle, 0 on it, -1 outside."""
    ax, ay, bx, by, cx, cy = x[a] - x[d], y[a] - y[d], x[b] - x[d], y[b] - y[d], x[c] - x[d], y[c] - y[d]
    value, size = 0.0, 0.0
    fax, fay, fbx, fby = np.float64(ax), np.float64(ay), np.float64(bx), np.float64(by)
    fcx, fcy = np.float64(cx), np.float64(cy)
    for _ in range(3):
        square, one, two = fax * fax + fay * fay, fbx * fcy, fby * fcx
        value += square * (one - two)
        size += square * (abs(one) + abs(two))
        fax, fay, fbx, fby, fcx, fcy = fbx, fby, fcx, fcy, fax, fay
    if value > ERROR_BOUND * size:
        return 1
    if value < -ERROR_BOUND * size:
        return -1
    return in_circle_exactly(ax, ay, bx, by, cx, cy)


@kernel
def turn(x, y, a, b, c):
    """Returns 1 where the corners run counter-clockwise, 0 on a line, -1 clockwise."""
    abx, aby, acx, acy = x[b] - x[a], y[b] - y[a], x[c] - x[a], y[c] - y[a]
    one, two = np.float64(abx) * np.float64(acy), np.float64(aby) * np.float64(acx)
    if abs(one - two) > ERROR_BOUND * (abs(one) + abs(two)):
        return 1 if one > two else -1
    exact = cross(abx, aby, acx, acy)
    if exact[0] == np.uint64(0) and exact[1] == np.uint64(0):
        return 0
    return -1 if exact[0] >> np.uint64(63) else 1


@kernel
def rename(across, triangle, old, new):
    """Update the neighbour of a triangle, if the triangle exists."""
    for k in range(3):
        if triangle >= 0 and across[triangle, k] == old:
            across[triangle, k] = new


@kernel
def flip_edges(x, y, triangles, across):
    """Flip edges until all are Delaunay; of four points on a circle, the edge with the first of them stays.

    That rule is Delaunay's triangulation with the points moved symbolically (the first by most), so the outcome is
    the same from every start (Lawson 1977; Edelsbrunner & Mücke 1990). An edge is left where a triangle beside it is
    turned over, before or after: only slivers of the hull are, and every other flip lowers the lifted surface, so
    there is an end.

    Parameters
    ----------
    x, y : (m,) int64 positions, in canonical order.
    triangles, across : (n, 3) int64, changed in place.

    Returns
    -------
    flips : int.
    """
    flips, before = 0, -1
    while flips != before:
        before = flips
        for t in range(triangles.shape[0]):
            for k in range(3):
                u = across[t, k]
                if u <= t:
                    continue
                a, p, q = triangles[t, k], triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
                m = 0 if triangles[u, 0] == q else (1 if triangles[u, 1] == q else 2)
                d = triangles[u, (m + 2) % 3]
                where = in_circle(x, y, a, p, q, d)
                if where < 0 or (where == 0 and min(p, q) < min(a, d)):
                    continue
                if turn(x, y, a, p, q) < 0 or turn(x, y, d, q, p) < 0:
                    continue
                if turn(x, y, a, p, d) <= 0 or turn(x, y, a, d, q) <= 0:
                    continue
                beyond_pd, beyond_dq = across[u, m], across[u, (m + 1) % 3]
                beyond_qa, beyond_ap = across[t, (k + 1) % 3], across[t, (k + 2) % 3]
                triangles[t, 0], triangles[t, 1], triangles[t, 2] = a, p, d
                across[t, 0], across[t, 1], across[t, 2] = beyond_pd, u, beyond_ap
                triangles[u, 0], triangles[u, 1], triangles[u, 2] = a, d, q
                across[u, 0], across[u, 1], across[u, 2] = beyond_dq, beyond_qa, t
                rename(across, beyond_pd, u, t)
                rename(across, beyond_qa, t, u)
                flips += 1
                break
    return flips
