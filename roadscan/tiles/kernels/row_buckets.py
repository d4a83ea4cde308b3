"""Buckets collect readings by row of cells until their tile is finished; the tiles that are counted into.

Successive readings of a rotating mirror or a lidar fall into distant cells: counted one by one, each reading would wait
for its cell's memory. So readings are first put into the bucket of their row of cells in their tile: buckets grow at
their ends only, and the ends of all rows stay in the second-level cache. A finished tile is processed row by row
(``tiles.kernels.bucket_statistics``).

A bucket is a chain of *blocks* of `BLOCK` readings of one pass. A reading is a number of 64 bits, from the lowest: its
column in the tile (16), its intensity (16), its height in quanta (32).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare, bare_inlined, bare_inner
from roadscan.compute.kernels.slots import prefetch
from roadscan.georeference.kernels.readings import CLASS_KEPT, KEPT, OUTSIDE

BLOCK = 64
"""Readings in a block."""
_BITS = 6  # Binary logarithm of BLOCK.
_LINE = 8
"""Readings in a cache line; the next line is fetched while one is filled."""
COLUMN, LIGHT_SHIFT, LIGHT, HEIGHT_SHIFT = np.uint64(0xFFFF), np.uint64(16), np.uint64(0xFFFF), np.uint64(32)  # Fields.

TAKEN, PASS = 0, 1
"""Indices of `held`: number of blocks in use, and the pass of the latest readings."""


class Buckets(NamedTuple):
    """Memory of all buckets: b blocks.

    Where the next reading of a bucket goes is its *end*; at a multiple of `BLOCK` (0 for a bucket without readings) it
    goes into a new block.
    """

    records: npt.NDArray[np.uint64]
    """(b · BLOCK,) readings."""
    before: npt.NDArray[np.int32]
    """(b,) previous block of the bucket, −1 for none."""
    sizes: npt.NDArray[np.int32]
    """(b,) number of readings in a block that is not the last one of its bucket."""
    owners: npt.NDArray[np.int32]
    """(b,) number of the readings' pass."""
    free: npt.NDArray[np.int32]
    """(b,) stack of free blocks."""
    held: npt.NDArray[np.int64]
    """(2,) TAKEN, PASS."""


class Places(NamedTuple):
    """Cells of readings in their tiles; working memory."""

    column: npt.NDArray[np.int32]
    """(n,)"""
    row: npt.NDArray[np.int32]
    """(n,)"""
    tile: npt.NDArray[np.int32]
    """(n,) index of the tile in the box of all tiles, row by row; −1 outside it."""
    known: npt.NDArray[np.int32]
    """(a,) trajectory interval whose σ each active tile has already, −1 for none."""


@bare_inner
def find_places(placed, n, active, places):
    """Write the cells of the first n georeferenced readings into `places`, in one loop without branches.

    placed : Georeferenced, of which what is not CLASS_KEPT has no place; active : ActiveTiles.
    """
    east, north, _, classes, _ = placed
    corner, per_cell, edge = active.corner_quanta, 1.0 / active.cell_quanta, np.int64(active.ends.shape[1])
    along, across = np.int64(active.rows.shape[0]), np.int64(active.rows.shape[1])
    column, row, place, _ = places
    size, per_tile = np.float64(edge), 1.0 / edge
    for i in range(n):
        x = np.floor((east[i] - corner[0] + 0.5) * per_cell)
        y = np.floor((north[i] - corner[1] + 0.5) * per_cell)
        a, b = np.floor((x + 0.5) * per_tile), np.floor((y + 0.5) * per_tile)
        inside = (a >= 0.0) & (a < across) & (b >= 0.0) & (b < along) & (classes[i] == CLASS_KEPT)
        column[i] = np.int32(x - a * size) if inside else np.int32(0)
        row[i] = np.int32(y - b * size) if inside else np.int32(0)
        place[i] = np.int32(b * across + a) if inside else np.int32(-1)


@bare_inlined
def new_block(end, number, buckets):
    """Take a block for a bucket that ends at `end`; return where its readings begin."""
    held = buckets.held
    block = np.int64(buckets.free[held[TAKEN]])
    held[TAKEN] += 1
    buckets.before[block] = (end - 1) >> _BITS
    buckets.sizes[block] = BLOCK
    buckets.owners[block] = number
    return block << _BITS


