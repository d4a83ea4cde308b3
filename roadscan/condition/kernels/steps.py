"""Steps of a longitudinal profile: differences of the lines fitted on both sides of a place."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel


@inlined
def line_at(x, h, sigma, first, end, at):
    """Return height at a place and variance of the best line through h[first:end]; NaN with fewer than three."""
    n, sx, sy, sxx, sxy = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(first, end):
        if np.isnan(h[k]):
            continue
        dx = x[k] - at
        n += 1.0
        sx += dx
        sy += h[k] - h[first]
        sxx += dx * dx
        sxy += dx * (h[k] - h[first])
    det = n * sxx - sx * sx
    if n < 3.0 or det <= 0.0:
        return np.nan, np.nan
    value = (sxx * sy - sx * sxy) / det + h[first]
    variance = 0.0
    for k in range(first, end):
        if not np.isnan(h[k]):
            w = (sxx - sx * (x[k] - at)) / det
            variance += w * w * sigma[k] * sigma[k]
    return value, variance


@kernel
def step_heights(x, h, sigma, reach, out):
    """Compute the height of a possible step at each place of a profile.

    Parameters
    ----------
    x, h, sigma : (n,) float64, ascending stations, heights (NaN where there is none), standard deviations, m.
    reach : (2,) float64, lines are fitted from reach[0] to reach[1] before and behind a place, m.
    out : (n, 3) float64, out: height of the step (m), its standard deviation (m), and how much of it happens within
        reach[0] of the place (m); NaN where a side lacks heights.
    """
    near, far = reach
    n = x.size
    before, before_end, behind, behind_end = 0, 0, 0, 0
    for k in range(n):
        while x[before] < x[k] - far - 1e-9:
            before += 1
        while x[before_end] <= x[k] - near + 1e-9:
            before_end += 1
        while behind < n and x[behind] < x[k] + near - 1e-9:
            behind += 1
        while behind_end < n and x[behind_end] <= x[k] + far + 1e-9:
            behind_end += 1
        out[k] = np.nan
        if before_end - before < 3 or behind_end - behind < 3:
            continue
        if np.isnan(h[before]) or np.isnan(h[behind]):
            continue
        low, low_variance = line_at(x, h, sigma, before, before_end, x[k])
        high, high_variance = line_at(x, h, sigma, behind, behind_end, x[k])
        out[k, 0] = high - low
        # Neighbouring heights share cells: about one in three is independent.
        out[k, 1] = math.sqrt(3.0 * (low_variance + high_variance))
        a, b = before_end - 1, behind
        slope = 0.5 * (
            (h[a] - h[before]) / (x[a] - x[before]) + (h[behind_end - 1] - h[b]) / (x[behind_end - 1] - x[b])
        )
        out[k, 2] = h[b] - h[a] - slope * (x[b] - x[a])
