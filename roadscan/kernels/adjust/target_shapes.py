"""Painted shapes with soft edges, and the equations that fit them to intensities.

A shape has two layers, white paint and dark paint, each from 0 to 1. An edge is a normal distribution function of the
distance to it, with the blur as its standard deviation. Intensities are modelled as

    level + slope · place + paint · white + dark · black.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.kernels.options import inlined, kernel

DISC, CHEQUERED = 0, 1
"""Kinds of shapes."""
EAST, NORTH, SIZE, BLUR, TURN, LEVEL, SLOPE_EAST, SLOPE_NORTH, PAINT, DARK = range(10)
"""Unknowns: centre (m), logarithms of size and blur, turn (rad), and the intensities above."""
UNKNOWNS = 10
_ROOT_HALF = math.sqrt(0.5)
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)
_FAR = 6.0


class Drawn(NamedTuple):
    """The shape as it is stated."""

    kind: int
    """`DISC` or `CHEQUERED`."""
    half_m: float
    """Radius, or edge of a quadrant."""
    centre_m: float
    """Radius of the dark centre of a disc; 0: none."""


class Robust(NamedTuple):
    """How residuals are weighed: Tukey's biweight of the residual over its scale."""

    noise: float
    """Scale of a residual in an even place, units of the intensity."""
    edge: float
    """What the scale gains at an edge, in units of the slope there times the blur."""
    cut: float
    """A residual beyond this many scales has no weight."""


class Fitted(NamedTuple):
    """Sums over n values, written by the kernel."""

    normal: npt.NDArray[np.float64]
    """(10, 10) normal matrix."""
    scores: npt.NDArray[np.float64]
    """(g, 10) right-hand side, the part of each group of values."""
    residual: npt.NDArray[np.float64]
    """(n,) value minus model."""
    edge: npt.NDArray[np.float64]
    """(n,) slope of the model times the blur."""
    weight: npt.NDArray[np.float64]
    """(n,) 0 to 1."""


@inlined
def _step(t):
    """Share of paint at a distance of `t` blurs inside an edge, and its derivative."""
    if t > _FAR:
        return 1.0, 0.0
    if t < -_FAR:
        return 0.0, 0.0
    return 0.5 * math.erfc(-t * _ROOT_HALF), _DENSITY * math.exp(-0.5 * t * t)


@inlined
def _disc(x, y, half, centre, blur):
    """White and dark layer of a disc, and the derivatives of each by centre, size, blur and turn."""
    r = math.sqrt(x * x + y * y) + 1e-12
    t = (half - r) / blur
    white, slope = _step(t)
    slope /= blur
    dark, dark_slope, u = 0.0, 0.0, 0.0
    if centre > 0.0:
        u = (centre - r) / blur
        dark, dark_slope = _step(u)
        dark_slope /= blur
    return (
        white, slope * x / r, slope * y / r, slope * half, -slope * blur * t, 0.0,
        dark, dark_slope * x / r, dark_slope * y / r, dark_slope * centre, -dark_slope * blur * u, 0.0,
    )  # fmt: skip


@inlined
def _halves(u, half, blur):
    """Share within (0, half) and within (−half, 0), each with its derivatives by u, log size and log blur."""
    middle, a = _step(u / blur)
    right, b = _step((u - half) / blur)
    left, c = _step((u + half) / blur)
    a, b, c = a / blur, b / blur, c / blur
    return (
        middle - right, a - b, b * half, -a * u + b * (u - half),
        left - middle, c - a, c * half, -c * (u + half) + a * u,
    )  # fmt: skip


@inlined
def _chequered(x, y, half, turn, blur):
    """White and dark layer of a square of four, and the derivatives of each by centre, size, blur and turn."""
    cos, sin = math.cos(turn), math.sin(turn)
    u, v = cos * x + sin * y, cos * y - sin * x
    p, pu, pk, ps, n, nu, nk, ns = _halves(u, half, blur)
    q, qv, qk, qs, m, mv, mk, ms = _halves(v, half, blur)
    white_u, white_v = pu * q + nu * m, p * qv + n * mv
    dark_u, dark_v = pu * m + nu * q, p * mv + n * qv
    return (
        p * q + n * m, sin * white_v - cos * white_u, -sin * white_u - cos * white_v,
        pk * q + p * qk + nk * m + n * mk, ps * q + p * qs + ns * m + n * ms, white_u * v - white_v * u,
        p * m + n * q, sin * dark_v - cos * dark_u, -sin * dark_u - cos * dark_v,
        pk * m + p * mk + nk * q + n * qk, ps * m + p * ms + ns * q + n * qs, dark_u * v - dark_v * u,
    )  # fmt: skip


@inlined
def _layers(x, y, drawn, state):
    kind, half, centre = drawn
    scale, blur = math.exp(state[SIZE]), math.exp(state[BLUR])
    if kind == DISC:
        return _disc(x, y, half * scale, centre * scale, blur)
    return _chequered(x, y, half * scale, state[TURN], blur)


@kernel
def fit_equations(place, value, group, drawn, state, robust, out):
    """Equations of one step of Gauss and Newton towards the shape that fits the values best.

    Parameters
    ----------
    place : (n, 2) float64, m, east and north; value : (n,) float64, intensities; group : (n,) int64.
    drawn : Drawn. state : (10,) float64, the unknowns. robust : Robust. out : Fitted.
    """
    noise, edge, cut = robust
    normal, scores, residual, steep, weight = out
    normal[:] = 0.0
    scores[:] = 0.0
    slopes = np.zeros(UNKNOWNS)
    blur = math.exp(state[BLUR])
    for i in range(value.size):
        east, north = place[i, 0], place[i, 1]
        layers = _layers(east - state[EAST], north - state[NORTH], drawn, state)
        white, dark = layers[0], layers[6]
        for k in range(5):
            slopes[k] = state[PAINT] * layers[1 + k] + state[DARK] * layers[7 + k]
        slopes[LEVEL], slopes[SLOPE_EAST], slopes[SLOPE_NORTH] = 1.0, east, north
        slopes[PAINT], slopes[DARK] = white, dark
        model = state[LEVEL] + state[SLOPE_EAST] * east + state[SLOPE_NORTH] * north
        model += state[PAINT] * white + state[DARK] * dark
        left = value[i] - model
        residual[i] = left
        steep[i] = blur * math.hypot(slopes[EAST], slopes[NORTH])
        variance = noise * noise + (edge * steep[i]) ** 2
        share = 1.0 - left * left / (variance * cut * cut)
        weight[i] = share * share if share > 0.0 else 0.0
        if share <= 0.0:
            continue
        w = weight[i] / variance
        for a in range(UNKNOWNS):
            scores[group[i], a] += w * slopes[a] * left
            for b in range(a + 1):
                normal[a, b] += w * slopes[a] * slopes[b]
    for a in range(UNKNOWNS):
        for b in range(a):
            normal[b, a] = normal[a, b]


@kernel
def draw_layers(place, drawn, state, out):
    """White and dark layer (n, 2) of a shape at places (n, 2); state : (10,) its unknowns; out : float64, written."""
    for i in range(place.shape[0]):
        layers = _layers(place[i, 0] - state[EAST], place[i, 1] - state[NORTH], drawn, state)
        out[i, 0], out[i, 1] = layers[0], layers[6]
