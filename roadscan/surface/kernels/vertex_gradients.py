"""Gradients at the vertices of a triangulation: local least squares over the neighbours."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import kernel
from roadscan.surface.kernels.vertex_neighbourhoods import MOST_RINGS, grow, is_narrow, whitening

FITTED, PLANE, LEVEL = 0, 1, 2
"""Sources of a gradient: the polynomial asked for, a plane, or nothing."""
LINEAR_TERMS, QUADRATIC_TERMS = 2, 5  # Numbers of coefficients of a plane and of a quadratic through a vertex.
LEAST = 6
"""With fewer neighbours another ring is added."""
LEAST_PIVOT = 1e-2
"""Least pivot of a normal matrix with unit diagonal: one over the variance inflation of a term."""


@kernel
def normal_equations(x, y, z, i, ring, count, terms, white, row, normal):
    """Sum the normal equations of z - z_i over a ring, in the monomials of the whitened offsets (u, v)."""
    normal[:, :] = 0.0
    for k in range(count):
        dx, dy = x[ring[k]] - x[i], y[ring[k]] - y[i]
        u = dx / white[0]
        v = (dy - white[1] * u) / white[2]
        row[0], row[1], row[2], row[3], row[4] = u, v, u * u, u * v, v * v
        row[terms] = z[ring[k]] - z[i]
        for a in range(terms):
            for b in range(a, terms + 1):
                normal[a, b] += row[a] * row[b]


@kernel
def solve(normal, terms, scale, solution):
    """Solve with the diagonal scaled to one; False where a term is nearly a linear combination of the others."""
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
    """Fit a polynomial through a vertex to its ring and store its gradient; False where the ring is too narrow."""
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
def vertex_gradients(x, y, z, starts, neighbours, wanted, gradients, sources):
    """Compute the gradient of a quadratic polynomial at vertices.

    Parameters
    ----------
    x, y, z : (m,) float64 (m), differences of x and y exact.
    starts, neighbours : (m + 1,), (e,) int64: neighbours of i from ``starts[i]`` to ``starts[i + 1]``, ascending.
    wanted : (n,) int64: vertices, each once. One ring of neighbours is taken, and one more at a time (up to
        MOST_RINGS) while there are fewer than LEAST, while they are narrow, or while they do not bear the polynomial.
    gradients : (m, 2) float64, out.
    sources : (m,) uint8, out: FITTED, PLANE or LEVEL.
    """
    ring, seen = np.empty(max(x.size, 1), np.int64), np.full(x.size, -1, np.int64)
    work = np.empty((QUADRATIC_TERMS + 3, QUADRATIC_TERMS + 1))
    terms, of_plane = min(x.size, 1) * QUADRATIC_TERMS, min(x.size, 1) * LINEAR_TERMS
    for k in range(wanted.size):
        i = wanted[k]
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
            enough = count > LEAST and not is_narrow(x, y, i, ring, count)
            enough = enough or (taken == MOST_RINGS and count > QUADRATIC_TERMS)
            if enough and fit(x, y, z, i, ring[1:count], count - 1, terms, work, gradients[i]):
                sources[i] = FITTED
        unknown = sources[i] != FITTED and count > LINEAR_TERMS
        if unknown and fit(x, y, z, i, ring[1:count], count - 1, of_plane, work, gradients[i]):
            sources[i] = PLANE
