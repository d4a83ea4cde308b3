"""Piles of a tile's rows → statistics of its cells, equal to the bit with those of ``kernels.cells``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from roadscan.kernels.cells import AT_ONCE, STATISTICS, kth_smallest
from roadscan.kernels.lanes import LANES, REACH, statistics_of, statistics_of_64
from roadscan.kernels.options import bare, bare_inlined
from roadscan.kernels.row_piles import COLUMN, LIGHT, LIGHT_SHIFT, free_row, last_block, size_of

statistics_of_8, statistics_of_32 = statistics_of(8), statistics_of(32)

WORD = 64
"""Passes that a word of marks names."""


def row_arrays(edge: int, passes: int, most: int) -> tuple[Any, ...]:
    """Arrays that a row of `edge` cells with up to `most` readings of so many passes is worked on in."""
    return (
        np.zeros(edge, np.int32), np.zeros(edge, np.int64), np.zeros((edge, -(-passes // WORD)), np.uint64),
        np.empty(edge, np.int32), np.empty(edge, np.int32), np.empty(most, np.int32),
        np.zeros((AT_ONCE, LANES), np.int32), *(np.zeros(LANES, np.int32) for _ in range(3)),
        np.zeros((STATISTICS, LANES)), np.empty(most, np.int32),
    )  # fmt: skip


@bare
def sort_row(end, piles, counts, light, marks, starts, used, heights):
    """Heights of a row cell by cell, in the order of the cells; returns how many cells have one.

    Parameters
    ----------
    end : int32, of the row's pile; piles : see ``row_piles.put_on_piles``.
    counts : (edge,) int32, light : (edge,) int64, marks : (edge, w) uint64, in/out, zeros: readings, sum of intensities
    and passes of each cell.
    starts : (edge,) int32, out, end of each cell's heights; used : (edge,) int32, out, cells that have some, ascending.
    heights : (≥ readings,) int32, out.
    """
    records, before, sizes, owners, _, _ = piles
    block = last_block(end)
    while block >= 0:
        first, word = np.uint64(block) * np.uint64(64), np.int64(owners[block]) // WORD
        mark = np.uint64(1) << np.uint64(np.int64(owners[block]) % WORD)
        for k in range(np.uint64(size_of(block, end, sizes))):
            record = records[first + np.uint64(k)]
            cell = record & COLUMN
            counts[cell] += np.int32(1)
            light[cell] += np.int64((record >> LIGHT_SHIFT) & LIGHT)
            marks[cell, word] |= mark
        block = np.int64(before[block])
    cells, at = 0, np.int32(0)
    for cell in range(counts.size):
        if counts[cell]:
            used[cells], starts[cell] = cell, at
            cells += 1
            at += counts[cell]
    block = last_block(end)
    while block >= 0:
        first = np.uint64(block) * np.uint64(64)
        for k in range(np.uint64(size_of(block, end, sizes))):
            record = records[first + np.uint64(k)]
            cell = record & COLUMN
            heights[np.uint64(starts[cell])] = np.int32(np.int64(record) >> np.int64(32))
            starts[cell] += np.int32(1)
        block = np.int64(before[block])
    return cells


@bare
def statistics_of_long(heights, light, floor, quantum_m, work, out, lane):
    """Statistics of one cell of n readings, as ``lanes.statistics_of``, into out[:, lane].

    heights : (n,) int32; light : int64, sum of intensities; work : (≥ n,) int32.
    """
    n, base = heights.size, np.int64(heights[0])
    for k in range(n):
        work[k] = np.int32(heights[k] - base)
    median = np.int64(kth_smallest(work, n, (n - 1) // 2))
    total, squares, low, high = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for k in range(n):
        d = np.int64(heights[k]) - base - median
        low, high = min(low, d), max(high, d)
        total += d
        squares += d * d
        work[k] = np.int32(abs(d))
    reach = np.int64(math.floor(max(REACH * kth_smallest(work, n, (n - 1) // 2), floor)))
    used, near = 0, np.int64(0)
    for k in range(n):
        d = np.int64(heights[k]) - base - median
        inside = (d <= reach) & (d >= -reach)
        used += inside
        near += d * inside
    middle, average = median + base, total / n
    out[0, lane] = (middle + average) * quantum_m
    out[1, lane] = (middle + near / used) * quantum_m
    out[2, lane] = (middle + low) * quantum_m
    out[3, lane] = (middle + high) * quantum_m
    out[4, lane] = math.sqrt(max(squares / n - average * average, 0.0)) * quantum_m
    out[5, lane] = light / n


@bare
def fill_table(cells, counts, light, starts, heights, table, own_counts, own_light, bases):
    """Heights of up to sixteen cells side by side, relative to the first of each; returns the most that a cell has.

    Cells of more than `AT_ONCE` heights, and lanes without a cell, get none.
    """
    most = np.int32(0)
    for lane in range(LANES):
        own_counts[lane] = 0
        if lane < cells.size:
            cell = np.uint64(cells[lane])
            n = counts[cell]
            if n <= AT_ONCE:
                first = np.uint64(starts[cell] - n)
                base = heights[first]
                own_counts[lane], own_light[lane], bases[lane] = n, np.int32(light[cell]), base
                most = max(most, n)
                for k in range(np.uint64(n)):
                    table[k, lane] = heights[first + np.uint64(k)] - base
    return most


@bare_inlined
def write_marked(marks, numbers, written, pass_ids):
    """Ids of the passes of a cell, ascending; marks : (w,) uint64. Returns the end of what is written."""
    for p in range(numbers.size):
        if (marks[p // WORD] >> np.uint64(p % WORD)) & np.uint64(1):
            pass_ids[written] = numbers[p]
            written += 1
    return written


@bare
def finish_piles(
    ends, piles, floor, quantum_m, numbers, work,
    column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
):  # fmt: skip
    """Statistics of all cells of a tile that hold a reading, in order of row and column; its blocks are given back.

    Parameters
    ----------
    ends : (edge,) int32, in/out, of the tile; piles : see ``row_piles.put_on_piles``.
    work : as :func:`row_arrays` makes them.
    Others, and what is returned, as in ``cells.finish_cells``.
    """
    counts, light, marks, starts, used, heights, table, own_counts, own_light, bases, out, many = work
    cell, written = 0, 0
    for y in range(ends.size):
        if ends[y] == 0:
            continue
        cells = sort_row(ends[y], piles, counts, light, marks, starts, used, heights)
        for first in range(0, cells, LANES):
            own = used[first : min(first + LANES, cells)]
            most = fill_table(own, counts, light, starts, heights, table, own_counts, own_light, bases)
            if most > 32:
                statistics_of_64(table, own_counts, own_light, bases, floor, quantum_m, out)
            elif most > 8:
                statistics_of_32(table, own_counts, own_light, bases, floor, quantum_m, out)
            elif most > 0:
                statistics_of_8(table, own_counts, own_light, bases, floor, quantum_m, out)
            for lane in range(own.size):
                x = np.int64(own[lane])
                n = np.int64(counts[x])
                if n > AT_ONCE:
                    end = np.int64(starts[x])
                    statistics_of_long(heights[end - n : end], light[x], floor, quantum_m, many, out, lane)
                column[cell], row[cell], count[cell] = x, y, n
                mean[cell], robust[cell], low[cell], high[cell] = out[0, lane], out[1, lane], out[2, lane], out[3, lane]
                deviation[cell], bright[cell] = np.float32(out[4, lane]), np.float32(out[5, lane])
                pass_offsets[cell] = written
                written = write_marked(marks[x], numbers, written, pass_ids)
                counts[x], light[x], marks[x] = 0, 0, 0
                cell += 1
        free_row(ends[y], piles[1], piles[4], piles[5])
        ends[y] = 0
    pass_offsets[cell] = written
    return cell, written
