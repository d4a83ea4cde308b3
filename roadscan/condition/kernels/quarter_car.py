"""Rolls a linear quarter car over a profile of any spacing, with the exact solution from sample to sample.

The profile is linear between its samples. The tyre envelops it: the slope under the car is constant over a step, that
of the profile's moving average at the middle of the step, as World Bank Technical Paper 46 (Sayers, Gillespie, Paterson
1986) has it for steps of 250 mm. Under a constant slope s each of the car's two pairs of conjugate modes follows a
separate equation, whose solution over a step d is c ← exp(p·d)·(c + w·s) − w·s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel

_SAME_STEP_M = 1e-9
"""Steps whose difference is smaller count as equal: stations at 100 km are rounded to 15 pm."""
_BLOCK = 256  # Samples per block.
_PER_M = 2000.0
"""Number of tabulated growths per metre of travel."""


class QuarterCar(NamedTuple):
    """A quarter car at its speed, as two modes; the sum of their real parts is the suspension's slope."""

    pole_per_m: tuple[complex, complex]
    """Eigenvalues with positive imaginary part (1/m of travel)."""
    weight: tuple[complex, complex]
    """Deflection of each mode under a slope of one, with reversed sign."""
    growth: np.ndarray
    """(steps, 2) complex128, factor of a mode over 0, ½, 1 … mm, up to the longest step."""


class Rules(NamedTuple):
    """Rules for rolling over a profile."""

    envelope_m: float
    """Length of the moving average (m)."""
    ahead_m: float
    """Distance of the middle of the moving average ahead of the middle of a step (m)."""
    start_m: float
    """The car starts at rest on the mean slope of this length; shorter pieces are left out."""
    longest_step_m: float
    """A wider step is a gap, behind which the car starts again (m)."""
    highest_step_m: float
    """Behind a higher jump the car starts again too (m)."""


@inlined
def _growth(pole, near, rest):
    """Return exp(pole · step) from its value at the nearest half of a millimetre and the rest of the step (m).

    With poles of at most 18 per metre the series is exact to 2 parts in 1e14.
    """
    z = pole * rest
    return near * ((1.0 + z) + z * z * (0.5 + z * (1 / 6 + z * (1 / 24))))


@inner
def _feel(xs, hs, rules, slope, grade):
    """Compute the slope (n,) under the tyre over the step before each sample; `slope[0]` is that of the start.

    grade : (n,) float64, room for the slopes of the profile itself.
    """
    n = xs.size
    for i in range(n - 1):
        grade[i] = (hs[i + 1] - hs[i]) / (xs[i + 1] - xs[i])
    half, first, last = 0.5 * rules.envelope_m, xs[0], xs[n - 1]
    low, high = 0, 0
    for i in range(1, n):
        slope[i] = grade[i - 1]
        if xs[i] - xs[i - 1] < rules.envelope_m:
            middle = 0.5 * (xs[i] + xs[i - 1]) + rules.ahead_m
            near, far = max(middle - half, first), min(middle + half, last)
            while xs[low + 1] < near:
                low += 1
            while xs[high + 1] < far:
                high += 1
            rise = (hs[high] - hs[low]) + ((far - xs[high]) * grade[high] - (near - xs[low]) * grade[low])
            slope[i] = rise / (far - near)
    end, k = first + rules.start_m, 0
    while k < n - 2 and xs[k + 1] < end:
        k += 1
    slope[0] = (hs[k] + (end - xs[k]) * grade[k] - hs[0]) / rules.start_m


@inner
def _grow(steps, car, growth):
    """Compute the growth of both modes (block, 2) over the steps (block,) of a block."""
    p1, p2 = car.pole_per_m
    for i in range(steps.size):
        whole = int(_PER_M * steps[i] + 0.5)
        rest = steps[i] - whole / _PER_M
        growth[i, 0] = _growth(p1, car.growth[whole, 0], rest)
        growth[i, 1] = _growth(p2, car.growth[whole, 1], rest)


