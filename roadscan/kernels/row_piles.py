"""Readings piled up by row of cells, until their tile is finished.

A turning mirror or a lidar looks elsewhere with every reading: counted into cells as they come, each reading would wait
for its cell's memory. So readings are first put on the pile of their row of cells in their tile: piles grow at their
ends only, and the ends of all rows stay in the second cache. A finished tile is taken row by row
(``kernels.pile_cells``).

A pile is a chain of *blocks* of `BLOCK` readings of one pass. A reading is a number of 64 bits, from the lowest: its
column in the tile (16), its intensity (16), its height in quanta (32).
"""

from __future__ import annotations

import numpy as np

from roadscan.kernels.georeference import CLASS_KEPT, KEPT, OUTSIDE
from roadscan.kernels.line_access import fetch_line
from roadscan.kernels.options import bare, bare_inlined

BLOCK = 64
"""Readings of a block."""
_BITS = 6
_LINE = 8
"""Readings of a line of the cache, which is fetched while the one before it is filled."""
COLUMN, LIGHT_SHIFT, LIGHT, HEIGHT_SHIFT = np.uint64(0xFFFF), np.uint64(16), np.uint64(0xFFFF), np.uint64(32)

TAKEN, PASS = 0, 1
"""What `held` counts: blocks in use, and the pass of the readings that came last."""


@bare
def cells_of(east, north, classes, corner, per_cell, edge, across, along, column, row, place):
    """Cells in their tiles, and where those tiles stand in the box of all tiles; one loop without branches.

    Parameters
    ----------
    east, north : (n,) float64, whole quanta; classes : (n,) uint8; what is not CLASS_KEPT has no place.
    corner : (2,) tuple, south-west corner of the box (quanta); per_cell : cells a quantum.
    edge : int64, cells along a tile's edge; across, along : int64, tiles of the box.
    column, row, place : (n,) int32, out; place is −1 outside the box.
    """
    size, per_tile = np.float64(edge), 1.0 / edge
    for i in range(place.size):
        x = np.floor((east[i] - corner[0] + 0.5) * per_cell)
        y = np.floor((north[i] - corner[1] + 0.5) * per_cell)
        a, b = np.floor((x + 0.5) * per_tile), np.floor((y + 0.5) * per_tile)
        inside = (a >= 0.0) & (a < across) & (b >= 0.0) & (b < along) & (classes[i] == CLASS_KEPT)
        column[i] = np.int32(x - a * size) if inside else np.int32(0)
        row[i] = np.int32(y - b * size) if inside else np.int32(0)
        place[i] = np.int32(b * across + a) if inside else np.int32(-1)


@bare_inlined
def new_block(end, number, before, sizes, owners, free, held):
    """Take a block for a pile that ends at `end`; returns where its readings begin."""
    block = np.int64(free[held[TAKEN]])
    held[TAKEN] += 1
    before[block] = (end - 1) >> _BITS
    sizes[block] = BLOCK
    owners[block] = number
    return block << _BITS


@bare
def close_piles(ends, sizes):
    """End the last block of every pile: what comes next begins a new one."""
    flat = ends.reshape(-1)
    for k in range(flat.size):
        used = flat[k] & (BLOCK - 1)
        if used:
            sizes[flat[k] >> _BITS] = used
            flat[k] += BLOCK - used


@bare
def put_on_piles(
    column, row, place, height, epochs, intervals, intensity, gain, number, tile_rows, spans, sigmas, interval_sigmas,
    known, ends, piles,
):  # fmt: skip
    """Put readings of one pass on the piles of the active tiles; note their epochs and σ with the tiles.

    Parameters
    ----------
    column, row, place : (n,), from :func:`cells_of`; height : (n,) float64, whole quanta; epochs : (n,) int64.
    intervals : (n,) int32, of the trajectory; intensity : (n,) unsigned; gain : uint32, their product has 16 bits.
    number : int, of the pass among the accumulator's.
    tile_rows : (rows, columns) int32, −1 for tiles that are not active; spans : (a, 2) int64, in/out, first and last
    epoch of each active tile; sigmas : (a, 2) float64, in/out, largest σ of the poses; interval_sigmas : (k, 2).
    known : (a,) int32, in/out, interval whose σ each tile has already, −1 for none.
    ends : (a, edge) int32, in/out, where the next reading of each row goes; at a multiple of `BLOCK` (0 for a pile
    without readings) it goes into a new block.
    piles : tuple of records : (b · BLOCK,) uint64; before : (b,) int32, block before it in its pile, −1 for none;
    sizes : (b,) int32, readings of a block that is no pile's last one; owners : (b,) int32, pass; free : (b,) int32,
    stack of free blocks; held : (2,) int64. At least n blocks have to be free.

    Returns
    -------
    int, readings put on piles.
    """
    records, before, sizes, owners, free, held = piles
    tiles, flat, edge, found = tile_rows.reshape(-1), ends.reshape(-1), np.int64(ends.shape[1]), 0
    if held[PASS] != number:
        close_piles(ends, sizes)
        held[PASS] = number
    for i in range(place.size):
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
        pile = np.uint64(tile * edge + np.int64(row[i]))
        end = np.int64(flat[pile])
        if end & (BLOCK - 1) == 0:
            end = new_block(end, number, before, sizes, owners, free, held)
        light = np.uint64(gain) * np.uint64(intensity[i])
        level = np.uint64(np.uint32(np.int32(height[i])))
        records[np.uint64(end)] = np.uint64(column[i]) | (light << LIGHT_SHIFT) | (level << HEIGHT_SHIFT)
        fetch_line(records, np.uint64(end + _LINE))
        flat[pile] = np.int32(end + 1)
        found += 1
    return found


