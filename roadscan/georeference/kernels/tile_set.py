"""Sets of tiles with weights: the tiles that a row group touches."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, kernel

_SPREAD = np.uint64(0x9E3779B97F4A7C15)
"""2⁶⁴ over the golden ratio: the multiplier of Knuth's multiplicative hashing."""


class TileSet(NamedTuple):
    """A set of tiles of fixed capacity, reused for all row groups; the caller keeps the number of tiles."""

    tile_m: float
    """Edge of a tile."""
    slots: npt.NDArray[np.int32]
    """(4 most,) a tile's place + 1, or 0: an open hash table (Knuth 1998, The Art of Computer Programming 3, 6.4)."""
    tiles: npt.NDArray[np.int64]
    """(most, 3) column, row, slot."""
    weights: npt.NDArray[np.float64]
    """(most,)"""


@kernel
def tile_set(most, tile_m):
    """Return an empty set for up to `most` tiles, a power of two; tile_m: edge of a tile."""
    return TileSet(tile_m, np.zeros(4 * most, np.int32), np.zeros((most, 3), np.int64), np.zeros(most))


@kernel
def add_tile(column, row, weight, found, count):
    """Add a tile, or add weight to one in the set; return the number of tiles, −1 where the set is full."""
    _, slots, tiles, weights = found
    mask = np.int64(slots.size - 1)
    key = (np.uint64(np.int64(column)) << np.uint64(32)) ^ (np.uint64(np.int64(row)) & np.uint64(0xFFFFFFFF))
    slot = np.int64((key * _SPREAD) >> np.uint64(32)) & mask
    while slots[slot] > 0:
        at = slots[slot] - 1
        if tiles[at, 0] == column and tiles[at, 1] == row:
            weights[at] += weight
            return count
        slot = (slot + 1) & mask
    if count == weights.size:
        return -1
    slots[slot] = count + 1
    tiles[count, 0] = column
    tiles[count, 1] = row
    tiles[count, 2] = slot
    weights[count] = weight
    return count + 1


@inlined
def strip(e, n, total, margin):
    """Return the strip along a direction (e, n) that contains a zonotope: x + slope · y lies in [−width, width].

    total : Σ |n × g| over the zonotope's generators g. Directions along the rows say nothing of x.
    """
    if abs(n) < 1e-6:
        return 0.0, np.inf
    return -e / n, (total + margin * (abs(e) + abs(n))) / abs(n)


@inlined
def crossed(e, n, g):
    """Return Σ |(e, n) × g_i| over four generators (e0, n0, e1, n1, …)."""
    return (
        abs(e * g[1] - n * g[0]) + abs(e * g[3] - n * g[2]) + abs(e * g[5] - n * g[4]) + abs(e * g[7] - n * g[6])
    )  # fmt: skip


@inlined
def inside(slope, width, y0, y1, low, high):
    """Return the part of [low, high] in a row of tiles between y0 and y1 that lies in a strip."""
    a, b = slope * y0, slope * y1
    return max(low, -width - max(a, b)), min(high, width - min(a, b))


