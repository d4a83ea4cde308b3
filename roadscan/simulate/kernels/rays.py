"""Rays of spinning lidars, line scanners and cameras: where they meet road and things."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from roadscan.simulate.kernels.beams import (
    ROOT_TOLERANCE_M,
    along_beam,
    clearance,
    into_defect,
    through,
    turn_to_road,
)
from roadscan.simulate.kernels.options import compiled
from roadscan.simulate.kernels.road import RoadArrays, brightness, defect_depth, on_surface

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

LIDAR_TOLERANCE_M = 1e-7
"""The same for the lidar."""


@compiled
def bend(bases: Float64, axis: int, x: float, y: float, z: float) -> float:
    """Easting, northing or height (axis 0, 1, 2) of a point near an anchor: quadratic in its east, north, up.

    bases : (3, 10) coefficients of 1, x, y, z, x², xy, xz, y², yz, z².
    """
    east = x * (bases[axis, 1] + x * bases[axis, 4] + y * bases[axis, 5] + z * bases[axis, 6])
    north = y * (bases[axis, 2] + y * bases[axis, 7] + z * bases[axis, 8])
    value: float = bases[axis, 0] + east + north + z * (bases[axis, 3] + z * bases[axis, 9])
    return value


@compiled
def turned(rotations: Float64, p: int, share: float, axis: int, x: float, y: float, z: float) -> float:
    """One component of a sensor's vector in the anchor's frame, between the rotations of packet `p` and the next.

    Linear in time: over the 0.55 ms of a packet that is good to 10⁻⁸ at 10 degrees a second.
    """
    begin = rotations[p, axis, 0] * x + rotations[p, axis, 1] * y + rotations[p, axis, 2] * z
    end = rotations[p + 1, axis, 0] * x + rotations[p + 1, axis, 1] * y + rotations[p + 1, axis, 2] * z
    value: float = begin + share * (end - begin)
    return value


@compiled
def between(origins_m: Float64, p: int, share: float, axis: int) -> float:
    """One coordinate of the sensor between the beginning of packet `p` and the next."""
    value: float = origins_m[p, axis] + share * (origins_m[p + 1, axis] - origins_m[p, axis])
    return value


@compiled
def fire_lidar(
    road: RoadArrays,
    bases: Float64,
    origins_m: Float64,
    rotations: Float64,
    near: Int64,
    elevation: Float64,
    azimuth_rad: Float64,
    firing_share: Float64,
    limits_m: Float64,
    memory: Float64,
    beam: Float64,
    on_road: Float64,
    out: Float64,
) -> None:
    """Ranges of a spinning lidar's firings.

    Parameters
    ----------
    bases : (3, 10), see :func:`bend`.
    origins_m, rotations, near : (p + 1, 3) and (p + 1, 3, 3) pose of the sensor (x forward, y left, z up) in the
        anchor's east, north, up at the packets' beginnings and the last one's end, and (p + 1,) the node under it.
    elevation : (l, 3) sine and cosine of each laser's elevation, and its origin's height along the sensor's z (m).
    azimuth_rad : (p, c, l) clockwise from the sensor's x, seen from above.
    firing_share : (c, l) time of each firing within its packet, as a share of the packet's time.
    limits_m : (2,) nearest and farthest range measured.
    memory : (l, 3) NaN at first, see :func:`first_hit`.
    beam, on_road : (3, 3) scratch.
    out : (p, c, l, 5) range, easting, northing, height (m), intensity; all NaN: no return.
    """
    packets, cycles, lasers = azimuth_rad.shape
    reach = 0.5 * limits_m[1]
    for p in range(packets):
        for c in range(cycles):
            for j in range(lasers):
                for i in range(5):
                    out[p, c, j, i] = np.nan
                share = firing_share[c, j]
                forward = elevation[j, 1] * math.cos(azimuth_rad[p, c, j])
                left = -elevation[j, 1] * math.sin(azimuth_rad[p, c, j])
                up = elevation[j, 0]
                rise = elevation[j, 2]
                dx = reach * turned(rotations, p, share, 0, forward, left, up)
                dy = reach * turned(rotations, p, share, 1, forward, left, up)
                dz = reach * turned(rotations, p, share, 2, forward, left, up)
                if dz > -0.01 * reach:
                    memory[j, 0] = np.nan
                    continue
                x = between(origins_m, p, share, 0) + turned(rotations, p, share, 0, 0.0, 0.0, rise)
                y = between(origins_m, p, share, 1) + turned(rotations, p, share, 1, 0.0, 0.0, rise)
                z = between(origins_m, p, share, 2) + turned(rotations, p, share, 2, 0.0, 0.0, rise)
                for axis in range(3):
                    first = bend(bases, axis, x, y, z)
                    second = bend(bases, axis, x + dx, y + dy, z + dz)
                    third = bend(bases, axis, x + 2.0 * dx, y + 2.0 * dy, z + 2.0 * dz)
                    through(beam, axis, reach, first, second, third)
                found, k, u, offset, depth = first_hit(road, beam, on_road, limits_m, near[p], memory, j)
                if math.isnan(found) or not on_surface(road, k, u, offset):
                    continue
                out[p, c, j, 0] = found
                for axis in range(3):
                    out[p, c, j, 1 + axis] = along_beam(beam, axis, found)
                out[p, c, j, 4] = brightness(road, k, u, offset, depth, 0.0)


@compiled
def first_hit(
    road: RoadArrays,
    beam: Float64,
    on_road: Float64,
    limits_m: Float64,
    near: int,
    memory: Float64,
    laser: int,
) -> tuple[float, int, float, float, float]:
    """Range at which a beam meets the road, with node, u, offset and depth of the defect there; NaN: it does not.

    The surface without defects is met once by beams steeper than its slopes; the shallower ones are out of range.

    beam : (3, 3) of easting, northing, height, in place of station, offset, height; on_road : (3, 3) scratch;
    limits_m : (2,) nearest and farthest range; near : node to start from;
    memory : (lasers, 3) where the laser's last two beams met that surface (m, NaN: nowhere), and its slope along the
    last; in and out.
    """
    guess = 2.0 * memory[laser, 0] - memory[laser, 1]
    if math.isnan(guess):
        guess = memory[laser, 0]
    r, k, u, offset = chased_range(road, beam, limits_m, near, guess, memory, laser)
    if math.isnan(r):
        r, k, u, offset = bracketed_range(road, beam, limits_m, near)
        memory[laser, 2] = 0.0
    memory[laser, 1] = memory[laser, 0]
    memory[laser, 0] = r
    if math.isnan(r):
        return r, k, u, offset, 0.0
    depth, _ = defect_depth(road, k, u, offset)
    found = r
    if depth > 0.0:
        fall = -(beam[2, 1] + 2.0 * r * beam[2, 2])
        for row in range(3):
            for column in range(3):
                on_road[row, column] = beam[row, column]
        turn_to_road(road, on_road, r, 0.1, k)
        further, depth = into_defect(road, on_road, 0.0, fall)
        found = r + further
        _, k, u, offset = clearance(road, beam, found, k)
    return found, k, u, offset, depth


@compiled
def chased_range(
    road: RoadArrays,
    beam: Float64,
    limits_m: Float64,
    near: int,
    guess_m: float,
    memory: Float64,
    laser: int,
) -> tuple[float, int, float, float]:
    """Range, node, u and offset where a beam meets the surface without defects, by the secant from a guess.

    NaN where there is no guess, or it leads nowhere within a few steps.
    """
    k, u, offset = near, 0.0, 0.0
    r = guess_m
    descent = -(beam[2, 1] + 2.0 * r * beam[2, 2])
    fall = descent + memory[laser, 2]
    last_gap, moved = 0.0, 0.0
    for _ in range(6):
        if not limits_m[0] <= r <= limits_m[1] or fall < 0.02:
            break
        gap, k, u, offset = clearance(road, beam, r, k)
        if abs(moved) > 1e-5:
            fall = (last_gap - gap) / moved
            memory[laser, 2] = fall - descent
        if abs(gap) < LIDAR_TOLERANCE_M:
            return r, k, u, offset
        last_gap = gap
        moved = gap / fall
        r += moved
    return np.nan, k, u, offset


@compiled
def bracketed_range(road: RoadArrays, beam: Float64, limits_m: Float64, near: int) -> tuple[float, int, float, float]:
    """Range, node, u and offset where a beam meets the surface without defects; NaN: not within the limits."""
    low, high = limits_m[0], limits_m[1]
    high_gap, k, u, offset = clearance(road, beam, high, near)
    if high_gap > 0.0:
        return np.nan, k, u, offset
    low_gap, k, u, offset = clearance(road, beam, low, near)
    if low_gap <= 0.0:
        return np.nan, k, u, offset
    r = low
    side = 0
    for _ in range(60):
        r = (low * high_gap - high * low_gap) / (high_gap - low_gap)
        gap, k, u, offset = clearance(road, beam, r, k)
        if abs(gap) < ROOT_TOLERANCE_M or high - low < ROOT_TOLERANCE_M:
            break
        if gap > 0.0:
            low, low_gap = r, gap
            if side == 1:
                high_gap *= 0.5
            side = 1
        else:
            high, high_gap = r, gap
            if side == -1:
                low_gap *= 0.5
            side = -1
    return r, k, u, offset
