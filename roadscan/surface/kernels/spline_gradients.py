"""Gradients of local splines at the vertices of a triangulation; ``surfaces.normals`` gives the reasons.

Of a vertex's neighbourhood, itself included, let A be the covariances of heights with noise on the diagonal, P the
monomials, z the heights and f the covariances of heights with a slope at the vertex. The best linear prediction of that
slope, with polynomials not penalised, is (Wahba 1990, section 1.5; Cressie 1993, section 3.4)

    g = ∇P β + fᵀ A⁻¹ (z - P β),      β = (Pᵀ A⁻¹ P)⁻¹ Pᵀ A⁻¹ z,

and the restricted likelihood of z has -2 ln l = (n - 6) ln r + ln |A| + ln |Pᵀ A⁻¹ P|, r = zᵀ A⁻¹ (z - P β), where the
scale of heights is the likeliest (Wahba 1985). All of it comes out of one elimination: of the rows A, then Pᵀ, zᵀ, fᵀ
(with zeros right of these), the columns of A and P are eliminated. What is left in the column of z is -r and -fᵀ A⁻¹
(z - P β).
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inner, kernel
from roadscan.compute.kernels.covariances import LANES, PEAK, REACH, TOGETHER, covariances, factorise, slope_covariances
from roadscan.surface.kernels.delaunay import MOST, MOST_RINGS, grow, is_narrow, whitening

TERMS, HEIGHTS, ALONG_U, ALONG_V, SIDES = 6, 6, 7, 8, 9
"""Rows below the covariances: 1, u², u v, v², u, v; then heights; then covariances with the slopes at the centre."""
WIDTH = MOST + 1 + SIDES  # Columns of the system: points, the vertex, and the sides.
WORK = (3, WIDTH + TOGETHER, WIDTH, LANES)
"""Shape of the kernel's working array."""
QUIET, NOISY = 1e-3, 3.0
"""Variances of noise between which the heights decide."""
LEAST_PIVOT = 1e-2
"""Least pivot of the terms' normal matrix with unit diagonal: one over the variance inflation of a term."""
MOST_LIKELY = 700.0
"""Greatest logarithm of a ratio of likelihoods; above it the exponential overflows."""
LEAST_MISFIT = 1e-14
"""Least misfit, as a share of the heights' squares: rounding."""


@kernel
def load(x, y, z, first, order, begin, members, counts, axes, present, offsets, system):
    """Load a batch of neighbourhoods, a lane each: offsets in their units, and the sides of their systems.

    Missing points are placed far from all others, and their sides are 0.

    Returns
    -------
    Points of the largest, the last, and its centre.
    """
    many = min(order.size - begin, LANES)
    size = 1 + counts[order[begin + many - 1]]
    for lane in range(LANES):
        count, r = -1, 0
        if lane < many:
            r = order[begin + lane]
            count = counts[r]
        for k in range(size):
            there, u, v, height = k <= count, 0.0, 0.0, 0.0
            if there and k > 0:
                i, j = first + r, members[r, k - 1]
                u = (x[j] - x[i]) / axes[r, 0]
                v = (y[j] - y[i] - axes[r, 1] * u) / axes[r, 2]
                height = z[j] - z[i]
            present[k, lane] = 1.0 if there else 0.0
            offsets[0, k, lane] = u if there else 2.0 * REACH * (k + 2)
            offsets[1, k, lane] = v
            system[size, k, lane] = present[k, lane]
            system[size + 1, k, lane] = u * u
            system[size + 2, k, lane] = u * v
            system[size + 3, k, lane] = v * v
            system[size + 4, k, lane] = u
            system[size + 5, k, lane] = v
            system[size + HEIGHTS, k, lane] = height
    return size


@bare_inner
def set_diagonal(system, present, size, variance):
    """Set the variances of the points; one for a missing point."""
    for k in range(size):
        row, there = system[k, k], present[k]
        for lane in range(LANES):
            row[lane] = 1.0 + there[lane] * (PEAK + variance - 1.0)


@bare
def clear(rows, first, last, begin, end):
    """Set stale entries to zero, from one row and column up to another."""
    for a in range(first, last):
        for b in range(begin, end):
            for lane in range(LANES):
                rows[a, b, lane] = 0.0


