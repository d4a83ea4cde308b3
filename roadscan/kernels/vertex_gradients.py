"""Gradients at the vertices of a triangulation: local least squares over the neighbours."""

from __future__ import annotations

import math

import numpy as np

from roadscan.kernels.options import inlined, kernel

FITTED, PLANE, LEVEL = 0, 1, 2
"""What a gradient was taken from: the polynomial asked for, a plane, or nothing."""
LINEAR_TERMS, QUADRATIC_TERMS, CUBIC_TERMS = 2, 5, 9
MOST_RINGS = 4
NARROWEST = 1.0 / 8.0**2
"""Squared ratio of the spreads of a ring across and along, below which it is not wide enough to tell a slope."""
SOFTNESS = 0.1
"""Squared distance (of 1 as the neighbours' mean) below which points do not gain weight any more."""
DAMPING = 0.3**2
"""Of the cubic terms, over the points' weights (a point at distance 1 counts 0.7)."""
LEAST_PIVOT = 1e-2
"""Of a normal matrix with unit diagonal: one over the variance inflation of a term."""


@kernel
def grow(starts, neighbours, ring, first, count, seen, centre):
    """Add the neighbours of ``ring[first:count]`` that are not in it yet; return how many there are."""
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
    """Sums of dx², dx · dy and dy² over the offsets from a vertex to a ring."""
    xx, xy, yy = 0.0, 0.0, 0.0
    for k in range(count):
        dx, dy = x[ring[k]] - x[i], y[ring[k]] - y[i]
        xx += dx * dx
        xy += dx * dy
        yy += dy * dy
    return xx, xy, yy


@kernel
def is_narrow(x, y, i, ring, count):
    """Whether points lie so nearly on a line with a vertex that their scatter would pass for the slope across."""
    xx, xy, yy = offset_squares(x, y, i, ring, count)
    return xx * yy - xy * xy < NARROWEST * (xx + yy) ** 2


@kernel
def whitening(x, y, i, ring, count, white):
    """Lower triangular 2 × 2 factor of the mean square of the offsets to a ring; False where they lie on a line."""
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


@kernel
def normal_equations(x, y, z, i, ring, count, terms, white, row, normal):
    """Sum the normal equations of z - z_i over a ring, in the monomials of the whitened offsets (u, v).

    With cubic terms, points count by (u² + v² + softness)⁻⁴, and the cubic terms are damped; the damping's weights
    are those of a form that no rotation changes. Otherwise all points count alike.
    """
    normal[:, :] = 0.0
    for k in range(count):
        dx, dy = x[ring[k]] - x[i], y[ring[k]] - y[i]
        u = dx / white[0]
        v = (dy - white[1] * u) / white[2]
        uu, vv = u * u, v * v
        row[0], row[1], row[2], row[3], row[4] = u, v, uu, u * v, vv
        weight = 1.0
        if terms == CUBIC_TERMS:
            row[5], row[6], row[7], row[8] = uu * u, uu * v, u * vv, vv * v
            near = 1.0 / ((uu + vv + SOFTNESS) * (uu + vv + SOFTNESS))
            weight = near * near
        row[terms] = z[ring[k]] - z[i]
        for a in range(terms):
            factor = weight * row[a]
            for b in range(a, terms + 1):
                normal[a, b] += factor * row[b]
    if terms == CUBIC_TERMS:
        normal[5, 5] += DAMPING
        normal[6, 6] += DAMPING / 3.0
        normal[7, 7] += DAMPING / 3.0
        normal[8, 8] += DAMPING


@kernel
def solve(normal, terms, scale, solution):
    """Solve with the diagonal scaled to one; False where a term is nearly a sum of the others."""
    for a in range(terms):
        if not normal[a, a] > 0.0:
            return False
        scale[a] = 1.0 / math.sqrt(normal[a, a])
    for a in range(terms):
        for b in range(a, terms):
            normal[a, b] *= scale[a] * scale[b]
        normal[a, terms] *= scale[a]
    for a in range(terms):
        if not normal[a, a] >= LEAST_PIVOT:
            return False
        for b in range(a + 1, terms):
            factor = normal[a, b] / normal[a, a]
            for c in range(b, terms + 1):
                normal[b, c] -= factor * normal[a, c]
    for a in range(terms - 1, -1, -1):
        value = normal[a, terms]
        for b in range(a + 1, terms):
            value -= normal[a, b] * solution[b]
        solution[a] = value / normal[a, a]
    for a in range(terms):
        solution[a] *= scale[a]
    return True


@kernel
def fit(x, y, z, i, ring, count, terms, work, gradient):
    """Fit a polynomial through a vertex to its ring and take its gradient; False where the ring does not bear it."""
    white, row, normal, solution = work[0], work[1], work[2:-1], work[-1]
    if not whitening(x, y, i, ring, count, white):
        return False
    normal_equations(x, y, z, i, ring, count, terms, white, row, normal)
    if not solve(normal, terms, row, solution):
        return False
    gradient[1] = solution[1] / white[2]
    gradient[0] = (solution[0] - white[1] * gradient[1]) / white[0]
    return True


@kernel
def vertex_gradients(x, y, z, starts, neighbours, terms, rings, least, gradients, sources):
    """Gradient at each vertex.

    Parameters
    ----------
    x, y, z : (m,) float64 (m), differences of x and y exact.
    starts, neighbours : (m + 1,), (e,) int64: neighbours of i from ``starts[i]`` to ``starts[i + 1]``, ascending.
    terms : QUADRATIC_TERMS or CUBIC_TERMS.
    rings, least : rings of neighbours that are taken, and one more at a time (up to MOST_RINGS) while there are fewer
        than `least`, while they are narrow, or while they do not bear the polynomial.
    gradients : (m, 2) float64, out.
    sources : (m,) uint8, out: FITTED, PLANE or LEVEL.
    """
    ring, seen = np.empty(max(x.size, 1), np.int64), np.full(x.size, -1, np.int64)
    work = np.empty((CUBIC_TERMS + 3, CUBIC_TERMS + 1))
    of_plane = min(terms, LINEAR_TERMS)  # a constant would have the fit compiled once more
    for i in range(x.size):
        seen[i] = i
        ring[0] = i
        first, count, taken = 0, 1, 0
        gradients[i, 0], gradients[i, 1] = 0.0, 0.0
        sources[i] = LEVEL
        while taken < MOST_RINGS and sources[i] != FITTED:
            before = count
            count = grow(starts, neighbours, ring, first, count, seen, i)
            first = before
            taken += 1
            enough = taken >= rings and count > least and not is_narrow(x, y, i, ring, count)
            enough = enough or (taken == MOST_RINGS and count > QUADRATIC_TERMS)
            if enough and fit(x, y, z, i, ring[1:count], count - 1, terms, work, gradients[i]):
                sources[i] = FITTED
        unknown = sources[i] != FITTED and count > LINEAR_TERMS
        if unknown and fit(x, y, z, i, ring[1:count], count - 1, of_plane, work, gradients[i]):
            sources[i] = PLANE
