"""Exact decisions for the Delaunay triangulation.

Positions are int64 on the lattice of ``surfaces.sites`` (2⁻³⁶ m), so differences are exact and every decision is the
same whatever else is triangulated. Triangles are (n, 3) int64 indices, counter-clockwise; column k of `across` is the
triangle over the edge opposite corner k, -1 where there is none.
"""

from __future__ import annotations

import math

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


RINGS, FEWEST, LEAST, MOST = 2, 10, 20, 32
"""Rings taken; least neighbours for a spline; neighbours below which another ring is added; most neighbours kept.
"""
UNIT_COUNT = 18.0
"""Number of neighbours whose mean square offset along each axis is the unit of length: those of two rings."""
STRETCH = 3.0
"""Ratio of length to width above which a neighbourhood's length is counted in larger units."""


@inner
def keep_nearest(x, y, i, ring, count, white, far):
    """Sort a ring by whitened distance from its vertex; equally far neighbours keep their order."""
    for k in range(count):
        j = ring[k]
        u = (x[j] - x[i]) / white[0]
        v = (y[j] - y[i] - white[1] * u) / white[2]
        distance, at = u * u + v * v, k
        while at > 0 and far[at - 1] > distance:
            ring[at], far[at] = ring[at - 1], far[at - 1]
            at -= 1
        ring[at], far[at] = j, distance


@kernel
def units(x, y, i, ring, count, axes):
    """Compute the lower triangular 2 × 2 factor that turns offsets into units of their spread.

    The units are the same in all directions, so that the ground is as rough along as across, except where the ring is
    longer than `STRETCH` times its width.
    """
    xx, xy, yy = offset_squares(x, y, i, ring, count)
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    turn = math.sqrt(half * half + xy * xy)
    long = middle + turn
    stretch = max(1.0, long * long / ((xx * yy - xy * xy) * STRETCH * STRETCH))
    cosine, sine = 1.0, 0.0
    if turn > 0.0:
        cosine, sine = half / turn, xy / turn
    square = UNIT_COUNT / count / count
    mean, change = square * middle, square * middle * (stretch - 1.0) / (stretch + 1.0)
    axes[0] = math.sqrt(mean + change * cosine)
    axes[1] = change * sine / axes[0]
    axes[2] = math.sqrt(mean - change * cosine - axes[1] * axes[1])


@kernel
def neighbourhoods(x, y, starts, neighbours, first, ring, seen, members, counts, axes):
    """Find the neighbourhoods of the vertices from `first` on.

    Rings are added (up to MOST_RINGS) while neighbours are too few or narrow; then the nearest are kept.

    Parameters
    ----------
    x, y : (m,) float64 (m), differences exact.
    starts, neighbours : (m + 1,), (e,) int64: neighbours of i from ``starts[i]`` to ``starts[i + 1]``, ascending.
    ring : (m + 1,) int64, work; seen : (m,) int64, work, -1 before the first call.
    members : (n, MOST) int64, out; counts : (n,) int64, out: how many of them, 0 where there is no spline.
    axes : (n, 3) float64, out: units of offsets, dx = a u, dy = b u + c v.
    """
    white, far = np.empty(3), np.empty(x.size + 1)
    for r in range(counts.size):
        i = first + r
        seen[i], ring[0], counts[r] = i, i, 0
        begin, count, taken = 0, 1, 0
        while taken < MOST_RINGS and (taken < RINGS or count <= LEAST or is_narrow(x, y, i, ring, count)):
            before = count
            count = grow(starts, neighbours, ring, begin, count, seen, i)
            begin = before
            taken += 1
        count -= 1
        if count < FEWEST or not whitening(x, y, i, ring[1:], count, white):
            continue
        if count > MOST:
            keep_nearest(x, y, i, ring[1:], count, white, far)
            count = MOST
        units(x, y, i, ring[1:], count, axes[r])
        counts[r] = count
        for k in range(count):
            members[r, k] = ring[1 + k]


MOST_RINGS = 4  # Rings that are added at most.
NARROWEST = 1.0 / 8.0**2
"""Squared ratio of a ring's spreads across and along below which it does not determine a slope across."""


@kernel
def grow(starts, neighbours, ring, first, count, seen, centre):
    """Add the neighbours of ``ring[first:count]`` that are not in it yet; return their total number."""
    total = count
    for k in range(first, count):
        for e in range(starts[ring[k]], starts[ring[k] + 1]):
            j = neighbours[e]
            if seen[j] != centre:
                seen[j] = centre
                ring[total] = j
                total += 1
    return total


@inlined
def offset_squares(x, y, i, ring, count):
    """Returns sums of dx², dx · dy and dy² over the offsets from a vertex to a ring."""
    xx, xy, yy = 0.0, 0.0, 0.0
    for k in range(count):
        dx, dy = x[ring[k]] - x[i], y[ring[k]] - y[i]
        xx += dx * dx
        xy += dx * dy
        yy += dy * dy
    return xx, xy, yy


@kernel
def is_narrow(x, y, i, ring, count):
    """Whether points are so nearly collinear with a vertex that their scatter would pass for the slope across."""
    xx, xy, yy = offset_squares(x, y, i, ring, count)
    return xx * yy - xy * xy < NARROWEST * (xx + yy) ** 2


@kernel
def whitening(x, y, i, ring, count, white):
    """Lower triangular 2 × 2 factor of the mean square offset of a ring; False where the ring is collinear."""
    xx, xy, yy = offset_squares(x, y, i, ring, count)
    white[0] = math.sqrt(xx / count)
    if not white[0] > 0.0:
        return False
    white[1] = xy / count / white[0]
    left = yy / count - white[1] * white[1]
    if not left > 1e-12 * yy / count:
        return False
    white[2] = math.sqrt(left)
    return True
