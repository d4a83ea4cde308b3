"""Steps of a longitudinal profile (differences of lines fitted on both sides of a place); rolling wheels and beams."""

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


@kernel
def roll_wheel(xs, hs, radius_m, out):
    """Compute heights of the lowest point of a wheel that rolls over a profile, at each of its samples.

    xs, hs : (n,) float64, stations ascending and heights, all finite (m).
    out : (n,) float64, out: highest h(x + u) + √(r² − u²) − r within the radius (m).
    """
    first = 0
    for i in range(xs.size):
        while xs[first] < xs[i] - radius_m:
            first += 1
        highest, k = hs[i], first
        while k < xs.size and xs[k] <= xs[i] + radius_m:
            u = xs[k] - xs[i]
            highest = max(highest, hs[k] + np.sqrt(max(radius_m * radius_m - u * u, 0.0)) - radius_m)
            k += 1
        out[i] = highest


@kernel
def roll_beam(xs, wheel_m, length_m, longest_step_m, out):
    """Compute the height of a rolling beam's middle wheel above its end wheels' mean, at each sample.

    xs, wheel_m : (n,) float64, stations ascending and heights of the wheels' lowest points (m).
    longest_step_m : a beam over a wider step measures nothing (m).
    out : (n,) float64, out: positive over a bump; NaN where the beam reaches beyond the profile or over a gap (m).
    """
    n, half = xs.size, 0.5 * length_m
    behind, ahead, gap_end = 0, 0, -np.inf
    for i in range(n):
        out[i] = np.nan
        near, far = xs[i] - half, xs[i] + half
        if near < xs[0] - 1e-9 or far > xs[n - 1] + 1e-9:
            continue
        while behind < n - 2 and xs[behind + 1] < near:
            behind += 1
        while ahead < n - 2 and xs[ahead + 1] < far:
            ahead += 1
            if xs[ahead] - xs[ahead - 1] > longest_step_m:
                gap_end = xs[ahead]
        if gap_end > near or xs[ahead + 1] - xs[ahead] > longest_step_m:
            continue
        low = wheel_m[behind] + (near - xs[behind]) / (xs[behind + 1] - xs[behind]) * (
            wheel_m[behind + 1] - wheel_m[behind]
        )
        high = wheel_m[ahead] + (far - xs[ahead]) / (xs[ahead + 1] - xs[ahead]) * (wheel_m[ahead + 1] - wheel_m[ahead])
        out[i] = wheel_m[i] - 0.5 * (low + high)
