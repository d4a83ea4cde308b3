"""Fills a tile's buckets and computes its cells from them, bit-identical to ``tiles.kernels.cell_statistics``.

Cells with similar numbers of readings are grouped wherever they lie: sixteen of up to 8, of up to 32 and of up to 64
readings go through ``compute.kernels.column_statistics`` together. Fuller ones are processed one by one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inlined, bare_inner, inlined, kernel
from roadscan.compute.kernels.column_statistics import LANES, statistics_of, statistics_of_64
from roadscan.georeference.kernels.timed_readings import CHUNK, place_mirror, place_returns, places
from roadscan.tiles.kernels.accumulate import end_of_pass, find_cells
from roadscan.tiles.kernels.cell_statistics import select_arrays, statistics_of_full, write_statistics
from roadscan.tiles.kernels.row_buckets import (
    BLOCK,
    COLUMN,
    LIGHT,
    LIGHT_SHIFT,
    TAKEN,
    Measured,
    Places,
    fetch_block,
    fill_buckets,
    free_row,
    height_of,
    last_block,
    put_in_own_buckets,
    size_of,
)

statistics_of_8, statistics_of_32 = statistics_of(8), statistics_of(32)  # Of up to 8 and up to 32 readings a cell.

SHORT, MEDIUM, LONG = 8, 32, 64
"""Most readings of a cell in each of the tables for sixteen cells."""
WORD = 64
"""Passes in a word of marks."""
COUNT_SHIFT = np.int64(40)
"""Number of bits of a cell's sum of intensities, above which the same number has the count of readings …"""
MOST = 1 << 23
"""… which suffices for rows of fewer readings."""
_LIGHTS = np.int64((1 << 40) - 1)  # Mask of the sum of intensities.
_NUMBERS = 4  # Rows of numbers of a table.
_COUNT, _LIGHT, _BASE, _TARGET = range(_NUMBERS)


