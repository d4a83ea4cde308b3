"""Heights of a tile's cells → statistics, in whole numbers: equal to the bit whatever the order of the readings."""

from __future__ import annotations

import math

import numpy as np

from roadscan.kernels.accumulate import LANES
from roadscan.kernels.lanes import medians_of_8, medians_of_16, medians_of_32, medians_of_64
from roadscan.kernels.options import inlined, kernel

MAD_TO_SIGMA = 1.4826
OUTLIER_SIGMAS = 3.0
AT_ONCE = 64
"""Heights a cell of which sixteen cells are worked on together; fuller cells are taken one by one."""


@inlined
def reach_of(deviation, floor_quanta):
    """Farthest from the median (quanta) that a height counts, by the median of the distances from it."""
    return np.int64(math.floor(max(OUTLIER_SIGMAS * MAD_TO_SIGMA * deviation, floor_quanta)))


@inlined
def spread_of(heights, first, end, median, reach, sums):
    """Sums over heights [first, end) of their distances d from the median.

    sums : (6,) int64, in/out: Σ d, Σ d², number and Σ d of those within reach, lowest d, highest d.
    """
    total, squares, used, near, low, high = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    for k in range(first, end):
        d = np.int64(heights[k]) - median
        total += d
        squares += d * d
        inside = (d <= reach) & (d >= -reach)
        used += inside
        near += d * inside
        low = min(low, d)
        high = max(high, d)
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = total, squares, used, near, low, high


@kernel
def gather(head, slots, bases, chain, filled, heights, counts):
    """Heights of a group's chain as columns of a table, relative to the first base. Returns the largest count.

    heights : (AT_ONCE, 16) int32, out, as far as it reaches; counts : (16,) int32, out, all heights there are.
    """
    most = 0
    for lane in range(LANES):
        counts[lane] = filled[head, lane]
    for lane in range(LANES):
        for k in range(counts[lane]):
            heights[k, lane] = slots[head, lane, k]
        most = max(most, counts[lane])
    e = chain[head]
    while e >= 0:
        shift = bases[e] - bases[head]
        for lane in range(LANES):
            size = np.int32(filled[e, lane])
            for k in range(min(size, AT_ONCE - counts[lane])):
                heights[counts[lane] + k, lane] = slots[e, lane, k] + shift
            counts[lane] += size
            most = max(most, counts[lane])
        e = chain[e]
    return most


@kernel
def middle_of(head, lane, slots, bases, chain, filled, size, work):
    """Lower median of a cell of any size, relative to the first base, and the lower median of the distances."""
    n = 0
    e = head
    while e >= 0:
        for k in range(filled[e, lane]):
            work[n] = np.int64(slots[e, lane, k]) + bases[e] - bases[head]
            n += 1
        e = chain[e]
    own = work[:size]
    own.sort()
    median = own[(size - 1) // 2]
    for k in range(size):
        own[k] = abs(own[k] - median)
    own.sort()
    return median, own[(size - 1) // 2]


@kernel
def release(head, slots_chain, filled, light, marks, free, held):
    """Give a group's elements back."""
    e = head
    while e >= 0:
        for lane in range(LANES):
            filled[e, lane] = 0
            light[e, lane] = 0
            for word in range(marks.shape[2]):
                marks[e, lane, word] = 0
        held[0] -= 1
        free[held[0]] = e
        e = slots_chain[e]


@kernel
def count_cells(groups, chain, filled):
    """Cells of a tile that hold a reading, and how many the fullest holds; groups : (g,) int32, first elements."""
    cells, most = 0, 0
    for group in range(groups.size):
        if groups[group] < 0:
            continue
        for lane in range(LANES):
            count = 0
            e = groups[group]
            while e >= 0:
                count += filled[e, lane]
                e = chain[e]
            cells += count > 0
            most = max(most, count)
    return cells, most


@kernel
def finish_cells(
    groups, edge, slots, bases, chain, filled, light, marks, free, held, floor_quanta, numbers, heights, work,
    column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
):  # fmt: skip
    """Statistics of all cells of a tile that hold a reading, in order of row and column; its groups are given back.

    Parameters
    ----------
    groups … held : see ``kernels.accumulate``; groups is the tile's own row, in/out, −1 everywhere when done.
    floor_quanta : int64, distance from the median up to which heights always count.
    numbers : (p,) uint16, ascending, ids of the passes that the bits of `marks` stand for.
    heights : (AT_ONCE, 16) int32, work; work : int64, work, as many as the fullest cell holds.
    column, row, count, mean, robust, low, high, deviation, bright : (c,) out; heights in quanta, float64.
    pass_offsets : (c + 1,) int32, out; pass_ids : (c · p,) uint16, out.

    Returns
    -------
    int, how many pass ids were written.
    """
    per_row = (edge + LANES - 1) // LANES
    counts = np.zeros(LANES, np.int32)
    medians = np.zeros(LANES, np.int32)
    deviations = np.zeros(LANES, np.int32)
    sums = np.zeros(6, np.int64)
    cell, written = 0, 0
    for group in range(groups.size):
        head = groups[group]
        if head < 0:
            continue
        most = gather(head, slots, bases, chain, filled, heights, counts)
        if most <= 8:
            medians_of_8(heights, counts, medians, deviations)
        elif most <= 16:
            medians_of_16(heights, counts, medians, deviations)
        elif most <= 32:
            medians_of_32(heights, counts, medians, deviations)
        elif most <= AT_ONCE:
            medians_of_64(heights, counts, medians, deviations)
        first_column = (group % per_row) * LANES
        for lane in range(LANES):
            size = np.int64(counts[lane])
            if size == 0:
                continue
            middle, away = np.int64(medians[lane]), np.int64(deviations[lane])
            if most > AT_ONCE:
                middle, away = middle_of(head, lane, slots, bases, chain, filled, size, work)
            median = middle + bases[head]
            reach = reach_of(away, floor_quanta)
            sums[:4] = 0
            sums[4], sums[5] = np.int64(1) << 40, -(np.int64(1) << 40)
            shine = np.int64(0)
            e = head
            while e >= 0:
                spread_of(slots[e, lane], 0, np.int64(filled[e, lane]), median - bases[e], reach, sums)
                shine += light[e, lane]
                e = chain[e]
            total = sums[0]
            column[cell] = first_column + lane
            row[cell] = group // per_row
            count[cell] = size
            low[cell] = median + sums[4]
            high[cell] = median + sums[5]
            mean[cell] = median + total / size
            robust[cell] = median + sums[3] / sums[2]
            deviation[cell] = math.sqrt(max(sums[1] / size - (total / size) * (total / size), 0.0))
            bright[cell] = shine / size
            pass_offsets[cell] = written
            for p in range(numbers.size):
                seen = False
                e = head
                while e >= 0:
                    seen |= (marks[e, lane, p >> 3] >> (p & 7)) & 1 == 1
                    e = chain[e]
                if seen:
                    pass_ids[written] = numbers[p]
                    written += 1
            cell += 1
        release(head, chain, filled, light, marks, free, held)
        groups[group] = -1
    pass_offsets[cell] = written
    return written