@inner
def _roll_piece(xs, hs, car, rules, squared, response_m, measured_m):
    """Roll over a piece without gaps that is at least as long as the start; sums continue from the first element."""
    response, measured = response_m[0], measured_m[0]
    slope = response_m  # an element is read before its sum is written, since fresh memory takes as long as the rolling
    _feel(xs, hs, rules, slope, measured_m)
    w1, w2 = car.weight
    a1, b1, a2, b2 = w1.real, w1.imag, w2.real, w2.imag
    x1, y1, x2, y2 = -a1 * slope[0], -b1 * slope[0], -a2 * slope[0], -b2 * slope[0]
    response_m[0], measured_m[0] = response, measured
    growth, steps = np.empty((_BLOCK, 2), np.complex128), np.empty(_BLOCK)
    step = -1.0
    for begin in range(1, xs.size, _BLOCK):
        count = min(_BLOCK, xs.size - begin)
        same = True
        for i in range(count):
            steps[i] = xs[begin + i] - xs[begin + i - 1]
            same &= abs(steps[i] - step) < _SAME_STEP_M
        if not same:
            _grow(steps[:count], car, growth)
            step = steps[0]
            for i in range(steps.size):
                if not abs(steps[i] - steps[0]) < _SAME_STEP_M:
                    step = -1.0
        for i in range(count):
            s, d, e1, e2 = slope[begin + i], steps[i], growth[i, 0], growth[i, 1]
            u, v = x1 + a1 * s, y1 + b1 * s
            x1, y1 = (e1.real * u - e1.imag * v) - a1 * s, (e1.real * v + e1.imag * u) - b1 * s
            u, v = x2 + a2 * s, y2 + b2 * s
            x2, y2 = (e2.real * u - e2.imag * v) - a2 * s, (e2.real * v + e2.imag * u) - b2 * s
            felt = x1 + x2
            response += d * (felt * felt if squared else abs(felt))
            measured += d
            response_m[begin + i], measured_m[begin + i] = response, measured


@inner
def _roll_valid(xs, hs, car, rules, squared, response_m, measured_m):
    """Roll over the pieces between gaps and jumps; pieces that are too short add nothing."""
    n, first = xs.size, 0
    response_m[0] = measured_m[0] = 0.0
    for i in range(1, n + 1):
        whole = i < n and xs[i] - xs[i - 1] <= rules.longest_step_m
        if whole and abs(hs[i] - hs[i - 1]) <= rules.highest_step_m:
            continue
        if xs[i - 1] - xs[first] >= rules.start_m:
            piece = slice(first, i)
            _roll_piece(xs[piece], hs[piece], car, rules, squared, response_m[piece], measured_m[piece])
        else:
            response_m[first + 1 : i] = response_m[first]
            measured_m[first + 1 : i] = measured_m[first]
        if i < n:
            response_m[i], measured_m[i] = response_m[i - 1], measured_m[i - 1]
        first = i


@inner
def _to_all(x_m, xs, sums, out):
    """Interpolate sums at samples with a height linearly to all samples."""
    last, k = xs.size - 1, 0
    for i in range(x_m.size):
        while k < last and xs[k + 1] <= x_m[i]:
            k += 1
        out[i] = sums[k]
        if k < last and x_m[i] > xs[k]:
            out[i] += (x_m[i] - xs[k]) / (xs[k + 1] - xs[k]) * (sums[k + 1] - sums[k])


@kernel
def roll(x_m, height_m, car, rules, squared, response_m, measured_m):
    """Roll a quarter car over profiles that share their stations.

    Samples without a height are bridged as far as `rules.longest_step_m` reaches.

    Parameters
    ----------
    x_m : (n,) float64, stations, ascending (m).
    height_m : (profiles, n) float64, not finite where there is none (m).
    squared : sum up squares in place of absolute values.
    response_m : (profiles, n) float64, out: integral of the suspension's |slope|, or its square, from the first sample
        on (m).
    measured_m : (profiles, n) float64, out: length rolled over from the first sample on (m).
    """
    for row in range(height_m.shape[0]):
        m = 0
        for i in range(x_m.size):
            m += math.isfinite(height_m[row, i])
        if m == x_m.size:
            _roll_valid(x_m, height_m[row], car, rules, squared, response_m[row], measured_m[row])
        elif m == 0:
            response_m[row, :] = 0.0
            measured_m[row, :] = 0.0
        else:
            xs, hs, response, measured = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
            k = 0
            for i in range(x_m.size):
                if math.isfinite(height_m[row, i]):
                    xs[k], hs[k] = x_m[i], height_m[row, i]
                    k += 1
            _roll_valid(xs, hs, car, rules, squared, response, measured)
            _to_all(x_m, xs, response, response_m[row])
            _to_all(x_m, xs, measured, measured_m[row])
