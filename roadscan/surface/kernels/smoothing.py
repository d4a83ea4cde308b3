"""One step down the energy of the adaptive regularised smoothing, in one pass over the grid.

The five filters of Yu et al. (2007), eq. 12, are sums of differences to neighbours within two cells. Which of them
acts is one number a cell: 1 to 5 for C1 (down the columns), C2 (along the rows), C3 (down to the right), C4 (down to
the left), C5 (all around); 0 for none and where nothing was measured.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inner, kernel

REACH = 4
"""Cells to each side on which a step depends: a filter and its transpose."""
# Weights of the smoothing stencils, as float32: the kernel stays in single precision.
_NONE, _TWELFTH, _SIXTEENTH, _FIFTY_SIXTH = (np.float32(v) for v in (0.0, 1.0 / 12.0, 1.0 / 16.0, 1.0 / 56.0))
_TWO, _C1, _C2, _C3, _C4, _C5 = (np.float32(v) for v in (2.0, 1.0, 2.0, 3.0, 4.0, 5.0))  # as float32


@inner
def residual_row(u, i, chosen, own, fixed, residual):
    """Compute the residual of the chosen filter at the cells of one row.

    Parameters
    ----------
    u : (rows, n + 4) float32, corrections, two cells more at either end; i : the row.
    chosen, own, fixed : (n,) float32, filter, its weight of the cell itself, its residual without corrections.
    residual : (n,) float32, out (m).
    """
    above2, above, below, below2 = i - 2, i - 1, i + 1, i + 2
    for j in range(chosen.size):
        c = chosen[j]
        nearest = (u[above, j + 2] + u[below, j + 2]) + (u[i, j + 1] + u[i, j + 3])
        far_down, far_along = u[above2, j + 2] + u[below2, j + 2], u[i, j] + u[i, j + 4]
        to_right = (u[above, j + 1] + u[below, j + 3]) + (u[above2, j] + u[below2, j + 4])
        to_left = (u[above, j + 3] + u[below, j + 1]) + (u[above2, j + 4] + u[below2, j])
        knights = (u[above2, j + 1] + u[above2, j + 3]) + (u[below2, j + 1] + u[below2, j + 3])
        knights += (u[above, j] + u[below, j]) + (u[above, j + 4] + u[below, j + 4])
        wide = (_TWO * nearest + (far_down + far_along)) + ((to_right + to_left) + knights)
        neighbours = _FIFTY_SIXTH * wide if c == _C5 else _NONE
        neighbours = _SIXTEENTH * (nearest + to_left) if c == _C4 else neighbours
        neighbours = _SIXTEENTH * (nearest + to_right) if c == _C3 else neighbours
        neighbours = _TWELFTH * (nearest + far_along) if c == _C2 else neighbours
        neighbours = _TWELFTH * (nearest + far_down) if c == _C1 else neighbours
        residual[j] = own[j] * u[i, j + 2] - neighbours + fixed[j]


@inner
def spread_row(chosen, residual, near, down, along, right, left, around):
    """Compute the residuals (n,) times the weight that their filters give to each kind of neighbour.

    near, down, along, right, left, around : (n,) float32, out: the four nearest, those two cells away up and down, to
        both sides, those on each diagonal, the eight at a knight's move.
    """
    for j in range(residual.size):
        c, r = chosen[j], residual[j]
        all_around = _FIFTY_SIXTH * r if c == _C5 else _NONE
        straight = _TWELFTH * r if c < _C3 else _SIXTEENTH * r
        near[j] = _TWO * all_around if c == _C5 else straight
        down[j] = straight if c == _C1 else all_around
        along[j] = straight if c == _C2 else all_around
        right[j] = straight if c == _C3 else all_around
        left[j] = straight if c == _C4 else all_around
        around[j] = all_around


@inner
def descent_row(ring, first, own, before, pull, aim, push, after):
    """Compute one row's step against the gradient.

    Parameters
    ----------
    ring : (5, 7, n + 4) float32, what :func:`spread_row` gave, and the residual, for the rows from two above to two
        below.
    first : int, where the uppermost of them stands; the others follow, round and round.
    own : (n,) float32, as there.
    before : (n,) float32, corrections; pull, aim, push : (n,) float32, step length times the weights of P and P_M,
        times what P asks for, times λ_C. All 0 where nothing was measured.
    after : (n,) float32, out.
    """
    a, b, c = ring[first], ring[(first + 1) % 5], ring[(first + 2) % 5]
    d, e = ring[(first + 3) % 5], ring[(first + 4) % 5]
    for j in range(after.size):
        total = (b[0, j + 2] + d[0, j + 2]) + (c[0, j + 1] + c[0, j + 3])
        total += (a[1, j + 2] + e[1, j + 2]) + (c[2, j] + c[2, j + 4])
        total += (b[3, j + 1] + d[3, j + 3]) + (a[3, j] + e[3, j + 4])
        total += (b[4, j + 3] + d[4, j + 1]) + (a[4, j + 4] + e[4, j])
        total += (a[5, j + 1] + a[5, j + 3]) + (e[5, j + 1] + e[5, j + 3])
        total += (b[5, j] + d[5, j]) + (b[5, j + 4] + d[5, j + 4])
        gradient = own[j] * c[6, j + 2] - total
        after[j] = before[j] - (pull[j] * before[j] - aim[j] + push[j] * gradient)


@kernel
def descend(correction, chosen, own, fixed, pull, aim, push, ring, after):
    """Compute one step of the smoothing over a whole grid.

    Parameters
    ----------
    correction : (rows + 8, columns + 8) float32, F − P_M (m) with a margin of four zeros.
    chosen, own, fixed, pull, aim, push : the same shape, see :func:`residual_row` and :func:`descent_row`; their
        margins are zeros.
    ring : (5, 7, columns + 4) float32, scratch.
    after : as `correction`, out; its margin is not touched.
    """
    n = correction.shape[1]
    last = correction.shape[0] - 2
    for i in range(2, last):
        q = ring[i % 5]
        residual_row(
            correction,
            i,
            chosen[i, 2 : n - 2],
            own[i, 2 : n - 2],
            fixed[i, 2 : n - 2],
            q[6],
        )
        spread_row(chosen[i, 2 : n - 2], q[6], q[0], q[1], q[2], q[3], q[4], q[5])
        k = i - 2
        if k >= REACH:
            descent_row(
                ring,
                (i - 4) % 5,
                own[k, REACH : n - REACH],
                correction[k, REACH : n - REACH],
                pull[k, REACH : n - REACH],
                aim[k, REACH : n - REACH],
                push[k, REACH : n - REACH],
                after[k, REACH : n - REACH],
            )


@inner
def choose_row(surface, measured, i, limit, chosen, own, residual):
    """Choose the filter, its weight of the cell itself and its residual, for the cells of one row.

    C5 if its response is within `limit`; else the one of C1 to C4 with the least response, if within it; else none.

    Parameters
    ----------
    surface : (rows + 4, n + 4) float64 (m), 0 where nothing was measured, two cells more at either end; measured : the
        same, 1 where measured, 0 elsewhere; i : the row, of those without margin.
    chosen, own, residual : (n,) float32, out; see ``surface/kernels/smoothing.py``.
    """
    i0, i1, i2, i3, i4 = i, i + 1, i + 2, i + 3, i + 4
    for j in range(chosen.size):
        z = surface[i2, j + 2]
        near = (surface[i1, j + 2] + surface[i3, j + 2]) + (surface[i2, j + 1] + surface[i2, j + 3])
        down, along = surface[i0, j + 2] + surface[i4, j + 2], surface[i2, j] + surface[i2, j + 4]
        right = (surface[i1, j + 1] + surface[i3, j + 3]) + (surface[i0, j] + surface[i4, j + 4])
        left = (surface[i1, j + 3] + surface[i3, j + 1]) + (surface[i0, j + 4] + surface[i4, j])
        knights = ((surface[i0, j + 1] + surface[i0, j + 3]) + (surface[i4, j + 1] + surface[i4, j + 3])) + (
            (surface[i1, j] + surface[i3, j]) + (surface[i1, j + 4] + surface[i3, j + 4])
        )
        n_near = (measured[i1, j + 2] + measured[i3, j + 2]) + (measured[i2, j + 1] + measured[i2, j + 3])
        n_down, n_along = measured[i0, j + 2] + measured[i4, j + 2], measured[i2, j] + measured[i2, j + 4]
        n_right = (measured[i1, j + 1] + measured[i3, j + 3]) + (measured[i0, j] + measured[i4, j + 4])
        n_left = (measured[i1, j + 3] + measured[i3, j + 1]) + (measured[i0, j + 4] + measured[i4, j])
        n_knights = ((measured[i0, j + 1] + measured[i0, j + 3]) + (measured[i4, j + 1] + measured[i4, j + 3])) + (
            (measured[i1, j] + measured[i3, j]) + (measured[i1, j + 4] + measured[i3, j + 4])
        )
        s1, r1 = (n_near + n_down) / 12.0, ((n_near + n_down) * z - (near + down)) / 12.0
        s2, r2 = (n_near + n_along) / 12.0, ((n_near + n_along) * z - (near + along)) / 12.0
        s3, r3 = (n_near + n_right) / 16.0, ((n_near + n_right) * z - (near + right)) / 16.0
        s4, r4 = (n_near + n_left) / 16.0, ((n_near + n_left) * z - (near + left)) / 16.0
        n_all = (2.0 * n_near + (n_down + n_along)) + ((n_right + n_left) + n_knights)
        r_all = (2.0 * near + (down + along)) + ((right + left) + knights)
        s5, r5 = n_all / 56.0, (n_all * z - r_all) / 56.0
        best, s, r = 1.0, s1, r1
        better = abs(r2) < abs(r)
        best, s, r = (2.0 if better else best), (s2 if better else s), (r2 if better else r)
        better = abs(r3) < abs(r)
        best, s, r = (3.0 if better else best), (s3 if better else s), (r3 if better else r)
        better = abs(r4) < abs(r)
        best, s, r = (4.0 if better else best), (s4 if better else s), (r4 if better else r)
        level = abs(r5) <= limit
        best, s, r = (5.0 if level else best), (s5 if level else s), (r5 if level else r)
        acts = (abs(r) <= limit) & (measured[i2, j + 2] > 0.0)
        chosen[j] = best if acts else 0.0
        own[j] = s if acts else 0.0
        residual[j] = r if acts else 0.0


@kernel
def choose_filters(surface, measured, limit, chosen, own, residual):
    """Apply :func:`choose_row` to a whole grid.

    surface, measured : (rows + 4, columns + 4) float64; chosen, own, residual : (rows, columns) float32, out.
    """
    for i in range(chosen.shape[0]):
        choose_row(surface, measured, i, limit, chosen[i], own[i], residual[i])