def row_arrays(edge: int, passes: int, most: int) -> tuple[Any, ...]:
    """Return working arrays for a row of `edge` cells with up to `most` readings of so many passes."""
    table, own = np.zeros((SHORT + MEDIUM + LONG, LANES), np.int32), np.zeros((3 * _NUMBERS, LANES), np.int32)
    row = (
        np.zeros(edge, np.int64), np.zeros((edge, -(-passes // WORD)), np.uint64), np.empty(edge, np.int32),
        np.empty(edge + 1, np.int32), np.empty(most, np.int32),
    )  # fmt: skip
    return row, table, own, np.zeros(3, np.int64), np.zeros((6, LANES)), select_arrays(most)


@bare_inner
def mark_row(end, buckets, marks):
    """Mark the passes of a row's cells; marks: (edge, w) uint64, in/out, zeros. See :func:`sort_row`."""
    records, before, sizes, owners, _, _ = buckets
    block = last_block(end)
    while block >= 0:
        word, mark = np.int64(owners[block]) // WORD, np.uint64(1) << np.uint64(np.int64(owners[block]) % WORD)
        for k in range(size_of(block, end, sizes)):
            marks[records[block * BLOCK + k] & COLUMN, word] |= mark
        block = np.int64(before[block])


@bare_inner
def sort_row(end, buckets, sums, ends, used, heights):
    """Sort the heights of a row by cell; return the number of cells that have one.

    Parameters
    ----------
    end : int32, of the row's bucket; buckets : Buckets.
    sums : (edge,) int64, in/out, zeros: readings of each cell above COUNT_SHIFT, below it the sum of their intensities.
    ends : (edge,) int32, out, end of each cell's heights; used : (edge + 1,) int32, out, cells that have some.
    heights : (≥ readings,) int32, out.
    """
    records, before, sizes, _, _, _ = buckets
    one = np.int64(1) << COUNT_SHIFT
    block = last_block(end)
    while block >= 0:
        fetch_block(np.int64(before[block]), records)
        first = np.uint64(block) * np.uint64(BLOCK)
        for k in range(np.uint64(size_of(block, end, sizes))):
            record = records[first + np.uint64(k)]
            sums[record & COLUMN] += one + np.int64((record >> LIGHT_SHIFT) & LIGHT)
        block = np.int64(before[block])
    cells, at = 0, np.int32(0)
    for cell in range(sums.size):
        used[cells], ends[cell] = cell, at
        cells += sums[cell] != 0
        at += np.int32(sums[cell] >> COUNT_SHIFT)
    block = last_block(end)
    while block >= 0:
        first = np.uint64(block) * np.uint64(BLOCK)
        for k in range(np.uint64(size_of(block, end, sizes))):
            record = records[first + np.uint64(k)]
            cell = record & COLUMN
            at = ends[cell]
            heights[np.uint64(at)] = height_of(record)
            ends[cell] = at + np.int32(1)
        block = np.int64(before[block])
    return cells


@bare_inlined
def put_aside(heights, first, n, light, target, kind, table, own, lane):
    """Put the n heights of a cell from `first` on into a lane of the part of the table for its size."""
    base, at = heights[np.uint64(first)], np.uint64(0 if kind == 0 else (SHORT if kind == 1 else SHORT + MEDIUM))
    numbers = np.uint64(_NUMBERS * kind)
    own[numbers + np.uint64(_COUNT), lane], own[numbers + np.uint64(_LIGHT), lane] = n, np.int32(light)
    own[numbers + np.uint64(_BASE), lane], own[numbers + np.uint64(_TARGET), lane] = base, target
    for k in range(np.uint64(n)):
        table[at + k, lane] = heights[np.uint64(first) + k] - base


@bare_inner
def finish_table(kind, table, owns, lanes, floor, quantum_m, out, columns):
    """Write the statistics of the cells in a part of the table to their places, and empty it."""
    own = owns[_NUMBERS * kind : _NUMBERS * (kind + 1)]
    for lane in range(lanes[kind], LANES):
        own[_COUNT, lane] = 0
    if kind == 0:
        statistics_of_8(table[:SHORT], own[_COUNT], own[_LIGHT], own[_BASE], floor, quantum_m, out)
    elif kind == 1:
        rows = table[SHORT : SHORT + MEDIUM]
        statistics_of_32(rows, own[_COUNT], own[_LIGHT], own[_BASE], floor, quantum_m, out)
    else:
        statistics_of_64(table[SHORT + MEDIUM :], own[_COUNT], own[_LIGHT], own[_BASE], floor, quantum_m, out)
    for lane in range(lanes[kind]):
        write_statistics(out, lane, np.int64(own[_TARGET, lane]), columns)
    lanes[kind] = 0


@bare_inlined
def write_marked(marks, numbers, written, pass_ids):
    """Write the ids of a cell's passes, ascending; marks: (w,) uint64. Return the end of what is written."""
    for p in range(numbers.size):
        if (marks[p // WORD] >> np.uint64(p % WORD)) & np.uint64(1):
            pass_ids[written] = numbers[p]
            written += 1
    return written


@bare
def finish_buckets(bucket_ends, buckets, floor, quantum_m, numbers, work, columns):
    """Write the statistics of all cells of a tile with a reading, and free its blocks.

    Parameters
    ----------
    bucket_ends : (edge,) int32, in/out, of the tile; buckets : Buckets. No row has `MOST` readings.
    work : as :func:`row_arrays` makes them.
    Others, and what is returned, as in ``cell_statistics.finish_cells``.
    """
    (sums, marks, ends, used, heights), table, owns, lanes, out, select = work
    cell, written = 0, 0
    for y in range(bucket_ends.size):
        if bucket_ends[y] == 0:
            continue
        cells = sort_row(bucket_ends[y], buckets, sums, ends, used, heights)
        if numbers.size > 1:
            mark_row(bucket_ends[y], buckets, marks)
        for k in range(cells):
            x = np.int64(used[k])
            n, light, end = sums[x] >> COUNT_SHIFT, sums[x] & _LIGHTS, np.int64(ends[x])
            if n > LONG:
                statistics_of_full(heights[end - n : end], light, floor, quantum_m, select, out, 0)
                write_statistics(out, 0, cell, columns)
            else:
                kind = np.int64(n > SHORT) + np.int64(n > MEDIUM)
                put_aside(heights, end - n, n, light, cell, kind, table, owns, np.uint64(lanes[kind]))
                lanes[kind] += 1
                if lanes[kind] == LANES:
                    finish_table(kind, table, owns, lanes, floor, quantum_m, out, columns)
            columns.column[cell], columns.row[cell], columns.readings[cell] = x, y, n
            columns.pass_offsets[cell] = written
            if numbers.size > 1:
                written = write_marked(marks[x], numbers, written, columns.pass_ids)
                marks[x] = 0
            else:
                columns.pass_ids[written] = numbers[0]
                written += 1
            sums[x] = 0
            cell += 1
        free_row(bucket_ends[y], buckets)
        bucket_ends[y] = 0
    for kind in range(3):
        if lanes[kind]:
            finish_table(kind, table, owns, lanes, floor, quantum_m, out, columns)
    columns.pass_offsets[cell] = written
    return cell, written


@inlined
def places_in_tiles(n, tiles):
    """Return arrays for the cells of n readings and for the σ of so many active tiles."""
    return Places(np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32), np.full(tiles, -1, np.int32))


@inlined
def part_of(measured, first, end):
    """Return readings `first` to `end` − 1 of :class:`Measured`."""
    return Measured(
        measured.epochs[first:end], measured.passes[first:end], measured.intensity[first:end], measured.gain,
        measured.interval_sigmas_m,
    )  # fmt: skip


@kernel
def bucket_returns(returns, measured, georeference, active, buckets, fates, first):
    """Georeference returns and put those in active tiles into their buckets.

    Parameters
    ----------
    returns : Returns; measured : Measured, of the same n returns; georeference : Georeference.
    active : ActiveTiles; buckets : Buckets; fates : (≥ FATES,) int64, in/out, counts by fate.
    first : int, return to begin with.

    Returns
    -------
    int, the return before which the buckets ran short of free blocks; n at the end.
    """
    placed, own = places(CHUNK), places_in_tiles(CHUNK, active.spans.shape[0])
    n = returns.epochs.size
    for start in range(first, n, CHUNK):
        if buckets.free.size - buckets.held[TAKEN] < CHUNK:
            return start
        end = min(start + CHUNK, n)
        place_returns(start, end, returns, georeference, placed, fates)
        fill_buckets(placed, part_of(measured, start, end), own, active, buckets, fates)
    return n


@kernel
def bucket_mirror(profiles, measured, georeference, active, buckets, fates, first):
    """Georeference the readings of a mirror's profiles and put those in active tiles into their buckets.

    Parameters
    ----------
    profiles : MirrorProfiles; measured : Measured, of the n · m readings.
    first : int, profile to begin with.
    Others, and what is returned, as in :func:`bucket_returns`.
    """
    n, m = profiles.ranges.shape
    at_once = max(CHUNK // m, 1)
    size = at_once * m
    placed, own = places(size), places_in_tiles(size, active.spans.shape[0])
    for start in range(first, n, at_once):
        if buckets.free.size - buckets.held[TAKEN] < size:
            return start
        end = min(start + at_once, n)
        place_mirror(start, end, profiles, georeference, placed, fates)
        fill_buckets(placed, part_of(measured, start * m, end * m), own, active, buckets, fates)
    return n


@kernel
def bucket_points(x, y, height, passes, intensity, cell_quanta, ends, buckets, first):
    """Put the points of one tile into its buckets.

    Parameters
    ----------
    x, y, height : (n,) int32, quanta, x and y from the tile's south-west corner.
    passes : (n,) int32, number of each point's pass among the accumulator's; best few after one another.
    intensity : (n,) uint16.
    ends : (edge,) int32, in/out, of the tile's buckets; buckets : Buckets.
    first : int, point to begin with.

    Returns
    -------
    int, the point before which the buckets ran short of free blocks; n at the end.
    """
    column, row = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    start = first
    while start < x.size:
        if buckets.free.size - buckets.held[TAKEN] < CHUNK:
            return start
        end = end_of_pass(passes, start, CHUNK)
        n = end - start
        find_cells(x[start:end], y[start:end], 1.0 / cell_quanta, column, row)
        put_in_own_buckets(column[:n], row[:n], height[start:end], intensity[start:end], passes[start], ends, buckets)
        start = end
    return start