@bare_inner
def close_buckets(ends, sizes):
    """Close the last block of every bucket, so that the next reading begins a new one."""
    flat = ends.reshape(-1)
    for k in range(flat.size):
        used = flat[k] & (BLOCK - 1)
        if used:
            sizes[flat[k] >> _BITS] = used
            flat[k] += BLOCK - used


@bare_inner
def put_in_buckets(placed, measured, first, end, places, active, buckets):
    """Put readings `first` to `end` − 1, of one pass, into the buckets of the active tiles.

    Their epochs and σ are noted with the tiles.

    Parameters
    ----------
    placed : Georeferenced; measured : Measured; places : from :func:`find_places`; active : ActiveTiles.
    buckets : Buckets, of which as many blocks as there are readings have to be free.

    Returns
    -------
    int, readings put into buckets.
    """
    number, gain, interval_sigmas = measured.passes[first], measured.gain, measured.interval_sigmas_m
    epochs, intensity, intervals, height = measured.epochs, measured.intensity, placed.intervals, placed.height
    column, row, place, known = places
    spans, sigmas, ends, records = active.spans, active.sigmas, active.ends, buckets.records
    tiles, flat, edge, found = active.rows.reshape(-1), ends.reshape(-1), np.int64(ends.shape[1]), 0
    if buckets.held[PASS] != number:
        close_buckets(ends, buckets.sizes)
        buckets.held[PASS] = number
    for i in range(np.uint64(first), np.uint64(end)):
        if place[i] < 0:
            continue
        tile = np.int64(tiles[np.uint64(place[i])])
        if tile < 0:
            continue
        if known[tile] != intervals[i]:
            k = known[tile] = intervals[i]
            sigmas[tile, 0] = max(sigmas[tile, 0], interval_sigmas[k, 0])
            sigmas[tile, 1] = max(sigmas[tile, 1], interval_sigmas[k, 1])
        spans[tile, 0] = min(spans[tile, 0], epochs[i])
        spans[tile, 1] = max(spans[tile, 1], epochs[i])
        bucket = np.uint64(tile * edge + np.int64(row[i]))
        at = np.int64(flat[bucket])
        if at & (BLOCK - 1) == 0:
            at = new_block(at, number, buckets)
        light = np.uint64(gain) * np.uint64(intensity[i])
        level = np.uint64(np.uint32(np.int32(height[i])))
        records[np.uint64(at)] = np.uint64(column[i]) | (light << LIGHT_SHIFT) | (level << HEIGHT_SHIFT)
        prefetch(records, np.uint64(at + _LINE))
        flat[bucket] = np.int32(at + 1)
        found += 1
    return found


@bare
def put_in_own_buckets(column, row, height, intensity, number, ends, buckets):
    """Put readings of one pass into the buckets of the tile that contains all of them.

    column, row, height : (n,) int32; intensity : (n,) uint16; number : int, of the pass; ends : (edge,) int32, in/out,
    of the tile's buckets; buckets : Buckets.
    """
    records = buckets.records
    if buckets.held[PASS] != number:
        close_buckets(ends, buckets.sizes)
        buckets.held[PASS] = number
    for i in range(np.uint64(column.size)):
        bucket = np.uint64(row[i])
        end = np.int64(ends[bucket])
        if end & (BLOCK - 1) == 0:
            end = new_block(end, number, buckets)
        light, level = np.uint64(intensity[i]), np.uint64(np.uint32(height[i]))
        records[np.uint64(end)] = np.uint64(column[i]) | (light << LIGHT_SHIFT) | (level << HEIGHT_SHIFT)
        prefetch(records, np.uint64(end + _LINE))
        ends[bucket] = np.int32(end + 1)


@bare
def fill_buckets(placed, measured, places, active, buckets, fates):
    """Put georeferenced readings into the buckets of the active tiles.

    Parameters
    ----------
    placed : Georeferenced, first of which are the readings; measured : Measured, of n readings; places : Places, work.
    active : ActiveTiles; buckets : Buckets, of which n blocks have to be free.
    fates : (≥ FATES,) int64, in/out: readings kept, and wanted ones outside the active tiles.
    """
    passes = measured.passes
    n, wanted, found, first = passes.size, 0, 0, 0
    find_places(placed, n, active, places)
    for i in range(n):
        wanted += placed.classes[i] == CLASS_KEPT
    while first < n:
        end = first + 1
        while end < n and passes[end] == passes[first]:
            end += 1
        if passes[first] >= 0:
            found += put_in_buckets(placed, measured, first, end, places, active, buckets)
        first = end
    fates[KEPT] += found
    fates[OUTSIDE] += wanted - found