@kernel
def read(root, size, lane, count, product, found):
    """Compute the gradient of one spline in its units, and the likelihood of its heights; False if ill-conditioned.

    Parameters
    ----------
    root : of ``simd.factorisation.factorise``, down to the sides; right of `size` all signs are turned.
    product : of the pivots of covariances and terms.
    found : (3,) float64, out: slope along u, along v, logarithm of the likelihood.
    """
    if not 0.0 < product < math.inf:
        return False
    of_u, of_v, rest = size + 4, size + 5, size + HEIGHTS
    for b in range(size + 1, rest + 1):
        alone = root[b, b, lane]
        for k in range(size + 1, min(b, rest)):
            alone += root[b, k, lane] ** 2 / root[k, k, lane]
        if b < rest and not root[b, b, lane] < LEAST_PIVOT * alone:
            return False
    v = root[rest, of_v, lane] / root[of_v, of_v, lane]
    u = (root[rest, of_u, lane] - root[of_v, of_u, lane] * v) / root[of_u, of_u, lane]
    found[0], found[1] = u - root[size + ALONG_U, rest, lane], v - root[size + ALONG_V, rest, lane]
    misfit = max(-root[rest, rest, lane], -LEAST_MISFIT * alone, 1e-300)
    found[2] = -0.5 * ((count + 1 - TERMS) * math.log(misfit) + math.log(product))
    return True


@kernel
def spline_gradients(x, y, z, first, order, members, counts, axes, work, fitted, gradients, sources):
    """Compute the gradients of the splines of neighbourhoods; others are left unchanged.

    Parameters
    ----------
    x, y, z : (m,) float64 (m), differences of x and y exact.
    first, members, counts, axes : of :func:`roadscan.surface.kernels.delaunay.neighbourhoods`.
    order : (k,) int64: the wanted ones, by ascending count.
    work : WORK, float64; faster at a multiple of 64 bytes.
    fitted : value of `sources` for the gradients found.
    gradients : (m, 2) float64, out; sources : (m,) uint8, out.
    """
    present, offsets = np.empty((MOST + 1, LANES)), np.empty((2, MOST + 1, LANES))
    system, close, calm = work[0], work[1], work[2]
    other, inverse, products = np.empty((WIDTH, LANES)), np.empty((WIDTH, LANES)), np.empty((2, LANES))
    quiet, noisy = np.empty(3), np.empty(3)
    for begin in range(0, order.size, LANES):
        size = load(x, y, z, first, order, begin, members, counts, axes, present, offsets, system)
        covariances(offsets[0], offsets[1], system, size)
        slope_covariances(offsets[0], offsets[1], system[size + ALONG_U], system[size + ALONG_V], size)
        last, end = size + SIDES, size + TERMS + 1
        clear(system, size, last, size, end)
        clear(system, last, last + TOGETHER, 0, end)  # computed without need; what stood there could be slow numbers
        for k in range(2):
            root = calm if k else close
            set_diagonal(system, present, size, NOISY if k else QUIET)
            clear(root, last, last + TOGETHER, 0, end)
            factorise(system, root, other, inverse, products[k], end, last)
        for lane in range(min(order.size - begin, LANES)):
            r = order[begin + lane]
            borne = read(close, size, lane, counts[r], products[0, lane], quiet)
            if not (borne and read(calm, size, lane, counts[r], products[1, lane], noisy)):
                continue
            share = 1.0 / (1.0 + math.exp(min(quiet[2] - noisy[2], MOST_LIKELY)))
            of_u, of_v = quiet[0] + share * (noisy[0] - quiet[0]), quiet[1] + share * (noisy[1] - quiet[1])
            gradients[first + r, 1] = of_v / axes[r, 2]
            gradients[first + r, 0] = (of_u - axes[r, 1] * gradients[first + r, 1]) / axes[r, 0]
            sources[first + r] = fitted


FITTED, PLANE, LEVEL = 0, 1, 2
"""Sources of a gradient: the polynomial asked for, a plane, or nothing."""
LINEAR_TERMS, QUADRATIC_TERMS = 2, 5  # Numbers of coefficients of a plane and of a quadratic through a vertex.
LEAST = 6
"""With fewer neighbours another ring is added."""
LEAST_VERTEX_PIVOT = 1e-2
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
        if not normal[a, a] >= LEAST_VERTEX_PIVOT:
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
