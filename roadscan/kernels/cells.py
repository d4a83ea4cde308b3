"""Heights of a tile's cells → statistics, in whole numbers: equal to the bit whatever the order of the readings."""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.kernels.accumulate import (
    COUNTS,
    HEADERS,
    LANES,
    LIGHT_SHIFT,
    LIGHTS,
    LINE,
    MARK_SHIFT,
    PASSES,
    SLOTS,
    WORD_SHIFT,
    WORDS,
)
from roadscan.kernels.full_cells import select_arrays, statistics_of_full
from roadscan.kernels.lanes import statistics_of_64
from roadscan.kernels.line_access import fetch_line
from roadscan.kernels.line_statistics import line_statistics_of_8, line_statistics_of_28
from roadscan.kernels.open_group import chained_lanes, open_group, put_apart
from roadscan.kernels.options import bare, bare_inlined
from roadscan.kernels.run_lines import lowest_bit
from roadscan.kernels.store_group import store_group

AHEAD = 2
"""Groups whose lines are fetched before their turn comes."""
STATISTICS = 6
"""Mean, robust, lowest and highest height, standard deviation, mean intensity."""
AT_ONCE = 64
"""Heights a cell of which sixteen cells are worked on together; fuller cells are taken one by one."""


def work_arrays(most: int) -> tuple[Any, ...]:
    """Arrays that `finish_cells` works in; `most` : heights that a cell may have."""
    pairs, table = np.zeros((SLOTS // 2, LANES), np.int32), np.zeros((AT_ONCE, LANES), np.int32)
    rows, out = np.zeros((4, LANES), np.int32), np.zeros((STATISTICS, LANES))
    return pairs, table, *rows, out, np.empty(most, np.int32), select_arrays(most)


@bare
def find_groups(groups, chain, found):
    """Groups of a tile that have an element, in order, and the largest number of lines that a cell has.

    groups : (g,) int32; found : (g + AHEAD,) int32, out, the numbers of these groups.

    Returns
    -------
    count, most : int.
    """
    count, most = np.uint64(0), 1
    for group in range(np.uint64(groups.size)):
        found[count] = group
        count += np.uint64(groups[group] >= 0)
    for k in range(count):
        first_line = np.int64(groups[found[k]]) * LANES
        longer = chained_lanes(chain, np.uint64(first_line))
        while longer:
            lines, line = 0, first_line + np.int64(lowest_bit(longer))
            while line >= 0:
                lines += 1
                line = np.int64(chain[line])
            most = max(most, lines)
            longer &= longer - np.uint64(1)
    for k in range(np.uint64(AHEAD)):
        found[count + k] = found[count - np.uint64(1)] if count > 0 else 0
    return np.int64(count), most


@bare_inlined
def add_chains(first_line, longer, lines, heads, bases, chain, heights, counts, light, marks):
    """Heights of the further lines of a group's cells, relative to the base of the cell's first line.

    longer : uint64, a bit for each cell that has further lines.
    heights : (AT_ONCE, LANES) int32, in/out, as far as it reaches; counts, light, marks : (LANES,) int32, in/out; light
    only serves cells of up to AT_ONCE heights: that of fuller ones may not fit.
    """
    unseen = longer
    while unseen:
        further = np.uint64(chain[first_line + np.int64(lowest_bit(unseen))])
        fetch_line(lines, further * np.uint64(LINE))
        unseen &= unseen - np.uint64(1)
    while longer:
        lane = np.int64(lowest_bit(longer))
        longer &= longer - np.uint64(1)
        line = np.int64(chain[first_line + lane])
        while line >= 0:
            header = heads[line * HEADERS + HEADERS - 1]
            size = np.int32(header & np.uint64(COUNTS))
            shift = bases[line] - bases[first_line + lane]
            for k in range(min(size, AT_ONCE - counts[lane])):
                heights[counts[lane] + k, lane] = np.int32(lines[line * LINE + k]) + shift
            counts[lane] += size
            light[lane] += np.int32((header >> np.uint64(LIGHT_SHIFT)) & np.uint64(LIGHTS))
            marks[lane] |= np.int32(header >> np.uint64(MARK_SHIFT))
            line = np.int64(chain[line])


@bare
def gather_many(first_line, lines, heads, bases, chain, heights):
    """All heights (quanta) of a cell → heights, int32. Returns their number and the sum of their intensities."""
    n, light, line = 0, np.int64(0), first_line
    while line >= 0:
        header = heads[line * HEADERS + HEADERS - 1]
        light += np.int64((header >> np.uint64(LIGHT_SHIFT)) & np.uint64(LIGHTS))
        for k in range(np.int64(header & np.uint64(COUNTS))):
            heights[n] = bases[line] + np.int32(lines[line * LINE + k])
            n += 1
        line = np.int64(chain[line])
    return n, light


@bare_inlined
def write_passes(first_line, marks, numbers, heads, chain, written, pass_ids):
    """Ids of the passes of a cell, ascending. Returns the end of what is written."""
    if numbers.size <= PASSES:
        for p in range(numbers.size):
            if (marks >> p) & 1:
                pass_ids[written] = numbers[p]
                written += 1
        return written
    for p in range(numbers.size):
        line, seen = first_line, False
        while line >= 0:
            header = heads[line * HEADERS + HEADERS - 1]
            word = np.int64((header >> np.uint64(WORD_SHIFT)) & np.uint64(WORDS))
            own = np.int64(header >> np.uint64(MARK_SHIFT))
            seen |= (word == p // PASSES) & ((own >> (p % PASSES)) & 1 == 1)
            line = np.int64(chain[line])
        if seen:
            pass_ids[written] = numbers[p]
            written += 1
    return written


@bare_inlined
def release(element, longer, chain, free, spare, held):
    """Give a group's element and the further lines of its cells back."""
    while longer:
        line = np.int64(chain[element * LANES + np.int64(lowest_bit(longer))])
        longer &= longer - np.uint64(1)
        while line >= 0:
            spare[held[1]] = line
            held[1] += 1
            line = np.int64(chain[line])
    held[0] -= 1
    free[held[0]] = element


@bare
def finish_cells(
    groups, found, taken, edge, pool, floor, quantum_m, numbers, work,
    column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
):  # fmt: skip
    """Statistics of all cells of a tile that hold a reading, in order of row and column; its groups are given back.

    Parameters
    ----------
    groups, pool : see ``kernels.accumulate``; groups is the tile's own row, in/out, −1 everywhere when done.
    found, taken : from :func:`find_groups`.
    edge : int64, cells along a tile's edge.
    floor : float64, distance from the median (quanta) up to which heights always count; quantum_m : float64, m.
    numbers : (p,) uint16, ascending, ids of the passes by their numbers.
    work : as :func:`work_arrays` makes them, for all heights of the fullest cell.
    column, row : (c,) uint16, out; count : (c,) uint32, out; mean, robust, low, high : (c,) float64, out, heights (m).
    deviation, bright : (c,) float32, out, standard deviation (m), mean intensity. c : all cells of the tile's groups.
    pass_offsets : (c + 1,) int32, out; pass_ids : (c · p,) uint16, out.

    Returns
    -------
    cells, ids : int, how many cells and pass ids were written.
    """
    lines, heads, bases, chain, free, spare, held = pool
    pairs, heights, counts, light, marks, own_bases, out, many, select = work
    per_row = (edge + LANES - 1) // LANES
    cell, written = 0, 0
    for k in range(taken):
        group = np.int64(found[k])
        element = np.int64(groups[group])
        later = np.uint64(groups[found[k + AHEAD]]) * np.uint64(LANES * LINE)
        for lane in range(LANES):
            fetch_line(lines, later + np.uint64(lane * LINE))
        fetch_line(chain, later // np.uint64(LINE))
        fetch_line(bases, later // np.uint64(LINE))
        first_line = element * LANES
        open_group(lines, np.uint64(first_line * LINE), pairs, counts, light, marks)
        longer = chained_lanes(chain, np.uint64(first_line))
        if longer:
            put_apart(pairs, heights)
            add_chains(first_line, longer, lines, heads, bases, chain, heights, counts, light, marks)
        most, least = np.int32(0), counts[0]
        for lane in range(LANES):
            most, least = max(most, counts[lane]), min(least, counts[lane])
            own_bases[lane] = bases[first_line + lane]
        if most <= 8 and not longer:
            line_statistics_of_8(pairs, counts, light, own_bases, floor, quantum_m, out)
        elif not longer:
            line_statistics_of_28(pairs, counts, light, own_bases, floor, quantum_m, out)
        elif most <= AT_ONCE:
            statistics_of_64(heights, counts, light, own_bases, floor, quantum_m, out)
        else:
            for lane in range(LANES):
                if counts[lane] > 0:
                    n, shine = gather_many(first_line + lane, lines, heads, bases, chain, many)
                    statistics_of_full(many[:n], shine, floor, quantum_m, select, out, lane)
        if least > 0 and numbers.size == 1:
            store_group(
                out, counts, np.uint16((group % per_row) * LANES), np.uint16(group // per_row), np.uint64(cell),
                np.int32(written), numbers[0], column, row, count, mean, robust, low, high, deviation, bright,
                pass_offsets, pass_ids,
            )  # fmt: skip
            cell += LANES
            written += LANES
            release(element, longer, chain, free, spare, held)
            groups[group] = -1
            continue
        for lane in range(LANES):
            if counts[lane] > 0:
                column[cell] = (group % per_row) * LANES + lane
                row[cell] = group // per_row
                count[cell] = counts[lane]
                mean[cell], robust[cell], low[cell], high[cell] = out[0, lane], out[1, lane], out[2, lane], out[3, lane]
                deviation[cell], bright[cell] = np.float32(out[4, lane]), np.float32(out[5, lane])
                pass_offsets[cell] = written
                written = write_passes(first_line + lane, marks[lane], numbers, heads, chain, written, pass_ids)
                cell += 1
        release(element, longer, chain, free, spare, held)
        groups[group] = -1
    pass_offsets[cell] = written
    return cell, written
