"""Neighbourhoods of the vertices of a triangulation for local splines: rings of members, and their units of length."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel

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