@kernel
def mark_zonotope(centre_e, centre_n, g, margin, disk, found, count):
    """Add all tiles that a zonotope touches: centre + Σ t_i g_i with |t_i| ≤ 1, grown by a margin, cut to a disk.

    A tile is left out only where an edge of the zonotope separates them (separating axes of convex sets; Ericson
    2005, Real-Time Collision Detection, section 4.4), or the disk does.

    Parameters
    ----------
    centre_e, centre_n : map, m; g : (8,) tuple, e and n of four generators (m), any of them zero.
    margin : m, along both axes; disk : (3,) tuple, map position of its centre, its radius (m), which may be infinite.

    Returns
    -------
    int, how many tiles the set holds, −1 where they are too many.
    """
    tile_m, most = found.tile_m, found.weights.size
    half_e = abs(g[0]) + abs(g[2]) + abs(g[4]) + abs(g[6]) + margin
    half_n = abs(g[1]) + abs(g[3]) + abs(g[5]) + abs(g[7]) + margin
    disk_e, disk_n, radius = disk[0] - centre_e, disk[1] - centre_n, disk[2]
    south, north = max(-half_n, disk_n - radius), min(half_n, disk_n + radius)
    west, east = max(-half_e, disk_e - radius), min(half_e, disk_e + radius)
    if not (east - west <= tile_m * most and north - south <= tile_m * most):
        return -1
    first_row, last_row = math.floor((centre_n + south) / tile_m), math.floor((centre_n + north) / tile_m)
    first, last = math.floor((centre_e + west) / tile_m), math.floor((centre_e + east) / tile_m)
    if first_row == last_row and first == last:
        return add_tile(first, first_row, 0.0, found, count)
    slope0, width0 = strip(g[0], g[1], crossed(g[0], g[1], g), margin)
    slope1, width1 = strip(g[2], g[3], crossed(g[2], g[3], g), margin)
    slope2, width2 = strip(g[4], g[5], crossed(g[4], g[5], g), margin)
    slope3, width3 = strip(g[6], g[7], crossed(g[6], g[7], g), margin)
    for row in range(first_row, last_row + 1):
        y0 = max(row * tile_m - centre_n, south)
        y1 = min((row + 1) * tile_m - centre_n, north)
        low, high = inside(slope0, width0, y0, y1, west, east)
        low, high = inside(slope1, width1, y0, y1, low, high)
        low, high = inside(slope2, width2, y0, y1, low, high)
        low, high = inside(slope3, width3, y0, y1, low, high)
        away = max(y0 - disk_n, disk_n - y1, 0.0)
        across = math.sqrt(max(radius * radius - away * away, 0.0))
        low, high = max(low, disk_e - across), min(high, disk_e + across)
        if low > high:
            continue
        for column in range(math.floor((centre_e + low) / tile_m), math.floor((centre_e + high) / tile_m) + 1):
            count = add_tile(column, row, 0.0, found, count)
            if count < 0:
                return count
    return count


@kernel
def empty(found, count):
    """Empty a set of `count` tiles, or a full one (−1)."""
    if count < 0:
        found.slots[:] = 0
    for i in range(count):
        found.slots[found.tiles[i, 2]] = 0


@kernel
def take(group, found, count, made, out_tiles, out_readings):
    """Append a group's tiles to the `made` rows of the output, and empty the set.

    Returns
    -------
    out_tiles : (n, 3) int64, group, column, row; grown where it was full.
    out_readings : (n,) int64, weights rounded up, at least 1.
    made : int, rows now written.
    """
    if made + max(count, 0) > out_readings.size:
        size = 2 * (made + count)
        more_tiles, more_readings = np.empty((size, 3), np.int64), np.empty(size, np.int64)
        for i in range(made):  # a slice assignment takes four seconds to compile, because of its error message
            more_readings[i] = out_readings[i]
            for k in range(3):
                more_tiles[i, k] = out_tiles[i, k]
        out_tiles, out_readings = more_tiles, more_readings
    for i in range(count):
        out_tiles[made, 0] = group
        out_tiles[made, 1] = found.tiles[i, 0]
        out_tiles[made, 2] = found.tiles[i, 1]
        out_readings[made] = max(np.int64(math.ceil(found.weights[i] - 1e-6)), 1)
        made += 1
    empty(found, count)
    return out_tiles, out_readings, made


@kernel
def block_ranges(ranges, size):
    """Return the least and greatest raw range of each block of readings.

    Parameters
    ----------
    ranges : (n, m) uint16, 0 no return; size : readings of a block, the last may have fewer.

    Returns
    -------
    low, high : (n, ceil(m / size)) uint16, 0 where a block has no return.
    """
    n, m = ranges.shape
    blocks = (m + size - 1) // size
    low, high = np.zeros((n, blocks), np.uint16), np.zeros((n, blocks), np.uint16)
    for i in range(n):
        for b in range(blocks):
            near, far = 65536, 0
            for j in range(b * size, min((b + 1) * size, m)):
                value = np.int64(ranges[i, j])
                far = max(far, value)
                near = min(near, value if value > 0 else 65536)
            if far > 0:
                low[i, b] = near
                high[i, b] = far
    return low, high
