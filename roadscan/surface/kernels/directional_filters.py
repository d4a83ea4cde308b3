"""Choice of the directional filter at each cell of a surface."""

from __future__ import annotations

from roadscan.compute.kernel_options import inner, kernel


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