@bare
def put_on_own_piles(column, row, height, intensity, number, ends, piles):
    """Put readings of one pass on the piles of the tile that all of them lie in.

    column, row, height : (n,) int32; intensity : (n,) uint16; number : int, of the pass; ends : (edge,) int32, in/out,
    of the tile; piles : as in :func:`put_on_piles`.
    """
    records, before, sizes, owners, free, held = piles
    if held[PASS] != number:
        close_piles(ends, sizes)
        held[PASS] = number
    for i in range(np.uint64(column.size)):
        pile = np.uint64(row[i])
        end = np.int64(ends[pile])
        if end & (BLOCK - 1) == 0:
            end = new_block(end, number, before, sizes, owners, free, held)
        light, level = np.uint64(intensity[i]), np.uint64(np.uint32(height[i]))
        records[np.uint64(end)] = np.uint64(column[i]) | (light << LIGHT_SHIFT) | (level << HEIGHT_SHIFT)
        fetch_line(records, np.uint64(end + _LINE))
        ends[pile] = np.int32(end + 1)


@bare
def pile_up(
    east, north, height, classes, epochs, intervals, passes, intensity, gain, corner, cell_quanta, cells, tile_rows,
    spans, sigmas, interval_sigmas, known, ends, piles, fates,
):  # fmt: skip
    """Put placed readings on the piles of the active tiles.

    Parameters
    ----------
    east, north, height, classes : (n,), as ``place_returns`` gives them.
    passes : (n,) int32, −1 for a reading that is in none.
    corner : (2,) tuple of int64, south-west corner of tile_rows[0, 0] (quanta); cell_quanta : int64, edge of a cell.
    cells : tuple of column, row, place : (n,) int32, work.
    fates : (6,) int64, in/out: readings kept, and wanted ones outside the active tiles.
    Others as in :func:`put_on_piles`.
    """
    column, row, place = cells
    n, wanted, found, first = classes.size, 0, 0, 0
    along, across = np.int64(tile_rows.shape[0]), np.int64(tile_rows.shape[1])
    edge = np.int64(ends.shape[1])
    cells_of(east, north, classes, corner, 1.0 / cell_quanta, edge, across, along, column[:n], row[:n], place[:n])
    for i in range(n):
        wanted += classes[i] == CLASS_KEPT
    while first < n:
        end = first + 1
        while end < n and passes[end] == passes[first]:
            end += 1
        if passes[first] >= 0:
            found += put_on_piles(
                column[first:end], row[first:end], place[first:end], height[first:end], epochs[first:end],
                intervals[first:end], intensity[first:end], gain, passes[first], tile_rows, spans, sigmas,
                interval_sigmas, known, ends, piles,
            )  # fmt: skip
        first = end
    fates[KEPT] += found
    fates[OUTSIDE] += wanted - found


@bare_inlined
def height_of(record):
    """Height of a reading (quanta)."""
    return np.int32(np.int64(record) >> np.int64(HEIGHT_SHIFT))


@bare_inlined
def fetch_block(block, records):
    """A block's readings are wanted soon; −1 for none."""
    first = np.uint64(max(block, 0)) * np.uint64(BLOCK)
    for k in range(np.uint64(0), np.uint64(BLOCK), np.uint64(_LINE)):
        fetch_line(records, first + k)


@bare_inlined
def last_block(end):
    """Number of the last block of a pile that ends at `end`, −1 without readings."""
    return (np.int64(end) - 1) >> _BITS


@bare_inlined
def size_of(block, end, sizes):
    """Readings in a block of a pile that ends at `end`."""
    used = np.int64(end) & (BLOCK - 1)
    return used if used and block == np.int64(end) >> _BITS else np.int64(sizes[block])


@bare
def sizes_of_rows(ends, before, sizes):
    """Readings of a tile, and of its fullest row; ends : (edge,) int32, see :func:`put_on_piles`."""
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
def free_row(end, before, free, held):
    """Give the blocks of a pile back."""
    block = last_block(end)
    while block >= 0:
        held[TAKEN] -= 1
        free[held[TAKEN]] = block
        block = np.int64(before[block])


@bare
def take_piles(ends, piles, west, south, column, row, heights, passes, intensity):
    """Readings of a tile row by row, out of its piles, which are empty then.

    Parameters
    ----------
    ends : (edge,) int32, in/out, of the tile; piles : see :func:`put_on_piles`.
    west, south : int, the tile's first cell.
    column, row, passes : (≥ n,) int32, heights : (≥ n,) int32, intensity : (≥ n,) uint16, out.
    """
    records, before, sizes, owners, free, held = piles
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
        free_row(ends[y], before, free, held)
        ends[y] = 0
