"""Painted shapes with soft edges, and the equations that fit them to labels of paint and road.

A shape is a share of white paint, from 0 to 1. An edge is a normal distribution function of the distance to it, with
the blur as its standard deviation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, kernel

DISC, CHEQUERED = 0, 1
"""Kinds of shapes."""
EAST, NORTH, SIZE, TURN = range(4)
"""Unknowns: centre (m), logarithm of the size over the stated one, turn (rad, east to north)."""
UNKNOWNS = 4  # Number of unknowns.
_ROOT_HALF = math.sqrt(0.5)  # Scale of the argument of erfc.
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)  # Density of the standard normal distribution at 0.
_FAR = 6.0  # Beyond this many blurs from an edge the share of paint is 0 or 1.


class Drawn(NamedTuple):
    """A shape as stated."""

    kind: int
    """`DISC` or `CHEQUERED`."""
    half_m: float
    """Radius, or edge of a quadrant."""
    centre_m: float
    """Radius of the dark centre of a disc; 0: none."""


class Paint(NamedTuple):
    """Appearance of the paint."""

    blur_m: float
    """Standard deviation of an edge."""
    lost: float
    """Chance that paint is worn off, above 0."""
    stray: float
    """Chance that there is paint beside the shape, above 0."""


class Fitted(NamedTuple):
    """Sums over n labels, written by the kernel."""

    normal: npt.NDArray[np.float64]
    """(4, 4) information matrix of Fisher."""
    scores: npt.NDArray[np.float64]
    """(g, 4) derivative of the log-likelihood, the part of each group."""


@inlined
def _step(t):
    """Returns the share of paint at a distance of `t` blurs inside an edge, and its derivative."""
    if t > _FAR:
        return 1.0, 0.0
    if t < -_FAR:
        return 0.0, 0.0
    return 0.5 * math.erfc(-t * _ROOT_HALF), _DENSITY * math.exp(-0.5 * t * t)


@inlined
def _disc(x, y, half, centre, blur):
    """Returns the white share of a disc, and its derivatives by the unknowns."""
    r = math.sqrt(x * x + y * y) + 1e-12
    white, outer = _step((half - r) / blur)
    inner = 0.0
    if centre > 0.0:
        dark, inner = _step((centre - r) / blur)
        white -= dark
    slope = (outer - inner) / blur / r
    return white, slope * x, slope * y, (outer * half - inner * centre) / blur, 0.0


@inlined
def _halves(u, half, blur):
    """Returns the shares within (0, half) and within (−half, 0), each with its derivatives by u and log size."""
    middle, a = _step(u / blur)
    right, b = _step((u - half) / blur)
    left, c = _step((u + half) / blur)
    a, b, c = a / blur, b / blur, c / blur
    return middle - right, a - b, b * half, left - middle, c - a, c * half


@inlined
def _chequered(x, y, half, turn, blur):
    """Returns the white share of a square of four, and its derivatives by the unknowns."""
    cos, sin = math.cos(turn), math.sin(turn)
    u, v = cos * x + sin * y, cos * y - sin * x
    p, pu, pk, n, nu, nk = _halves(u, half, blur)
    q, qv, qk, m, mv, mk = _halves(v, half, blur)
    by_u, by_v = pu * q + nu * m, p * qv + n * mv
    by_size = pk * q + p * qk + nk * m + n * mk
    return p * q + n * m, sin * by_v - cos * by_u, -sin * by_u - cos * by_v, by_size, by_u * v - by_v * u


@kernel
def fit_equations(place, label, group, drawn, state, paint, out):
    """Compute the log-likelihood of labels under a shape, and the equations of one step of Fisher scoring.

    A label is Bernoulli's with the chance ``stray + (1 − lost − stray) · white``, or a share between.

    Parameters
    ----------
    place : (n, 2) float64, m, east and north; label : (n,) float64, 0 road to 1 paint; group : (n,) int64.
    drawn : Drawn. state : (4,) float64, the unknowns. paint : Paint. out : Fitted.
    """
    kind, half, centre = drawn
    blur, lost, stray = paint
    normal, scores = out
    normal[:] = 0.0
    scores[:] = 0.0
    slopes = np.zeros(UNKNOWNS)
    scale = math.exp(state[SIZE])
    rise = 1.0 - lost - stray
    total = 0.0
    for i in range(label.size):
        x, y = place[i, 0] - state[EAST], place[i, 1] - state[NORTH]
        if kind == DISC:
            white, slopes[0], slopes[1], slopes[2], slopes[3] = _disc(x, y, half * scale, centre * scale, blur)
        else:
            white, slopes[0], slopes[1], slopes[2], slopes[3] = _chequered(x, y, half * scale, state[TURN], blur)
        chance = stray + rise * white
        total += label[i] * math.log(chance) + (1.0 - label[i]) * math.log(1.0 - chance)
        information = 1.0 / (chance * (1.0 - chance))
        for a in range(UNKNOWNS):
            scores[group[i], a] += rise * slopes[a] * (label[i] - chance) * information
            for b in range(a + 1):
                normal[a, b] += rise * rise * slopes[a] * slopes[b] * information
    for a in range(UNKNOWNS):
        for b in range(a):
            normal[b, a] = normal[a, b]
    return total


@kernel
def draw_white(place, drawn, state, blur_m, out):
    """Compute the white share (n,) of a shape at places (n, 2).

    Parameters
    ----------
    place : (n, 2) float64, m. drawn : Drawn. state : (4,) float64, the unknowns. blur_m : float64.
    out : (n,) float64, written.
    """
    kind, half, centre = drawn
    scale = math.exp(state[SIZE])
    for i in range(place.shape[0]):
        x, y = place[i, 0] - state[EAST], place[i, 1] - state[NORTH]
        if kind == DISC:
            out[i] = _disc(x, y, half * scale, centre * scale, blur_m)[0]
        else:
            out[i] = _chequered(x, y, half * scale, state[TURN], blur_m)[0]
