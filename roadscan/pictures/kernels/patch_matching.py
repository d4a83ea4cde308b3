"""Least-squares matching of small patches of two pictures (Gruen 1985; Förstner 1982)."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel
from roadscan.compute.kernels.arrays import catmull_rom, sampled

HALF_PX = 8  # Half the edge of a patch (px): 17 by 17 pixels hold enough grey values for eight unknowns.
_UNKNOWNS = 8  # Two of the place, four of the affine form, factor and level of the grey values.
_ROUNDS = 25  # Gauss–Newton steps, at most; five are usual.
_SETTLED_PX = 0.002  # A step below this (px) is the last one.
_FARTHEST_PX = 1.5  # Features are never so far off (px): what lies farther from one is another.
_LEAST_CONTRAST = 2.0  # Standard deviation of a patch (grey values of 256), at least: less is noise.
_LEAST_ALIKE = 0.8
"""Share of the first patch's variance that the second explains, at least: less is another thing, or half hidden."""
_STIFF = 1e-3
"""Weight of the first form of a patch, in units of its variance: patches without structure across keep theirs."""


@inlined
def _weight(i, j):
    """Return the weight of a pixel of a patch: a Gaussian of half its half edge."""
    return math.exp(-2.0 * (i * i + j * j) / (HALF_PX * HALF_PX))


@inlined
def _grey(picture, u, v):
    """Return grey value and derivatives by column and row at a place."""
    c, r = math.floor(u), math.floor(v)
    return sampled(picture, int(r), int(c), catmull_rom(u - c), catmull_rom(v - r))


@inlined
def _holds(picture, u, v):
    """Return whether a place has the neighbours that its grey value is made of."""
    return 1.0 <= u < picture.shape[1] - 2.0 and 1.0 <= v < picture.shape[0] - 2.0


@kernel
def match_patches(first, second, places, guesses, forms, found):
    """Fill `found` (n, 2) with the places in a second picture that show what the first one shows; NaN where none does.

    first, second : (rows, columns) float32 grey values, 0 to 255, smoothed. places : (n, 2) column, row in the first;
    guesses : (n, 2) in the second; forms : (n, 2, 2) by how much column and row move there as they move in the first.
    """
    grey = np.empty((2 * HALF_PX + 1, 2 * HALF_PX + 1))
    state, normal, right = np.empty(_UNKNOWNS), np.empty((_UNKNOWNS, _UNKNOWNS)), np.empty(_UNKNOWNS)
    for n in range(len(places)):
        found[n] = np.nan
        variance = _patch(first, places[n, 0], places[n, 1], grey)
        if variance < _LEAST_CONTRAST * _LEAST_CONTRAST:
            continue
        state[:] = 0.0
        state[0], state[1] = guesses[n, 0], guesses[n, 1]
        state[2], state[3], state[4], state[5] = forms[n, 0, 0], forms[n, 0, 1], forms[n, 1, 0], forms[n, 1, 1]
        state[6] = 1.0
        left = np.inf
        for turn in range(_ROUNDS):
            left = _equations(second, grey, variance, state, turn == 0, normal, right)
            if not math.isfinite(left):
                break
            step = np.linalg.solve(normal, right)
            state += step
            if math.hypot(state[0] - guesses[n, 0], state[1] - guesses[n, 1]) > _FARTHEST_PX:
                left = np.inf
                break
            if turn > 0 and math.hypot(step[0], step[1]) < _SETTLED_PX:
                break
        if left < (1.0 - _LEAST_ALIKE) * variance:
            found[n, 0], found[n, 1] = state[0], state[1]


@kernel
def _patch(picture, u, v, grey):
    """Fill a patch with grey values less their mean; return their variance, 0 where it reaches beyond the picture."""
    if not (_holds(picture, u - HALF_PX, v - HALF_PX) and _holds(picture, u + HALF_PX, v + HALF_PX)):
        return 0.0
    mean, total, square = 0.0, 0.0, 0.0
    for j in range(-HALF_PX, HALF_PX + 1):
        for i in range(-HALF_PX, HALF_PX + 1):
            value, _, _ = _grey(picture, u + i, v + j)
            grey[j + HALF_PX, i + HALF_PX] = value
            w = _weight(i, j)
            total += w
            mean += w * value
    mean /= total
    for j in range(-HALF_PX, HALF_PX + 1):
        for i in range(-HALF_PX, HALF_PX + 1):
            grey[j + HALF_PX, i + HALF_PX] -= mean
            square += _weight(i, j) * grey[j + HALF_PX, i + HALF_PX] ** 2
    return square / total


@kernel
def _equations(picture, grey, variance, state, begins, normal, right):
    """Fill the normal equations of a patch; return the mean square that is left, infinite beyond the picture.

    state : (8,) column, row, derivatives of both by column and row of the patch, factor and level of the grey values.
    begins : the level is not known yet; it is set here.
    """
    a = np.empty(_UNKNOWNS)
    total, square, level = 0.0, 0.0, 0.0
    for turn in range(2 if begins else 1):
        normal[:], right[:] = 0.0, 0.0
        total, square, level = 0.0, 0.0, 0.0
        for j in range(-HALF_PX, HALF_PX + 1):
            for i in range(-HALF_PX, HALF_PX + 1):
                u, v = state[0] + state[2] * i + state[3] * j, state[1] + state[4] * i + state[5] * j
                if not _holds(picture, u, v):
                    return np.inf
                value, along, across = _grey(picture, u, v)
                w = _weight(i, j)
                total += w
                level += w * value
                miss = grey[j + HALF_PX, i + HALF_PX] - state[6] * value - state[7]
                square += w * miss * miss
                a[0], a[1], a[6], a[7] = state[6] * along, state[6] * across, value, 1.0
                a[2], a[3], a[4], a[5] = a[0] * i, a[0] * j, a[1] * i, a[1] * j
                for p in range(_UNKNOWNS):
                    right[p] += w * a[p] * miss
                    for q in range(_UNKNOWNS):
                        normal[p, q] += w * a[p] * a[q]
        if begins and turn == 0:
            state[7] = -state[6] * level / total
    for p in range(2, 6):
        normal[p, p] += _STIFF * variance * total
    for p in range(_UNKNOWNS):
        normal[p, p] *= 1.0 + 1e-9
    return square / total
