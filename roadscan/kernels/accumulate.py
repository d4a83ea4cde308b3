"""Readings → cells in one pass: of each reading its height is kept until the tile is finished, and nothing else.

The cells of a tile are taken sixteen at a time, side by side along a row: a *group*. When the first reading falls
into a group, it gets an *element* of the pool: `SLOTS` heights for each of its cells, as differences from the
element's base. A cell with more readings, or with heights too far from the base for 16 bits, makes the group's
chain of elements longer. What is kept depends on the order of the readings only until it is sorted
(``kernels.cells``).

Neighbouring readings of a profile mostly lie in one cell, so readings are counted in *runs*: what has to be looked
up is looked up once a run, and the heights of a run are stored as one vector.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.kernels.options import inlined, kernel

LANES = 16
"""Cells of a group."""
SLOTS = 40
"""Heights that an element holds of each cell: 64 bytes, a line of the cache."""
FARTHEST = 32_000
"""Largest difference (quanta) between a height and the base of its element."""
NOWHERE = -(1 << 30)
"""Column of a reading that is not to be counted: outside every tile."""
VECTOR = 8
"""Heights of a run that are stored at once."""
PIECE = 512
"""Readings worked on together: their working arrays stay in the first cache."""


@inlined
def new_element(bases, chain, free, held, height):
    """Take an element from the stack of free ones; `held` (1,) counts those in use."""
    e = free[held[0]]
    held[0] += 1
    bases[e] = height
    chain[e] = -1
    return e


@inlined
def element_with_room(bases, chain, filled, free, held, head, lane, height):
    """Element of the chain from `head` with room for one more height of a cell; a new one where there is none."""
    e = head
    while not (filled[e, lane] < SLOTS and abs(height - bases[e]) <= FARTHEST):
        if chain[e] < 0:
            chain[e] = new_element(bases, chain, free, held, height)
        e = chain[e]
    return e


@inlined
def find_runs(column, row, starts):
    """Where readings of another cell begin: (n + 1,) int32, out, the last one n. Returns how many runs there are."""
    runs = 0
    last_column, last_row = column[0] + np.int32(1), row[0]
    for j in range(column.size):
        new = (column[j] != last_column) | (row[j] != last_row)
        last_column, last_row = column[j], row[j]
        starts[runs] = j
        runs += new
    starts[runs] = column.size
    return runs


@inlined
def sum_up(intensity, gain, sums):
    """Sums of the intensities, times `gain`, before each reading: (n + 1,) uint32, out."""
    total = np.uint32(0)
    for j in range(intensity.size):
        sums[j] = total
        total += gain * np.uint32(intensity[j])
    sums[intensity.size] = total


@inlined
def store_run(heights, first, offset, slots, at):
    """Store VECTOR heights, moved by `offset`; all are read before one is written, so that they are one vector."""
    h = heights
    a, b, c, d = h[first], h[first + np.uint64(1)], h[first + np.uint64(2)], h[first + np.uint64(3)]
    e, f, g, k = h[first + np.uint64(4)], h[first + np.uint64(5)], h[first + np.uint64(6)], h[first + np.uint64(7)]
    slots[at] = np.int16(a + offset)
    slots[at + np.uint64(1)] = np.int16(b + offset)
    slots[at + np.uint64(2)] = np.int16(c + offset)
    slots[at + np.uint64(3)] = np.int16(d + offset)
    slots[at + np.uint64(4)] = np.int16(e + offset)
    slots[at + np.uint64(5)] = np.int16(f + offset)
    slots[at + np.uint64(6)] = np.int16(g + offset)
    slots[at + np.uint64(7)] = np.int16(k + offset)


@kernel
def accumulate(
    column, row, heights, low, high, intensity, gain, word, bit, starts, sums,
    tile_rows, groups, edge, slots, bases, chain, filled, light, marks, free, held, touched,
):  # fmt: skip
    """Count readings into the cells of active tiles.

    Parameters
    ----------
    column, row : (n,) int32, cells from the south-west corner of tile_rows[0, 0]; column NOWHERE for readings that a
    filter leaves out.
    heights : (n + VECTOR,) int32, quanta of the map; what follows the n-th is read, but not counted.
    low, high : int, no height lies below or above.
    intensity : (n,) unsigned; gain : uint32; their product takes at most 16 bits.
    word, bit : int, uint8; place of the readings' pass in `marks`.
    starts : (n + 1,) int32, sums : (n + 1,) uint32, work.
    tile_rows : (rows, columns) int32, row of each tile in `groups`; −1 for tiles that are not active.
    groups : (a, edge · ⌈edge / 16⌉) int32, first element of each group of a tile, −1 where it has none.
    edge : int64, cells along a tile's edge.
    slots : (c, LANES, SLOTS) int16; bases, chain : (c,) int32; filled : (c, LANES) uint8.
    light : (c, LANES) uint32, sum of intensities; marks : (c, LANES, w) uint8, bits of passes.
    free : (c,) int32, stack of free elements; held : (1,) int64, how many are in use. At least 2 n have to be free.
    touched : (a,) uint8, out, 1 for each active tile that got a reading.

    Returns
    -------
    int, how many readings were counted; the other wanted ones lie outside the active tiles.
    """
    per_row, per_tile = (edge + LANES - 1) // LANES, groups.shape[1]
    table, flat, fills = groups.reshape(-1), slots.reshape(-1), filled.reshape(-1)
    lights, bits, words = light.reshape(-1), marks.reshape(-1), marks.shape[2]
    counted = 0
    west, south, tile = -(1 << 40), -(1 << 40), -1
    sum_up(intensity, gain, sums)
    for run in range(find_runs(column, row, starts)):
        first, end = starts[run], starts[run + 1]
        x, y = np.int64(column[first]), np.int64(row[first])
        if not (west <= x < west + edge and south <= y < south + edge):
            across, along = x // edge, y // edge
            west, south, tile = across * edge, along * edge, -1
            if 0 <= along < tile_rows.shape[0] and 0 <= across < tile_rows.shape[1]:
                tile = tile_rows[along, across]
                if tile >= 0:
                    touched[tile] = 1
        if tile < 0:
            continue
        place = np.uint64(tile * per_tile + (y - south) * per_row + ((x - west) >> 4))
        lane = np.uint64((x - west) & 15)
        found = table[place]
        if found < 0:
            found = new_element(bases, chain, free, held, heights[first])
            table[place] = found
        head = np.uint64(found)
        base = np.int64(bases[head])
        counted += end - first
        cell = head * np.uint64(LANES) + lane
        slot = np.uint64(fills[cell])
        near = (low - base >= -FARTHEST) & (high - base <= FARTHEST)
        if not near:  # a stray reading among the others is no reason to take them one by one
            near = True
            for j in range(first, end):
                near &= abs(heights[j] - base) <= FARTHEST
        if near & (slot <= np.uint64(SLOTS - VECTOR)) & (end - first <= VECTOR):
            store_run(heights, np.uint64(first), -np.int32(base), flat, cell * np.uint64(SLOTS) + slot)
            fills[cell] = slot + np.uint64(end - first)
            lights[cell] += sums[end] - sums[first]
            bits[cell * np.uint64(words) + np.uint64(word)] |= bit
            continue
        for j in range(first, end):
            e = element_with_room(bases, chain, filled, free, held, np.int64(head), np.int64(lane), heights[j])
            slots[e, lane, filled[e, lane]] = np.int16(heights[j] - bases[e])
            filled[e, lane] += 1
            marks[e, lane, word] |= bit
            light[e, lane] += gain * np.uint32(intensity[j])
    return counted


@inlined
def note(column, row, epochs, sigma, edge, tile_rows, spans, sigmas):
    """Note epochs and σ of readings with the active tiles that they fall into."""
    west, south, tile = -(1 << 40), -(1 << 40), -1
    for j in range(column.size):
        x, y = np.int64(column[j]), np.int64(row[j])
        if not (west <= x < west + edge and south <= y < south + edge):
            across, along = x // edge, y // edge
            west, south, tile = across * edge, along * edge, -1
            if 0 <= along < tile_rows.shape[0] and 0 <= across < tile_rows.shape[1]:
                tile = tile_rows[along, across]
                if tile >= 0:
                    sigmas[tile, 0] = max(sigmas[tile, 0], sigma[0])
                    sigmas[tile, 1] = max(sigmas[tile, 1], sigma[1])
        if tile >= 0:
            spans[tile, 0] = min(spans[tile, 0], epochs[j])
            spans[tile, 1] = max(spans[tile, 1], epochs[j])


@kernel
def accumulate_placed(
    east, north, height, classes, passes, intensity, gain, epochs, intervals, corner, cell_quanta, edge,
    tile_rows, groups, slots, bases, chain, filled, light, marks, free, held, spans, sigmas, interval_sigmas, first,
):  # fmt: skip
    """Count readings that have their places into the cells of active tiles.

    Parameters
    ----------
    east, north, height : (n,) float64, whole quanta of the map.
    classes : (n,) uint8, 0 for readings that are kept.
    passes : (n,) int32, number of the reading's pass among the accumulator's, −1 where it is in none.
    intensity : (n,) unsigned; gain : uint32, see :func:`accumulate`; epochs : (n,) int64, GPS ns.
    intervals : (n,) int32, interval of the trajectory that placed each reading, a row of `interval_sigmas`.
    corner : (2,) tuple of int64, south-west corner of tile_rows[0, 0] (quanta).
    cell_quanta, edge, tile_rows … held : see :func:`accumulate`.
    spans : (a, 2) int64, in/out, first and last epoch of each active tile.
    sigmas : (a, 2) float64, in/out, largest σ of the poses; interval_sigmas : (k, 2) float64.
    first : int, reading to begin with.

    Returns
    -------
    done : int, the reading before which the pool ran short of free elements; n at the end.
    counted : int, readings that fell into active tiles.
    """
    column, row = np.empty(PIECE, np.int32), np.empty(PIECE, np.int32)
    heights = np.zeros(PIECE + VECTOR, np.int32)
    starts, sums = np.empty(PIECE + 1, np.int32), np.empty(PIECE + 1, np.uint32)
    touched = np.zeros(groups.shape[0], np.uint8)
    per_cell = 1.0 / cell_quanta
    counted = 0
    start = first
    while start < east.size:
        if free.size - held[0] < 2 * PIECE:
            return start, counted
        end = start
        while (
            end < min(start + PIECE, east.size)
            and passes[end] == passes[start]
            and (intervals[end] == intervals[start])
        ):
            end += 1
        n = end - start
        low, high = np.int64(2**31 - 1), np.int64(-(2**31))
        for j in range(n):
            i = start + j
            wanted = (classes[i] == 0) & (passes[i] >= 0)
            x = math.floor((east[i] - corner[0] + 0.5) * per_cell)
            y = math.floor((north[i] - corner[1] + 0.5) * per_cell)
            # What lies far outside must not come back into the box when it is cut to 32 bits.
            wanted &= (x > NOWHERE) & (x < -NOWHERE) & (y > NOWHERE) & (y < -NOWHERE)
            column[j] = np.int32(x) if wanted else np.int32(NOWHERE)
            row[j] = np.int32(y) if wanted else np.int32(0)
            heights[j] = np.int32(height[i]) if wanted else np.int32(0)
            if wanted:
                low, high = min(low, np.int64(heights[j])), max(high, np.int64(heights[j]))
        if low <= high:
            counted += accumulate(
                column[:n], row[:n], heights, low, high, intensity[start:end], gain,
                passes[start] >> 3, np.uint8(1 << (passes[start] & 7)), starts, sums,
                tile_rows, groups, edge, slots, bases, chain, filled, light, marks, free, held, touched,
            )  # fmt: skip
            note(
                column[:n],
                row[:n],
                epochs[start:end],
                interval_sigmas[intervals[start]],
                edge,
                tile_rows,
                spans,
                sigmas,
            )
        start = end
    return start, counted
