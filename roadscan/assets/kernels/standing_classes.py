"""Classes of stationary returns beside and over the road, by the features of their cubes."""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import kernel

LEAFY, WALL, WIRE, ALONE = 1, 2, 4, 8
"""Bits of a cube."""


@kernel
def standing_classes(above, number, cubes, place, sensor, limits, codes, out):
    """Give returns without a class the class of what stands there.

    above : (n,) float32, heights above the ground (m). number : (n,) int32 cube of each return, −1 of none. cubes :
    (k,) uint8 bits of each cube. place, sensor : three (n,) arrays, x, y and height (m). limits : (height of what lies
    on the ground, heights from which vegetation is medium and high, how near a lone return is noise (m)). codes :
    classes: none, low, medium and high vegetation, building, wire, noise. out : (n,) uint8, changed where it holds
    none.
    """
    for k in range(out.size):
        if out[k] != codes[0]:
            continue
        h = above[k]
        if number[k] < 0:
            if abs(h) < limits[0]:
                out[k] = codes[1]
            continue
        bits = cubes[number[k]]
        if bits & LEAFY:
            out[k] = codes[1] if h < limits[1] else codes[2] if h < limits[2] else codes[3]
        if bits & WALL:
            out[k] = codes[4]
        if bits & WIRE:
            out[k] = codes[5]
        if bits & ALONE:
            dx, dy, dz = place[0][k] - sensor[0][k], place[1][k] - sensor[1][k], place[2][k] - sensor[2][k]
            if math.sqrt(dx * dx + dy * dy + dz * dz) < limits[3]:
                out[k] = codes[6]
