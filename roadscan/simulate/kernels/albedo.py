"""Random brightness of surfaces in pictures: noise in space of several octaves, and bricks, as pixels average them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadscan.compute.array_types import Float32, Float64
from roadscan.simulate.kernels.options import compiled, inlined, mixed

NODE_SPREAD = 0.3697
"""Standard deviation of noise between nodes of even random numbers from −1 to 1: the mean over a cell of the cubic
weights' squares, to the third power, times a third, is its variance."""
MOST_SAMPLES = 4
"""Places along each side of a pixel at most, over which an octave is averaged."""
SAMPLES_A_WAVE = 2.0  # places in a wavelength
GONE_WAVES = 2.0
"""Length of a pixel's side, in wavelengths, from which on an octave is not seen: what is left of it is below 5 %."""
BRICK_M, COURSE_M, MORTAR_M = 0.25, 0.075, 0.010
"""Length of a brick and height of a course, with mortar, and the mortar's width (m)."""
MORTAR_SHARE = 1.5
"""Brightness of mortar above the mean, in contrasts of the bricks."""
BRICKS_GONE_M = 0.15
"""Length of a pixel's side (m) from which on bricks are not seen."""
OFFSET = 1 << 30
"""Added to numbers of nodes, so that they are positive."""
# A rotation that lays no axis of the noise along the map's axes: 35° about east, 28° about north, 41° about up.
R00, R01, R02 = 0.66636901, -0.33418554, 0.66653760
R10, R11, R12 = 0.57926574, 0.79488404, -0.18058394  # its second row
R20, R21, R22 = -0.46947156, 0.50643793, 0.72326833  # its third row


class Octaves(NamedTuple):
    """The octaves of a surface's noise."""

    wavelength_m: Float64
    """(k,)"""
    share: Float64
    """(k,) standard deviation of each; the sum of their squares is 1."""
    seed: np.uint64


@inlined
def even(bits: np.uint64) -> float:
    """Return a random number from −1 to 1 of 64 bits."""
    return float(bits >> np.uint64(11)) / 4503599627370496.0 - 1.0


@inlined
def node_line(ij: np.uint64, k: int, w: float) -> float:
    """Return the noise between the nodes `k` and `k` + 1 of a line of nodes."""
    first = even(mixed(ij ^ np.uint64(k + OFFSET)))
    second = even(mixed(ij ^ np.uint64(k + 1 + OFFSET)))
    return first + w * (second - first)


@inlined
def node_plane(i_bits: np.uint64, j: int, k: int, v: float, w: float) -> float:
    """Return the noise between four nodes of a plane of nodes."""
    first = node_line(mixed(i_bits ^ np.uint64(j + OFFSET)), k, w)
    second = node_line(mixed(i_bits ^ np.uint64(j + 1 + OFFSET)), k, w)
    return first + v * (second - first)


@inlined
def smooth(x: float) -> float:
    """Return the cubic weight of the later of two nodes at a share of their distance."""
    return x * x * (3.0 - 2.0 * x)


@compiled
def noise_at(x: float, y: float, z: float, seed: np.uint64) -> float:
    """Return noise with mean 0 and standard deviation 1 at a place in units of its wavelength's half.

    Random numbers at the nodes of a lattice, by counter, and cubic weights between (value noise: Perlin 1985).
    """
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = smooth(x - i), smooth(y - j), smooth(z - k)
    first = node_plane(mixed(seed ^ np.uint64(i + OFFSET)), j, k, v, w)
    second = node_plane(mixed(seed ^ np.uint64(i + 1 + OFFSET)), j, k, v, w)
    value: float = (first + u * (second - first)) / NODE_SPREAD
    return value


@inlined
def places_along(side_m: float, wave_m: float) -> int:
    """Return the places along a side of a pixel over which a wave is averaged."""
    return min(max(math.ceil(SAMPLES_A_WAVE * side_m / wave_m), 1), MOST_SAMPLES)


