"""Converts stations and offsets of a road line into eastings and northings, by cubic pieces between its nodes."""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import inlined, kernel


@inlined
def slope(nodes, k, axis):
    """Return the change of a coordinate per node at node k, of fourth order inside the line, lower at its ends."""
    last = len(nodes) - 1
    if 2 <= k <= last - 2:
        outer = nodes[k + 2, axis] - nodes[k - 2, axis]
        return (8.0 * (nodes[k + 1, axis] - nodes[k - 1, axis]) - outer) / 12.0
    if 1 <= k <= last - 1:
        return 0.5 * (nodes[k + 1, axis] - nodes[k - 1, axis])
    if last < 2:
        return nodes[last, axis] - nodes[0, axis]
    if k == 0:
        return -1.5 * nodes[0, axis] + 2.0 * nodes[1, axis] - 0.5 * nodes[2, axis]
    return 1.5 * nodes[last, axis] - 2.0 * nodes[last - 1, axis] + 0.5 * nodes[last - 2, axis]


@inlined
def along(nodes, k, t, axis):
    """Return a coordinate at fraction t between nodes k and k + 1, and its change per node there."""
    here, after = nodes[k, axis], nodes[k + 1, axis]
    d0, d1 = slope(nodes, k, axis), slope(nodes, k + 1, axis)
    step = after - here
    a = d0 + d1 - 2.0 * step
    b = 3.0 * step - 2.0 * d0 - d1
    return here + t * (d0 + t * (b + t * a)), d0 + t * (2.0 * b + 3.0 * t * a)


@kernel
def place(nodes, first, station, offset, out):
    """Compute positions of points beside a line whose nodes are 1 m apart.

    A place depends on the three nodes before it and the three after it. The line goes on straight beyond its ends.

    Parameters
    ----------
    nodes : (k, 2) float64, m, k ≥ 2; first : int64, station of the first node (m).
    station, offset : (n,) float64, m; offset positive to the right.
    out : (n, 4) float64, out: easting, northing (m), and the unit vector along the line (east, north).
    """
    last = len(nodes) - 2
    for i in range(station.size):
        s = station[i] - first
        k = min(max(math.floor(s), 0), last)
        t = min(max(s - k, 0.0), 1.0)
        beyond = s - k - t
        x, dx = along(nodes, k, t, 0)
        y, dy = along(nodes, k, t, 1)
        length = math.hypot(dx, dy)
        dx, dy = dx / length, dy / length
        out[i, 0] = x + beyond * dx + offset[i] * dy
        out[i, 1] = y + beyond * dy - offset[i] * dx
        out[i, 2] = dx
        out[i, 3] = dy