@bare_inlined
def height_of(record):
    """Return the height of a reading (quanta)."""
    return np.int32(np.int64(record) >> np.int64(HEIGHT_SHIFT))


@bare_inlined
def fetch_block(block, records):
    """Prefetch the readings of a block; −1 for none."""
    first = np.uint64(max(block, 0)) * np.uint64(BLOCK)
    for k in range(np.uint64(0), np.uint64(BLOCK), np.uint64(_LINE)):
        prefetch(records, first + k)


@bare_inlined
def last_block(end):
    """Return the last block of a bucket that ends at `end`, −1 without readings."""
    return (np.int64(end) - 1) >> _BITS


@bare_inlined
def size_of(block, end, sizes):
    """Return the number of readings in a block of a bucket that ends at `end`."""
    used = np.int64(end) & (BLOCK - 1)
    return used if used and block == np.int64(end) >> _BITS else np.int64(sizes[block])


@bare
def sizes_of_rows(ends, before, sizes):
    """Return the number of readings of a tile, and of its fullest row; ends: (edge,) int32, of its buckets."""
    total, most = np.int64(0), np.int64(0)
    for y in range(ends.size):
        own, block = np.int64(0), last_block(ends[y])
        while block >= 0:
            own += size_of(block, ends[y], sizes)
            block = np.int64(before[block])
        total += own
        most = max(most, own)
    return total, most


@bare
def free_row(end, buckets):
    """Free the blocks of a bucket."""
    before, free, held = buckets.before, buckets.free, buckets.held
    block = last_block(end)
    while block >= 0:
        held[TAKEN] -= 1
        free[held[TAKEN]] = block
        block = np.int64(before[block])


@bare
def take_readings(ends, buckets, west, south, readings, passes, intensity):
    """Move the readings of a tile out of its buckets, row by row.

    Parameters
    ----------
    ends : (edge,) int32, in/out, of the tile's buckets, which are empty then; buckets : Buckets.
    west, south : int, the tile's first cell.
    readings : Heights, passes : (≥ n,) int32, intensity : (≥ n,) uint16, out.
    """
    records, before, sizes, owners, _, _ = buckets
    column, row, heights = readings
    n = 0
    for y in range(ends.size):
        block = last_block(ends[y])
        while block >= 0:
            for k in range(size_of(block, ends[y], sizes)):
                record = records[(block << _BITS) + k]
                column[n], row[n] = west + np.int64(record & COLUMN), south + y
                heights[n] = height_of(record)
                passes[n], intensity[n] = owners[block], np.uint16((record >> LIGHT_SHIFT) & LIGHT)
                n += 1
            block = np.int64(before[block])
        free_row(ends[y], buckets)
        ends[y] = 0


class ActiveTiles(NamedTuple):
    """Active tiles in a box of tiles; each has a row in the arrays of (a, …)."""

    rows: npt.NDArray[np.int32]
    """(rows, columns) of the box: the row of each tile, −1 for tiles that are not active."""
    corner_quanta: tuple[int, int]
    """South-west corner of the box."""
    cell_quanta: int
    """Edge of a cell."""
    edge: int
    """Cells along a tile's edge."""
    groups: npt.NDArray[np.int32]
    """(a, edge · ⌈edge / 16⌉) pool element of each group of sixteen cells, −1 where it has none."""
    ends: npt.NDArray[np.int32]
    """(a, edge) position for the next reading in each row's bucket (``row_buckets.Buckets``)."""
    spans: npt.NDArray[np.int64]
    """(a, 2) first and last epoch of the readings, GPS ns; in/out."""
    sigmas: npt.NDArray[np.float64]
    """(a, 2) largest horizontal and vertical 1 σ of the poses (m); in/out."""


class Measured(NamedTuple):
    """Attributes of readings, or of profiles, besides their position."""

    epochs: npt.NDArray[np.int64]
    """(n,) GPS ns of the measurement."""
    passes: npt.NDArray[np.int32]
    """(n,) index of the pass among the accumulator's, −1 for none."""
    intensity: npt.NDArray[np.unsignedinteger]
    """(n,), for profiles (n, m)."""
    gain: np.uint32
    """Factor on the intensity; the product takes at most 16 bits."""
    interval_sigmas_m: npt.NDArray[np.float64]
    """(intervals of the trajectory, 2) largest horizontal and vertical 1 σ of the poses."""