@inlined
def length_of(vectors: Float64, p: int) -> float:
    """Return the length of row `p` of vectors (n, 3)."""
    return math.sqrt(vectors[p, 0] * vectors[p, 0] + vectors[p, 1] * vectors[p, 1] + vectors[p, 2] * vectors[p, 2])


@compiled
def add_noise(
    place_m: Float64, across_m: Float64, down_m: Float64, contrast: Float32, octaves: Octaves, out: Float32
) -> None:
    """Add the noise of surfaces in pixels to their brightness, as a share of it.

    Parameters
    ----------
    place_m : (n, 3) middles of what the pixels see, from the scene's origin.
    across_m, down_m : (n, 3) from there to what the next pixel of the row, and of the column, sees.
    contrast : (n,) standard deviation over all octaves, as a share.
    out : (n,)
    """
    for p in range(place_m.shape[0]):
        if contrast[p] <= 0.0:
            continue
        wide, high = length_of(across_m, p), length_of(down_m, p)
        total = 0.0
        for o in range(octaves.wavelength_m.size):
            wave = octaves.wavelength_m[o]
            seen = 1.0 - max(wide, high) / (GONE_WAVES * wave)
            if seen <= 0.0:
                continue
            columns, rows = places_along(wide, wave), places_along(high, wave)
            scale, value = 2.0 / wave, 0.0
            seed = octaves.seed + np.uint64(o)
            for a in range(columns):
                s = (a + 0.5) / columns - 0.5
                for b in range(rows):
                    t = (b + 0.5) / rows - 0.5
                    x = (place_m[p, 0] + s * across_m[p, 0] + t * down_m[p, 0]) * scale
                    y = (place_m[p, 1] + s * across_m[p, 1] + t * down_m[p, 1]) * scale
                    z = (place_m[p, 2] + s * across_m[p, 2] + t * down_m[p, 2]) * scale
                    value += noise_at(
                        R00 * x + R01 * y + R02 * z, R10 * x + R11 * y + R12 * z, R20 * x + R21 * y + R22 * z, seed
                    )
            total += octaves.share[o] * min(2.0 * seen, 1.0) * value / (columns * rows)
        out[p] += contrast[p] * total


@inlined
def brick_at(along_m: float, up_m: float, seed: np.uint64) -> float:
    """Return the brightness of a wall of bricks above the mean, in contrasts."""
    course = math.floor(up_m / COURSE_M)
    shifted = along_m / BRICK_M + 0.5 * (course % 2)
    brick = math.floor(shifted)
    if up_m - course * COURSE_M < MORTAR_M or (shifted - brick) * BRICK_M < MORTAR_M:
        return MORTAR_SHARE
    bits = mixed(mixed(seed ^ np.uint64(course + OFFSET)) ^ np.uint64(brick + OFFSET))
    return 1.5 * even(bits) - 0.25


@compiled
def add_bricks(
    wall_m: Float64, across_m: Float64, down_m: Float64, contrast: float, seed: np.uint64, out: Float32
) -> None:
    """Add the bricks of walls in pixels to their brightness, as a share of it.

    Parameters
    ----------
    wall_m : (n, 2) place on the wall: along it, and up.
    across_m, down_m : (n, 2) from there to what the next pixel of the row, and of the column, sees.
    out : (n,)
    """
    for p in range(wall_m.shape[0]):
        wide = math.hypot(across_m[p, 0], across_m[p, 1])
        high = math.hypot(down_m[p, 0], down_m[p, 1])
        seen = 1.0 - max(wide, high) / BRICKS_GONE_M
        if seen <= 0.0:
            continue
        columns, rows = places_along(wide, 4.0 * MORTAR_M), places_along(high, 4.0 * MORTAR_M)
        value = 0.0
        for a in range(columns):
            s = (a + 0.5) / columns - 0.5
            for b in range(rows):
                t = (b + 0.5) / rows - 0.5
                along = wall_m[p, 0] + s * across_m[p, 0] + t * down_m[p, 0]
                value += brick_at(along, wall_m[p, 1] + s * across_m[p, 1] + t * down_m[p, 1], seed)
        out[p] += contrast * min(2.0 * seen, 1.0) * value / (columns * rows)
