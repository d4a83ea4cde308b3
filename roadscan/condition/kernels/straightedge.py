"""Rolls wheels and beams over a profile."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel


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
