"""Readings → cells in one pass: of each reading its height is kept until the tile is finished, and nothing else.

The heights of a cell stand in *lines* of 64 bytes, as long as a line of the cache: `SLOTS` differences from the line's
base, and a header with their number, the sum of their intensities and the passes they are from. The cells of a tile
are taken sixteen at a time, side by side along a row: a *group*. When the first reading falls into a group, it gets
an *element* of the pool: a line for each of its cells. A cell with more readings, or with heights too far from the
base for 16 bits, or of more passes than a header has bits for, chains spare lines behind its own. What is kept depends
on the order of the readings only until it is sorted (``kernels.cells``).

Neighbouring readings of a profile mostly lie in one cell, so readings are counted in *runs*: what has to be looked
up is looked up once a run, and the heights of a run are stored as one vector.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.kernels.georeference import KEPT
from roadscan.kernels.line_access import VECTOR, fetch_line, store_heights
from roadscan.kernels.options import bare, bare_inlined
from roadscan.kernels.run_lines import AT_ONCE, find_known_lines, lowest_bit
from roadscan.kernels.runs import find_runs, sum_up
from roadscan.kernels.selection import bounds_of

LANES = 16
"""Cells of a group."""
LINE = 32
"""Numbers of 16 bits in a line: the heights, then the header."""
SLOTS = 28
"""Heights of a line."""
HEADERS = 8
"""Numbers of 64 bits in a line; the last one is its header."""
LAST = LINE - VECTOR
"""Heights that a line may hold already when a whole vector is stored behind them."""
FARTHEST = 32_000
"""Largest difference (quanta) between a height and the base of its line."""
NOWHERE = -(1 << 30)
"""Column of a reading that is not to be counted: outside every tile."""
AHEAD = 12
"""Runs whose lines are fetched before their turn comes."""
PIECE = 1024
"""Readings worked on together: their working arrays stay in the first cache."""

COUNTS = 31
LIGHT_SHIFT, LIGHTS = 5, (1 << 21) - 1
WORD_SHIFT, WORDS = 26, (1 << 14) - 1
MARK_SHIFT = 40
PASSES = 24
"""A header, from its lowest bit: number of heights (5), sum of intensities (21), word (14), passes (24).

