"""Moments of ground returns and counts of what grows on it, by cells."""

from __future__ import annotations

from roadscan.kernels.options import kernel


@kernel
def ground_moments(x, y, above, intensity, kind, corner, cell_m, sums):
    """Add returns to their cells: sums (rows, columns, 9) float64.

    x, y : (n,) places (m); above : (n,) height above the ground (m); intensity : (n,); kind : (n,) 1 ground, 2 what
    grows, else left out; corner : (x, y) of cell (0, 0). Sums of ground: n, Σu, Σv, Σh, Σuh, Σvh, Σh² with u, v from
    the middle of the cell (m), Σ intensity; last the number of returns of what grows.
    """
    rows, columns = sums.shape[:2]
    for i in range(x.size):
        if kind[i] != 1 and kind[i] != 2:
            continue
        a, b = (x[i] - corner[0]) / cell_m, (y[i] - corner[1]) / cell_m
        if not (a >= 0.0 and b >= 0.0 and a < columns and b < rows):
            continue
        r, c = int(b), int(a)
        if kind[i] == 2:
            sums[r, c, 8] += 1.0
            continue
        u, v, h = (a - c - 0.5) * cell_m, (b - r - 0.5) * cell_m, above[i]
        sums[r, c, 0] += 1.0
        sums[r, c, 1] += u
        sums[r, c, 2] += v
        sums[r, c, 3] += h
        sums[r, c, 4] += u * h
        sums[r, c, 5] += v * h
        sums[r, c, 6] += h * h
        sums[r, c, 7] += intensity[i]
