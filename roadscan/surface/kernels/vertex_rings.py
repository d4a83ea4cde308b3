"""Rings of neighbours around the vertices of a triangulation, and the spread of their offsets."""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import inlined, kernel

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