Pass number p has the bit p mod 24 in lines of the word p div 24; a line has one word."""


def work_arrays(tiles: int) -> tuple[Any, ...]:
    """Arrays that readings are worked on in, a piece at a time, and a mark for each of so many active tiles.

    Column, row and height of each reading; of runs the first reading, the sum of intensities before each reading, the
    cell's column, row and line; the marks.
    """
    of_runs = (
        np.empty(PIECE + 1, np.uint32),
        np.empty(PIECE + 1, np.uint32),
        np.zeros(PIECE + AT_ONCE, np.int32),
        np.zeros(PIECE + AT_ONCE, np.int32),
        np.empty(PIECE + AT_ONCE, np.int32),
    )
    heights = np.zeros(PIECE + VECTOR, np.int32)
    return np.empty(PIECE, np.int32), np.empty(PIECE, np.int32), heights, of_runs, np.zeros(tiles, np.uint8)


@bare_inlined
def header_of_pass(number):
    """What a pass sets in a header, its bit and its word (uint64)."""
    word, bit = np.uint64(number // PASSES), np.uint64(number % PASSES)
    return (word << np.uint64(WORD_SHIFT)) | (np.uint64(1) << (bit + np.uint64(MARK_SHIFT)))


@bare_inlined
def new_group(heads, bases, chain, free, held, height):
    """Take an element from the stack of free ones, its lines empty; `held` counts those in use."""
    e = free[held[0]]
    held[0] += 1
    for line in range(np.uint64(e) * np.uint64(LANES), np.uint64(e + 1) * np.uint64(LANES)):
        heads[line * np.uint64(HEADERS) + np.uint64(HEADERS - 1)] = 0
        bases[line] = height
        chain[line] = -1
    return e


@bare_inlined
def new_line(heads, bases, chain, free, spare, held, height):
    """Take an empty line from the spare ones; where there is none, an element becomes spare lines."""
    if held[1] == 0:
        e = new_group(heads, bases, chain, free, held, height)
        for lane in range(LANES):
            spare[lane] = e * LANES + LANES - 1 - lane
        held[1] = LANES
    held[1] -= 1
    line = spare[held[1]]
    heads[line * HEADERS + HEADERS - 1] = 0
    bases[line] = height
    chain[line] = -1
    return line


@bare_inlined
def line_with_room(own, size, low, high, word, heads, bases, chain):
    """Line of the chain from `own` that takes `size` more heights from `low` to `high`; −1 where none does."""
    line = np.int64(own)
    while line >= 0:
        header = heads[line * HEADERS + HEADERS - 1]
        used = np.int64(header & np.uint64(COUNTS))
        base = np.int64(bases[line])
        fits = (used + size <= SLOTS) & (low - base >= -FARTHEST) & (high - base <= FARTHEST)
        if fits & ((used == 0) | (header & np.uint64(WORDS << WORD_SHIFT) == word)):
            return line
        line = np.int64(chain[line])
    return line


@bare_inlined
def longer_chain(own, height, heads, bases, chain, free, spare, held):
    """A new line behind `own`: before the older ones, which are full."""
    line = np.int64(new_line(heads, bases, chain, free, spare, held, height))
    chain[line] = chain[own]
    chain[own] = line
    return line


@bare
def count_slowly(
    own, heights, intensity, gain, first, end, mark, lines, heads, bases, chain, free, spare, held
):  # fmt: skip
    """Count readings `first` to `end` − 1 into the cell that begins with the line `own`, one by one."""
    for j in range(first, end):
        height = np.int64(heights[j])
        word = mark & np.uint64(WORDS << WORD_SHIFT)
        line = line_with_room(own, 1, height, height, word, heads, bases, chain)
        if line < 0:
            line = longer_chain(own, height, heads, bases, chain, free, spare, held)
        at = line * HEADERS + HEADERS - 1
        lines[line * LINE + np.int64(heads[at] & np.uint64(COUNTS))] = np.int16(height - bases[line])
        shine = np.uint64(gain) * np.uint64(intensity[j])
        heads[at] = (heads[at] + np.uint64(1) + (shine << np.uint64(LIGHT_SHIFT))) | mark


@bare_inlined
def line_of_run(own, heights, first, end, word, heads, bases, chain, free, spare, held):
    """Line of the cell that begins with `own` with room for a run; −1 where its heights are too far apart for one."""
    low, high = np.int64(heights[first]), np.int64(heights[first])
    for j in range(first, end):
        low, high = min(low, np.int64(heights[j])), max(high, np.int64(heights[j]))
    line = line_with_room(own, np.int64(end - first), low, high, word, heads, bases, chain)
    if line < 0 and high - low <= FARTHEST:
        line = longer_chain(own, low, heads, bases, chain, free, spare, held)
    return line


@bare_inlined
def store_run(heights, first, size, base, lines, line, used):
    """Write the heights of a run behind the `used` ones of the line that begins at `line`.

    A whole vector is written, not the part of one, which takes AMD's Zen 4 twenty cycles: what lies beyond the run's
    heights is overwritten by the next run, or by the header, which is written last.
    """
    if used <= np.uint64(LAST):
        store_heights(heights, first, base, lines, line + used)
        return
    for k in range(size):
        lines[line + used + k] = np.int16(heights[first + k] - base)


@bare_inlined
def tile_at(x, y, edge, tile_rows):
    """South-west cell of the tile that holds cell (x, y), and its row in `groups`, −1 where it is not active."""
    across, along = x // edge, y // edge
    inside = (along >= 0) & (along < tile_rows.shape[0]) & (across >= 0) & (across < tile_rows.shape[1])
    return across * edge, along * edge, np.int64(tile_rows[along, across]) if inside else np.int64(-1)


@bare
def find_lines(columns, rows, heights, starts, runs, tile_rows, groups, edge, pool, touched, cells):
    """First line of each run's cell, −1 outside the active tiles; cells : (n + 16,) int32, out. Takes new groups.

    columns, rows : (n + 16,) int32, cells of the runs; starts : (n + 1,) uint32, their first readings.
    """
    _, heads, bases, chain, free, _, held = pool
    per_row, per_tile = (edge + LANES - 1) // LANES, groups.shape[1]
    table = groups.reshape(-1)
    west, south, tile = np.int64(NOWHERE), np.int64(NOWHERE), np.int64(-1)
    block = np.uint64(0)
    while block < runs:
        own = (np.int32(west), np.int32(south), np.int32(edge if tile >= 0 else 0), np.int32(per_row))
        at = np.uint64(max(tile, 0) * per_tile)
        unknown = find_known_lines(columns, rows, block, runs, own, np.int32(NOWHERE), table, at, cells)
        while unknown:
            run = block + lowest_bit(unknown)
            unknown &= unknown - np.uint64(1)
            x, y = np.int64(columns[run]), np.int64(rows[run])
            if not (west <= x < west + edge and south <= y < south + edge):
                west, south, tile = tile_at(x, y, edge, tile_rows)
                if tile >= 0:
                    touched[tile] = 1
            if tile < 0:
                continue
            place = np.uint64(tile * per_tile + (y - south) * per_row + ((x - west) >> 4))
            found = table[place]
            if found < 0:
                found = new_group(heads, bases, chain, free, held, heights[np.uint64(starts[run])])
                table[place] = found
            cells[run] = found * LANES + ((x - west) & 15)
        block += np.uint64(AT_ONCE)


@bare
def accumulate(
    column, row, heights, low, high, intensity, gain, number, of_runs, tile_rows, groups, edge, pool, touched
):  # fmt: skip
    """Count readings into the cells of active tiles.

    Parameters
    ----------
    column, row : (n,) int32, cells from the south-west corner of tile_rows[0, 0]; column NOWHERE for readings that a
    filter leaves out.
    heights : (n + VECTOR,) int32, quanta of the map; what follows the n-th is read, but not counted.
    low, high : int, no height lies below or above.
    intensity : (n,) unsigned; gain : uint32; their product takes at most 16 bits.
    number : int, of the readings' pass among the accumulator's.
    of_runs : arrays to work in, see :func:`work_arrays`.
    tile_rows : (rows, columns) int32, row of each tile in `groups`; −1 for tiles that are not active.
    groups : (a, edge · ⌈edge / 16⌉) int32, element of each group of a tile, −1 where it has none.
    edge : int64, cells along a tile's edge.
    pool : tuple of lines : (c · LANES · LINE,) int16; heads : the same memory as (c · LANES · HEADERS,) uint64;
    bases : (c · LANES,) int32, of each line; chain : (c · LANES,) int32, next line of the cell, −1 for none;
    free : (c,) int32, stack of free elements; spare : (c · LANES,) int32, stack of spare lines;
    held : (2,) int64, elements in use, spare lines. At least 2 n elements have to be free.
    touched : (a,) uint8, out, 1 for each active tile that got a reading.

    Returns
    -------
    int, how many readings were counted; the other wanted ones lie outside the active tiles.
    """
    lines, heads, bases, chain, free, spare, held = pool
    starts, sums, columns, rows, cells = of_runs
    mark = header_of_pass(number)
    word = mark & np.uint64(WORDS << WORD_SHIFT)
    sum_up(intensity, sums)
    runs = find_runs(column, row, starts, columns, rows)
    find_lines(columns, rows, heights, starts, runs, tile_rows, groups, edge, pool, touched, cells)
    counted = np.int64(0)
    for run in range(runs):
        fetch_line(lines, np.uint64(cells[run + np.uint64(AHEAD)]) * np.uint64(LINE))
        if cells[run] < 0:
            continue
        own = np.uint64(cells[run])
        first, end = np.uint64(starts[run]), np.uint64(starts[run + np.uint64(1)])
        counted += np.int64(end - first)
        while first < end:
            size = min(end - first, np.uint64(VECTOR))
            line, base = own, np.int64(bases[own])
            at = line * np.uint64(HEADERS) + np.uint64(HEADERS - 1)
            header = heads[at]
            used = header & np.uint64(COUNTS)
            fits = (used + size <= np.uint64(SLOTS)) & (low - base >= -FARTHEST) & (high - base <= FARTHEST)
            if not (fits & (header & np.uint64(WORDS << WORD_SHIFT) == word)):
                other = line_of_run(own, heights, first, first + size, word, heads, bases, chain, free, spare, held)
                if other < 0:
                    count_slowly(
                        own, heights, intensity, gain, first, first + size, mark,
                        lines, heads, bases, chain, free, spare, held,
                    )  # fmt: skip
                    first += size
                    continue
                line = np.uint64(other)
                base, at = np.int64(bases[line]), line * np.uint64(HEADERS) + np.uint64(HEADERS - 1)
                header = heads[at]
                used = header & np.uint64(COUNTS)
            store_run(heights, first, size, np.int32(base), lines, line * np.uint64(LINE), used)
            shine = np.uint64(gain) * np.uint64(sums[first + size] - sums[first])
            heads[at] = (header + size + (shine << np.uint64(LIGHT_SHIFT))) | mark
            first += size
    return counted


@bare
def accumulate_cells(
    column, row, heights, passes, intensity, edge, tile_rows, groups, pool, work, fates, first
):  # fmt: skip
    """Count readings that know their cells, best in the order of cells.

    Parameters
    ----------
    column, row : (n,) int32; heights : (n + VECTOR,) int32, as in :func:`accumulate`; all in active tiles.
    passes : (n,) int32, number of the reading's pass among the accumulator's; intensity : (n,) uint16.
    edge, tile_rows, groups, pool : see :func:`accumulate`; work : as :func:`work_arrays` makes them.
    fates : (6,) int64, in/out, readings that were kept.
    first : int, reading to begin with.

    Returns
    -------
    int, the reading before which the pool ran short of free elements; n at the end.
    """
    free, held = pool[4], pool[6]
    of_runs, touched = work[3:]
    start = first
    while start < column.size:
        if free.size - held[0] < 2 * PIECE:
            return start
        end, last = start, min(start + PIECE, column.size)
        while end < last and passes[end] == passes[start]:
            end += 1
        low, high = bounds_of(heights[start:end])
        fates[KEPT] += accumulate(
            column[start:end], row[start:end], heights[start : end + VECTOR], low, high, intensity[start:end],
            np.uint32(1), passes[start], of_runs, tile_rows, groups, edge, pool, touched,
        )  # fmt: skip
        start = end
    return start


@bare
def accumulate_points(
    x, y, height, passes, intensity, cell_quanta, edge, tile_rows, groups, pool, work, first
):  # fmt: skip
    """Count the points of one tile into its cells.

    Parameters
    ----------
    x, y, height : (n,) int32, quanta, x and y from the tile's south-west corner, not negative.
    passes : (n,) int32, number of each point's pass among the accumulator's; intensity : (n,) uint16.
    cell_quanta, edge, tile_rows, groups, pool : see :func:`accumulate`; work : as :func:`work_arrays` makes them.
    first : int, point to begin with.

    Returns
    -------
    int, the point before which the pool ran short of free elements; n at the end.
    """
    free, held = pool[4], pool[6]
    column, row, heights, of_runs, touched = work
    start = first
    while start < x.size:
        if free.size - held[0] < 2 * PIECE:
            return start
        end, last = start, min(start + PIECE, x.size)
        while end < last and passes[end] == passes[start]:
            end += 1
        n = end - start
        find_cells(x[start:end], y[start:end], 1.0 / cell_quanta, column, row)
        for j in range(n):
            heights[j] = height[start + j]
        low, high = bounds_of(heights[:n])
        accumulate(
            column[:n], row[:n], heights, low, high, intensity[start:end], np.uint32(1), passes[start], of_runs,
            tile_rows, groups, edge, pool, touched,
        )  # fmt: skip
        start = end
    return start


@bare
def find_cells(x, y, per_cell, column, row):
    """Cells (≥ n,) int32, out, of points; x, y : (n,) int32, quanta from the tile's south-west corner."""
    for j in range(x.size):
        column[j] = np.int32(np.floor((x[j] + 0.5) * per_cell))
        row[j] = np.int32(np.floor((y[j] + 0.5) * per_cell))
