"""Moments of low returns, by cells."""

from __future__ import annotations

from roadscan.compute.kernel_options import kernel


@kernel
def low_moments(x, y, above, intensity, is_counted, limits, corner, cell_m, sums):
    """Add low returns to their cells: sums (rows, columns, 4) float64: n, Σh, Σh², Σ intensity.

    x, y : (n,) places (m); above : (n,) h, height above the ground (m); intensity : (n,); is_counted : (n,) bool;
    limits : (2,) least and greatest h that counts (m); corner : (x, y) of cell (0, 0).
    """
    rows, columns = sums.shape[:2]
    for i in range(x.size):
        h = above[i]
        if not is_counted[i] or not (limits[0] <= h <= limits[1]):
            continue
        a, b = (x[i] - corner[0]) / cell_m, (y[i] - corner[1]) / cell_m
        if not (a >= 0.0 and b >= 0.0 and a < columns and b < rows):
            continue
        r, c = int(b), int(a)
        sums[r, c, 0] += 1.0
        sums[r, c, 1] += h
        sums[r, c, 2] += h * h
        sums[r, c, 3] += intensity[i]
